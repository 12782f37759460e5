"""Written glTF: the round trip, the structure of the file, the figure, the way back to the source."""

from __future__ import annotations

import base64
import json
import struct
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from handmade_gltf_files import QUARTER_X, Gltf, person, put, turn
from handmade_motion_files import bvh_text, deepmimic_text

from poise.formats import read_clip, write_clip
from poise.motion import Clip, trim
from poise.motion.rotations import quat_distance
from refusals import refused
from toy_human import swing

WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
TYPES = {5121: "<u1", 5123: "<u2", 5126: "<f4"}


def unpacked(path: Path) -> tuple[dict[str, Any], bytes]:
    """The JSON and the buffer of a .glb or embedded .gltf, taken apart without any library."""
    data = path.read_bytes()
    if path.suffix == ".gltf":
        doc = json.loads(data)
        return doc, base64.b64decode(doc["buffers"][0]["uri"].partition(",")[2])
    magic, version, total, size, kind = struct.unpack_from("<4sIIII", data)
    assert (magic, version, total, kind) == (b"glTF", 2, len(data), 0x4E4F534A) and size % 4 == 0
    length, second = struct.unpack_from("<II", data, 20 + size)
    assert second == 0x004E4942 and 28 + size + length == len(data) and length % 4 == 0
    return json.loads(data[20 : 20 + size]), data[28 + size :]


def values(doc: dict[str, Any], blob: bytes, index: int) -> np.ndarray:
    accessor = doc["accessors"][index]
    view = doc["bufferViews"][accessor["bufferView"]]
    width, dtype = WIDTHS[accessor["type"]], np.dtype(TYPES[accessor["componentType"]])
    start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
    assert start % 4 == 0 and accessor["count"] > 0
    assert accessor["count"] * width * dtype.itemsize <= view["byteLength"]
    assert view.get("byteOffset", 0) + view["byteLength"] <= doc["buffers"][0]["byteLength"] == len(blob)
    return np.frombuffer(blob, dtype, accessor["count"] * width, start).reshape(-1, width)


def difference(a: Clip, b: Clip) -> tuple[float, float]:
    """Largest distance in mm and largest angle in degrees; all else must be equal."""
    assert a.skeleton.names == b.skeleton.names and a.skeleton.parents == b.skeleton.parents
    assert (a.frames, a.fps, a.cyclic) == (b.frames, b.fps, b.cyclic)
    assert [j for j, _ in a.skeleton.ends] == [j for j, _ in b.skeleton.ends]
    for (_, tip), (_, other) in zip(a.skeleton.ends, b.skeleton.ends, strict=True):
        np.testing.assert_allclose(tip, other, atol=1e-6)
    angle = quat_distance(a.rot, b.rot).max()
    return float(np.abs(a.positions() - b.positions()).max() * 1e3), float(np.rad2deg(angle))


@pytest.mark.parametrize("suffix", [".glb", ".gltf"])
@pytest.mark.parametrize(
    "source",
    [
        "lafan1_bvh/walk4_subject1.bvh",
        "other/bandai_bvh/dataset-1_dash_active_001.bvh",
        "cmu_amc/02/02_01.amc",
        "deepmimic_txt/humanoid3d_walk.txt",
        "cmu_bvh/acrnn_salsa/04.bvh",
    ],
)
def test_round_trip_of_real_clips(data_dir: Path, tmp_path: Path, source: str, suffix: str) -> None:
    clip = read_clip(data_dir / source)
    if clip.frames > 600:
        clip = trim(clip, 0, 600)
    write_clip(clip, tmp_path / f"a{suffix}")
    mm, degrees = difference(clip, read_clip(tmp_path / f"a{suffix}"))
    assert mm < 1e-2 and degrees < 1e-3


def clips(folder: Path) -> list[Clip]:
    (folder / "a.bvh").write_text(bvh_text())
    (folder / "a.txt").write_text(deepmimic_text(loop="wrap"))
    return [read_clip(folder / "a.bvh"), read_clip(folder / "a.txt")]


def test_time_stays_exact(tmp_path: Path) -> None:
    """Odd rates and frame times come back to the last bit, though keys are 32 bits wide."""
    clip = clips(tmp_path)[0]
    for fps in (1 / 0.033333, 29.97, 1000 / 7.0, 12.5):
        write_clip(clip.replaced(fps=fps), tmp_path / "b.glb")
        again = read_clip(tmp_path / "b.glb")
        assert again.fps == fps and again.frames == clip.frames


def test_a_first_frame_at_rest_is_kept(tmp_path: Path) -> None:
    """What looks like an inserted rest pose is motion when Poise wrote the file."""
    clip = clips(tmp_path)[1]
    rot = clip.rot.copy()
    rot[1:, 0] = (0.0, 0.0, 0.0, 1.0)
    write_clip(clip.replaced(rot=rot), tmp_path / "b.glb")
    assert read_clip(tmp_path / "b.glb").frames == clip.frames


def test_the_structure_of_the_file(tmp_path: Path) -> None:
    """Bounds, alignment, smallest and largest values, weights, unit normals, rising times."""
    for i, clip in enumerate(clips(tmp_path)):
        for suffix in (".glb", ".gltf"):
            path = tmp_path / f"{i}{suffix}"
            write_clip(clip, path)
            doc, blob = unpacked(path)
            assert doc["asset"] == {"generator": "Poise", "version": "2.0"}
            joints = len(clip.skeleton)
            animation, primitive = doc["animations"][0], doc["meshes"][0]["primitives"][0]
            times = doc["accessors"][animation["samplers"][0]["input"]]
            t = values(doc, blob, animation["samplers"][0]["input"])
            assert times["min"] == [float(t.min())] and times["max"] == [float(t.max())]
            assert (np.diff(t[:, 0]) > 0).all() and len(t) == clip.frames
            np.testing.assert_allclose(t[:, 0], np.arange(clip.frames) / clip.fps, atol=1e-6)
            assert len(animation["channels"]) == joints + 1
            for channel in animation["channels"]:
                keys = values(doc, blob, animation["samplers"][channel["sampler"]]["output"])
                assert len(keys) == clip.frames and channel["target"]["node"] < joints
                if channel["target"]["path"] == "rotation":
                    np.testing.assert_allclose(np.linalg.norm(keys, axis=-1), 1, atol=1e-6)
                    assert (np.abs(np.diff(keys, axis=0)).max(-1) < 0.9).all()
            mesh = {k: values(doc, blob, v) for k, v in primitive["attributes"].items()}
            bounds = doc["accessors"][primitive["attributes"]["POSITION"]]
            np.testing.assert_array_equal(bounds["min"], mesh["POSITION"].min(0))
            np.testing.assert_array_equal(bounds["max"], mesh["POSITION"].max(0))
            np.testing.assert_allclose(np.linalg.norm(mesh["NORMAL"], axis=-1), 1, atol=1e-5)
            assert len({len(v) for v in mesh.values()}) == 1 and len(mesh["POSITION"]) % 3 == 0
            assert mesh["JOINTS_0"].max() < joints and (mesh["JOINTS_0"][:, 1:] == 0).all()
            np.testing.assert_array_equal(mesh["WEIGHTS_0"], [[1, 0, 0, 0]] * len(mesh["WEIGHTS_0"]))
            assert doc["skins"][0]["joints"] == list(range(joints))


def rest_matrices(doc: dict[str, Any]) -> dict[int, np.ndarray]:
    """World matrices of all nodes in the rest pose, from the JSON alone."""
    out: dict[int, np.ndarray] = {}
    stack = [(n, np.eye(4)) for n in doc["scenes"][0]["nodes"]]
    while stack:
        index, above = stack.pop()
        node = doc["nodes"][index]
        x, y, z, w = node.get("rotation", (0, 0, 0, 1))
        m = np.eye(4)
        m[:3, :3] = [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
        m[:3, :3] = m[:3, :3] * np.array(node.get("scale", (1, 1, 1)))
        m[:3, 3] = node.get("translation", (0, 0, 0))
        out[index] = above @ m
        stack += [(c, out[index]) for c in node.get("children", [])]
    return out


def test_the_figure_hangs_on_its_joints(tmp_path: Path) -> None:
    """Inverse bind matrices undo the rest pose; bones are closed and face outwards."""
    clip = clips(tmp_path)[0]
    write_clip(clip, tmp_path / "b.glb")
    doc, blob = unpacked(tmp_path / "b.glb")
    rest = rest_matrices(doc)
    skin = doc["skins"][0]
    inverse = values(doc, blob, skin["inverseBindMatrices"]).reshape(-1, 4, 4).transpose(0, 2, 1)
    for matrix, joint in zip(inverse, skin["joints"], strict=True):
        np.testing.assert_allclose(rest[joint] @ matrix, np.eye(4), atol=1e-6)
        assert matrix[3].tolist() == [0, 0, 0, 1]
    attributes = doc["meshes"][0]["primitives"][0]["attributes"]
    points = values(doc, blob, attributes["POSITION"]).reshape(-1, 8, 3, 3).astype(float)
    normals = values(doc, blob, attributes["NORMAL"]).reshape(-1, 8, 3, 3)
    owner = values(doc, blob, attributes["JOINTS_0"])[:, 0].reshape(-1, 8, 3)
    # Hips -> Spine and LeftLeg, Spine -> Head, LeftLeg -> LeftFoot, and two bone tips.
    assert len(points) == 6 and (owner == owner[:, :1, :1]).all()
    middle = points.mean((1, 2))
    assert (((points.mean(2) - middle[:, None]) * normals[:, :, 0]).sum(-1) > 0).all()
    for bone, joint in zip(points.reshape(6, -1, 3), owner[:, 0, 0], strict=True):
        assert np.linalg.norm(bone - rest[int(joint)][:3, 3], axis=-1).min() < 1e-6


def posed(doc: dict[str, Any], blob: bytes, frame: int) -> dict[int, np.ndarray]:
    """World matrices of all nodes in a frame."""
    now = json.loads(json.dumps(doc))
    animation = doc["animations"][0]
    for channel in animation["channels"]:
        keys = values(doc, blob, animation["samplers"][channel["sampler"]]["output"])
        target = channel["target"]
        now["nodes"][target["node"]][target["path"]] = keys[frame].tolist()
    return rest_matrices(now)


def test_the_bounds_of_the_figure_go_where_it_goes(tmp_path: Path) -> None:
    """A viewer takes the bounds of a skinned mesh in its first frame in the space of its node, and draws
    nothing where the node takes them out of sight."""
    walk = swing(2.0, 30.0, speed=3.0)
    write_clip(walk, tmp_path / "b.glb")
    doc, blob = unpacked(tmp_path / "b.glb")
    (node,) = (i for i, n in enumerate(doc["nodes"]) if "skin" in n)
    primitive = doc["meshes"][0]["primitives"][0]["attributes"]
    mesh = {k: values(doc, blob, v) for k, v in primitive.items()}
    skin = doc["skins"][0]
    inverse = values(doc, blob, skin["inverseBindMatrices"]).reshape(-1, 4, 4).transpose(0, 2, 1)
    points = np.concatenate((mesh["POSITION"], np.ones((len(mesh["POSITION"]), 1))), 1)
    owner = mesh["JOINTS_0"][:, 0]
    local = np.zeros((0, 3))
    for frame in range(walk.frames):
        world = posed(doc, blob, frame)
        bones = np.stack([world[j] @ b for j, b in zip(skin["joints"], inverse, strict=True)])
        seen = np.einsum("nab,nb->na", bones[owner], points)
        if not len(local):
            local = (seen @ np.linalg.inv(world[node]).T)[:, :3]
            middle = (local.min(0) + local.max(0)) / 2
            radius = np.linalg.norm(local - middle, axis=-1).max()
        there = world[node] @ [*middle, 1.0]
        assert np.linalg.norm(seen[:, :3] - there[:3], axis=-1).max() < 1.3 * radius
    assert max(difference(walk, read_clip(tmp_path / "b.glb"))) < 1e-2


def test_another_library_reads_and_validates_it(tmp_path: Path) -> None:
    """pygltflib is a twin for the tests alone."""
    pytest.importorskip("pygltflib")
    from pygltflib import GLTF2
    from pygltflib.validator import validate

    for i, clip in enumerate(clips(tmp_path)):
        write_clip(clip, tmp_path / f"{i}.glb")
        loaded = GLTF2.load(str(tmp_path / f"{i}.glb"))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            assert validate(loaded, warning=True) == []


def test_a_gltf_source_gets_its_nodes_back(tmp_path: Path) -> None:
    """Nodes above the root, scales, rest pose, units, names, animation: written as they came."""
    file = Gltf()
    top = file.node("Armature", rotation=QUARTER_X, scale=[0.01] * 3, translation=[1, 0, 2])
    file, at = person(top, file, 100.0)
    nodes = file.doc["nodes"]
    nodes[at["Spine"]].update(rotation=turn("z", 5), scale=[2, 2, 2])
    nodes[at["Head"]]["name"] = "mixamorig:Head"
    animation = file.animation("Take 001")
    times = [k / 30 for k in range(5)]
    path = [(0, 10 * k, 90) for k in range(5)]
    file.channel(animation, at["Hips"], "translation", times, path)
    file.channel(animation, at["Hips"], "rotation", times, [turn("x", 90 + k) for k in range(5)])
    clip = read_clip(put(tmp_path, "in.glb", file))
    write_clip(clip, tmp_path / "out.glb")
    assert max(difference(clip, read_clip(tmp_path / "out.glb"))) < 1e-3
    doc, blob = unpacked(tmp_path / "out.glb")
    assert [n["name"] for n in doc["nodes"]] == [*(n["name"] for n in nodes), "Figure"]
    assert doc["animations"][0]["name"] == "Take 001"
    for ours, theirs in zip(doc["nodes"], nodes, strict=False):
        # The figure that Poise adds hangs on the joint that travels.
        below = [c for c in ours.get("children", []) if c < len(nodes)]
        assert below == theirs.get("children", [])
        for key, default in (("translation", [0] * 3), ("rotation", [0, 0, 0, 1]), ("scale", [1] * 3)):
            np.testing.assert_allclose(ours.get(key, default), theirs.get(key, default), atol=1e-6)
    keys = values(doc, blob, doc["animations"][0]["samplers"][0]["output"])
    np.testing.assert_allclose(keys, path, atol=1e-4)


def test_a_still_root_stays_still_on_the_way_back(tmp_path: Path) -> None:
    """With branches below the root, the hips carry the travel again, and the others stay."""
    file = Gltf()
    root = file.node("Root", translation=[0, 0, 1])
    file, at = person(root, file)
    file.doc["skins"][0]["joints"] = [root, *at.values(), file.node("ik", root, translation=[0.2, 0, 0])]
    path = [(0.1, 0.9, 0.1 * k) for k in range(3)]
    file.channel(file.animation(), at["Hips"], "translation", [0, 0.05, 0.1], path)
    clip = read_clip(put(tmp_path, "in.glb", file))
    write_clip(clip, tmp_path / "out.glb")
    doc, blob = unpacked(tmp_path / "out.glb")
    moves = {
        doc["nodes"][c["target"]["node"]]["name"]: values(
            doc, blob, doc["animations"][0]["samplers"][c["sampler"]]["output"]
        )
        for c in doc["animations"][0]["channels"]
        if c["target"]["path"] == "translation"
    }
    np.testing.assert_allclose(
        moves["Root"], [(0, 0, 1)] * 3 if len(moves["Root"]) == 3 else moves["Root"]
    )
    assert np.ptp(moves["Root"], axis=0).max() < 1e-7
    np.testing.assert_allclose(moves["Hips"][[0, -1]], [path[0], path[-1]], atol=1e-6)
    assert max(difference(clip, read_clip(tmp_path / "out.glb"))) < 1e-3


def test_the_same_clip_gives_the_same_bytes(tmp_path: Path) -> None:
    clip = clips(tmp_path)[0]
    for suffix in (".glb", ".gltf"):
        for name in ("b", "c"):
            write_clip(clip, tmp_path / f"{name}{suffix}")
        assert (tmp_path / f"b{suffix}").read_bytes() == (tmp_path / f"c{suffix}").read_bytes()


def test_a_missing_folder_is_told(tmp_path: Path) -> None:
    clip = clips(tmp_path)[0]
    with refused("cannot-write"):
        write_clip(clip, tmp_path / "none" / "b.glb")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.bvh", "a.txt"]
