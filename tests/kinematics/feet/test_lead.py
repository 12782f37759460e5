"""Feet are led by the smallest smooth correction; frames that are fixed stay."""

from __future__ import annotations

import numpy as np

from poise.kinematics.feet import Sole
from poise.kinematics.hold import RETURN_PER_S, SMOOTH_S, lead
from poise.motion.rotations import axis_angle_to_quat, quat_rotate
from poise.motion.vectors import norm


def test_the_banded_solution_is_that_of_the_plain_least_squares() -> None:
    rng = np.random.default_rng(0)
    frames, fps = 12, 30.0
    ankle = rng.normal(size=(frames, 3))
    ends = ankle[:, None] + rng.normal(size=(frames, 2, 3))
    weight = rng.uniform(size=(frames - 1, 2))
    shift, turn, tilt, _ = (x for x in lead(Sole(ankle, ends), weight, fps)[:4])
    length = float(np.linalg.norm(ends[0, 1] - ends[0, 0]))
    rows, want = [], []
    arm = (ends - ankle[:, None])[..., :2]
    for t in range(frames - 1):
        for p in range(2):
            v = (ends[t + 1, p] - ends[t, p])[:2] * fps
            r = 0.5 * (arm[t, p] + arm[t + 1, p]) / length
            for axis, across in ((0, -r[1]), (1, r[0])):
                row = np.zeros((frames, 3))
                row[t, axis], row[t + 1, axis] = -fps, fps
                row[t, 2], row[t + 1, 2] = -fps * across, fps * across
                rows.append(np.sqrt(weight[t, p]) * row.ravel())
                want.append(-np.sqrt(weight[t, p]) * v[axis])
    for k in range(3):
        for t in range(frames):
            row = np.zeros((frames, 3))
            row[t, k] = RETURN_PER_S
            rows.append(row.ravel())
            want.append(0.0)
            if 0 < t < frames - 1:
                row = np.zeros((frames, 3))
                row[t - 1, k], row[t, k], row[t + 1, k] = 1, -2, 1
                rows.append(SMOOTH_S * fps**2 * row.ravel())
                want.append(0.0)
    x = np.linalg.lstsq(np.array(rows), np.array(want), rcond=None)[0].reshape(frames, 3)
    assert np.abs(shift[:, :2] - x[:, :2]).max() < 1e-9 and not shift[:, 2].any() and not tilt.any()
    assert np.abs(turn - x[:, 2] / length).max() < 1e-9


def test_fixed_frames_stay_and_the_foot_stands_where_they_do() -> None:
    frames, fps = 31, 30.0
    ankle = np.zeros((frames, 3))
    ankle[:, 0] = np.linspace(0.0, 0.1, frames)
    ankle[:, 2] = np.linspace(0.1, 0.12, frames)
    toe = np.array([[-0.05, 0.0, -0.1], [0.15, 0.0, -0.1]], dtype=float)
    sole = Sole(ankle, ankle[:, None] + toe)
    fixed = np.zeros(frames, dtype=bool)
    fixed[0] = True
    one = lead(sole, np.full((frames - 1, 2), 100.0), fps, fixed, vertical=True)
    assert not one.shift[0].any() and float(one.turn[0]) == 0.0
    still = ankle + one.shift
    assert float(norm(still - ankle[0]).max()) < 2e-3
    # Without it the height is left to others.
    assert not lead(sole, np.ones((frames - 1, 2)), fps, fixed).shift[:, 2].any()


def test_a_rocking_foot_is_laid_flat() -> None:
    frames, fps = 31, 30.0
    angle = 0.1 * np.sin(np.linspace(0, 12, frames))
    ankle = np.zeros((frames, 3))
    toe = np.stack((0.2 * np.cos(angle), 0 * angle, 0.2 * np.sin(angle)), -1)
    one = lead(
        Sole(ankle, np.stack((ankle, toe), 1)), np.full((frames - 1, 2), 100.0), fps, vertical=True
    )
    assert float(np.abs(one.shift[:, 2]).max()) < 1e-3
    assert float(np.abs(angle + one.tilt - (angle + one.tilt).mean()).max()) < 2e-3
    # Positive tilt about the axis raises the toe.
    turned = quat_rotate(axis_angle_to_quat(one.axis, one.tilt), toe)
    assert float(np.abs(np.diff(turned[:, 2])).max()) < 2e-4


def test_an_ankle_that_bears_keeps_the_foot_from_rolling() -> None:
    frames, fps = 61, 30.0
    angle = 0.1 * np.sin(np.linspace(0.0, 12.0, frames))
    along = np.broadcast_to(np.array([1.0, 0.0, 0.0], dtype=float), (frames, 3))
    turn = axis_angle_to_quat(along, angle)
    rest = np.array([[-0.05, 0.0, -0.08], [0.15, 0.0, -0.08]], dtype=float)
    ends = quat_rotate(
        np.broadcast_to(turn[:, None], (frames, 2, 4)), np.broadcast_to(rest, (frames, 2, 3))
    )
    # It rolls about the line of its sole, which stays: the ankle sways.
    middle = ends.mean(1) - rest.mean(0)
    sole = Sole(-middle, ends - middle[:, None])
    weight = np.full((frames - 1, 2), 100.0)
    sway = (sole.ankle[:, 1].max() - sole.ankle[:, 1].min()).item()
    assert sway > 0.015
    loose, held = (lead(sole, weight, fps, flat=flat) for flat in (None, weight[:, 0]))
    assert loose.roll is None and float(np.abs(loose.shift).max()) < 1e-3
    assert held.roll is not None
    left = sole.ankle + held.shift
    assert float(left[:, 1].max() - left[:, 1].min()) < 0.1 * sway
    np.testing.assert_allclose(held.roll - held.roll.mean(), -(angle - angle.mean()), atol=0.02, rtol=0)
