"""Turns faster than a human joint are repaired, and nothing else is touched."""

from __future__ import annotations

import math

import numpy as np
import pytest

from poise.body import find_anatomy
from poise.kinematics.repair import speeds
from poise.kinematics.repair.estimate import CleanReport
from poise.kinematics.repair.speeds import (
    ARM_SPEED,
    TRUNK_SPEED,
    limit_speeds,
    speed_limits,
    without_rougher,
)
from poise.motion import Clip
from poise.motion.rotations import quat_angle, quat_conj, quat_mul
from toy_human import human, swing, turn

JOINT = human().index("LeftArm")
ANATOMY = find_anatomy(human())


def twisted(clip: Clip, angles: np.ndarray, joint: int = JOINT) -> Clip:
    """The clip with a joint turned by `angles (T)` rad about its long axis."""
    rot = clip.rot.copy()
    rot[:, joint] = quat_mul(rot[:, joint], turn("Z", angles))
    return clip.replaced(rot=rot)


def apart(a: Clip, b: Clip) -> np.ndarray:
    """Angle `(T, J)` rad between the local rotations of two clips."""
    return quat_angle(quat_mul(quat_conj(a.rot), b.rot))


def fastest(clip: Clip) -> np.ndarray:
    """The largest speed of every joint, rad/s."""
    rot = clip.rot.copy()
    steps = quat_angle(quat_mul(quat_conj(rot[:-1]), rot[1:]))
    return steps.max(0) * clip.fps


@pytest.fixture
def clip() -> Clip:
    return swing(1.0, 120.0, speed=1.0)


def test_a_repair_that_jerks_the_body_more_is_undone(clip):
    """The hips turn for one frame, and what hangs on them turns back: hardly anything moves."""
    turns = np.zeros(clip.frames)
    turns[50] = 0.3
    rot = clip.rot.copy()
    for name, way in (("Hips", turns), ("Spine", -turns), ("LeftUpLeg", -turns), ("RightUpLeg", -turns)):
        j = clip.skeleton.index(name)
        rot[:, j] = quat_mul(turn("X", way), rot[:, j])
    broken = clip.replaced(rot=rot)
    mended, found = limit_speeds(broken, ANATOMY)
    # Hips may be as fast as that, a trunk and thighs may not.
    assert {r.joint for r in found} == {"Spine", "LeftUpLeg", "RightUpLeg"}
    same, repairs, undone = without_rougher(broken, mended, found)
    assert repairs == () and undone == found
    np.testing.assert_array_equal(same.rot, broken.rot)
    (said,) = CleanReport(kept=undone).sentences()
    assert said.startswith("Left faster than a human joint, since mending jerks the body more: Spine ")
    # Where it helps it stays.
    angles = np.zeros(clip.frames)
    angles[50:52] = 2.8
    broken = twisted(clip, angles)
    mended, found = limit_speeds(broken, ANATOMY)
    assert without_rougher(broken, mended, found) == (mended, found, ())


def test_a_clean_clip_comes_back_as_it_is(clip):
    same, found = limit_speeds(clip, ANATOMY)
    assert same is clip and found == ()


@pytest.mark.parametrize("length", [1, 2, 6])
def test_a_brief_turn_is_interpolated_away(clip, length):
    angles = np.zeros(clip.frames)
    angles[50 : 50 + length] = 2.8
    mended, (found,) = limit_speeds(twisted(clip, angles), ANATOMY)
    assert found.joint == "LeftArm" and found.way == "interpolated"
    assert found.before == pytest.approx(2.8 * 120, rel=0.02) and found.after < 10.0
    assert found.change_deg == pytest.approx(math.degrees(2.8), abs=2.0)
    # Within the margin of two frames on each side, and close to the motion that was there.
    assert 47 <= found.start <= 50 and 49 + length <= found.stop <= 52 + length
    assert apart(mended, clip).max() < 0.02
    assert np.array_equal(mended.root_pos, clip.root_pos) and mended.fps == clip.fps
    assert np.abs(np.linalg.norm(mended.rot, axis=-1) - 1).max() < 1e-12


def test_other_joints_and_frames_stay_to_the_last_digit(clip):
    angles = np.zeros(clip.frames)
    angles[50:53] = 2.8
    broken = twisted(clip, angles)
    mended, (found,) = limit_speeds(broken, ANATOMY)
    changed = (mended.rot != broken.rot).any(-1)
    assert changed[found.start : found.stop + 1, JOINT].all()
    changed[found.start : found.stop + 1, JOINT] = False
    assert not changed.any()


def test_a_step_that_stays_is_bridged_by_the_shortest_stretch(clip):
    angles = np.where(np.arange(clip.frames) < 60, 0.0, 1.5)
    mended, (found,) = limit_speeds(twisted(clip, angles), ANATOMY)
    # 1.5 rad at half the limit take 9 frames; the swing itself adds little.
    assert found.way == "interpolated" and 7 <= found.stop - found.start <= 9
    assert fastest(mended)[JOINT] <= ARM_SPEED / 2 + 1e-9


@pytest.mark.parametrize("first", [True, False])
def test_damage_at_an_end_is_held(clip, first):
    angles = np.zeros(clip.frames)
    angles[0 if first else -1] = 2.0
    mended, (found,) = limit_speeds(twisted(clip, angles), ANATOMY)
    # Two frames are held while the arm swings at 3.2 rad/s.
    assert found.way == "held" and found.stop - found.start <= 1 and apart(mended, clip).max() < 0.06
    assert fastest(mended)[JOINT] < 10.0


def test_long_noise_is_smoothed_there_alone(clip):
    rng = np.random.default_rng(0)
    angles = np.zeros(clip.frames)
    angles[40:90] = rng.normal(0.0, 0.4, 50)
    broken = twisted(clip, angles)
    assert fastest(broken)[JOINT] > 1.5 * ARM_SPEED
    mended, found = limit_speeds(broken, ANATOMY)
    assert {f.way for f in found} <= {"interpolated", "smoothed"}
    assert fastest(mended)[JOINT] <= ARM_SPEED + 1e-9
    assert apart(mended, clip).max() < apart(broken, clip).max()
    assert not (mended.rot != broken.rot).any(-1)[:15].any()


def test_every_part_has_its_limit(clip):
    limits = dict(zip(clip.skeleton.names, speed_limits(clip, ANATOMY), strict=True))
    assert limits["LeftFoot"] == limits["Spine"] == TRUNK_SPEED < ARM_SPEED == limits["LeftForeArm"]
    slow = np.where(np.arange(clip.frames) < 60, 0.0, 34.0 / 120.0)
    assert limit_speeds(twisted(clip, slow), ANATOMY)[1] == ()
    (found,) = limit_speeds(twisted(clip, slow, clip.skeleton.index("LeftFoot")), ANATOMY)[1]
    assert found.joint == "LeftFoot"


@pytest.mark.parametrize("seed", range(3))
def test_a_repair_looks_at_its_surroundings_alone(seed, monkeypatch):
    """Cut to its surroundings a spell is mended as on the whole track, in time of its own length."""
    clip = swing(4.0, 120.0, speed=1.0)
    rng = np.random.default_rng(seed)
    angles = np.zeros(clip.frames)
    for at in rng.integers(2, clip.frames - 2, 5):
        angles[at : at + int(rng.integers(1, 12))] += rng.uniform(-3, 3)
    broken = twisted(clip, angles)
    cut, found = limit_speeds(broken, ANATOMY)
    monkeypatch.setattr(speeds, "_around", lambda fps: 10**9)
    whole, other = limit_speeds(broken, ANATOMY)
    assert found and [(f.start, f.stop, f.way) for f in found] == [
        (f.start, f.stop, f.way) for f in other
    ]
    assert np.degrees(apart(cut, whole)).max() < 1e-5
