"""AMASS, AIST++ and their relatives: against a naive twin, and back into the file they came from."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from handmade_numpy_files import aist, amass, save_npz, save_pickle
from scipy.spatial.transform import Rotation

from poise.formats import read_clip, write_clip
from poise.formats.smpl import LAYOUTS, PELVIS, smpl_skeleton, write_amass
from poise.motion import Clip
from refusals import refused

WIDTHS = {66: 22, 72: 24, 156: 52, 165: 55}


def naive_positions(data: dict[str, Any], rest: np.ndarray | None = None) -> np.ndarray:
    """`(T, J, 3)` the joints as the body model defines them, frame by frame, in the file's axes."""
    poses = data["poses"].reshape(len(data["poses"]), -1, 3)
    layout = next(x for x in LAYOUTS if len(x.names) == poses.shape[1])
    out = np.zeros(poses.shape)
    for t, pose in enumerate(poses):
        turns: list[Rotation] = []
        for j, parent in enumerate(layout.parents):
            own = Rotation.from_rotvec(pose[j])
            if parent < 0:
                turns.append(own)
                out[t, j] = data["trans"][t] + (np.array(PELVIS) if rest is None else rest[0])
            else:
                bone = layout.offsets[j] if rest is None else rest[j] - rest[parent]
                turns.append(turns[parent] * own)
                out[t, j] = out[t, parent] + turns[parent].apply(bone.copy())
    return out


def angle_between(a: Clip, b: Clip) -> float:
    """The largest angle between two clips' rotations, degrees."""
    dots = np.abs((a.rot * b.rot).sum(-1)).clip(0, 1)
    return float(np.degrees(2 * np.arccos(dots)).max())


def check_round_trip(clip: Clip, path: Path) -> Clip:
    write_clip(clip, path)
    back = read_clip(path)
    assert np.abs(back.positions() - clip.positions()).max() < 1e-3
    assert angle_between(clip, back) < 0.1
    assert back.skeleton.names == clip.skeleton.names and back.fps == clip.fps
    assert back.skeleton.parents == clip.skeleton.parents and back.frames == clip.frames
    np.testing.assert_allclose(back.skeleton.offsets, clip.skeleton.offsets, atol=1e-12)
    return back


@pytest.mark.parametrize("width", WIDTHS)
def test_joints_stand_where_the_body_model_puts_them(tmp_path: Path, width: int) -> None:
    data = amass(width)
    clip = read_clip(save_npz(tmp_path / "a.npz", data))
    assert len(clip.skeleton) == WIDTHS[width] and clip.fps == 60.0 and clip.frames == 12
    # AMASS is Z up as a clip is, so that positions are the same numbers.
    np.testing.assert_allclose(clip.positions(), naive_positions(data), atol=1e-12)
    assert clip.skeleton.source.up_axis == "Z" and clip.skeleton.source.format == "smpl"


@pytest.mark.parametrize("width", WIDTHS)
def test_amass_comes_back_as_it_came(tmp_path: Path, width: int) -> None:
    data = amass(width)
    clip = read_clip(save_npz(tmp_path / "a.npz", data))
    check_round_trip(clip, tmp_path / "b.npz")
    with np.load(tmp_path / "b.npz", allow_pickle=False) as back:
        for key in ("poses", "trans", "betas"):
            np.testing.assert_allclose(back[key], data[key], atol=1e-9)
        assert str(back["gender"]) == "female" and float(back["mocap_framerate"]) == 60.0


def test_the_rest_pose_stands_upright_and_looks_ahead() -> None:
    for layout, joints in zip(LAYOUTS, WIDTHS.values(), strict=True):
        skeleton = smpl_skeleton(layout.name)
        rest = dict(zip(skeleton.names, skeleton.rest_positions(), strict=True))
        assert len(skeleton) == joints
        # Z up, facing -Y, the left hand on the person's left (+X).
        assert rest["head"][2] > 0.5 and rest["left_ankle"][2] < -0.8
        assert rest["left_foot"][1] < rest["left_ankle"][1] and rest["left_wrist"][0] > 0.6
        for name, place in rest.items():
            if name.startswith("left"):
                twin = rest[name.replace("left", "right", 1)]
                np.testing.assert_allclose(twin, place * [-1, 1, 1], atol=1e-12)
        tips = [skeleton.names[j] for j, _ in skeleton.ends]
        assert "head" in tips and len(set(tips)) == len(tips)


def test_rest_joints_of_the_file_are_taken(tmp_path: Path) -> None:
    data = amass(66)
    rest = np.random.default_rng(1).normal(size=(22, 3)) * 0.2 + [0, 0.5, 0]
    clip = read_clip(save_npz(tmp_path / "a.npz", {**data, "J": rest}))
    np.testing.assert_allclose(clip.positions(), naive_positions(data, rest), atol=1e-12)
    assert any("file's array 'J'" in n for n in clip.skeleton.source.notes)
    check_round_trip(clip, tmp_path / "b.npz")


def test_what_was_taken_is_not_said_to_be_stated(tmp_path: Path) -> None:
    def why(**options: Any) -> dict[str, str]:
        return dict(read_clip(tmp_path / "a.npz", **options).skeleton.source.evidence)

    save_npz(tmp_path / "a.npz", amass(66))
    assert why()["up"] == "The file states no vertical: Z taken, as AMASS has it"
    assert why()["unit"] == "The file states no unit: metres taken, as AMASS has it"
    stated = why(up_axis="Z", unit_m=1.0)
    assert (stated["up"], stated["unit"]) == ("Stated with --up", "Stated with --unit")
    save_npz(tmp_path / "a.npz", {**amass(66), "up_axis": np.array("Z")})
    assert why()["up"] == "The format itself states it"


def test_parts_that_are_kept_apart(tmp_path: Path) -> None:
    data = amass(165)
    poses = data.pop("poses")
    parts = {
        "root_orient": poses[:, :3],
        "pose_body": poses[:, 3:66],
        "pose_jaw": poses[:, 66:69],
        "pose_eye": poses[:, 69:75],
        "pose_hand": poses[:, 75:],
    }
    data["mocap_frame_rate"] = data.pop("mocap_framerate")
    whole = read_clip(save_npz(tmp_path / "a.npz", {**data, "poses": poses}))
    apart = read_clip(save_npz(tmp_path / "b.npz", {**data, **parts}))
    np.testing.assert_array_equal(apart.rot, whole.rot)
    assert apart.skeleton.names == whole.skeleton.names
    body = {k: parts[k] for k in ("root_orient", "pose_body")}
    small = read_clip(save_npz(tmp_path / "c.npz", {**data, **body}))
    np.testing.assert_allclose(small.positions(), whole.positions()[:, :22], atol=1e-12)
    smplx = {
        "global_orient": poses[:, :3],
        "body_pose": poses[:, 3:66].reshape(-1, 21, 3),
        "left_hand_pose": poses[:, 75:120],
        "right_hand_pose": poses[:, 120:],
        "transl": data["trans"],
        "fps": 60,
    }
    hands = read_clip(save_npz(tmp_path / "d.npz", smplx))
    assert len(hands.skeleton) == 52
    at = [whole.skeleton.index(n) for n in hands.skeleton.names]
    np.testing.assert_allclose(hands.positions(), whole.positions()[:, at], atol=1e-12)


def test_aist_is_y_up_scaled_and_asked_for(tmp_path: Path) -> None:
    path = save_pickle(tmp_path / "a.pkl", aist())
    with refused("pickle-refused", says="--allow-pickle"):
        read_clip(path)
    clip = read_clip(path, allow_pickle=True)
    source = clip.skeleton.source
    assert clip.fps == 60.0 and source.up_axis == "Y" and np.isclose(source.unit_m, 1 / 93.8)
    same = aist()
    data = {"poses": same["smpl_poses"].astype(float), "trans": same["smpl_trans"] / 93.8}
    x, y, z = np.moveaxis(naive_positions(data), -1, 0)
    np.testing.assert_allclose(clip.positions(), np.stack((x, -z, y), -1), atol=1e-6)
    back = check_round_trip(clip, tmp_path / "b.npz")
    assert back.skeleton.source.up_axis == "Y"


def test_a_world_that_is_y_up_is_noticed(tmp_path: Path) -> None:
    data = aist()
    y_up = {"poses": data["smpl_poses"], "trans": data["smpl_trans"] / 93.8, "fps": 60.0}
    path = save_npz(tmp_path / "a.npz", y_up)
    clip = read_clip(path)
    assert clip.skeleton.source.up_axis == "Y"
    assert any("Y taken, since the body stands along it" in n for n in clip.skeleton.source.notes)
    assert clip.positions()[:, clip.skeleton.index("head"), 2].min() > 1.0
    assert read_clip(path, up_axis="Z").skeleton.source.up_axis == "Z"
    check_round_trip(clip, tmp_path / "b.npz")


def test_overrides(tmp_path: Path) -> None:
    data = amass(66)
    centimetres = {**data, "trans": data["trans"] * 100}
    del centimetres["mocap_framerate"]
    path = save_npz(tmp_path / "a.npz", centimetres)
    clip = read_clip(path, unit_m=0.01, fps=50)
    assert clip.fps == 50.0
    np.testing.assert_allclose(clip.positions(), naive_positions(data), atol=1e-12)
    with refused("rate-missing", says="--fps"):
        read_clip(path)


def test_another_skeleton_is_told_to_retarget(tmp_path: Path) -> None:
    clip = read_clip(save_npz(tmp_path / "a.npz", amass()))
    other = clip.replaced(
        skeleton=smpl_skeleton("SMPL body"), rot=clip.rot[:, :22], root_pos=clip.root_pos
    )
    check_round_trip(other, tmp_path / "b.npz")
    names = ("hips", *other.skeleton.names[1:])
    renamed = other.replaced(skeleton=replace(other.skeleton, names=names))
    with refused("skeleton-differs"):
        write_amass(renamed, tmp_path / "c.npz")
    with refused("skeleton-differs"):
        write_clip(renamed, tmp_path / "c.amass.npz")
    assert not (tmp_path / "c.npz").exists()
    with refused("layout-unknown", says="SMPL-Q"):
        smpl_skeleton("SMPL-Q")


def test_the_real_aist_clip(data_dir: Path, tmp_path: Path) -> None:
    clip = read_clip(data_dir / "amass/aistpp_gBR_sBM_cAll_d04_mBR0_ch01.pkl", allow_pickle=True)
    assert len(clip.skeleton) == 24 and clip.frames == 720 and clip.fps == 60.0
    head, toe = (clip.positions()[:, clip.skeleton.index(n), 2] for n in ("head", "left_foot"))
    # A dancer: mostly upright, the feet near the ground most of the time.
    assert np.median(head - toe) > 1.2
    assert np.ptp(np.percentile(clip.positions()[..., 2].min(1), [10, 60])) < 0.1
    check_round_trip(clip, tmp_path / "b.npz")
    check_round_trip(clip, tmp_path / "b.csv")
