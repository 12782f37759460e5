"""Loops: told, repeated, and the period that closes best."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from poise.kinematics.loops import best_period, overlap_of, repeated
from poise.metrics import jerk
from poise.motion import Clip, trim
from poise.motion.rotations import quat_distance
from toy_walker import walker


def test_a_loop_is_told_by_its_ends() -> None:
    clip = walker(1.0)
    assert overlap_of(clip) == 1
    assert overlap_of(trim(clip, 0, clip.frames - 1)) == 0
    assert overlap_of(trim(clip, 0, 20)) is None


@pytest.mark.parametrize("overlap", [0, 1])
def test_a_repeated_loop_has_no_double_frame(overlap: int) -> None:
    clip = walker(1.0)
    one = clip if overlap else trim(clip, 0, clip.frames - 1)
    long = repeated(one, overlap, 3)
    assert long.frames == 3 * 30 + 1
    for k in range(3):
        np.testing.assert_array_equal(long.rot[30 * k], one.rot[0])
    assert (np.abs(np.diff(long.rot, axis=0)).max((1, 2)) > 0).all()


def noisy(clip: Clip, seed: int = 0) -> Clip:
    """Periods that differ smoothly, and drift over the ground and in heading."""
    rng = np.random.default_rng(seed)
    t = np.arange(clip.frames) / clip.fps
    waves = sum(
        0.02 * rng.normal(size=(3, 1)) * np.sin(2 * np.pi * f * t + rng.uniform(0, 6))
        for f in (0.3, 0.7)
    )
    drift = 0.03 * t * np.array([[1.0], [0.5], [0.0]])
    return clip.replaced(root_pos=clip.root_pos + (waves + drift).T)


@pytest.mark.parametrize("overlap", [0, 1])
def test_the_period_that_is_taken_out_closes_smoothly(overlap: int) -> None:
    one = walker(1.0, fps=60.0)
    one = one if overlap else trim(one, 0, one.frames - 1)
    made = best_period(noisy(repeated(one, overlap, 5)), 60, overlap)
    assert made.frames == one.frames
    if overlap:
        np.testing.assert_allclose(made.root_pos[0], made.root_pos[-1], atol=1e-9)
        apart = quat_distance(torch.tensor(made.rot[0]), torch.tensor(made.rot[-1]))
        assert float(apart.max()) < 1e-6
    again = repeated(made, overlap, 3)
    shake = jerk(torch.tensor(again.positions()), again.fps).numpy()
    seam = np.zeros(len(shake), dtype=bool)
    for k in (1, 2):
        seam[60 * k - 3 : 60 * k + 1] = True
    assert shake[seam].max() <= shake[~seam].max()


def test_what_several_periods_do_alike_is_kept() -> None:
    one = walker(1.0, fps=60.0)
    made = best_period(repeated(one, 1, 4), 60, 1)
    np.testing.assert_allclose(made.root_pos, one.root_pos, atol=1e-9)
    assert float(quat_distance(torch.tensor(made.rot), torch.tensor(one.rot)).max()) < 1e-6


def test_even_drift_is_taken_off_evenly() -> None:
    one = walker(1.0, fps=60.0)
    long = repeated(one, 1, 4)
    way = np.arange(long.frames)[:, None] * np.array([0.001, -0.0005, 0.0])
    made = best_period(long.replaced(root_pos=long.root_pos + way), 60, 1)
    moved = made.root_pos - one.root_pos
    np.testing.assert_allclose(moved, np.broadcast_to(moved[:1], moved.shape), atol=1e-9)


def test_no_period_is_taken_from_where_the_motion_is_lost() -> None:
    one = walker(1.0, fps=60.0)
    long = repeated(one, 1, 5)
    root = np.array(long.root_pos)
    # It sinks from 3.2 s on.
    root[192:, 2] -= 0.5
    made = best_period(long.replaced(root_pos=root), 60, 1, stop=192)
    np.testing.assert_allclose(made.root_pos, one.root_pos, atol=1e-9)
