"""Hands that stay where they are on another skeleton: known truth by hand, real pairs."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from test_retarget import CLIPS, real, walk

from poise.kinematics import RetargetConfig, retarget
from poise.kinematics.limbs import match_positions
from poise.kinematics.retargeting.hands import APART, TOUCHES, _calm
from poise.kinematics.retargeting.passage import Retargeter
from poise.kinematics.retargeting.plant import FOLDED
from poise.metrics import jerk
from poise.motion import Clip, Skeleton
from poise.motion.roles import SIDES, find_roles
from poise.motion.smoothing import eased
from toy_human import human, swing

PLACE = RetargetConfig(hands="place")
#: Places of the hands, from the chest of the toy, m: in front, and clear of the body.
AHEAD = {"Left": (0.42, 0.35, 0.1), "Right": (0.38, -0.4, 0.2)}


def reaching(at: dict[str, tuple[float, float, float]] = AHEAD, joint: str = "Chest") -> Clip:
    """A walk with both wrists at places from a joint, in the world's axes."""
    clip = swing(seconds=1.0, speed=1.0)
    goals: dict[int | str, np.ndarray] = {
        f"{side}Hand": clip.positions()[:, clip.skeleton.index(joint)] + np.array(place)
        for side, place in at.items()
    }
    return clip.replaced(rot=match_positions(clip.skeleton, clip.rot, clip.root_pos, goals))


def changed(**factors: float) -> Skeleton:
    """The toy with joints that are farther from their parents."""
    skeleton = human()
    offsets = np.array(skeleton.offsets)
    for name, factor in factors.items():
        for j in (k for k, n in enumerate(skeleton.names) if n.endswith(name)):
            offsets[j] = offsets[j] * factor
    return replace(skeleton, offsets=offsets)


def wrists(clip: Clip) -> dict[str, np.ndarray]:
    pos = clip.positions()
    return {side: pos[:, clip.skeleton.index(f"{side}Hand")] for side in AHEAD}


def test_hands_in_front_stay_though_arms_are_longer() -> None:
    clip, other = reaching(), changed(ForeArm=1.15, Hand=1.25)
    made, report = retarget(clip, other, config=PLACE)
    off, _ = retarget(clip, other)
    lengths = [float(np.linalg.norm(other.offsets[other.index(n)])) for n in ("LeftForeArm", "LeftHand")]
    for side, want in wrists(clip).items():
        np.testing.assert_allclose(wrists(made)[side], want, atol=1e-6)
        assert np.linalg.norm(wrists(off)[side] - want, axis=-1).mean() > 0.05
        # The law of cosines tells the elbow.
        pos = made.positions()
        a, b, c = (pos[:, other.index(side + n)] for n in ("Arm", "ForeArm", "Hand"))
        far = np.linalg.norm(want - a, axis=-1)
        bend = (far**2 - lengths[0] ** 2 - lengths[1] ** 2) / (2 * lengths[0] * lengths[1])
        cosine = ((b - a) * (c - b)).sum(-1) / lengths[0] / lengths[1]
        np.testing.assert_allclose(cosine, bend, atol=1e-6)
    assert report.hands_percent is not None and max(report.hands_percent) < 1e-4
    assert dict(report.ends)["left hand"] < 1e-4 and dict(report.ends)["left foot"] < 1e-6


def test_a_giants_hands_are_where_the_source_has_them_at_its_size() -> None:
    clip = reaching()
    offsets = np.array(human(2.0).offsets)
    arms = [k for k, n in enumerate(human().names) if n.endswith(("ForeArm", "Hand"))]
    offsets[arms] *= 1.2
    made, report = retarget(clip, replace(human(2.0), offsets=offsets), config=PLACE)
    assert report.scale == pytest.approx(2.0)
    for side, want in wrists(clip).items():
        np.testing.assert_allclose(
            np.diff(wrists(made)[side], axis=0), 2 * np.diff(want, axis=0), atol=1e-6
        )
        # Over the floor, too, which lies where the toes tread.
        ground = report.ground_m
        np.testing.assert_allclose(
            wrists(made)[side][:, 2] - ground, 2 * (want[:, 2] - ground), atol=1e-6
        )
    apart = [np.linalg.norm(w["Left"] - w["Right"], axis=-1) for w in (wrists(made), wrists(clip))]
    np.testing.assert_allclose(apart[0], 2 * apart[1], atol=1e-6)


def test_a_hand_on_the_head_goes_with_the_head() -> None:
    # A neck that is 15 cm longer: the place from the hips would be the chin.
    at = {"Left": (0.1, 0.06, 0.03), "Right": (0.45, -0.1, 0.1)}
    clip = reaching(at, "Head")
    other = changed(Neck=1.7, ForeArm=1.3, Hand=1.3)
    made, report = retarget(clip, other, config=PLACE)
    head = [c.positions()[:, c.skeleton.index("Head")] for c in (clip, made)]
    assert np.linalg.norm(head[1] - head[0], axis=-1).mean() > 0.14
    before, after = wrists(clip)["Left"] - head[0], wrists(made)["Left"] - head[1]
    assert np.linalg.norm(after - before, axis=-1).max() < 0.02
    # The other one is in front of it and stays where it is.
    away = np.linalg.norm(wrists(made)["Right"] - wrists(clip)["Right"], axis=-1)
    assert away.max() < 0.02
    assert report.hands_percent is not None and report.hands_percent[1] < 0.5


def test_arms_that_are_too_short_reach_towards_it_and_elbows_keep_their_range() -> None:
    clip, other = reaching(), changed(ForeArm=0.75, Hand=0.75)
    made, report = retarget(clip, other, config=PLACE)
    off, _ = retarget(clip, other)
    for side, want in wrists(clip).items():
        far = [np.linalg.norm(wrists(c)[side] - want, axis=-1).mean() for c in (made, off)]
        assert far[0] < far[1]
        a, c = (made.positions()[:, other.index(side + n)] for n in ("Arm", "Hand"))
        line, way = c - a, want - a
        cosine = (line * way).sum(-1) / np.linalg.norm(line, axis=-1) / np.linalg.norm(way, axis=-1)
        np.testing.assert_allclose(cosine, 1.0, atol=1e-6)
    assert report.hands_percent is not None and report.hands_percent[0] > 1.0
    assert "in frames in which an arm is too short" in " ".join(report.sentences())
    # A hand 20 cm from the shoulder, arms twice as long: the elbow would have to fold by 159 degrees.
    near = reaching({"Left": (0.2, 0.19, 0.16), "Right": (0.4, -0.4, 0.1)})
    made, report = retarget(near, changed(ForeArm=2.0, Hand=2.0), config=PLACE)
    assert math.radians(140) < bend(made, "left").max() <= FOLDED + 1e-6
    assert report.hands_percent is not None and report.hands_percent[1] > 1.0


def bend(clip: Clip, side: str) -> np.ndarray:
    """rad, of an elbow."""
    roles, pos = find_roles(clip.skeleton), clip.positions()
    a, b, c = (pos[:, roles.joint(f"{side}_{k}") or 0] for k in ("upper_arm", "forearm", "hand"))
    u, v = b - a, c - b
    cosine = (u * v).sum(-1) / np.linalg.norm(u, axis=-1) / np.linalg.norm(v, axis=-1)
    return np.arccos(np.clip(cosine, -1.0, 1.0))


@pytest.mark.parametrize("name", CLIPS)
def test_real_clips_onto_themselves_change_nothing(name: str, data_dir) -> None:
    clip = real(data_dir, name)
    made, report = retarget(clip, clip, config=PLACE)
    assert np.abs(made.positions() - clip.positions()).max() < 1e-6
    assert report.hands_percent is not None and report.hands_percent[1] < 1e-4


def test_hands_of_real_pairs_are_nearer_and_as_smooth(data_dir) -> None:
    """Seen from the hips, in percent of their height: a third of what it is with directions kept, though
    some arms are too short; wrists jerk no more, and elbows stay in their range."""
    ends = list[tuple[float, float]]()
    for a in ("bandai", "salsa", "deepmimic"):
        for b in ("lafan", "cmu", "mass"):
            clip, onto = real(data_dir, a), real(data_dir, b)
            made, report = retarget(clip, onto, config=PLACE)
            off, before = retarget(clip, onto)
            passage = Retargeter.between(clip, onto)
            for side in SIDES:
                name = f"{side} hand"
                ends.append((dict(before.ends)[name], dict(report.ends)[name]))
                assert ends[-1][1] < ends[-1][0], (a, b, name, ends[-1])
                pair = passage.joints.limb_pair(f"{side}_hand")
                assert pair is not None
                scaled = passage.scale.place(clip.positions()[:, pair[0]])
                paths = scaled, off.positions()[:, pair[1]], made.positions()[:, pair[1]]
                size, plain, kept = (float(jerk(p[:, None], clip.fps).mean()) for p in paths)
                assert kept < 1.15 * max(size, plain), (a, b, name)
                most = max(float(bend(clip, side).max()), FOLDED)
                assert float(bend(made, side).max()) < most + 0.02
            np.testing.assert_array_equal(made.skeleton.offsets, onto.skeleton.offsets)
            assert report.slide_mm_s[1] <= 1.1 * report.slide_mm_s[0] + 2.0
    was, now = np.mean(ends, axis=0)
    assert was > 8.0 and now < 0.35 * was


def test_what_a_hand_goes_with_changes_smoothly() -> None:
    assert 0 < TOUCHES < APART < 1
    path = np.zeros((40, 3))
    path[20:] = 1.0
    calm = _calm(path, 2.0, False)
    assert calm[0, 0] == 0.0 and calm[-1, 0] == pytest.approx(1.0)
    assert np.diff(calm[:, 0]).max() < 0.25 and np.diff(calm[:, 0]).min() >= 0
    # A cycle's ends are one moment.
    circle = np.sin(np.linspace(0, 2 * math.pi, 41))[:, None] * np.ones(3)
    calm = _calm(circle, 1.5, True)
    np.testing.assert_allclose(calm[0], calm[-1])
    np.testing.assert_allclose(calm, circle * calm[10, 0], atol=1e-3)


def test_without_hands_directions_are_kept() -> None:
    clip = walk()
    legs = [k for k, n in enumerate(human().names) if "Arm" not in n and "Hand" not in n]
    names = [human().names[k] for k in legs]
    parents = [legs.index(human().parents[k]) if k else -1 for k in legs]
    other = Skeleton(tuple(names), tuple(parents), human().offsets[legs])
    made, report = retarget(clip, other, config=PLACE)
    plain, _ = retarget(clip, other)
    np.testing.assert_array_equal(made.rot, plain.rot)
    assert report.hands_percent is None


def test_eased_keeps_what_is_slow_and_follows_no_more_than_it_must() -> None:
    fps, t = 60.0, np.arange(240) / 60.0
    slow, quick = np.sin(2 * np.pi * t)[:, None], 0.1 * np.sin(2 * np.pi * 15 * t)[:, None]
    made = eased(slow + quick, np.ones(240), fps, 4.0)
    np.testing.assert_allclose(made[20:-20], slow[20:-20], atol=2e-3)
    # A path goes on smoothly in frames that count for nothing, and follows those that count for much.
    weight = np.where(t < 2.0, 1e6, 0.0)
    made = eased(slow + quick, weight, fps, 4.0)
    np.testing.assert_allclose(made[:110], (slow + quick)[:110], atol=1e-3)
    assert np.abs(np.diff(made[130:], 3, axis=0)).max() < 0.1 * np.abs(np.diff(quick, 3, axis=0)).max()
