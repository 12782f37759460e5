"""Noise of known size is told, and taken off nearer to the truth than the best filter does."""

from __future__ import annotations

from collections.abc import Callable
from importlib.resources import as_file, files
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import butter, sosfiltfilt

from poise.formats import read_clip
from poise.formats.point_fit import fit_clip
from poise.kinematics import anatomy_of, examine, heal, support_of
from poise.kinematics.hold import mend_slides
from poise.kinematics.repair import estimate as clean
from poise.kinematics.repair import support
from poise.kinematics.repair.estimate import clean_clip, denoise, find_lost, noise_faults, refill
from poise.kinematics.repair.faults import Fault
from poise.kinematics.repair.support import slide_faults
from poise.motion import Clip
from poise.motion.keypoints import Keypoints
from poise.motion.rotations import quat_mul, rotvec_to_quat, unwrap_quats
from poise.motion.smoothing import Spectrum, filled, white_mm
from refusals import refused

CUTOFFS = (0.7, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0, 5.0, 6.0, 8.0, 10.0)


@pytest.fixture(scope="module")
def walk() -> Clip:
    """The walk that comes with Poise, 30 Hz."""
    with as_file(files("poise") / "data/walk.bvh") as path:
        return read_clip(path)


def white(rng: np.random.Generator, frames: int, channels: int, fps: float) -> np.ndarray:
    return rng.standard_normal((frames, channels, 3))


def tone(hz: float) -> Callable[[np.random.Generator, int, int, float], np.ndarray]:
    def make(rng: np.random.Generator, frames: int, channels: int, fps: float) -> np.ndarray:
        phase = rng.uniform(0, 2 * np.pi, (channels, 3))
        return np.sqrt(2) * np.sin(2 * np.pi * hz * np.arange(frames)[:, None, None] / fps + phase)

    return make


def dirty(clip: Clip, mm: float, kind: Callable[..., np.ndarray], seed: int = 0) -> Clip:
    """The clip with every joint turned and the root moved by noise, so that joints are `mm` off."""
    noise = kind(np.random.default_rng(seed), clip.frames, len(clip.skeleton) + 1, clip.fps)

    def made(size: float) -> Clip:
        rot = quat_mul(clip.rot, rotvec_to_quat(size * noise[:, :-1]))
        return clip.replaced(rot=unwrap_quats(rot), root_pos=clip.root_pos + 0.2 * size * noise[:, -1])

    size = 0.02
    for _ in range(4):
        size *= mm / off_mm(made(size), clip)
    return made(size)


def off_mm(a: Clip, b: Clip) -> float:
    return 1e3 * float(np.linalg.norm(a.positions() - b.positions(), axis=-1).mean())


def filtered(clip: Clip, truth: Clip) -> float:
    """mm from the truth of the best Butterworth filter, chosen by one who knows the truth."""

    def low(x: np.ndarray, hz: float) -> np.ndarray:
        return sosfiltfilt(butter(4, hz, fs=clip.fps, output="sos"), x, axis=0)

    out = []
    for hz in CUTOFFS:
        rot = low(clip.rot.reshape(clip.frames, -1), hz).reshape(clip.rot.shape)
        rot = rot / np.linalg.norm(rot, axis=-1, keepdims=True)
        out.append(off_mm(clip.replaced(rot=rot, root_pos=low(clip.root_pos, hz)), truth))
    return min(out)


@pytest.mark.parametrize("mm", [10.0, 25.0, 100.0])
def test_white_noise_is_taken_off_as_the_best_filter_does(walk: Clip, mm: float) -> None:
    broken = [dirty(walk, mm, white, seed) for seed in range(3)]
    ratio = [off_mm(denoise(b), walk) / filtered(b, walk) for b in broken]
    assert np.mean(ratio) < 1.02


@pytest.mark.parametrize("name", ["walk_normal_001", "kick_normal_001", "punch_normal_001"])
def test_white_noise_on_recorded_motion_is_taken_off_better_than_any(data_dir: Path, name: str) -> None:
    clip = read_clip(next((data_dir / "other/bandai_bvh").rglob(f"dataset-1_{name}.bvh")))
    for mm in (10.0, 50.0):
        broken = dirty(clip, mm, white)
        assert off_mm(denoise(broken), clip) < filtered(broken, clip)


@pytest.mark.parametrize("hz", [4.0, 5.0, 7.3])
def test_a_tremble_is_told_by_its_frequency_and_taken_off(walk: Clip, hz: float) -> None:
    broken = dirty(walk, 25.0, tone(hz))
    (fault,) = (f for f in examine(broken).faults if f.kind == "tremble")
    assert fault.detail == f"at {hz:.1f} Hz"
    # 25 mm is the mean distance, whose square mean is a little more.
    assert fault.size == pytest.approx(28.0, rel=0.15)
    assert off_mm(denoise(broken), walk) < 0.8 * filtered(broken, walk)


def test_white_noise_is_measured(walk: Clip) -> None:
    rng = np.random.default_rng(1)
    places = walk.positions()
    assert white_mm(places, walk.fps) < 2.0
    # Three axes of 10 mm each.
    shaken = places + 0.01 * rng.standard_normal(places.shape)
    assert white_mm(shaken, walk.fps) == pytest.approx(17.3, rel=0.1)


def test_a_clean_motion_has_no_noise_and_comes_back_as_it_is(walk: Clip) -> None:
    assert denoise(walk) is walk
    assert refill(walk) is walk
    assert {"tremble", "spike", "held"}.isdisjoint(f.kind for f in examine(walk).faults)


def test_the_spectrum_of_white_noise_and_of_a_tone() -> None:
    rng, frames, fps = np.random.default_rng(2), 4000, 100.0
    groups = np.zeros(3, dtype=int)
    noise = 0.5 * rng.standard_normal((frames, 3))
    assert Spectrum.of(noise, fps, groups).floor()[0] == pytest.approx(0.75, rel=0.05)
    wave = np.sin(2 * np.pi * 7.0 * np.arange(frames) / fps)[:, None] * np.array([1.0, 0.0, 2.0])
    # The variance of a sin is a^2 / 2.
    assert Spectrum.of(wave, fps, groups).tone(7.0)[0][0] == pytest.approx(2.5, rel=0.02)


def test_spikes_and_held_joints_are_filled_in(walk: Clip) -> None:
    rot = unwrap_quats(walk.rot).copy()
    arm, leg = (walk.skeleton.index(n) for n in ("LeftArm", "RightUpLeg"))
    turn = rotvec_to_quat(np.array([0.0, 0.0, 1.2], dtype=float))
    rot[20, arm] = quat_mul(rot[20, arm], turn)
    rot[37:46, leg] = rot[36, leg]
    broken = walk.replaced(rot=rot)
    assert sorted(find_lost(broken, rot)) == [("held", leg, 37, 45), ("spike", arm, 20, 20)]
    faults = {f.kind: f for f in examine(broken).faults if f.kind in ("spike", "held")}
    assert (faults["spike"].joint, faults["spike"].start) == (walk.skeleton.names[arm], 20)
    assert faults["spike"].size == pytest.approx(np.degrees(1.2), rel=0.1)
    was, now = off_mm(broken, walk), off_mm(refill(broken), walk)
    assert now < 0.25 * was
    others = np.delete(np.arange(walk.frames), [20, *range(37, 46)])
    np.testing.assert_allclose(refill(broken).positions()[others], walk.positions()[others], atol=1e-9)


@pytest.mark.parametrize("frame", [0, 1, 2, -3, -2, -1])
def test_a_trembling_clip_loses_its_spikes_at_either_end(walk: Clip, frame: int) -> None:
    # 20 degrees of a joint that carries the trunk; too little to be sure of in a clip without noise.
    spine = walk.skeleton.index("Spine")
    shaken = dirty(walk, 8.0, tone(5.0))
    rot = unwrap_quats(shaken.rot)
    leap = rotvec_to_quat(np.array([0.35, 0.0, 0.0], dtype=float))
    rot[frame, spine] = quat_mul(rot[frame, spine], leap)
    found, whole = noise_faults(shaken.replaced(rot=rot))
    at = frame % walk.frames
    assert [(f.joint, f.start) for f in found if f.kind == "spike"] == [("Spine", at)]
    off = np.linalg.norm(denoise(whole).positions() - walk.positions(), axis=-1)[at].mean()
    assert off < 0.012


def test_what_is_missing_lies_on_the_smoothest_curve() -> None:
    t = np.arange(60) / 30.0
    known = np.ones(60, dtype=bool)
    known[25:33] = False
    y = (1.0 + 2.0 * t - 0.7 * t**2)[:, None]
    # A parabola has no third difference.
    np.testing.assert_allclose(filled(np.where(known[:, None], y, 9.0), known, 30.0), y, atol=1e-5)


def test_a_long_clip_is_smoothed_by_pieces_that_meet(walk: Clip) -> None:
    there = np.concatenate([np.arange(walk.frames), np.arange(walk.frames - 2, 0, -1)])
    order = np.resize(there, 3000)
    long = walk.replaced(root_pos=walk.root_pos[order], rot=unwrap_quats(walk.rot[order]))
    broken = dirty(long, 25.0, white)
    fixed = denoise(broken)
    assert off_mm(fixed, long) < filtered(broken, long)
    step = np.linalg.norm(np.diff(fixed.positions(), axis=0), axis=-1).max()
    assert step < 1.5 * np.linalg.norm(np.diff(long.positions(), axis=0), axis=-1).max()


def test_trembling_feet_do_not_move_the_path(walk: Clip) -> None:
    fixed = heal(dirty(walk, 25.0, white))
    ends = [c.root_pos[-1, :2] for c in (fixed, walk)]
    assert np.linalg.norm(ends[0] - ends[1]) < 0.03


@pytest.mark.parametrize("name", ["dataset-1_run_sad_001", "dataset-1_dash_not-confident_001"])
def test_clean_runs_keep_their_path(data_dir: Path, name: str) -> None:
    run = read_clip(next((data_dir / "other/bandai_bvh").rglob(f"{name}.bvh")))
    np.testing.assert_allclose(heal(run).root_pos[:, :2], run.root_pos[:, :2], atol=1e-9)


def test_a_tremble_as_slow_as_steps_is_told_under_a_gait(walk: Clip) -> None:
    broken = dirty(walk, 25.0, tone(2.0))
    found = [f for f in examine(broken).faults if f.kind == "tremble"]
    assert len(found) == 1 and 5.0 < found[0].size < 40.0
    assert float(found[0].detail.split()[1]) == pytest.approx(2.0, abs=0.15)
    # The gait keeps its own 2 Hz, which every low-pass cuts.
    assert off_mm(denoise(broken), walk) < 1.1 * filtered(broken, walk)


def test_cycles_that_repeat_have_no_tremble(walk: Clip) -> None:
    # A bounce of all joints in each cycle is the motion's own, since it comes back exactly.
    cycle = dirty(walk, 25.0, tone(4.0))
    first = cycle.rot[:30]
    again = cycle.replaced(rot=np.tile(first, (4, 1, 1)), root_pos=np.tile(cycle.root_pos[:30], (4, 1)))
    assert not [f for f in examine(again).faults if "Hz" in f.detail]


def test_small_spikes_are_found_where_there_are_large_ones(walk: Clip) -> None:
    rng = np.random.default_rng(5)
    hit = rng.random((walk.frames, len(walk.skeleton), 1)) < 0.02
    # One in the first and one in the last frame, and one of half a turn.
    hit[0, 3] = hit[-1, 4] = hit[40, 5] = True
    turn = 0.6 * rng.standard_normal((walk.frames, len(walk.skeleton), 3)) * hit
    turn[40, 5] = (0.0, 3.1, 0.0)
    rot = quat_mul(walk.rot, rotvec_to_quat(turn))
    broken = walk.replaced(rot=rot)
    assert off_mm(broken, walk) > 20.0
    assert off_mm(refill(broken), walk) < 2.0


def test_feet_that_trembled_stand_again(walk: Clip) -> None:
    before, after = (
        examine(c).figures["sole_slide_mm_per_s"] for c in (walk, heal(dirty(walk, 25.0, white)))
    )
    assert before is not None and after is not None and after < before + 20.0


@pytest.mark.parametrize("mm", [10.0, 50.0])
def test_feet_of_trembling_keypoints_stand_again(walk: Clip, mm: float) -> None:
    truth = fit_clip(Keypoints(walk.skeleton.names, walk.positions(), walk.fps))
    rng = np.random.default_rng(0)
    off = rng.standard_normal((*truth.rot.shape[:2], 3))
    places = truth.positions() + mm / 1e3 * off / np.linalg.norm(off, axis=-1).mean()
    fitted = fit_clip(Keypoints(truth.skeleton.names, places, truth.fps))
    healed = heal(fitted)
    # The points were freed of noise: no joint of the bones between them is lost.
    assert [f for f in noise_faults(fitted)[0] if f.kind != "tremble"] == []
    assert off_mm(healed, truth) < 1.3 * off_mm(fitted, truth)
    before, loose, after = (_ankle_slide(c, truth) for c in (truth, fitted, healed))
    assert after < before + 20.0 and after - before < 0.3 * (loose - before)


def _ankle_slide(clip: Clip, truth: Clip) -> float:
    """mm/s of ankles and toes that stand in truth."""
    feet = [j for j, n in enumerate(truth.skeleton.names) if "Foot" in n or "Toe" in n]
    path, there = clip.positions()[:, feet], truth.positions()[:, feet]
    stands = np.linalg.norm(np.diff(there, axis=0), axis=-1) * truth.fps < 0.1
    stands &= there[1:, :, 2] < there[..., 2].min(0) + 0.05
    speed = np.linalg.norm(np.diff(path[..., :2], axis=0), axis=-1) * clip.fps
    return 1e3 * float(speed[stands].mean())


def test_a_foot_that_trembles_little_keeps_its_roll(walk: Clip) -> None:
    broken = dirty(walk, 10.0, white)
    held, loose = heal(broken), clean_clip(broken, rougher=False)[0]
    assert off_mm(held, walk) < 1.1 * off_mm(loose, walk)
    before, after = (_ankle_slide(c, walk) for c in (walk, held))
    assert after < before + 20.0


def test_a_foot_that_swings_through_near_the_floor_is_not_held(walk: Clip) -> None:
    # It stands, is 0.2 m on after 0.1 s, and stands there.
    frames = 40
    path = np.repeat(walk.root_pos[:1], frames, axis=0)
    path[:, 0] += 0.2 * np.clip((np.arange(frames) - 18) / 3, 0.0, 1.0)
    clip = walk.replaced(root_pos=path, rot=np.repeat(walk.rot[:1], frames, axis=0))
    support = support_of(clip, anatomy_of(clip))
    assert support is not None
    feet = {f.joint for f in slide_faults(clip, support)}
    assert feet
    faults = [Fault("foot slide", foot, 0, frames - 1, 20.0) for foot in feet]
    assert off_mm(mend_slides(clip, support, faults), clip) < 0.1


def test_a_run_is_held_less_than_a_walk() -> None:
    t = np.arange(120) / 30.0
    stands = np.stack([np.sin(2 * np.pi * hz * t) > 0 for hz in (0.5, 2.5)], 1).astype(float)
    lasting = support.lasting(stands)
    # A second, and a fifth of one; nothing elsewhere.
    assert lasting[5, 0] == pytest.approx(30, abs=1) and lasting[3, 1] == pytest.approx(6, abs=1)
    assert (lasting[stands < 0.5] == 1).all()


def test_frames_that_jump_about_are_no_motion(walk: Clip) -> None:
    rng = np.random.default_rng(0)
    rot = rng.standard_normal(walk.rot.shape)
    rot /= np.linalg.norm(rot, axis=-1, keepdims=True)
    nothing = walk.replaced(rot=rot, root_pos=rng.standard_normal((walk.frames, 3)))
    for here in (nothing, nothing.replaced(root_pos=walk.root_pos)):
        with refused("only-noise"):
            heal(here)


def test_what_the_doctor_found_is_not_looked_for_again(
    walk: Clip, monkeypatch: pytest.MonkeyPatch
) -> None:
    counted: list[Clip] = []

    def counting(clip: Clip) -> Clip:
        counted.append(clip)
        return denoise(clip)

    monkeypatch.setattr(clean, "denoise", counting)
    broken = dirty(walk, 25.0, white)
    found = examine(broken)
    healed = heal(broken, found=found)
    assert len(counted) == 1
    by_itself = heal(broken)
    np.testing.assert_array_equal(healed.rot, by_itself.rot)
    np.testing.assert_array_equal(healed.root_pos, by_itself.root_pos)
    # What is known of another clip is not taken.
    np.testing.assert_array_equal(heal(walk, found=found).rot, heal(walk).rot)


def test_a_twist_that_the_next_joint_undoes_is_no_spike(walk: Clip) -> None:
    skeleton, rot = walk.skeleton, walk.rot
    arm, fore = skeleton.index("LeftArm"), skeleton.index("LeftForeArm")
    hand = skeleton.index("LeftHand")
    bone = skeleton.offsets[fore] / np.linalg.norm(skeleton.offsets[fore])
    turned = rot.copy()
    for frame in (20, 41, 60):
        turned[frame, arm] = quat_mul(rot[frame, arm], rotvec_to_quat(1.2 * bone))
        turned[frame, fore] = quat_mul(rotvec_to_quat(-1.2 * bone), rot[frame, fore])
    twisted = walk.replaced(rot=unwrap_quats(turned))
    np.testing.assert_allclose(twisted.positions(), walk.positions(), atol=1e-9)
    assert not find_lost(twisted, unwrap_quats(turned))
    assert np.abs(refill(twisted).positions() - walk.positions())[:, hand].max() < 1e-9
    # The same leap of the arm alone is one.
    leaping = turned.copy()
    leaping[:, fore] = rot[:, fore]
    alone = walk.replaced(rot=unwrap_quats(leaping))
    lost = find_lost(alone, unwrap_quats(leaping))
    assert {("spike", arm, t, t) for t in (20, 41, 60)} <= set(lost)


def test_keypoints_that_were_cleaned_are_not_made_worse(data_dir: Path) -> None:
    folder = data_dir / "noisy/pose2sim/single"
    read, pair = (
        read_clip(folder / f"S00_P00_T01_BalancingTrial_0-100{end}.trc")
        for end in ("", "_filt_butterworth")
    )
    hand = read.skeleton.index("LeftHand")
    there = pair.positions()[:, hand] - pair.root_pos
    for clip in (read, heal(read)):
        off = np.linalg.norm(clip.positions()[:, hand] - clip.root_pos - there, axis=-1)
        assert 1e3 * off.mean() < 13.0 and 1e3 * off.max() < 130.0
