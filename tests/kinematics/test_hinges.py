"""Hinge chains: any number of turns, no jumps, and the best path by brute force."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from poise.kinematics import chain_angles, chain_quat
from poise.motion.rotations import (
    euler_to_quat,
    normalize,
    quat_angle,
    quat_conj,
    quat_mul,
    quat_to_euler,
)
from poise.motion.vectors import lower_median

ORDERS = ["".join(p) for p in itertools.permutations("XYZ")]
ONE = np.array([1.0, 0, 0, 0], dtype=float)


def a_frame(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return normalize(rng.normal(size=(4,)))


def apart(a: np.ndarray, b: np.ndarray) -> float:
    return float(quat_angle(quat_mul(a, quat_conj(b))).max())


def smooth(frames: int, n: int, seed: int, size: float = 1.0) -> np.ndarray:
    """Random smooth angles `(frames, n)` that swing by about `size` rad."""
    rng = np.random.default_rng(seed)
    t = np.linspace(0, 1, frames)[:, None]
    phase, speed = 6 * rng.random(size=(2, n))
    return size * np.sin(phase + (2 + speed) * t)


@pytest.mark.parametrize("order", ORDERS)
def test_three_hinges_make_any_rotation(order):
    rng = np.random.default_rng(1)
    rot = normalize(rng.normal(size=(60, 4)))
    frame = a_frame(2)
    angles = chain_angles(rot, order, frame)
    assert angles.shape == (60, 3)
    assert apart(chain_quat(angles, order, np.broadcast_to(frame, (60, 4))), rot) < 1e-6


@pytest.mark.parametrize("order", [*ORDERS, "ZY", "XZ", "Y", "X"])
def test_smooth_angles_come_back(order):
    angles = smooth(120, len(order), 3)
    frame = a_frame(4)
    rot = chain_quat(angles, order, np.broadcast_to(frame, (120, 4)))
    back = chain_angles(rot, order, frame)
    np.testing.assert_allclose(back, angles, atol=1e-6, rtol=0)


@pytest.mark.parametrize("order", ["Y", "ZY", "YZ", "YXZ", "ZXY"])
def test_a_pirouette_of_five_turns_counts_up(order):
    count = 5 * 2 * math.pi
    angles = smooth(300, len(order), 5, 0.3)
    angles[:, order.index("Y")] = np.linspace(0, count, 300)
    rot = chain_quat(angles, order, np.broadcast_to(ONE, (300, 4)))
    back = chain_angles(rot, order, ONE)
    # Only the start may differ by whole turns: the middle of the spin lies nearest zero.
    np.testing.assert_allclose(back - back[:1], angles - angles[:1], atol=1e-6, rtol=0)
    spin = back[:, order.index("Y")]
    assert float(spin[-1] - spin[0]) == pytest.approx(count)
    assert abs(float(lower_median(spin))) <= math.pi + 1e-6


def test_signs_of_quaternions_do_not_matter():
    angles = smooth(50, 3, 6)
    rot = chain_quat(angles, "ZYX", np.broadcast_to(ONE, (50, 4)))
    flips = np.where(np.arange(50) % 3 == 0, -1.0, 1.0)[:, None]
    np.testing.assert_allclose(chain_angles(rot * flips, "ZYX", ONE), angles, atol=1e-6, rtol=0)


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("sign", [-1, 1])
def test_straight_through_gimbal_lock_without_a_jump(order, sign):
    # The middle angle goes from -0.3 to pi + 0.3 and meets the lock exactly: plain Euler angles flip.
    angles = np.zeros((181, 3))
    angles[:, 0], angles[:, 2] = 0.4, -0.2
    angles[:, 1] = sign * np.linspace(-0.3, math.pi + 0.3, 181)
    rot = chain_quat(angles, order, np.broadcast_to(ONE, (181, 4)))
    plain = quat_to_euler(rot, order)
    assert float(np.abs(plain[1:] - plain[:-1]).max()) > 2.0
    middle = np.array([0.4, sign * 1.5, -0.2], dtype=float)
    back = chain_angles(rot, order, ONE, prefer=middle)
    np.testing.assert_allclose(back, angles, atol=1e-6, rtol=0)


@pytest.mark.parametrize("order", ORDERS)
def test_a_pose_held_at_the_lock_keeps_its_last_angle(order):
    # In, one second exactly at 90 degrees while the first hinge goes on turning, and out again.
    angles = np.zeros((90, 3))
    angles[:, 0] = np.linspace(0.0, 1.0, 90)
    angles[:, 1], angles[:, 2] = math.pi / 2, 0.5
    angles[:30, 1] = np.linspace(0.8, math.pi / 2, 31)[:30]
    angles[60:, 1] = np.linspace(math.pi / 2, 0.8, 31)[1:]
    back = chain_angles(chain_quat(angles, order, np.broadcast_to(ONE, (90, 4))), order, ONE)
    np.testing.assert_allclose(back, angles, atol=1e-6, rtol=0)


def test_the_best_path_is_that_of_brute_force():
    rng = np.random.default_rng(7)
    for _ in range(6):
        rot = normalize(rng.normal(size=(7, 4)))
        ours = chain_angles(rot, "ZYX", ONE)
        first = quat_to_euler(rot, "ZYX")
        second = np.stack((first[:, 0] + np.pi, np.pi - first[:, 1], first[:, 2] + np.pi), -1)
        both = np.stack((first, second), 1)

        def price(path: np.ndarray) -> float:
            steps = np.remainder(np.diff(path, axis=0) + np.pi, 2 * np.pi) - np.pi
            home = np.remainder(path + np.pi, 2 * np.pi) - np.pi
            return float((steps**2).sum() + 1e-4 * (home**2).sum())

        best = min(price(both[np.arange(7), list(p)]) for p in itertools.product((0, 1), repeat=7))
        assert price(ours) == pytest.approx(best, rel=1e-9)


def test_a_still_clip_takes_the_branch_nearest_home():
    still = np.repeat(euler_to_quat(np.array([[0.5, 0.2, -0.3]]), "ZYX"), 10, 0)
    expected = np.tile([0.5, 0.2, -0.3], (10, 1))
    np.testing.assert_allclose(chain_angles(still, "ZYX", ONE), expected, atol=1e-7)
    other = np.array([0.5 + math.pi, math.pi - 0.2, math.pi - 0.3], dtype=float)
    near = chain_angles(still, "ZYX", ONE, prefer=other)
    np.testing.assert_allclose(near, np.tile(other, (10, 1)), atol=1e-7)


def test_fewer_hinges_drop_what_they_cannot_make():
    # A turn about x and z on one hinge about z: the twist about z stays.
    rot = quat_mul(
        euler_to_quat(np.array([[0.7]], dtype=float), "Z"),
        euler_to_quat(np.array([[0.2]], dtype=float), "X"),
    )
    assert float(chain_angles(rot, "Z", ONE)[0, 0]) == pytest.approx(0.7)
    assert chain_angles(rot, "", ONE).shape == (1, 0)
    assert apart(chain_quat(np.zeros((1, 0)), "", np.broadcast_to(ONE, (1, 4))), ONE[None]) == 0
