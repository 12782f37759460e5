"""Eqs. 6 and 7, Euler angles of all orders, and hinges that only point."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from paper_humanoid import count_jumps

from poise.kinematics.ik_bodies import arc, frame_of, prefix_product, rotate, square_to
from poise.kinematics.ik_frames import (
    continuous_euler,
    euler_angles,
    one_turn_check,
    pointing_angles,
    unwrapped,
    zyx_angles,
    zyx_matrix,
)
from poise.motion.rotations import euler_to_quat, normalize, quat_to_matrix
from poise.motion.vectors import norm

ORDERS = ["".join(p) for p in itertools.permutations("XYZ")]


def rotations(count: int, seed: int = 0) -> np.ndarray:
    q = np.random.default_rng(seed).normal(size=(count, 4))
    return quat_to_matrix(normalize(q))


def chain(angles: np.ndarray, order: str) -> np.ndarray:
    return quat_to_matrix(euler_to_quat(angles, order))


def test_eq_6_is_exact_for_square_frames():
    parent, child = rotations(2000, 1), rotations(2000, 2)
    angles = zyx_angles(parent, child)
    np.testing.assert_allclose(parent @ zyx_matrix(angles), child, atol=1e-12)
    np.testing.assert_allclose(zyx_matrix(angles), chain(angles, "ZYX"), atol=1e-12)
    assert np.abs(angles[:, 1]).max() <= math.pi / 2 + 1e-12


@pytest.mark.parametrize(("degrees", "read"), [(20, 18.9), (30, 26.6), (45, 35.3)])
def test_eq_6_misreads_frames_that_are_not_square(degrees, read):
    # The ankle of Eq. 21: y_c along the shin, z_c along a foot that points down by `degrees`.
    a = math.radians(degrees)
    child = np.array([[1.0, 0, 0], [0, 1, 0], [0, -math.sin(a), math.cos(a)]]).T
    ex = zyx_angles(np.eye(3), child)[2]
    assert math.degrees(ex) == pytest.approx(read, abs=0.05)
    # With y_c = z_c x x_c it is read as it is.
    square = frame_of("z", x=child[:, 0], z=child[:, 2])
    assert math.degrees(zyx_angles(np.eye(3), square)[2]) == pytest.approx(degrees)


@pytest.mark.parametrize("order", ORDERS)
def test_euler_angles_of_every_order(order):
    m = rotations(300, 3)
    np.testing.assert_allclose(chain(euler_angles(m, order), order), m, atol=1e-12)


@pytest.mark.parametrize("order", ORDERS)
def test_a_pirouette_and_a_turn_through_the_lock_come_back(order):
    t = np.linspace(0, 1, 200)[:, None]
    spin = np.array([0.3, 0.4, 0.2]) + t * np.array([10 * math.pi, 0, 0])
    through = np.array([0.4, -0.3, -0.2]) + t * np.array([0, math.pi + 0.6, 0])
    angles = np.stack((spin, through), 1)
    back = unwrapped(continuous_euler(chain(angles, order), order))
    np.testing.assert_allclose(back[:, 0] - back[:1, 0], spin - spin[:1], atol=1e-8)
    # Either of the two names of the same motion will do: it only must not jump.
    np.testing.assert_allclose(chain(back, order), chain(angles, order), atol=1e-9)
    assert count_jumps(back[:, 1], 0.1).sum() == 0


def test_eq_7_adds_one_turn_and_misses_flips():
    two_turns = np.linspace(0, 4 * math.pi, 60)
    wrapped = np.remainder(two_turns + math.pi, 2 * math.pi) - math.pi
    once = one_turn_check(wrapped[:40, None])
    np.testing.assert_allclose(once[:, 0], two_turns[:40], atol=1e-12)
    # In the second turn the step is 4 pi and one turn is not enough.
    assert count_jumps(one_turn_check(wrapped[:, None])).sum() > 0
    assert count_jumps(unwrapped(wrapped[:, None])).sum() == 0
    # Through the lock Euler angles flip by pi, less than lambda = 5: Eq. 7 keeps the flip.
    b = np.linspace(1.2, 1.9, 30)
    m = chain(np.stack((0 * b + 0.4, b, 0 * b), -1), "ZYX")[:, None]
    assert count_jumps(continuous_euler(m, "ZYX", branches=False)[:, 0]).sum() == 2
    assert count_jumps(unwrapped(continuous_euler(m, "ZYX"))[:, 0]).sum() == 0


@pytest.mark.parametrize("order", ["X", "Y", "Z", "XY", "YX", "ZX", "XZ", "YZ", "ZY"])
def test_one_and_two_hinges_point_where_they_can(order):
    axes = rotations(1, 5)[0]
    rest = np.array([0.3, -0.5, 0.8]) / np.sqrt(0.98)
    t = np.linspace(0, 1, 80)
    angles = np.stack([0.9 * np.sin(3 * t + k) for k in range(len(order))], -1)
    turned = np.broadcast_to(axes, (80, 3, 3)) @ chain(angles, order) @ axes.T
    wanted = turned @ rest
    found = unwrapped(pointing_angles(rest, wanted, order, axes))
    again = np.broadcast_to(axes, (80, 3, 3)) @ chain(found, order) @ axes.T
    np.testing.assert_allclose(again @ rest, wanted, atol=1e-9)
    assert np.abs(np.diff(found, axis=0)).max() < 0.2


@pytest.mark.parametrize("order", ["X", "ZX"])
def test_a_direction_out_of_reach_is_approached(order):
    # The first axis' share of the direction cannot grow beyond what the second hinge gives it.
    rest = np.array([0.0, 0.0, 1.0]) if order == "ZX" else np.full(3, 1 / np.sqrt(3))
    wanted = np.array([[1.0, 0.0, 0.0]])
    found = pointing_angles(rest, wanted, order, np.eye(3))
    assert np.isfinite(found).all()
    got = (chain(found, order) @ rest)[0]
    grid = np.linspace(-math.pi, math.pi, 361)
    sweep = np.array(list(itertools.product(grid[::10], repeat=len(order))))
    best = (chain(sweep, order) @ rest @ wanted[0]).max()
    assert float(got @ wanted[0]) > best - 0.01


def test_small_mathematics():
    rng = np.random.default_rng(6)
    a, b = (normalize(rng.normal(size=(100, 3))) for _ in range(2))
    np.testing.assert_allclose(rotate(arc(a, b), a), b, atol=1e-12, rtol=0)
    np.testing.assert_allclose(rotate(arc(a, -a), a), -a, atol=1e-9, rtol=0)
    assert float(np.abs((square_to(a, b) * b).sum(-1)).max()) < 1e-12
    assert float(norm(square_to(b, b)).min()) > 0.9
    m = rotations(37, 7)
    expected = [m[0]]
    for k in m[1:]:
        expected.append(k @ expected[-1])
    np.testing.assert_allclose(prefix_product(m), np.stack(expected), atol=1e-12, rtol=0)
    for hold in "xyz":
        others = [k for k in "xyz" if k != hold]
        for other in others:
            f = frame_of(hold, **{hold: a, other: b})
            np.testing.assert_allclose(np.linalg.det(f), np.ones(100), atol=1e-7)
            np.testing.assert_allclose(f[..., "xyz".index(hold)], a, atol=1e-12, rtol=0)
            assert bool(((f[..., "xyz".index(other)] * b).sum(-1) > 0).all())
