"""Keypoints that tremble give the motion below; those that do not give what they gave."""

from __future__ import annotations

from importlib.resources import as_file, files
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import butter, sosfiltfilt

from poise.formats import read_clip
from poise.formats.point_fit import FitConfig, fit_clip
from poise.kinematics import examine
from poise.motion import Clip
from poise.motion.keypoints import Keypoints
from poise.motion.skeleton import Source
from refusals import refused


@pytest.fixture(scope="module")
def truth() -> Clip:
    """The walk that comes with Poise, 30 Hz, as a skeleton follows its joints."""
    with as_file(files("poise") / "data/walk.bvh") as path:
        walk = read_clip(path)
    return fit_clip(Keypoints(walk.skeleton.names, walk.positions(), walk.fps))


def points_of(clip: Clip, positions: np.ndarray, raw: bool = False) -> Keypoints:
    return Keypoints(clip.skeleton.names, positions, clip.fps, source=Source(raw=raw))


def off_mm(a: np.ndarray, b: np.ndarray) -> float:
    return 1e3 * float(np.linalg.norm(a - b, axis=-1).mean())


def shaken(clip: Clip, noise: np.ndarray, mm: float) -> np.ndarray:
    """The joints' places `(T, J, 3)`, each `mm` off on average."""
    return clip.positions() + mm / 1e3 * noise / np.linalg.norm(noise, axis=-1).mean()


def tone(clip: Clip, hz: float, seed: int = 0) -> np.ndarray:
    phase = np.random.default_rng(seed).uniform(0, 2 * np.pi, (len(clip.skeleton), 3))
    return np.sin(2 * np.pi * hz * np.arange(clip.frames)[:, None, None] / clip.fps + phase)


def best_filter(positions: np.ndarray, clip: Clip) -> float:
    """mm that the best Butterworth filter leaves, its cut-off chosen by one who knows the truth."""
    there = clip.positions()
    cutoffs = (0.7, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0)
    sos = [butter(4, hz, fs=clip.fps, output="sos") for hz in cutoffs]
    return min(off_mm(sosfiltfilt(s, positions, axis=0), there) for s in sos)


def test_clean_keypoints_give_bit_for_bit_what_they_gave(truth: Clip) -> None:
    made, raw = (fit_clip(points_of(truth, truth.positions(), raw)) for raw in (False, True))
    np.testing.assert_array_equal(made.rot, raw.rot)
    np.testing.assert_array_equal(made.root_pos, raw.root_pos)
    assert not made.skeleton.source.mended


@pytest.mark.parametrize("mm", [10.0, 25.0, 50.0])
def test_white_noise_on_keypoints_is_taken_off_as_the_best_filter_does(truth: Clip, mm: float) -> None:
    for seed in range(2):
        noise = np.random.default_rng(seed).standard_normal((truth.frames, len(truth.skeleton), 3))
        seen = shaken(truth, noise, mm)
        made = fit_clip(points_of(truth, seen))
        assert off_mm(made.positions(), truth.positions()) < best_filter(seen, truth)


@pytest.mark.parametrize("hz", [2.0, 4.0, 5.0, 7.3])
def test_a_tremble_of_keypoints_is_told_and_taken_off(truth: Clip, hz: float) -> None:
    seen = shaken(truth, tone(truth, hz), 25.0)
    made = fit_clip(points_of(truth, seen))
    ((_, told, _, _, size),) = made.skeleton.source.mended
    assert abs(float(told) - hz) <= 0.1
    # 25 mm is the mean distance, whose square mean is a little more.
    assert 1e3 * size == pytest.approx(27.0, rel=0.25)
    assert off_mm(made.positions(), truth.positions()) < best_filter(seen, truth)
    (fault,) = (f for f in examine(made).faults if f.kind == "tremble")
    assert (fault.joint, fault.detail) == (
        "",
        f"at {float(told):.1f} Hz",
    ) and fault.size == pytest.approx(1e3 * size)
    assert fault.hz == float(told) and fault.to_dict()["hz"] == fault.hz


def test_what_the_user_states_goes_before_what_was_measured(truth: Clip) -> None:
    seen = shaken(truth, tone(truth, 5.0), 25.0)
    raw = fit_clip(points_of(truth, seen, raw=True))
    assert off_mm(raw.positions(), truth.positions()) > 15.0
    filtered = fit_clip(points_of(truth, seen), FitConfig(smooth_hz=8.0))
    assert not filtered.skeleton.source.mended
    assert off_mm(filtered.positions(), truth.positions()) > 15.0


def test_keypoints_that_jump_about_are_no_motion(truth: Clip) -> None:
    rng = np.random.default_rng(0)
    places = truth.positions()[:1] + 0.3 * rng.standard_normal(truth.positions().shape)
    with refused("only-noise"):
        fit_clip(points_of(truth, places))


def test_a_body_that_bounces_does_not_tremble(truth: Clip) -> None:
    # All of it moves at 2 Hz, and its bones keep their lengths.
    t = np.arange(truth.frames) / truth.fps
    bounced = truth.positions() + 0.05 * np.sin(2 * np.pi * 2.0 * t)[:, None, None]
    assert not fit_clip(points_of(truth, bounced)).skeleton.source.mended


def test_triangulated_keypoints_tremble_and_filtered_ones_do_not(data_dir: Path) -> None:
    folder = data_dir / "noisy/pose2sim/single"
    raw, filtered = (
        read_clip(folder / f"S00_P00_T01_BalancingTrial_0-100{end}.trc")
        for end in ("", "_filt_butterworth")
    )
    # 3 mm along two axes and 6 along one.
    ((kind, _, _, _, size),) = raw.skeleton.source.mended
    assert kind == "tremble" and 0.005 < size < 0.01
    assert not filtered.skeleton.source.mended
