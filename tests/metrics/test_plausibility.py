"""Sliding, penetration, floating and jerk on motions of known figures."""

from __future__ import annotations

import math

import pytest
import torch

from poise.metrics import (
    KINDS,
    Shapes,
    ballistic,
    floating,
    foot_contacts,
    foot_points,
    foot_slide,
    jerk,
    lowest_points,
    penetration,
    s2h_foot_penetration,
    smoothness,
)
from poise.motion.rotations import axis_angle_to_quat
from refusals import refused

FPS = 30.0


def line(frames, velocity, start=(0.0, 0.0, 0.0), fps=FPS):
    """One point `(T, 1, 3)` in uniform motion."""
    t = torch.arange(frames, dtype=torch.float64).unsqueeze(-1) / fps
    return (torch.tensor(start, dtype=torch.float64) + t * torch.tensor(velocity).double()).unsqueeze(1)


@pytest.mark.parametrize("fps", [30.0, 60.0, 120.0])
def test_a_foot_at_a_tenth_of_a_metre_per_second_slides_100(fps):
    assert foot_slide(line(40, (0.06, 0.08, 0.0), fps=fps), fps) == pytest.approx(100.0)


def test_planted_high_and_landing_feet():
    assert foot_slide(line(10, (0.0, 0.0, 0.0)), FPS) == 0.0
    assert foot_slide(line(10, (1.0, 0.0, 0.0), start=(0, 0, 0.03)), FPS).isnan()
    # A foot that comes down at 0.3 m/s is landing: its forward speed is no slide.
    _, contact = foot_contacts(line(4, (1.0, 0.0, -0.3), start=(0, 0, 0.02)), FPS)
    assert not contact.any()
    # Two points, one planted and one sliding at 50 mm/s.
    both = torch.cat((line(9, (0, 0, 0)), line(9, (0.05, 0, 0))), 1)
    assert foot_slide(both, FPS) == pytest.approx(25.0)


def test_a_swinging_foot_is_no_slide_but_a_skater_is():
    planted, swinging = line(9, (0.02, 0.0, 0.0)), line(9, (3.0, 0.0, 0.0), start=(0, 0, 0.015))
    assert foot_slide(torch.cat((planted, swinging), 1), FPS) == pytest.approx(20.0)
    # Pulled along at walking speed with both feet on the ground: nothing is planted, all counts.
    assert foot_slide(torch.cat((swinging, swinging), 1), FPS) == pytest.approx(3000.0)


def test_foot_slide_equals_a_naive_loop():
    g = torch.Generator().manual_seed(4)
    points = torch.rand(3, 12, 5, 3, generator=g, dtype=torch.float64) * torch.tensor([0.02, 0.02, 0.03])
    mask = torch.rand(3, 12, generator=g) > 0.2
    got = foot_slide(points, FPS, mask=mask)
    for e in range(3):
        speeds = []
        for t in range(11):
            for f in range(5):
                a, b = points[e, t, f].tolist(), points[e, t + 1, f].tolist()
                rise = abs(b[2] - a[2]) * FPS
                if mask[e, t] and mask[e, t + 1] and max(a[2], b[2]) <= 0.02 and rise <= 0.2:
                    speeds.append(1000 * FPS * math.hypot(b[0] - a[0], b[1] - a[1]))
        assert float(got[e]) == pytest.approx(sum(speeds) / len(speeds))


def test_slide_and_heights_do_not_depend_on_place_or_heading():
    g = torch.Generator().manual_seed(4)
    points = torch.rand(12, 5, 3, generator=g, dtype=torch.float64) * torch.tensor([0.02, 0.02, 0.03])
    turn = torch.tensor([[0.6, -0.8, 0.0], [0.8, 0.6, 0.0], [0.0, 0.0, 1.0]]).double()
    moved = points @ turn.T + torch.tensor([3.0, -1.0, 0.0])
    assert foot_slide(moved, FPS) == pytest.approx(float(foot_slide(points, FPS)))


def test_a_ball_that_rolls_without_slipping_slides_far_less_than_it_travels():
    radius, frames = 0.05, 60
    shapes = Shapes(
        torch.tensor([KINDS["sphere"]]), torch.tensor([[radius, 0, 0]]), torch.zeros(1, 3),
        torch.tensor([[1.0, 0, 0, 0]]), torch.tensor([0]),
    )  # fmt: skip
    travel = line(frames, (0.2, 0.0, 0.0), start=(0, 0, radius))
    angle = travel[:, :, 0] / radius
    quat = axis_angle_to_quat(torch.tensor([0.0, 1.0, 0.0]).double().expand(frames, 1, 3), angle)
    rolling = foot_slide(foot_points(travel, quat, shapes, [0]), FPS)
    still = torch.tensor([1.0, 0, 0, 0]).double().expand(frames, 1, 4)
    assert foot_slide(foot_points(travel, still, shapes, [0]), FPS) == pytest.approx(200.0)
    assert rolling < 60.0


def test_a_sphere_sunk_by_10_mm():
    shapes = Shapes(
        torch.tensor([KINDS["sphere"]]), torch.tensor([[0.1, 0, 0]]), torch.zeros(1, 3),
        torch.tensor([[1.0, 0, 0, 0]]), torch.tensor([0]),
    )  # fmt: skip
    pos = torch.tensor([[0.0, 0.0, 0.09]], dtype=torch.float64).expand(5, 1, 3)
    quat = torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64).expand(5, 1, 4)
    low = lowest_points(pos, quat, shapes)
    found = penetration(low)
    assert [float(x) for x in found] == pytest.approx([10.0, 10.0, 1.0])
    half = penetration(torch.tensor([-0.01, 0.02, -0.03, torch.nan]), torch.tensor([True] * 3 + [False]))
    assert [float(x) for x in half] == pytest.approx([40 / 3, 30.0, 2 / 3])


def test_the_feet_below_the_floor_as_skeleton2humanoid_counts_them():
    fp, fq = s2h_foot_penetration(torch.tensor([[0.1, -0.01], [0.0, -0.03]]))
    assert float(fp) == pytest.approx(-10.0) and float(fq) == 0.5


def jump(fps=FPS, hold=0.0):
    """Stand 0.5 s, fly up at 2 m/s until the ground is met again, stand 0.5 s; lowest and com height."""
    t = torch.arange(round(1.4 * fps), dtype=torch.float64) / fps - 0.5
    air = (2.0 * t - 0.5 * 9.81 * t**2).clamp_min(0)
    lowest = torch.where(t > 0, air, torch.zeros_like(air)) + hold
    return lowest, lowest + 0.9


@pytest.mark.parametrize("fps", [30.0, 60.0, 120.0])
def test_free_fall_is_no_floating(fps):
    lowest, com = jump(fps)
    assert floating(lowest, com, fps) < 1.0
    drop = 50.0 - 0.5 * 9.81 * (torch.arange(30, dtype=torch.float64) / fps) ** 2
    assert ballistic(drop, fps).all() and floating(drop, drop, fps).isnan()


@pytest.mark.parametrize("fps", [30.0, 60.0, 120.0])
def test_hovering_is_floating(fps):
    still = torch.full((40,), 0.025, dtype=torch.float64)
    assert floating(still, still + 0.9, fps) == pytest.approx(25.0)
    # A hovering walker bobs by 2 cm at 2 Hz: its acceleration reaches 3 m/s^2, far from g.
    bob = 0.9 + 0.02 * torch.sin(4 * math.pi * torch.arange(60).double() / fps)
    assert floating(torch.full_like(bob, 0.03), bob, fps) == pytest.approx(30.0)
    # A jump from 20 mm above the ground floats by 20 mm, not by the height of the jump.
    assert floating(*jump(fps, hold=0.02), fps) == pytest.approx(20.0, abs=2.0)


def test_a_slow_glide_held_by_a_hand_is_floating():
    t = torch.arange(60, dtype=torch.float64) / FPS
    glide = 0.2 * torch.sin(math.pi * t / 2.0)  # up and down 20 cm in 2 s: |a| <= 0.5 m/s^2
    assert floating(glide, glide + 0.9, FPS) == pytest.approx(float(glide.mean() * 1000))


def test_single_precision_finds_the_same_flight():
    _, com = jump(120.0)
    assert torch.equal(ballistic(com.float(), 120.0), ballistic(com, 120.0))


def test_jerk_of_a_cubic_and_smoothness():
    t = torch.arange(20, dtype=torch.float64) / 60.0
    pos = torch.zeros(20, 2, 3, dtype=torch.float64)
    pos[:, 0, 0] = 2.0 * t**3  # jerk 12
    pos[:, 1, 1] = 5.0 * t**2  # jerk 0
    assert torch.allclose(jerk(pos, 60.0), torch.full((17,), 6.0, dtype=torch.float64))
    assert smoothness(line(9, (0.6, 0.0, 0.0))).tolist() == pytest.approx([20.0] * 8)
    assert smoothness(line(9, (0.6, 0, 0), fps=120.0), 120.0).mean() == pytest.approx(20.0)


def test_wrong_shapes_are_told():
    with refused("wrong-shape", says="(5, 3)"):
        foot_slide(torch.zeros(5, 3), FPS)
