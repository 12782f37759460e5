"""Resampling, trimming and moving clips."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from poise.metrics import jerk
from poise.motion import Clip, ground_shift, resample, shifted, trim
from poise.motion.rotations import quat_angle, quat_conj, quat_mul
from refusals import refused
from toy_human import swing


def apart(a: np.ndarray, b: np.ndarray) -> float:
    twist = quat_mul(torch.tensor(a), quat_conj(torch.tensor(b)))
    return float(quat_angle(twist).max())


def test_the_same_rate_changes_nothing():
    clip = swing(speed=1.0, bend=0.5)
    same = resample(clip, 30.0)
    np.testing.assert_allclose(same.root_pos, clip.root_pos, atol=1e-12)
    assert apart(same.rot, clip.rot) < 1e-7 and same.frames == clip.frames


@pytest.mark.parametrize("fps", [7.0, 24.0, 59.94, 60.0, 120.0])
def test_duration_and_path_stay(fps):
    clip = swing(1.0, 30.0, speed=1.5, bend=0.5)
    other = resample(clip, fps)
    assert other.fps == fps and clip.seconds - 1 / fps < other.seconds <= clip.seconds + 1e-2 / fps
    # Against the same motion authored at the other rate's times.
    at = np.arange(other.frames) / fps * 30.0
    twin = np.stack([np.interp(at, np.arange(31), clip.root_pos[:, k]) for k in range(3)], -1)
    np.testing.assert_allclose(other.root_pos, twin, atol=1e-9)
    assert np.abs(np.linalg.norm(other.rot, axis=-1) - 1).max() < 1e-12


def test_up_and_down_again_gives_the_frames_back():
    clip = swing(speed=1.0, bend=0.5)
    back = resample(resample(clip, 120.0), 30.0)
    np.testing.assert_allclose(back.root_pos, clip.root_pos, atol=1e-9)
    assert apart(back.rot, clip.rot) < 1e-7


def test_halfway_rotations_are_halfway():
    clip = swing()
    twice = resample(clip, 60.0)
    a, mid, b = clip.rot[4], twice.rot[9], clip.rot[5]
    whole = quat_angle(quat_mul(torch.tensor(b), quat_conj(torch.tensor(a))))
    half = quat_angle(quat_mul(torch.tensor(mid), quat_conj(torch.tensor(a))))
    torch.testing.assert_close(half, whole / 2, atol=1e-7, rtol=0)


def test_odd_stated_rates_keep_the_last_frame():
    # A file's frame time of .0083333 s is 120.00048 fps, DeepMimic's .033332 s is 30.0012 fps: no frame
    # may be lost to the rounding.
    for frame_time, fps in ((0.0083333, 120.0), (0.033332, 30.0), (0.016666, 60.0)):
        assert resample(swing(2.0, fps).replaced(fps=1 / frame_time), 30.0).frames == 61


def test_attributes_are_kept_and_arguments_unchanged():
    clip = swing(speed=1.0, cyclic=True, name="walk")
    before = clip.root_pos.copy(), clip.rot.copy()
    other = resample(clip, 60.0)
    assert other.cyclic and other.name == "walk" and other.skeleton is clip.skeleton
    cut = trim(clip, 5, 20)
    assert cut.frames == 15 and not cut.cyclic
    np.testing.assert_array_equal(cut.root_pos, clip.root_pos[5:20])
    moved = ground_shift(shifted(clip, (1.0, 2.0, 0.0)), 0.3)
    np.testing.assert_allclose(moved.root_pos - clip.root_pos, np.tile([1.0, 2.0, 0.3], (31, 1)))
    per_frame = shifted(clip, np.arange(93.0).reshape(31, 3))
    np.testing.assert_allclose(per_frame.root_pos[30], clip.root_pos[30] + [90.0, 91.0, 92.0])
    np.testing.assert_array_equal(clip.root_pos, before[0])
    np.testing.assert_array_equal(clip.rot, before[1])


def test_mistakes_are_told():
    for fps in (0.0, -1.0, float("nan"), 1e9):
        with refused("rate-out-of-range", says="swing"):
            resample(swing(), fps)
    with refused("clip-too-short", says=("1.000", "0.5")):
        resample(swing(), 0.5)
    with refused("clip-too-short"):
        trim(swing(), 4, 5)


def test_a_smooth_motion_stays_smooth_at_a_higher_rate() -> None:
    """Straight lines between frames have corners, which are a jerk that nobody made."""

    def shake(clip: Clip) -> float:
        return float(jerk(torch.tensor(clip.positions()), clip.fps).mean())

    fine = swing(2.0, 120.0, speed=1.0, bend=0.5)
    coarse = resample(fine, 30.0)
    straight, smooth = resample(coarse, 120.0), resample(coarse, 120.0, smooth=True)
    assert smooth.frames == straight.frames == fine.frames
    assert np.abs(smooth.positions() - fine.positions()).max() < 0.002
    assert shake(smooth) < 1.2 * shake(fine) + 1.0 < 0.5 * shake(straight)
    # Frames that are known are what they were, whatever sign their quaternions have.
    flipped = coarse.rot.copy()
    flipped[::2] *= -1.0
    other = resample(coarse.replaced(rot=flipped), 120.0, smooth=True)
    assert apart(other.rot[::4], coarse.rot) < 1e-6
    assert apart(other.rot, smooth.rot) < 1e-6
    # To a lower rate there are no corners.
    np.testing.assert_array_equal(
        resample(fine, 30.0, smooth=True).root_pos, resample(fine, 30.0).root_pos
    )


def test_splines_do_not_ring_where_the_root_leaps() -> None:
    """As where a character that fell was put back on its motion."""
    clip = resample(swing(2.0, 120.0, speed=1.0, bend=0.5), 30.0)
    root = clip.root_pos.copy()
    root[30:, 0] += 1.5
    before, after = (resample(c, 120.0, smooth=True) for c in (clip, clip.replaced(root_pos=root)))
    off = after.root_pos[:, 0] - before.root_pos[:, 0]
    assert np.abs(off[: 29 * 4 - 40]).max() < 1e-3 and np.abs(off[30 * 4 + 40 :] - 1.5).max() < 1e-3
    assert off.min() > -0.01 and off.max() < 1.51
