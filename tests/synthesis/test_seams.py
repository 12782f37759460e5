"""Ends that meet in place and speed, other rates, gaps, and feet that stay."""

from __future__ import annotations

import pytest
import torch

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
from poise.motion.windows import foot_joints
from poise.synthesis.filler import check_keyframes, split_gaps
from poise.synthesis.limits import fade, meet, sampled
from refusals import refused
from toy_human import swing, turn


def path(frames: int = 30, joints: int = 3) -> tuple[torch.Tensor, torch.Tensor]:
    g = torch.Generator().manual_seed(0)
    root = torch.randn(frames, 3, generator=g, dtype=torch.float64).cumsum(0) * 0.03
    angle = torch.randn(frames, joints, generator=g, dtype=torch.float64).cumsum(0) * 0.1
    axis = normalize(torch.randn(joints, 3, generator=g, dtype=torch.float64))
    return root, axis_angle_to_quat(axis.expand(frames, joints, 3), angle)


def turned(rot: torch.Tensor, a: int, b: int) -> torch.Tensor:
    return quat_mul(rot[b], quat_conj(rot[a]))


@pytest.mark.parametrize("length", [2, 3, 7, 40])
@pytest.mark.parametrize("blend", [1, 6])
def test_both_ends_are_met_in_place_and_speed(length: int, blend: int) -> None:
    root, rot = path(length + 4)
    made, turns = meet(root, rot, 2, 2, blend)
    end = length + 2
    for kept in (0, 1, end, end + 1):
        assert torch.equal(made[kept], root[kept])
        assert torch.allclose((turns[kept] * rot[kept]).sum(-1).abs(), torch.ones(3).double())
    assert torch.allclose(made[2] - made[1], made[1] - made[0], atol=1e-12)
    assert torch.allclose(made[end] - made[end - 1], made[end + 1] - made[end], atol=1e-12)
    for (a, b), (c, d) in (((0, 1), (1, 2)), ((end - 1, end), (end, end + 1))):
        apart = quat_angle(quat_mul(turned(turns, a, b), quat_conj(turned(turns, c, d))))
        assert float(apart.max()) < 1e-6


def test_frames_far_from_the_ends_stay_as_they_were() -> None:
    root, rot = path(44)
    made, _ = meet(root, rot, 2, 2, 5)
    assert torch.equal(made[8:36], root[8:36]) and not torch.equal(made[3], root[3])


def test_a_lone_keyframe_is_reached_in_the_motions_own_speed() -> None:
    root = torch.linspace(0, 1.1, 12, dtype=torch.float64)[:, None].repeat(1, 3)
    rot = path(12)[1][:1].repeat(12, 1, 1)
    # A motion that leads there already stays as it is.
    assert torch.allclose(meet(root, rot, 1, 1, 5)[0], root)
    # One that stops 0.3 m short is brought there without a jump.
    root[-1] += 0.3
    made = meet(root, rot, 1, 1, 5)[0]
    steps = torch.diff(made[:, 0])
    assert torch.equal(made[[0, 11]], root[[0, 11]]) and torch.allclose(made[:6], root[:6])
    assert float(torch.diff(steps).abs().max()) < 0.05 and float(steps.sum()) == pytest.approx(1.4)
    # One frame between two moving ends takes the mean of both wishes.
    root, rot = path(12)
    one = meet(root[:5], rot[:5], 2, 2, 5)[0]
    assert torch.allclose(one[2], 0.5 * ((2 * root[1] - root[0]) + (2 * root[3] - root[4])))
    assert torch.equal(meet(root[:2], rot[:2], 1, 1, 5)[0], root[:2])


def test_weights_fade_to_nothing_at_the_other_end() -> None:
    assert fade(5, 2).tolist() == pytest.approx([1, 0.5, 0, 0, 0])
    assert fade(3, 9).tolist() == pytest.approx([1, 0.5, 0])
    assert fade(1, 4).tolist() == [1.0]


def test_other_rates_run_through_every_frame() -> None:
    root, rot = path()
    at = torch.arange(30).double()
    same, turns = sampled(root, rot, at)
    assert torch.allclose(same, root, atol=1e-12)
    assert torch.allclose((turns * rot).sum(-1).abs(), torch.ones(30, 3).double())
    # A line stays a line between its frames (the ends repeat themselves).
    line = torch.arange(10).double()[:, None].expand(10, 3)
    got = sampled(line, rot[:10], torch.tensor([2.25, 5.5]))[0]
    assert got[:, 0].tolist() == pytest.approx([2.25, 5.5])
    assert torch.equal(sampled(root[:1], rot[:1], torch.zeros(3).double())[0], root[:1].expand(3, 3))


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


def bent() -> tuple[Skeleton, torch.Tensor, torch.Tensor]:
    """A body that sways with bent knees, so that feet can be reached for."""
    clip = swing(1.0, bend=0.3)
    root, rot = clip.tensors()
    sway = 0.03 * torch.sin(torch.linspace(0, 6, 31, dtype=torch.float64))
    for side in ("Left", "Right"):
        rot[:, clip.skeleton.index(f"{side}UpLeg")] = turn("Y", -0.4 + sway)
        rot[:, clip.skeleton.index(f"{side}Leg")] = turn("Y", torch.full((31,), 0.8).double())
    return clip.skeleton, root, rot


def test_feet_stay_where_they_stand_and_nothing_else_moves() -> None:
    s, root, rot = bent()
    feet, offsets = foot_joints(s), torch.tensor(s.offsets.copy())
    contact = torch.zeros(31, 4, dtype=torch.bool)
    contact[5:20, :2] = True
    free = torch.ones(31, dtype=torch.bool)
    free[[0, 30]] = False
    held = lock_feet(s, feet, root, rot, contact, free, 30.0)
    before, after = (forward_kinematics(s.parents, offsets, root, r)[0] for r in (rot, held))
    left = feet[0]
    assert float(torch.diff(before[5:20, left], dim=0).norm(dim=-1).max()) > 2e-3
    assert float(torch.diff(after[6:19, left], dim=0).norm(dim=-1).max()) < 1e-4
    # The other leg, the frames far away, bone lengths and the kept frames are as before.
    assert torch.allclose(after[:, feet[2]], before[:, feet[2]], atol=1e-12)
    assert torch.allclose(after[28:], before[28:], atol=4e-3)
    assert torch.equal(held[0], rot[0]) and torch.equal(held[30], rot[30])
    assert torch.allclose(held.norm(dim=-1), torch.ones(31, len(s), dtype=torch.float64))


def test_a_spell_that_touches_a_keyframe_stands_where_the_keyframe_does() -> None:
    s, root, rot = bent()
    feet, offsets = foot_joints(s), torch.tensor(s.offsets.copy())
    contact = torch.zeros(31, 4, dtype=torch.bool)
    contact[0:10, :2] = True
    free = torch.ones(31, dtype=torch.bool)
    free[0] = False
    held = lock_feet(s, feet, root, rot, contact, free, 30.0)
    pos = forward_kinematics(s.parents, offsets, root, held)[0]
    assert float((pos[:10, feet[0]] - pos[0, feet[0]]).norm(dim=-1).max()) < 2e-3
