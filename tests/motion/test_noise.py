"""Estimator noise: identities, statistics against what was asked for, and against real estimators."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from poise.formats import read_clip
from poise.formats.point_noise import smooth
from poise.formats.point_raw import assemble_points
from poise.formats.point_tables import trc_points
from poise.formats.raw import ReadOptions
from poise.motion import resample
from poise.motion.keypoints import Keypoints
from poise.motion.noise import (
    TRIANGULATED,
    VIDEO,
    Drift,
    Dropouts,
    FrameLoss,
    Jitter,
    Latency,
    Noise,
    Outliers,
    SwapSides,
    WrongDepth,
    hold_missing,
    last_seen,
    perturb_clip,
    perturb_points,
    perturb_positions,
    robustness_levels,
    scaled,
    side_pairs,
    smooth_path,
    spell_mask,
    wandering_path,
)
from poise.motion.rotations import quat_angle, quat_conj, quat_mul
from refusals import refused
from toy_human import human, swing

KINDS = (Jitter, Outliers, Drift, WrongDepth, Dropouts, FrameLoss, SwapSides, Latency)
NAMES = ("Hips", "LeftKnee", "RightKnee", "LeftWrist", "RightWrist")
FPS = 30.0


def still(frames: int = 3000) -> np.ndarray:
    """Points that do not move, so that everything that does is noise."""
    return np.tile(np.arange(15.0).reshape(1, 5, 3) / 10, (frames, 1, 1))


def moved(noise: Noise | tuple[Noise, ...], frames: int = 3000, seed: int = 0) -> np.ndarray:
    return perturb_positions(still(frames), FPS, NAMES, noise, seed) - still(frames)


def points() -> Keypoints:
    clip = swing(2.0)
    return Keypoints(clip.skeleton.names, clip.positions(), clip.fps, "swing")


@pytest.mark.parametrize("kind", KINDS)
def test_strength_nothing_changes_nothing(kind: type[Noise]) -> None:
    clip, none = swing(1.0), kind(strength=0.0)
    assert np.array_equal(perturb_points(points(), none).positions, points().positions)
    made = perturb_clip(clip, none)
    assert np.array_equal(made.rot, clip.rot) and np.array_equal(made.root_pos, clip.root_pos)


@pytest.mark.parametrize("kind", KINDS)
def test_the_same_seed_makes_the_same_noise(kind: type[Noise]) -> None:
    clip, noise = swing(2.0), kind(strength=3.0)
    a, b = perturb_clip(clip, noise), perturb_clip(clip, noise)
    assert np.array_equal(a.rot, b.rot) and np.array_equal(a.root_pos, b.root_pos)
    assert np.abs(np.linalg.norm(a.rot, axis=-1) - 1).max() < 1e-12
    p, q = perturb_points(points(), noise), perturb_points(points(), noise)
    np.testing.assert_array_equal(p.positions, q.positions)
    assert not np.array_equal(p.positions, points().positions)
    if kind is not Latency:
        for other in (
            perturb_points(points(), noise, 1),
            perturb_points(points(), replace(noise, seed=1)),
        ):
            assert not np.array_equal(other.positions, p.positions, equal_nan=True)
        named = perturb_points(points().replaced(name="other"), noise)
        assert not np.array_equal(named.positions, p.positions, equal_nan=True)


@pytest.mark.parametrize("kind", (Jitter, Drift, WrongDepth))
def test_another_strength_is_the_same_noise_at_another_size(kind: type[Noise]) -> None:
    np.testing.assert_allclose(moved(kind(strength=2.0), 50), 2 * moved(kind(), 50), atol=1e-12)


@pytest.mark.parametrize("kind", (Dropouts, FrameLoss))
def test_more_strength_loses_what_less_loses_and_more(kind: type[Noise]) -> None:
    lost = [np.isnan(moved(kind(strength=s))).any(-1) for s in (1.0, 4.0)]
    assert not (lost[0] & ~lost[1]).any() and lost[1].sum() > 3 * lost[0].sum()


def test_jitter_has_its_size_and_memory() -> None:
    off = moved(Jitter(sigma_m=0.01, tau_s=0.1))
    assert off.std() == pytest.approx(0.01, rel=0.05)
    for lag, want in ((1, np.exp(-1 / 18)), (3, np.exp(-0.5)), (9, np.exp(-4.5))):
        got = np.mean(off[lag:] * off[:-lag]) / np.mean(off**2)
        assert got == pytest.approx(want, abs=0.05)
    # Points and coordinates tremble on their own.
    corr = np.corrcoef(off.reshape(len(off), -1).T)
    assert np.abs(corr[np.triu_indices(15, 1)]).max() < 0.2
    axis = moved(Jitter(sigma_m=0.01, tau_s=0.0, axis=(0, 2, 0), axis_ratio=3.0)).std((0, 1))
    np.testing.assert_allclose(axis, [0.01, 0.03, 0.01], rtol=0.05)


def test_drift_moves_the_whole_body() -> None:
    off = moved(Drift(sigma_m=(0.1, 0.0, 0.05), tau_s=0.5), 30000)
    np.testing.assert_allclose(off, np.broadcast_to(off[:, :1], off.shape), atol=1e-12)
    np.testing.assert_allclose(off[:, 0].std(0), [0.1, 0.0, 0.05], rtol=0.1)
    x = off[:, 0, 0]
    assert np.mean(x[15:] * x[:-15]) / np.mean(x**2) == pytest.approx(np.exp(-1), abs=0.07)


def test_wrong_depth_by_hand() -> None:
    pos = np.zeros((4, 2, 3))
    pos[:, 0], pos[:, 1] = (2.0, 1.0, 0.0), (4.0, 0.0, 1.0)
    wrong = WrongDepth(sigma=0.0, bias=0.1, axis=(2.0, 0.0, 0.0), camera=(0.0, 5.0, 5.0))
    got = perturb_positions(pos, FPS, ("a", "b"), wrong)
    np.testing.assert_allclose(got[0], [(2.2, 1.0, 0.0), (4.4, 0.0, 1.0)])
    # Without a camera it stands 4 m in front of the body's middle.
    near = perturb_positions(pos, FPS, ("a", "b"), replace(wrong, camera=None))
    np.testing.assert_allclose(near[0, :, 0], [2.0 + 0.1 * 3.0, 4.0 + 0.1 * 5.0])
    clip = swing(1.0)
    made = perturb_clip(clip, replace(wrong, camera=(-1.0, 0.0, 0.0)))
    np.testing.assert_allclose(made.root_pos[:, 0] + 1, 1.1 * (clip.root_pos[:, 0] + 1))
    assert np.array_equal(made.root_pos[:, 1:], clip.root_pos[:, 1:])


def test_dropouts_have_their_share_and_length() -> None:
    lost = np.isnan(moved(Dropouts(share=0.1, mean_s=0.2), 20000)).any(-1)
    assert lost.mean() == pytest.approx(0.1, rel=0.1)
    starts = (lost[1:] & ~lost[:-1]).sum()
    assert lost.sum() / starts / FPS == pytest.approx(0.2, rel=0.1)
    assert not np.array_equal(lost[:, 0], lost[:, 1])
    whole = np.isnan(moved(FrameLoss(share=0.1), 20000)).any(-1)
    assert (whole.all(1) == whole.any(1)).all() and whole.mean() == pytest.approx(0.1, rel=0.15)
    assert np.isnan(moved(Dropouts(share=1.0), 5)).all()


def test_spells_so_dense_that_they_touch() -> None:
    rng = np.random.default_rng(0)
    assert spell_mask(rng, 20000, 1, FPS, 0.9, 1 / FPS).mean() == pytest.approx(0.9, abs=0.02)


def test_a_pose_holds_what_was_last_seen() -> None:
    clip = swing(2.0, speed=1.0)
    made = perturb_clip(clip, FrameLoss(share=0.4))
    at = [int(np.flatnonzero((clip.root_pos == x).all(1))[0]) for x in made.root_pos]
    assert at == sorted(at) and all(a <= t for t, a in enumerate(at) if t > at[0]) and at[-1] > 30
    np.testing.assert_array_equal(made.rot, clip.rot[at])
    lost = np.array([[1, 0], [0, 1], [1, 1], [0, 1]], dtype=bool)
    np.testing.assert_array_equal(last_seen(lost), [[1, 0], [1, 0], [1, 0], [3, 0]])


def test_gaps_are_held() -> None:
    pos = still(4)
    pos[1, 2] = pos[0, 3] = np.nan
    pos[2] += 1.0
    held = hold_missing(pos)
    np.testing.assert_array_equal(held[1, 2], pos[0, 2])
    np.testing.assert_array_equal(held[0, 3], pos[1, 3])
    assert not np.isnan(held).any()


def test_swapped_sides() -> None:
    pos = np.random.default_rng(0).normal(size=(2000, 5, 3))
    got = perturb_positions(pos, FPS, NAMES, SwapSides(share=0.2))
    legs = (got[:, 1] != pos[:, 1]).any(-1)
    arms = (got[:, 3] != pos[:, 3]).any(-1)
    np.testing.assert_array_equal(got[:, 0], pos[:, 0])
    np.testing.assert_array_equal(got[legs][:, [1, 2]], pos[legs][:, [2, 1]])
    np.testing.assert_array_equal(got[arms][:, [3, 4]], pos[arms][:, [4, 3]])
    assert legs.mean() == pytest.approx(0.2, abs=0.06) and (legs != arms).any()
    always = SwapSides(share=1.0)
    clip = swing(1.0)
    twice = perturb_clip(perturb_clip(clip, always), always)
    assert np.array_equal(twice.rot, clip.rot)
    assert np.array_equal(
        perturb_clip(clip, always).rot[:, human().index("LeftLeg")],
        clip.rot[:, human().index("RightLeg")],
    )


def test_pairs_of_sides() -> None:
    names = (
        "root",
        "lfemur",
        "rfemur",
        "lowerback",
        "LWrist",
        "RWrist",
        "hand.L",
        "hand.R",
        "l_toe",
        "r_toe",
    )
    assert side_pairs(names) == ((1, 2, "leg"), (4, 5, "arm"), (6, 7, "arm"), (8, 9, "leg"))
    assert len(side_pairs(human().names)) == 7


def test_latency_shifts_and_interpolates() -> None:
    ramp = np.arange(10.0)[:, None, None] * np.ones((1, 5, 3))
    late = perturb_positions(ramp, FPS, NAMES, Latency(seconds=2 / FPS))[:, 0, 0]
    np.testing.assert_allclose(late, [0, 0, 0, 1, 2, 3, 4, 5, 6, 7], atol=1e-9)
    half = perturb_positions(ramp, FPS, NAMES, Latency(seconds=2 / FPS, strength=0.25))[:, 0, 0]
    np.testing.assert_allclose(half, np.maximum(np.arange(10) - 0.5, 0), atol=1e-9)
    clip = swing(1.0, speed=1.0)
    made = perturb_clip(clip, Latency(seconds=3 / FPS))
    np.testing.assert_allclose(made.root_pos[3:], clip.root_pos[:-3], atol=1e-12)
    turn = quat_mul(quat_conj(torch.tensor(clip.rot[:-3])), torch.tensor(made.rot[3:]))
    assert float(quat_angle(turn).abs().max()) < 1e-6
    # A missing frame spoils only what is made of it.
    ramp[5] = np.nan
    late = perturb_positions(ramp, FPS, NAMES, Latency(seconds=2 / FPS))
    assert np.isnan(late[:, 0, 0]).tolist() == [False] * 7 + [True] + [False] * 2


def test_rotations_turn_by_what_was_asked_for() -> None:
    clip = swing(60.0)
    made = perturb_clip(clip, Jitter(sigma_rad=0.1, sigma_m=0.0))
    turn = quat_angle(quat_mul(quat_conj(torch.tensor(clip.rot)), torch.tensor(made.rot)))
    assert float(turn.square().mean().sqrt()) == pytest.approx(0.1 * 3**0.5, rel=0.05)
    np.testing.assert_allclose(made.root_pos, clip.root_pos, atol=1e-12)


def test_noise_acts_in_order() -> None:
    pair = (Latency(seconds=0.5), Drift())
    a, b = moved(pair, 90), moved(pair[::-1], 90)
    # A drift that is delayed holds its first value; one after the delay does not.
    assert np.ptp(b[:16], axis=0).max() < 1e-12 < np.ptp(a[:16], axis=0).max()


def test_a_ladder() -> None:
    rungs = robustness_levels(VIDEO, (2.0, 0.0, 1.0))
    assert [(r.name, r.strength) for r in rungs] == [("clean", 0.0), ("all x1", 1.0), ("all x2", 2.0)]
    assert rungs[1].noise == VIDEO and rungs[2].noise == scaled(VIDEO, 2.0)
    every = robustness_levels(TRIANGULATED, (0.0, 1.0), each=True)
    assert [r.name for r in every] == ["clean", "all x1", "Jitter x1", "Outliers x1"]
    clean = perturb_points(points(), rungs[0].noise)
    assert np.array_equal(clean.positions, points().positions)
    off = []
    for rung in robustness_levels(VIDEO, (0.5, 1.0, 2.0, 4.0)):
        seen = hold_missing(perturb_points(points(), rung.noise).positions)
        off.append(float(np.linalg.norm(seen - points().positions, axis=-1).mean()))
    assert off == sorted(off) and off[0] > 0.01


def test_what_makes_no_sense_is_refused() -> None:
    with refused("out-of-range", says=("Jitter", "strength")):
        Jitter(strength=-1.0)
    with refused("out-of-range", says=("Dropouts", "share")):
        Dropouts(share=float("nan"))
    with refused("no-direction"):
        moved(Jitter(axis=(0.0, 0.0, 0.0)), 5)
    with refused("wrong-shape", says="(T, 1, 3)"):
        perturb_positions(still(5), FPS, ("a",), Jitter())
    with refused("out-of-range"):
        robustness_levels((), (1.0,))


def test_processes_have_unit_size() -> None:
    rng = np.random.default_rng(0)
    for tau in (0.0, 0.02, 0.3):
        assert smooth_path(rng, 20000, (2,), FPS, tau).std() == pytest.approx(1.0, abs=0.1)
        assert wandering_path(rng, 20000, (2,), FPS, tau).std() == pytest.approx(1.0, abs=0.1)


def test_triangulated_noise_is_like_pose2sims(data_dir) -> None:
    folder = data_dir / "noisy/pose2sim/single"
    raw, clean = (
        assemble_points(
            trc_points(folder / f"S00_P00_T01_BalancingTrial_0-100{tail}.trc"), ReadOptions()
        )
        for tail in ("", "_filt_butterworth")
    )
    made = perturb_points(clean, TRIANGULATED)
    real = np.linalg.norm(raw.positions - clean.positions, axis=-1)
    ours = np.linalg.norm(made.positions - clean.positions, axis=-1)
    for q in (0.5, 0.9, 0.99):
        assert np.quantile(ours, q) == pytest.approx(np.quantile(real, q), rel=0.3)


def test_video_jitter_is_like_rokokos(data_dir) -> None:
    dance = resample(read_clip(data_dir / "noisy/rokoko_video/jesse_dance.bvh"), FPS)
    fingers = ("Thumb", "Index", "Middle", "Ring", "Pinky")
    body = [j for j, n in enumerate(dance.skeleton.names) if not any(f in n for f in fingers)]
    real = dance.positions()[:, body]
    clean = resample(read_clip(data_dir / "cmu_amc/02/02_07.amc"), FPS).positions()
    names = tuple(f"p{k}" for k in range(clean.shape[1]))
    ours = perturb_positions(clean, FPS, names, Jitter())

    def above(x: np.ndarray, hz: float) -> float:
        return float(np.median(np.linalg.norm(x - smooth(x, FPS, hz), axis=-1)))

    # Below 4 Hz a dance is not noise.
    for hz in (4.0, 6.0, 8.0):
        assert above(ours, hz) == pytest.approx(above(real, hz), rel=0.25)
        assert above(clean, hz) < 0.3 * above(real, hz)
