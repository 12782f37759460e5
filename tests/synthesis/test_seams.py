"""Ends that meet in place and speed, other rates, gaps, and feet that stay."""

from __future__ import annotations

import numpy as np
import pytest

from poise.kinematics.steps import lock_feet
from poise.motion import Skeleton
from poise.motion.rotations import (
    axis_angle_to_quat,
    forward_kinematics,
    normalize,
    quat_angle,
    quat_conj,
    quat_mul,
)
from poise.motion.vectors import norm
from poise.synthesis.filler import check_keyframes, split_gaps
from poise.synthesis.limits import fade, meet, sampled
from poise.synthesis.windows import foot_joints
from refusals import refused
from toy_human import swing, turn


def path(frames: int = 30, joints: int = 3) -> tuple[np.ndarray, np.ndarray]:
    g = np.random.default_rng(0)
    root = g.normal(size=(frames, 3)).cumsum(0) * 0.03
    angle = g.normal(size=(frames, joints)).cumsum(0) * 0.1
    axis = normalize(g.normal(size=(joints, 3)))
    return root, axis_angle_to_quat(np.broadcast_to(axis, (frames, joints, 3)), angle)


def turned(rot: np.ndarray, a: int, b: int) -> np.ndarray:
    return quat_mul(rot[b], quat_conj(rot[a]))


@pytest.mark.parametrize("length", [2, 3, 7, 40])
@pytest.mark.parametrize("blend", [1, 6])
def test_both_ends_are_met_in_place_and_speed(length: int, blend: int) -> None:
    root, rot = path(length + 4)
    made, turns = meet(root, rot, 2, 2, blend)
    end = length + 2
    for kept in (0, 1, end, end + 1):
        assert np.array_equal(made[kept], root[kept])
        assert np.allclose(np.abs((turns[kept] * rot[kept]).sum(-1)), np.ones(3).astype(float))
    assert np.allclose(made[2] - made[1], made[1] - made[0], atol=1e-12)
    assert np.allclose(made[end] - made[end - 1], made[end + 1] - made[end], atol=1e-12)
    for (a, b), (c, d) in (((0, 1), (1, 2)), ((end - 1, end), (end, end + 1))):
        apart = quat_angle(quat_mul(turned(turns, a, b), quat_conj(turned(turns, c, d))))
        assert float(apart.max()) < 1e-6


def test_frames_far_from_the_ends_stay_as_they_were() -> None:
    root, rot = path(44)
    made, _ = meet(root, rot, 2, 2, 5)
    assert np.array_equal(made[8:36], root[8:36]) and not np.array_equal(made[3], root[3])


def test_a_lone_keyframe_is_reached_in_the_motions_own_speed() -> None:
    root = np.tile(np.linspace(0, 1.1, 12)[:, None], (1, 3))
    rot = np.repeat(path(12)[1][:1], 12, 0)
    # A motion that leads there already stays as it is.
    assert np.allclose(meet(root, rot, 1, 1, 5)[0], root)
    # One that stops 0.3 m short is brought there without a jump.
    root[-1] += 0.3
    made = meet(root, rot, 1, 1, 5)[0]
    steps = np.diff(made[:, 0])
    assert np.array_equal(made[[0, 11]], root[[0, 11]]) and np.allclose(made[:6], root[:6])
    assert float(np.abs(np.diff(steps)).max()) < 0.05 and float(steps.sum()) == pytest.approx(1.4)
    # One frame between two moving ends takes the mean of both wishes.
    root, rot = path(12)
    one = meet(root[:5], rot[:5], 2, 2, 5)[0]
    assert np.allclose(one[2], 0.5 * ((2 * root[1] - root[0]) + (2 * root[3] - root[4])))
    assert np.array_equal(meet(root[:2], rot[:2], 1, 1, 5)[0], root[:2])


def test_weights_fade_to_nothing_at_the_other_end() -> None:
    assert fade(5, 2).tolist() == pytest.approx([1, 0.5, 0, 0, 0])
    assert fade(3, 9).tolist() == pytest.approx([1, 0.5, 0])
    assert fade(1, 4).tolist() == [1.0]


def test_other_rates_run_through_every_frame() -> None:
    root, rot = path()
    at = np.arange(30).astype(float)
    same, turns = sampled(root, rot, at)
    assert np.allclose(same, root, atol=1e-12)
    assert np.allclose(np.abs((turns * rot).sum(-1)), np.ones((30, 3)).astype(float))
    # A line stays a line between its frames (the ends repeat themselves).
    line = np.broadcast_to(np.arange(10).astype(float)[:, None], (10, 3))
    got = sampled(line, rot[:10], np.array([2.25, 5.5]))[0]
    assert got[:, 0].tolist() == pytest.approx([2.25, 5.5])
    assert np.array_equal(
        sampled(root[:1], rot[:1], np.zeros(3).astype(float))[0], np.broadcast_to(root[:1], (3, 3))
    )


def test_keyframes_that_make_no_sense_are_told_apart() -> None:
    assert check_keyframes((0, 30, 45), 50) == (0, 30, 45)
    for keys, words in (
        ((3,), ("too-few-keyframes",)),
        ((0, 50), ("frame-outside", "50")),
        ((-1, 5), ("frame-outside", "-1")),
        ((0, 7, 7), ("keyframe-repeated", "7")),
        ((0, 9, 7), ("not-rising", ("7", "9"))),
    ):
        with refused(*words):
            check_keyframes(keys, 50)


def test_long_gaps_are_split_and_told() -> None:
    gaps, inserted, warnings = split_gaps((0, 1, 30, 161), 60)
    assert [(g.a, g.b) for g in gaps] == [(1, 30), (30, 74), (74, 117), (117, 161)]
    assert inserted == [74, 117] and len(warnings) == 1 and "74, 117" in warnings[0]
    assert all(g.b - g.a - 1 <= 60 for g in gaps)
    assert split_gaps((0, 61), 60) == ([(0, 61)], [], [])


def bent() -> tuple[Skeleton, np.ndarray, np.ndarray]:
    """A body that sways with bent knees, so that feet can be reached for."""
    clip = swing(1.0, bend=0.3)
    root, rot = clip.arrays()
    sway = 0.03 * np.sin(np.linspace(0, 6, 31))
    for side in ("Left", "Right"):
        rot[:, clip.skeleton.index(f"{side}UpLeg")] = turn("Y", -0.4 + sway)
        rot[:, clip.skeleton.index(f"{side}Leg")] = turn("Y", np.full((31,), 0.8).astype(float))
    return clip.skeleton, root, rot


def test_feet_stay_where_they_stand_and_nothing_else_moves() -> None:
    s, root, rot = bent()
    feet, offsets = foot_joints(s), s.offsets.copy()
    contact = np.zeros((31, 4), dtype=bool)
    contact[5:20, :2] = True
    free = np.ones(31, dtype=bool)
    free[[0, 30]] = False
    held = lock_feet(s, feet, root, rot, contact, free, 30.0)
    before, after = (forward_kinematics(s.parents, offsets, root, r)[0] for r in (rot, held))
    left = feet[0]
    assert float(norm(np.diff(before[5:20, left], axis=0)).max()) > 2e-3
    assert float(norm(np.diff(after[6:19, left], axis=0)).max()) < 1e-4
    # The other leg, the frames far away, bone lengths and the kept frames are as before.
    assert np.allclose(after[:, feet[2]], before[:, feet[2]], atol=1e-12)
    assert np.allclose(after[28:], before[28:], atol=4e-3)
    assert np.array_equal(held[0], rot[0]) and np.array_equal(held[30], rot[30])
    assert np.allclose(norm(held), np.ones((31, len(s))))


def test_a_spell_that_touches_a_keyframe_stands_where_the_keyframe_does() -> None:
    s, root, rot = bent()
    feet, offsets = foot_joints(s), s.offsets.copy()
    contact = np.zeros((31, 4), dtype=bool)
    contact[0:10, :2] = True
    free = np.ones(31, dtype=bool)
    free[0] = False
    held = lock_feet(s, feet, root, rot, contact, free, 30.0)
    pos = forward_kinematics(s.parents, offsets, root, held)[0]
    assert float(norm(pos[:10, feet[0]] - pos[0, feet[0]]).max()) < 2e-3
