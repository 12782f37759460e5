"""Keypoints become clips: identities on real joints, hand-made bodies, gaps, spikes, noise."""

from __future__ import annotations

from dataclasses import replace
from importlib.resources import as_file, files
from pathlib import Path

import numpy as np
import pytest

from poise.body.parts import find_anatomy
from poise.formats import read_clip
from poise.formats.markers import find_places, split_label
from poise.formats.point_fit import FitConfig, fit_clip, fit_distances
from poise.formats.point_noise import drop_spikes, fill, longest_stretch, smooth
from poise.formats.point_skeleton import hold_lengths, steady_twist
from poise.motion import Clip
from poise.motion.keypoints import Keypoints
from poise.motion.rotations import quat_angle, quat_between
from poise.motion.vectors import lower_median, norm
from refusals import refused

# A standing body that faces -Y with the left at +X, m.
BODY = {
    "LHip": (0.1, 0, 0.9), "RHip": (-0.1, 0, 0.9),
    "LKnee": (0.1, -0.02, 0.5), "RKnee": (-0.1, -0.02, 0.5),
    "LAnkle": (0.1, 0, 0.1), "RAnkle": (-0.1, 0, 0.1), "LBigToe": (0.1, -0.18, 0.02),
    "RBigToe": (-0.1, -0.18, 0.02), "LHeel": (0.1, 0.05, 0.02), "RHeel": (-0.1, 0.05, 0.02),
    "LShoulder": (0.18, 0, 1.4), "RShoulder": (-0.18, 0, 1.4), "LElbow": (0.2, 0.01, 1.1),
    "RElbow": (-0.2, 0.01, 1.1), "LWrist": (0.2, -0.06, 0.86), "RWrist": (-0.2, -0.06, 0.86),
    "Nose": (0, -0.1, 1.6),
}  # fmt: skip


def standing(frames: int = 40, fps: float = 30.0, leave_out: tuple[str, ...] = ()) -> Keypoints:
    """The body, which sways a little so that nothing is still."""
    names = tuple(n for n in BODY if n not in leave_out)
    rest = np.array([BODY[n] for n in names])
    sway = 0.05 * np.sin(np.arange(frames) / fps * 2 * np.pi)[:, None, None]
    return Keypoints(names, rest + sway * (0.5 + rest[:, 2:3] * [[1.0, 0.5, 0.0]]), fps)


def mean_mm(points: Keypoints, clip: Clip) -> float:
    return 1e3 * float(np.mean([np.nanmean(d) for d in fit_distances(points, clip).values()]))


def test_a_standing_person_gets_an_ordinary_skeleton() -> None:
    points = standing()
    clip = fit_clip(points)
    parts = {(p.kind, p.side) for p in find_anatomy(clip.skeleton).parts}
    assert {
        ("pelvis", ""),
        ("head", ""),
        ("hand", "left"),
        ("foot", "right"),
        ("clavicle", "left"),
    } <= parts
    assert mean_mm(points, clip) < 2.0
    # Standing is near the rest pose but for the arms: no joint of legs and trunk turns by much.
    q = clip.rot
    for name in ("Hips", "LeftUpLeg", "LeftLeg", "RightFoot", "Spine", "Neck"):
        assert float(quat_angle(q[:, clip.skeleton.index(name)]).max()) < np.radians(25), name
    toe = clip.positions()[:, clip.skeleton.index("LeftToeBase")]
    assert (toe[:, 1] < clip.positions()[:, clip.skeleton.index("LeftFoot")][:, 1] - 0.05).all()


def test_left_and_right_share_their_bones_and_lengths_are_medians() -> None:
    points = standing()
    positions = points.positions.copy()
    positions[:3, points.names.index("LAnkle"), 2] -= 0.5
    positions[:, points.names.index("RAnkle"), 2] -= 0.02
    clip = fit_clip(points.replaced(positions=positions), FitConfig(drop_spikes=False))
    lengths = np.linalg.norm(clip.skeleton.offsets, axis=-1)
    left, right = (lengths[clip.skeleton.index(f"{s}Foot")] for s in ("Left", "Right"))
    assert left == pytest.approx(right)
    assert left == pytest.approx((np.hypot(0.4, 0.02) + np.hypot(0.42, 0.02)) / 2, abs=0.004)


def test_feet_without_toes_follow_the_shins() -> None:
    clip = fit_clip(standing(leave_out=("LBigToe", "RBigToe", "LHeel", "RHeel")))
    assert "LeftToeBase" not in clip.skeleton.names
    turn = quat_angle(clip.rot[:, clip.skeleton.index("LeftFoot")])
    assert float(turn.max()) < 1e-6
    assert any("toe" in note for note in clip.skeleton.source.notes)


@pytest.mark.parametrize(
    "files",
    ["lafan1_bvh/walk4_subject1.bvh", "other/bandai_bvh/dataset-1_punch_normal_001.bvh"],
)
def test_the_joints_of_a_real_clip_are_met_exactly(data_dir: Path, files: str) -> None:
    source = read_clip(data_dir / files)
    source = source.replaced(root_pos=source.root_pos[:1500], rot=source.rot[:1500])
    points = Keypoints(source.skeleton.names, source.positions(), source.fps)
    clip = fit_clip(points)
    assert mean_mm(points, clip) < 0.1
    # Rotations agree with the source's up to each joint's constant rest pose.
    pairs = {"LeftUpLeg": ("LeftUpLeg", "UpperLeg_L"), "RightLeg": ("RightLeg", "LowerLeg_R")}
    pairs |= {"LeftArm": ("LeftArm", "UpperArm_L"), "Hips": ("Hips", "Hips")}
    _, now = clip.world()
    _, was = source.world()
    for joint, options in pairs.items():
        name = next(n for n in options if n in source.skeleton.names)
        turn = quat_between(
            now[:, clip.skeleton.index(joint)],
            was[:, source.skeleton.index(name)],
        )
        mean = np.linalg.eigh((turn[:, :, None] * turn[:, None]).mean(0))[1][:, -1]
        off = np.rad2deg(quat_angle(quat_between(np.broadcast_to(mean, turn.shape), turn)))
        assert float(lower_median(off)) < 8.0, joint


def test_motion_and_its_image_in_a_turned_world_have_the_same_pose() -> None:
    points = standing()
    c, s = np.cos(2.0), np.sin(2.0)
    turned = points.positions @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) + [3.0, -2.0, 0.5]
    one, two = fit_clip(points), fit_clip(points.replaced(positions=turned))
    assert np.allclose(one.skeleton.offsets, two.skeleton.offsets, atol=1e-9)
    turn = quat_between(one.rot[:, 1:], two.rot[:, 1:])
    assert float(quat_angle(turn).max()) < 1e-6


def test_no_quaternion_flips_its_sign_and_the_twist_is_steady_through_straight_limbs() -> None:
    # The elbow bends, stretches fully, and bends again: the upper arm must not spin meanwhile.
    frames, fps = 120, 60.0
    points = standing(frames, fps)
    positions = points.positions.copy()
    bend = np.abs(np.linspace(-1.2, 1.2, frames))
    elbow = positions[:, points.names.index("LElbow")]
    upper = elbow - positions[:, points.names.index("LShoulder")]
    down = upper / np.linalg.norm(upper, axis=-1, keepdims=True)
    ahead = np.cross(down, np.tile([1.0, 0, 0], (frames, 1)))
    ahead /= np.linalg.norm(ahead, axis=-1, keepdims=True)
    ahead *= np.sign(-ahead[:, 1:2])
    lower = np.cos(bend)[:, None] * down + np.sin(bend)[:, None] * ahead
    positions[:, points.names.index("LWrist")] = elbow + 0.25 * lower
    clip = fit_clip(points.replaced(positions=positions))
    q = clip.rot
    assert float((q[1:] * q[:-1]).sum(-1).min()) > 0.9
    arm = q[:, clip.skeleton.index("LeftArm")]
    assert float(quat_angle(quat_between(arm[1:], arm[:-1])).max()) * fps < 3.0


def test_collars_in_one_place_do_not_turn_the_chest() -> None:
    with as_file(files("poise") / "data/walk.bvh") as path:
        walk = read_clip(path)
    # Its collars both lie on its neck.
    names, pos = walk.skeleton.names, walk.positions()
    assert np.allclose(pos[:, names.index("LeftShoulder")], pos[:, names.index("RightShoulder")])
    clip = fit_clip(Keypoints(names, pos, walk.fps))
    chest = clip.world()[1][:, clip.skeleton.index("Spine1")]
    assert float(quat_angle(quat_between(chest[1:], chest[:-1])).max()) < np.radians(8)


def test_noise_of_a_centimetre_is_taken_off_unless_the_file_is_to_stay() -> None:
    points = standing(120, 60.0)
    rng = np.random.default_rng(0)
    noisy = points.replaced(positions=points.positions + 0.01 * rng.standard_normal((120, len(BODY), 3)))
    raw = noisy.replaced(source=replace(noisy.source, raw=True))
    rough, calm, filtered = fit_clip(raw), fit_clip(noisy), fit_clip(noisy, FitConfig(smooth_hz=5.0))
    assert mean_mm(points, rough) < 16.0
    assert mean_mm(points, calm) < 0.75 * mean_mm(points, filtered)
    assert mean_mm(points, filtered) < 0.6 * mean_mm(points, rough)
    assert any("smoothed" in note for note in filtered.skeleton.source.notes)
    told = "The keypoints tremble by 17 mm from frame to frame: the tremble is taken off"
    assert any(note.startswith(told) for note in calm.skeleton.source.notes)
    ((kind, hz, first, last, size),) = calm.skeleton.source.mended
    # Three axes of 10 mm each.
    assert (kind, hz, first, last) == ("tremble", "", 0, 119)
    assert size == pytest.approx(0.0173, rel=0.1)
    for clip in (rough, filtered, fit_clip(points)):
        assert not any("tremble" in note for note in clip.skeleton.source.notes)
        assert not clip.skeleton.source.mended


def test_spikes_are_taken_out_and_steps_and_fast_motion_stay() -> None:
    t = np.arange(100) / 60.0
    path = np.stack((np.sin(8 * t), t, 0.5 * np.cos(6 * t)), -1)[:, None]
    broken = path.copy()
    broken[40:42, 0] += 0.4
    cleaned, spikes = drop_spikes(broken, 60.0)
    assert np.flatnonzero(spikes[:, 0]).tolist() == [40, 41]
    assert np.abs(fill(cleaned[:, 0]) - path[:, 0]).max() < 0.02
    assert not drop_spikes(path, 60.0)[1].any()
    step = path + np.where(t > 0.7, 1.0, 0.0)[:, None, None]
    assert not drop_spikes(step, 60.0)[1].any()


def test_a_short_gap_is_filled_in_the_place_of_the_joint_above() -> None:
    points = standing(60)
    positions = points.positions.copy()
    positions[20:30, points.names.index("RWrist")] = np.nan
    clip = fit_clip(points.replaced(positions=positions))
    assert clip.frames == 60
    assert mean_mm(points, clip) < 3.0
    assert any("interpolated: right wrist 10" in note for note in clip.skeleton.source.notes)


def test_a_long_gap_cuts_the_recording_to_its_longest_stretch() -> None:
    points = standing(90)
    positions = points.positions.copy()
    positions[30:55, points.names.index("RWrist")] = np.nan
    clip = fit_clip(points.replaced(positions=positions))
    assert clip.frames == 35
    assert any("frames 55 to 89 of 90" in note for note in clip.skeleton.source.notes)
    assert fit_clip(points.replaced(positions=positions), FitConfig(max_gap_s=1.0)).frames == 90


def test_longest_stretch_by_hand() -> None:
    missing = np.zeros((10, 2), dtype=bool)
    missing[0, 0] = missing[4:6, 1] = True
    assert longest_stretch(missing, 2) == (1, 10)
    assert longest_stretch(missing, 1) == (6, 10)
    assert longest_stretch(np.ones((3, 1), dtype=bool), 5) == (0, 0)


def test_the_low_pass_halves_the_power_at_its_cutoff_and_keeps_lines() -> None:
    t = np.arange(600) / 60.0
    wave = np.sin(2 * np.pi * 4.0 * t)
    out = smooth(wave[:, None], 60.0, 4.0)[100:500, 0]
    assert np.std(out) / np.std(wave[100:500]) == pytest.approx(2**-0.5, abs=0.01)
    assert np.allclose(smooth(t[:, None], 60.0, 2.0)[:, 0], t)


def test_twist_of_clear_bends_is_kept_and_unclear_ones_are_bridged() -> None:
    angle = np.full((90,), 0.8)
    size = np.where((np.arange(90) > 30) & (np.arange(90) < 60), 0.0, 0.6)
    shown = np.stack((np.cos(angle), np.sin(angle)), -1) * size[..., None]
    assert np.allclose(steady_twist(shown, 60.0), angle, atol=1e-3)
    assert np.allclose(steady_twist(np.zeros((10, 2)), 60.0), np.zeros(10).astype(float))


def test_lengths_hold_after_the_tracks_are_moved_as_little_as_needed() -> None:
    rng = np.random.default_rng(1)
    tracks = {n: rng.standard_normal((5, 3)) for n in "abc"}
    bones = [("a", "b", 1.0), ("b", "c", 0.7)]
    out = hold_lengths(tracks, bones, rounds=60)
    for a, b, length in bones:
        assert np.allclose(norm(out[a] - out[b]), np.full((5,), length).astype(float), atol=1e-4)
    kept = hold_lengths(out, bones)
    assert max(float(norm(kept[n] - out[n]).max()) for n in "abc") < 1e-3


@pytest.mark.parametrize(
    ("label", "expected"),
    [
        ("RHip", ("right", "hip")), ("left_foot_index", ("left", "footindex")),
        ("mixamorig:LeftArm", ("left", "arm")), ("Anna:LASI", ("left", "asi")),
        ("r.ASIS_study", ("right", "asisstudy")), ("Foot_L", ("left", "foot")),
        ("Bip01_L_Thigh", ("left", "thigh")), ("root", ("", "root")), ("rShldr", ("right", "shldr")),
        ("MidHip", ("", "midhip")), ("lfemur", ("left", "femur")), ("Spine2", ("", "spine2")),
    ],
)  # fmt: skip
def test_labels_tell_side_and_part(label: str, expected: tuple[str, str]) -> None:
    assert split_label(label) == expected


def test_words_that_differ_between_sets_are_told_by_their_company() -> None:
    smpl = find_places(
        ("left_ankle", "left_foot", "left_collar", "left_shoulder", "left_wrist", "left_hand")
    )
    assert smpl == {"left_ankle": (0,), "left_toe": (1,), "left_collar": (2,), "left_shoulder": (3,),
                    "left_wrist": (4,), "left_hand": (5,)}  # fmt: skip
    bvh = find_places(("LeftFoot", "LeftToeBase", "LeftShoulder", "LeftArm", "LeftHand"))
    assert bvh == {"left_ankle": (0,), "left_toe": (1,), "left_collar": (2,), "left_shoulder": (3,),
                   "left_wrist": (4,)}  # fmt: skip
    assert find_places(("Nose", "Head")) == {"face": (0,), "head_top": (1,)}


def test_missing_parts_are_named_with_what_was_meant() -> None:
    points = standing()
    names = tuple("RAnkl" if n == "RAnkle" else n for n in points.names)
    with refused("keypoint-missing", says=("right ankle", "RAnkl")):
        fit_clip(replace(points, names=names))
    with refused("keypoint-missing", says="left hip, right hip"):
        fit_clip(standing(leave_out=("LHip", "RHip")))
    gone = points.positions.copy()
    gone[:, points.names.index("LWrist")] = np.nan
    with refused("keypoints-unseen", says="LWrist"):
        fit_clip(points.replaced(positions=gone))


@pytest.mark.parametrize(
    "change", [{"max_gap_s": -1.0}, {"smooth_hz": 0.0}, {"smooth_hz": float("nan")}]
)
def test_settings_that_make_no_sense_are_refused(change: dict[str, float]) -> None:
    with refused("out-of-range"):
        FitConfig(**change)  # type: ignore[arg-type]


def test_keypoints_check_themselves() -> None:
    with refused("name-repeated"):
        Keypoints(("A", "A"), np.zeros((2, 2, 3)), 30.0)
    with refused("wrong-shape", says="(T, 1, 3)"):
        Keypoints(("A",), np.zeros((2, 1, 2)), 30.0)
    with refused("not-finite", says="frame 1"):
        Keypoints(("A",), np.array([[[0.0, 0, 0]], [[np.inf, 0, 0]]]), 30.0)
    points = Keypoints(
        ("A",), np.array([[[0, np.nan, 0]], [[1.0, 1, 1]]]), 30.0, confidence=np.array([[1], [0]])
    )
    assert points.missing.tolist() == [[True], [True]]
    with pytest.raises(ValueError):
        points.positions[0] = 1.0
