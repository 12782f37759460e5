"""Sound files to damage: small, made here, of every format."""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from poise.formats import read_clip, write_clip
from poise.motion import trim

_TESTS = Path(__file__).resolve().parents[1]


@dataclass(frozen=True)
class Seed:
    """A sound motion: `files` by name, of which `name` is the one that is read."""

    format: str
    name: str
    files: dict[str, bytes]


#: Formats whose readers start a process for each file.
NATIVE = ("usda", "usdc", "c3d", "fbx", "mjcf")
#: Seeds of keypoints, to which a body is fitted: ten times as slow as the others where they are read.
FITTED = ("a.trc", "a.csv", "keys.npz", "joints.npy", "mdm.npy")


def seeds(folder: Path) -> list[Seed]:
    """All seeds; `folder` is worked in."""
    beside = (_TESTS / "formats", _TESTS, _TESTS / "body", _TESTS.parent / "benchmarks")
    sys.path += [str(p) for p in beside if str(p) not in sys.path]
    import handmade_motion_files as motion
    import handmade_numpy_files as arrays
    import test_opensim_files as opensim
    import test_points_files as points
    from test_gltf_errors import walker

    out = [
        Seed("bvh", "a.bvh", {"a.bvh": motion.bvh_text().encode()}),
        Seed("amc", "7_01.amc", {"7.asf": motion.ASF.encode(), "7_01.amc": motion.amc_text().encode()}),
        Seed("deepmimic", "a.txt", {"a.txt": motion.deepmimic_text().encode()}),
        Seed("trc", "a.trc", {"a.trc": points.trc_text().encode()}),
        Seed("points", "a.csv", {"a.csv": points.csv_text(points.walking()).encode()}),
        Seed("mot", "a.mot", {"a.mot": opensim.mot().encode()}),
    ]
    own = arrays.odd_clip()
    for name in ("own.csv", "own.poise.npz", "own.glb", "own.gltf", "own.bvh"):
        write_clip(own, folder / name)
    arrays.save_npz(folder / "amass.npz", arrays.amass(66))
    arrays.save_npz(
        folder / "keys.npz",
        {"positions": points.walking(), "names": np.array(points.NAMES), "fps": np.array(30.0)},
    )
    arrays.save_pickle(folder / "aist.pkl", arrays.aist())
    arrays.save_npy(folder / "lib.npy", arrays.poselib())
    file, _ = walker()
    gltf = json.dumps(file.doc).encode()
    (folder / "walker.gltf").write_bytes(gltf)
    single = ("own.csv", "own.poise.npz", "own.glb", "own.gltf", "own.bvh", "amass.npz", "keys.npz",
              "aist.pkl", "lib.npy")  # fmt: skip
    kinds = {"own.poise.npz": "npz", "own.csv": "csv", "own.bvh": "bvh", "amass.npz": "npz",
             "keys.npz": "npz", "aist.pkl": "pkl", "lib.npy": "npy"}  # fmt: skip
    for name in single:
        kind = kinds.get(name, name.rsplit(".", 1)[-1])
        beside = {p.name: p.read_bytes() for p in folder.glob("own*.bin")} if kind == "gltf" else {}
        out.append(Seed(kind, name, {name: (folder / name).read_bytes(), **beside}))
    return out + _generated(folder) + _native(folder)


def _generated(folder: Path) -> list[Seed]:
    """What generators, pose estimators and avatars write."""
    import handmade_numpy_files as arrays
    import test_generated_files as made
    import test_gltf_vrm as vrm
    from handmade_gltf_files import put

    frames, body = 6, made.LAYOUTS[0]
    places = made.moved(body.names, body.parents, body.offsets)[0][:frames]
    names, _ = made.SKELETONS[min(made.SKELETONS)]
    turns = np.tile(np.eye(3), (frames, len(names), 1, 1))
    joints = np.linspace((0, 0, 0), (0, 1.7, 0.1), len(names)) + np.arange(frames)[:, None, None] * 0.01
    smpl = arrays.amass(66, frames)
    out = dict[str, bytes]()
    for name, write in {
        "joints.npy": lambda p: np.save(p, places),
        "mdm.npy": lambda p: arrays.save_npy(
            p,
            {
                "motion": places.transpose(1, 2, 0)[None],
                "text": ["walks"],
                "lengths": np.array([frames]),
            },
        ),
        "kimodo.npz": lambda p: np.savez(p, posed_joints=joints, global_rot_mats=turns),
        "gvhmr.npz": lambda p: np.savez(
            p, fps=30, body_pose=smpl["poses"][:, 3:], global_orient=smpl["poses"][:, :3],
            transl=smpl["trans"], betas=np.zeros((frames, 10)),
        ),
    }.items():  # fmt: skip
        write(folder / name)
        out[name] = (folder / name).read_bytes()
    named = {bone: f"node {k}" for k, (bone, _, _) in enumerate(vrm.BONES)}
    out["a.vrm"] = put(folder, "avatar.glb", vrm.model("VRMC_vrm", named)).read_bytes()
    return [Seed("vrm" if n[-3:] == "vrm" else n[-3:], n, {n: data}) for n, data in out.items()]


def _native(folder: Path) -> list[Seed]:
    """Seeds of the readers whose libraries are at hand."""
    from importlib.util import find_spec

    import test_mjcf
    from test_points_files import NAMES, walking, write_c3d

    out = [Seed("mjcf", "own.xml", {"own.xml": test_mjcf.mjcf().encode()})]
    if find_spec("ufbx") is not None:
        from handmade_fbx_files import fbx_text

        out.append(Seed("fbx", "a.fbx", {"a.fbx": fbx_text(4).encode()}))
    if find_spec("ezc3d") is not None:
        write_c3d(folder / "a.c3d", walking() * 1000, NAMES)
        out.append(Seed("c3d", "a.c3d", {"a.c3d": (folder / "a.c3d").read_bytes()}))
    if find_spec("pxr") is not None:
        clip = trim(read_clip(folder / "own.bvh"), 0, 4)
        for suffix in ("usda", "usdc"):
            write_clip(clip, folder / f"a.{suffix}")
            out.append(
                Seed(suffix, f"a.{suffix}", {f"a.{suffix}": (folder / f"a.{suffix}").read_bytes()})
            )
    return out
