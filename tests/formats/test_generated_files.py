"""Files of generators and pose estimators: joints, Kimodo, HY-Motion, GVHMR, SAM 3D Body."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from handmade_numpy_files import amass, save_npz, save_pickle

from poise.formats import read_clip, write_clip
from poise.formats.named_arrays import SKELETONS
from poise.formats.smpl import LAYOUTS
from poise.motion import Clip
from poise.motion.rotations import forward_kinematics, quat_to_matrix, rotvec_to_quat
from refusals import refused
from test_docs import WALK
from toy_human import swing

FRAMES = 24
POINTED = ("pred_keypoints_3d", "pred_cam_t")


def moved(names, parents, offsets, seed: int = 0):
    """Places and local turns of a body that stands 0.95 m high, Y up, and bends a little."""
    angles = np.cumsum(np.random.default_rng(seed).normal(0, 0.01, (FRAMES, len(names), 3)), 0)
    local = rotvec_to_quat(angles)
    root = np.zeros((FRAMES, 3)) + (0.0, 0.95, 0.0) + np.linspace(0, 0.4, FRAMES)[:, None] * (0, 0, 1)
    pos, turns = forward_kinematics(parents, offsets, root, local)
    return pos, np.asarray(quat_to_matrix(np.asarray(turns)))


def _y_up(clip: Clip) -> np.ndarray:
    x, y, z = np.moveaxis(clip.positions(), -1, 0)
    return np.stack((x, z, -y), -1)


@pytest.mark.parametrize("count", [22, 24])
def test_arrays_of_joints_are_read(tmp_path: Path, count: int) -> None:
    body = LAYOUTS[0 if count == 22 else 1]
    pos, _ = moved(body.names, body.parents, body.offsets)
    np.save(tmp_path / "a.npy", pos)
    clip = read_clip(tmp_path / "a.npy", fps=25.0, up_axis="Y")
    assert clip.fps == 25.0 and clip.frames == FRAMES
    for name in ("left_ankle", "right_wrist", "left_knee", "right_shoulder"):
        given = pos[:, [body.names.index(name)]]
        away = np.linalg.norm(_y_up(clip) - given, axis=-1).mean(0)
        assert away.min() < 0.03, name


def test_arrays_of_joints_say_their_rate_or_ask_for_it(tmp_path: Path) -> None:
    for body, name in ((LAYOUTS[0], "a.npy"), (LAYOUTS[1], "b.npy")):
        np.save(tmp_path / name, moved(body.names, body.parents, body.offsets)[0])
    clip = read_clip(tmp_path / "a.npy")
    assert clip.fps == 20.0 and any("HumanML3D" in n for n in clip.skeleton.source.notes)
    with refused("rate-missing", says="--fps"):
        read_clip(tmp_path / "b.npy")


@pytest.mark.parametrize("count", sorted(SKELETONS))
def test_kimodo_npz_is_read_to_the_millimetre(tmp_path: Path, count: int) -> None:
    names, parents = SKELETONS[count]
    table = dict(zip(LAYOUTS[0].names, LAYOUTS[0].offsets, strict=True))
    offsets = np.array([table.get(n, (0.01, 0.06, 0.01)) for n in names]) * 1.0
    for j, n in enumerate(names):
        if n.endswith(("Leg", "Shin", "Foot")):
            offsets[j] = (0.05 if n.startswith("Left") else -0.05, -0.3, 0.0)
    pos, turns = moved(names, parents, offsets)
    contacts = np.ones((FRAMES, 4), dtype=bool)
    np.savez(tmp_path / "k.npz", posed_joints=pos, global_rot_mats=turns, foot_contacts=contacts)
    clip = read_clip(tmp_path / "k.npz")
    assert clip.fps == 30.0 and clip.skeleton.names == names
    assert np.abs(_y_up(clip) - pos).max() < 1e-3
    write_clip(clip, tmp_path / "k.bvh")
    assert read_clip(tmp_path / "k.bvh").frames == FRAMES


def test_kimodos_robot_and_unknown_bodies_are_refused(tmp_path: Path) -> None:
    for count, said in ((34, ("robot-motion",)), (12, ("layout-unknown", "12"))):
        turns = np.tile(np.eye(3), (4, count, 1, 1))
        np.savez(tmp_path / "k.npz", posed_joints=np.zeros((4, count, 3)), global_rot_mats=turns)
        with refused(*said):
            read_clip(tmp_path / "k.npz")


def test_hy_motion_npz_has_30_frames_a_second(tmp_path: Path) -> None:
    data = amass()
    poses, trans = data["poses"], data["trans"]
    gender, betas = np.array(["neutral"]), np.zeros((1, 16))
    np.savez(tmp_path / "h.npz", Rh=poses[:, :3], trans=trans, poses=poses, betas=betas, gender=gender)
    clip = read_clip(tmp_path / "h.npz")
    assert clip.fps == 30.0 and any("HY-Motion" in n for n in clip.skeleton.source.notes)


def test_gvhmrs_result_is_read_as_its_npz_is(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    told = {"body_pose": 0.2 * rng.normal(size=(6, 63)), "global_orient": np.zeros((6, 3))}
    told |= {"transl": rng.normal(size=(6, 3)), "betas": np.zeros((6, 10))}
    tensors = {k: torch.tensor(v) for k, v in told.items()}
    # As GVHMR writes it: tensors that share their numbers, of other types, and views of them.
    tensors["betas"] = torch.zeros(1, 10).expand(6, 10)
    tensors["transl"] = torch.tensor(told["transl"].T.copy()).T
    more = {"x": torch.ones(2, 3, dtype=torch.float16)[:, 1:], "seen": torch.tensor([True, False])}
    whole = {"smpl_params_global": tensors, "smpl_params_incam": tensors, "net_outputs": more}
    torch.save(whole, tmp_path / "hmr4d_results.pt")
    with refused("pickle-refused", says=("--allow-pickle",)):
        read_clip(tmp_path / "hmr4d_results.pt", fps=30)
    with refused("rate-missing", says=("--fps",)):
        read_clip(tmp_path / "hmr4d_results.pt", allow_pickle=True)
    clip = read_clip(tmp_path / "hmr4d_results.pt", fps=30, allow_pickle=True)
    np.savez(tmp_path / "motion.npz", fps=30, up_axis="Y", **told)
    same = read_clip(tmp_path / "motion.npz")
    np.testing.assert_allclose(clip.positions(), same.positions(), atol=1e-6)
    assert clip.fps == 30.0 and len(clip.skeleton) == 22 and clip.skeleton.source.up_axis == "Y"
    assert "GVHMR's motion in the world" in clip.skeleton.source.notes[0]


def test_a_clip_of_the_house_is_not_taken_for_kimodos(tmp_path: Path) -> None:
    write_clip(swing(), tmp_path / "s.npz")
    assert read_clip(tmp_path / "s.npz").skeleton.source.format != "kimodo"


def _sam3d(clip: Clip) -> list[list[dict[str, Any]]]:
    """Results of SAM 3D Body as `process_one_image` gives them for each picture, made from a clip: the
    person second in some pictures, somebody else beside."""
    names = [n.lower() for n in clip.skeleton.names]
    parts = {"shoulder": "arm", "elbow": "forearm", "hip": "upleg", "knee": "leg", "ankle": "foot"}
    pos = clip.positions()
    # A camera's axes: X to the right, Y down, Z ahead.
    pos = np.stack([pos[..., 0], -pos[..., 2], pos[..., 1] + 4.0], -1)
    points = np.full((clip.frames, 70, 3), np.nan)
    for k, part in enumerate(parts.values()):
        for s, side in enumerate(("left", "right")):
            points[:, 5 + 2 * k + s] = pos[:, names.index(side + part)]
    for column, name in ((62, "lefthand"), (41, "righthand"), (69, "neck"), (0, "head")):
        points[:, column] = pos[:, names.index(name)]
    for column, name in ((15, "lefttoe"), (18, "righttoe")):
        points[:, column] = points[:, column + 1] = pos[:, names.index(name)]
        points[:, column + 2] = points[:, 13 if column == 15 else 14] + np.array([0.0, 0.06, 0.0])
    points = np.where(np.isnan(points), points[:, :1], points)
    root = points[:, 9:11].mean(1)

    def one(t: int, aside: float) -> dict[str, Any]:
        place = root[t] + [aside, 0.0, 0.0]
        return {"pred_keypoints_3d": points[t] - root[t], "pred_cam_t": place, "bbox": np.zeros(4)}

    mine, other = (lambda t: one(t, 0.0)), (lambda t: one(t, 3.0))
    return [[mine(t), other(t)] if t % 3 or not t else [other(t), mine(t)] for t in range(clip.frames)]


@pytest.mark.parametrize("form", ["pickle", "torch", "json", "indented", "npz", "frames"])
def test_sam_3d_body_is_read_in_each_form_that_people_save(tmp_path: Path, form: str) -> None:
    walk = read_clip(WALK)
    frames = _sam3d(walk)
    whole = {k: np.stack([min(f, key=lambda p: p["pred_cam_t"][0])[k] for f in frames]) for k in POINTED}
    plain = [[{k: np.asarray(v).tolist() for k, v in p.items()} for p in f] for f in frames]
    if form == "pickle":
        path = save_pickle(tmp_path / "a.pkl", {f"{t:06d}.jpg": f for t, f in enumerate(frames)})
    elif form == "torch":
        path = tmp_path / "a.pt"
        torch.save([[{k: torch.tensor(v) for k, v in p.items()} for p in f] for f in frames], path)
    elif form == "npz":
        path = save_npz(tmp_path / "a.npz", whole)
    else:
        path = tmp_path / "a.json"
        named = [{"frame": f"{t}.jpg", "outputs": f} for t, f in enumerate(plain)]
        text = json.dumps(named if form == "frames" else plain, indent=1 if form == "indented" else None)
        path.write_text(text, encoding="utf-8-sig" if form == "indented" else "utf-8")
    with refused("rate-missing", says=("--fps",)):
        read_clip(path, allow_pickle=True)
    clip = read_clip(path, fps=30, allow_pickle=True)
    source = clip.skeleton.source
    assert (source.format, source.up_axis, clip.frames) == ("sam3d", "-Y", walk.frames)
    assert any("camera's frame" in note for note in source.notes)
    # The same walk, wherever the camera stood.
    for name in ("LeftFoot", "RightHand"):
        there, here = (c.positions()[:, c.skeleton.names.index(name)] for c in (clip, walk))
        steps = [np.diff(p, axis=0) for p in (there, here)]
        np.testing.assert_allclose(steps[0][:, 2], steps[1][:, 2], atol=0.02)
        np.testing.assert_allclose(*(np.linalg.norm(s, axis=-1) for s in steps), atol=0.03)


def test_turns_of_the_rig_without_places_are_refused(tmp_path: Path) -> None:
    path = save_npz(tmp_path / "a.npz", {"mhr_model_params": np.zeros((4, 204)), "fps": 30})
    with refused("key-missing", says=("pred_keypoints_3d",)):
        read_clip(path)
    frames = {"pred_keypoints_3d": np.zeros((4, 17, 3)), "fps": 30}
    with refused("wrong-shape", "70"):
        read_clip(save_npz(tmp_path / "b.npz", frames))
