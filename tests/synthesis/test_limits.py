"""What a filled gap may do: ends without jerks, speeds that people reach."""

from __future__ import annotations

import numpy as np
import pytest

from poise.jobs.inbetween.fill import inbetween
from poise.kinematics.feet import off_floor
from poise.motion.rotations import quat_angle, quat_conj, quat_mul
from poise.motion.vectors import norm
from poise.synthesis.limits import calmed, excess, fastest, spread
from toy_human import human, swing, turn

FPS = 30.0


def test_what_is_missed_is_spread_over_the_whole_gap() -> None:
    """Frames that end 0.5 m and 0.6 rad off their keyframe reach it, and none of them jumps."""
    n = 29
    t = np.arange(1, n + 1, dtype=float)[:, None]
    root = np.concatenate((0.01 * t, 0 * t, 0 * t), 1)
    rot = turn("z", 0.01 * t[:, 0])[:, None]
    ends = (
        np.array([[0.0, 0, 0], [0.8, 0, 0]], dtype=float),
        turn("z", np.array([0.0, 0.9], dtype=float))[:, None],
    )
    got = spread(ends, (root, rot))
    whole = np.concatenate((ends[0][:1], got[0], ends[0][1:]))
    step = norm(np.diff(whole, axis=0))
    assert float(step.max()) < 1.6 * 0.8 / (n + 1) + 0.01
    assert float(step[-1]) < 0.015
    turned = np.concatenate((ends[1][:1], got[1], ends[1][1:]))[:, 0]
    angle = quat_angle(quat_mul(turned[1:], quat_conj(turned[:-1])))
    assert float(angle.max()) < 0.06 and float(angle[-1]) < 0.015
    # Frames that miss nothing stay.
    right = (np.array([[0.0, 0, 0], [0.3, 0, 0]], dtype=float), rot[[0, -1]].copy())
    right[1][0], right[1][1] = turn("z", np.array([0.0, 0.3], dtype=float))[:, None]
    same = spread(right, (root, rot))
    np.testing.assert_allclose(same[0], root, atol=1e-7)
    assert float(quat_angle(quat_mul(same[1], quat_conj(rot))).max()) < 1e-6


def test_the_network_is_followed_as_far_as_people_reach() -> None:
    plain = np.zeros((4, 3)), turn("x", np.zeros(4))[:, None]
    wild = np.ones((4, 3)), turn("x", np.ones(4))[:, None]

    def over(motion: tuple[np.ndarray, np.ndarray]) -> float:
        return float(motion[0].max()) / 0.6

    got = calmed(wild, plain, lambda m, feet: m, over)
    assert (got.share, got.feet) == (0.5, "held")
    np.testing.assert_allclose(got.motion[0], np.full((4, 3), 0.5), atol=1e-7)
    # Where held feet are the fault, they are let go.
    got = calmed(wild, plain, lambda m, feet: (m[0] + 5.0 * (feet == "held"), m[1]), over)
    assert (got.share, got.feet) == (0.5, "free")
    # Where nothing helps it is said by how much.
    got = calmed(wild, plain, lambda m, feet: (m[0] + 1.2, m[1]), over)
    assert got.share == 0.0 and got.over == pytest.approx(2.0)


def test_speeds_and_heights_of_a_skeleton() -> None:
    clip = swing(1.0)
    root, rot = clip.arrays()
    limits = fastest(clip.skeleton)
    hands = [n for n in clip.skeleton.names if "Hand" in n]
    assert float(limits[clip.skeleton.names.index(hands[0])]) == 9.0
    assert excess(clip.skeleton, limits, (root, rot), clip.fps)[0] < 1.0
    root = root.copy()
    root[10:, 0] += 0.5
    factor, joint = excess(clip.skeleton, limits, (root, rot), clip.fps)
    assert factor > 3.0 and limits[joint] < 5.0
    up = root.copy()
    up[5, 2] += 0.4
    height = off_floor(clip.skeleton, (up, rot))
    assert float(height[5]) > 0.3 and float(np.abs(height[[0, 1, 2]]).max()) < 0.1


def test_keyframes_that_ask_for_too_much_are_named() -> None:
    """Hips that are 3 m away a tenth of a second later cannot be; the frames are named."""
    clip = swing(2.0)
    root = clip.root_pos.copy()
    root[33:, 0] += 3.0
    far = clip.replaced(root_pos=root)
    made = inbetween(far, (0, 30, 33, 59), adapt=0)
    assert any("more than people reach" in w and "30 to 33" in w for w in made.warnings)
    assert human().names == clip.skeleton.names


def test_keyframes_under_the_floor_are_named() -> None:
    clip = swing(2.0)
    root = clip.root_pos.copy()
    root[28:33, 2] -= 0.6
    made = inbetween(clip.replaced(root_pos=root), (0, 30, 59), adapt=0)
    (said,) = [w for w in made.warnings if w.startswith("keyframe ") and "under the floor" in w]
    assert said.startswith("keyframe 30 lies 0.") and "no body can be" in said
    # A file with a floor of its own, and a jump, are no mistake.
    low = clip.replaced(root_pos=clip.root_pos - (0.0, 0.0, 2.0))
    assert not any(w.startswith("keyframe ") for w in inbetween(low, (0, 30, 59), adapt=0).warnings)
    up = clip.root_pos.copy()
    up[30, 2] += 0.5
    raised = clip.replaced(root_pos=up)
    said = inbetween(raised, (0, 30, 59), adapt=0).warnings
    assert not any(w.startswith("keyframe ") for w in said)
