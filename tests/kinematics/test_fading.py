"""What a stream is smoothed by: clean ones not at all, noisy ones by as much as they tremble."""

from __future__ import annotations

import numpy as np
import pytest

from poise.kinematics.stream_noise import LATE_S, SAMPLES, FadingFilter, of_points

POINTS = 8


def motion(seconds: float, fps: float) -> np.ndarray:
    """`(T, 3 K)` m: every channel moves by 0.3 m at some 0.3 to 1.2 Hz, and more slowly."""
    rng, t = np.random.default_rng(1), np.arange(round(seconds * fps)) / fps
    hz, phase = rng.uniform(0.3, 1.2, 3 * POINTS), rng.uniform(0, 2 * np.pi, 3 * POINTS)
    return 0.15 * np.sin(2 * np.pi * hz * t[:, None] + phase) + 0.3 * np.sin(t[:, None] * 0.5 + phase)


def run(z: np.ndarray, fps: float, fading: FadingFilter) -> tuple[np.ndarray, np.ndarray]:
    """The newest samples, and each as it is known a sample later."""
    newest, later = list[np.ndarray](), list[np.ndarray]()
    for k, row in enumerate(z):
        newest.append(fading(row, 1 / fps if k else 0.0))
        later.append(next(iter(fading.before()), z[max(k - 1, 0)]))
    return np.array(newest), np.array(later)


def off(a: np.ndarray, b: np.ndarray) -> float:
    """mm between points, on average."""
    return 1e3 * float(np.linalg.norm((a - b).reshape(len(a), -1, 3), axis=-1).mean())


def one_euro(x: np.ndarray, fps: float, hz: float, beta: float) -> np.ndarray:
    """Casiez et al. 2012."""
    out, speed = x.copy(), np.zeros_like(x[0])
    for k in range(1, len(x)):
        speed += (np.diff(x[k - 1 : k + 1], axis=0)[0] * fps - speed) / (1 + fps / (2 * np.pi))
        share = 1 / (1 + fps / (2 * np.pi * (hz + beta * np.abs(speed))))
        out[k] = share * x[k] + (1 - share) * out[k - 1]
    return out


@pytest.mark.parametrize("fps", [10.0, 30.0, 60.0, 120.0])
def test_a_clean_stream_passes_as_it_is(fps: float) -> None:
    z, fading = motion(10, fps), of_points(POINTS)
    for k, row in enumerate(z):
        assert fading(row, 1 / fps if k else 0.0) is row and fading.before() == []
    assert (fading.noise.mm, fading.noise.hz, fading.late_s) == (0.0, None, 0.0)


@pytest.mark.parametrize("fps", [24.0, 30.0, 60.0])
@pytest.mark.parametrize("mm", [10.0, 25.0])
def test_white_noise_is_measured_and_taken_off(fps: float, mm: float) -> None:
    truth, rng = motion(10, fps), np.random.default_rng(0)
    z = truth + 1e-3 * mm / np.sqrt(3) * rng.normal(size=truth.shape)
    fading = of_points(POINTS)
    newest, later = run(z, fps, fading)
    assert fading.noise.mm == pytest.approx(mm, rel=0.15) and fading.noise.hz is None
    assert fading.late_s == LATE_S
    known = slice(round(3 * fps), None)
    raw = off(z[known], truth[known])
    assert off(newest[known], truth[known]) < 0.92 * raw
    assert off(later[known], truth[round(3 * fps) - 1 : -1]) < 0.65 * raw
    # A filter of one setting takes as much off, but comes late.
    fixed = one_euro(z, fps, 2.0, 2.0)
    assert off(newest[known], truth[known]) < off(fixed[known], truth[known])


@pytest.mark.parametrize("hz", [4.0, 5.0, 7.3])
def test_a_tremble_of_one_frequency_is_told_and_taken_off(hz: float) -> None:
    truth, fps, rng = motion(12, 30.0), 30.0, np.random.default_rng(0)
    t = np.arange(len(truth))[:, None] / fps
    # Deviation 1 in every channel, 20 mm for each point.
    tremble = np.sqrt(2) * np.sin(2 * np.pi * (hz * t + rng.uniform(size=truth.shape[1])))
    z = truth + 0.02 / np.sqrt(3) * tremble
    fading = of_points(POINTS)
    newest, later = run(z, fps, fading)
    assert fading.noise.hz == pytest.approx(hz, abs=0.1)
    assert fading.noise.mm == pytest.approx(20.0, rel=0.1)
    known = slice(150, None)
    assert off(newest[known], truth[known]) < 0.3 * off(z[known], truth[known])
    assert off(later[known], truth[149:-1]) < 0.2 * off(z[known], truth[known])


def test_what_leaps_is_there_at_once_and_disturbs_no_other() -> None:
    truth, rng = motion(8, 30.0), np.random.default_rng(0)
    noise = 0.01 * rng.normal(size=truth.shape)
    leaps = truth.copy()
    leaps[200:, 3:6] += [0.5, -0.3, 0.0]
    still, moved = (run(x + noise, 30.0, of_points(POINTS))[0] for x in (truth, leaps))
    np.testing.assert_array_equal(moved[200, 3:6], leaps[200, 3:6] + noise[200, 3:6])
    assert off(moved[200:230, 3:6], leaps[200:230, 3:6]) < 25
    others = np.r_[0:3, 6 : 3 * POINTS]
    np.testing.assert_allclose(moved[:203, others], still[:203, others], atol=1e-9)


def test_a_stream_that_calms_passes_as_it_is_again() -> None:
    z, rng = motion(12, 30.0), np.random.default_rng(0)
    z[:150] += 0.015 * rng.normal(size=(150, z.shape[1]))
    fading = of_points(POINTS)
    newest, _ = run(z, 30.0, fading)
    assert np.abs(newest[60:150] - z[60:150]).max() > 0.005
    assert fading.late_s == 0.0
    np.testing.assert_array_equal(newest[150 + SAMPLES :], z[150 + SAMPLES :])
    # It fades out: nothing leaps by more than it trembled.
    assert np.abs(np.diff(newest - z, axis=0))[150:].max() < 0.02


def test_lost_samples_and_a_pause() -> None:
    truth, rng = motion(10, 30.0), np.random.default_rng(0)
    z = truth + 0.012 * rng.normal(size=truth.shape)
    kept = np.flatnonzero(rng.uniform(size=len(z)) > 0.1)
    fading, out = of_points(POINTS), list[np.ndarray]()
    for before, k in zip(np.append(-1, kept), kept, strict=False):
        out.append(fading(z[k], (k - before) / 30))
    known = kept >= 90
    left, raw = off(np.array(out)[known], truth[kept][known]), off(z[kept][known], truth[kept][known])
    assert left < 0.85 * raw and fading.noise.hz is None
    # After a pause it goes on from what comes, and what is known of the noise stays.
    there = z[-1] + 1.0
    assert fading(there, 3.0) is there and fading.before() == []
    assert np.abs(fading(there + 0.01, 1 / 30) - there).max() < 0.02 and fading.noise.mm > 10


def test_a_cut_off_that_is_asked_for_smooths_whatever_comes() -> None:
    t = np.arange(300)[:, None] / 30
    line, _ = run(np.tile(2.0 * t + 1.0, 3), 30.0, of_points(1, 2.0))
    np.testing.assert_allclose(line[90:], np.tile(2.0 * t + 1.0, 3)[90:], atol=1e-3)
    noise = np.random.default_rng(0).normal(size=(4000, 3))
    left = [run(noise, 30.0, of_points(1, hz))[0][100:].var() for hz in (1.0, 2.0, 4.0)]
    assert 0.1 < left[0] < left[1] < left[2] < 0.7
