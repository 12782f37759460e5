"""What generators and pose estimators write: arrays of joints, Kimodo, HY-Motion, GVHMR."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from handmade_numpy_files import amass

from poise.formats import read_clip, write_clip
from poise.formats.named_arrays import SKELETONS
from poise.formats.smpl import LAYOUTS
from poise.motion import Clip
from poise.motion.rotations import forward_kinematics, quat_to_matrix, rotvec_to_quat
from refusals import refused
from toy_human import swing

FRAMES = 24


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
