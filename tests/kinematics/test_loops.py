"""Loops: told, repeated, and the period that closes best."""

from __future__ import annotations

import numpy as np
import pytest

from poise.kinematics.loops import best_period, cut_loop, overlap_of, repeated
from poise.kinematics.travel import moved_by
from poise.metrics import jerk
from poise.motion import Clip, trim
from poise.motion.rotations import heading_quat, quat_conj, quat_distance, quat_mul, quat_rotate
from refusals import refused
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
        apart = quat_distance(made.rot[0], made.rot[-1])
        assert float(apart.max()) < 1e-6
    again = repeated(made, overlap, 3)
    shake = jerk(again.positions(), again.fps)
    seam = np.zeros(len(shake), dtype=bool)
    for k in (1, 2):
        seam[60 * k - 3 : 60 * k + 1] = True
    assert shake[seam].max() <= shake[~seam].max()


def test_what_several_periods_do_alike_is_kept() -> None:
    one = walker(1.0, fps=60.0)
    made = best_period(repeated(one, 1, 4), 60, 1)
    np.testing.assert_allclose(made.root_pos, one.root_pos, atol=1e-9)
    assert float(quat_distance(made.rot, one.rot).max()) < 1e-6


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


def walked_about(seconds: float = 12.0) -> Clip:
    """A walker of one second a cycle that turns and changes as it goes, so that no part repeats."""
    cycles = round(seconds)
    clip = noisy(repeated(walker(1.0), 1, cycles))
    t = np.arange(clip.frames) / clip.fps
    return moved_by(clip, np.stack((0.4 * t, 0.1 * t, 0 * t), 1), 0.2 * t)


def test_a_loop_is_cut_where_its_end_meets_its_start() -> None:
    clip = walked_about()
    made, apart = cut_loop(clip, 5.3)
    # Whole cycles alone close, whatever is asked for.
    assert made.cyclic and (made.frames - 1) / made.fps == pytest.approx(5.0, abs=0.07)
    assert apart < 0.04
    # The last frame is the first, turned and gone on.
    np.testing.assert_allclose(np.abs((made.rot[0] * made.rot[-1]).sum(-1))[1:], 1.0, atol=1e-9)
    assert made.root_pos[-1, 2] == pytest.approx(made.root_pos[0, 2])
    onto = quat_mul(heading_quat(made.rot[-1, 0]), quat_conj(heading_quat(made.rot[0, 0])))
    # Gone on with, the seam is no rougher than the motion.
    pos = made.positions()
    ahead = quat_rotate(np.broadcast_to(onto, (8, pos.shape[1], 4)), pos[1:9] - made.root_pos[0])
    base = made.root_pos[-1] * [1.0, 1.0, 0.0] + made.root_pos[0] * [0.0, 0.0, 1.0]
    rough = np.linalg.norm(np.diff(np.concatenate((pos, ahead + base)), 3, axis=0), axis=-1).mean(1)
    assert rough[made.frames - 4 :].max() < 1.3 * rough[: made.frames - 20].max()
    # Frames before the join are the motion's own.
    own = clip.positions()
    starts = np.linalg.norm(own - pos[0], axis=-1).max(1).argmin()
    np.testing.assert_allclose(pos[:60], own[starts : starts + 60], atol=1e-9)


def test_a_loop_holds_nothing_that_is_excluded() -> None:
    clip = walked_about()
    made, _ = cut_loop(clip, 3.0, [(0.0, 4.0), (9.0, 20.0)])
    start = np.linalg.norm(clip.positions() - made.positions()[0], axis=-1).max(1).argmin()
    assert start > 4.0 * 30 and start + made.frames - 1 < 9.0 * 30
    with refused("clip-too-short", says="holds no 6 s in a row"):
        cut_loop(clip, 6.0, [(0.0, 4.0), (9.0, 20.0)])
