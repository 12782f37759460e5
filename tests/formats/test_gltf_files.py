"""glTF files as other tools write them: trees, scales, samplers, accessors, rates."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from handmade_gltf_files import QUARTER_X, Gltf, person, put, turn, walker

from poise.body import generate_table
from poise.errors import PoiseError
from poise.formats import read_clip
from poise.motion.rotations import quat_to_matrix, slerp


def wxyz(q: tuple[float, float, float, float]) -> np.ndarray:
    return np.array([q[3], *q[:3]], dtype=float)


def test_a_plain_walk(tmp_path: Path) -> None:
    file, _ = walker()
    clip = read_clip(put(tmp_path, "walk.glb", file))
    assert clip.skeleton.names == ("Hips", "Spine", "Head", "LeftLeg", "LeftFoot")
    assert clip.skeleton.parents == (-1, 0, 1, 0, 3)
    assert (clip.frames, clip.fps, clip.name) == (7, 30.0, "walk")
    assert clip.skeleton.source.notes == ()
    # Y up becomes Z up: (x, y, z) -> (x, -z, y).
    np.testing.assert_allclose(clip.root_pos[3], (0, -0.15, 0.9), atol=1e-7)
    np.testing.assert_allclose(clip.skeleton.offsets[1], (0, 0, 0.25), atol=1e-7)
    # At 20 degrees about X the foot hangs at 0.85 (-cos, -sin) in Y and Z.
    a = np.radians(20)
    foot = (0.1, 0.85 * np.sin(a) - 0.2, 0.9 - 0.85 * np.cos(a))
    np.testing.assert_allclose(clip.positions()[4, 4], foot, atol=1e-6)


def test_the_three_containers_are_one_clip(tmp_path: Path) -> None:
    file, _ = walker()
    (tmp_path / "sub dir").mkdir()
    (tmp_path / "sub dir" / "b.bin").write_bytes(bytes(file.data))
    (tmp_path / "outside.gltf").write_text(file.gltf("sub%20dir/b.bin"))
    glb = read_clip(put(tmp_path, "a.glb", file))
    for path in (put(tmp_path, "a.gltf", file), tmp_path / "outside.gltf"):
        other = read_clip(path)
        assert np.array_equal(other.rot, glb.rot) and np.array_equal(other.root_pos, glb.root_pos)
    # Content decides, not the suffix.
    renamed = tmp_path / "a.txt"
    renamed.write_bytes(file.glb())
    assert read_clip(renamed).skeleton.source.format == "gltf"


@pytest.mark.parametrize("skin", [True, False])
def test_armature_scale_and_axis_turn_are_baked(tmp_path: Path, skin: bool) -> None:
    """A Z-up armature in centimetres, set upright and scaled to metres by the node above it."""
    file = Gltf()
    root = file.node("Armature", rotation=QUARTER_X, scale=[0.01] * 3, translation=[1.0, 0.0, 0.0])
    file, at = person(root, file, 100.0, skin)
    # Inside the armature Z is up: the bones lie along Y there, so the person lies on its back.
    times = [0.0, 0.05, 0.1]
    animation = file.animation()
    file.channel(animation, at["Hips"], "rotation", times, [turn("x", 90)] * 3)
    file.channel(animation, at["Hips"], "translation", times, [(0, 10 * k, 90) for k in range(3)])
    file.channel(animation, at["Spine"], "rotation", times, [turn("z", 10 * k) for k in range(3)])
    for name in ("Head", "LeftLeg", "LeftFoot"):
        file.channel(animation, at[name], "rotation", times, [turn("z", 0)] * 3)
    clip = read_clip(put(tmp_path, "a.glb", file))
    assert clip.skeleton.names[0] == "Hips" and clip.skeleton.source.unit_m == 1.0
    np.testing.assert_allclose(clip.skeleton.offsets[2], (0, 0, 0.35), atol=1e-6)
    # Armature (1, 0, 0) + R_x(-90) 0.01 (0, 10 k, 90) = (1, 0.9, -0.1 k) Y up = (1, 0.1 k, 0.9) Z up.
    np.testing.assert_allclose(clip.root_pos, [(1, 0.1 * k, 0.9) for k in range(3)], atol=1e-6)
    # R_x(-90) R_x(90) is the identity: the person stands.
    np.testing.assert_allclose(clip.positions()[0, 2], (1, 0, 1.5), atol=1e-6)


def test_children_may_come_before_parents(tmp_path: Path) -> None:
    """Blender lists leaves first; the joints come depth first in the order of the children."""
    file = Gltf()
    foot = file.node("LeftFoot", translation=[0, -0.85, 0])
    leg = file.node("LeftLeg", translation=[0.1, 0, 0], children=[foot])
    head = file.node("Head", translation=[0, 0.6, 0])
    hips = file.node("Hips", translation=[0, 0.9, 0], children=[head, leg])
    file.doc["scenes"][0]["nodes"] = [hips]
    file.doc["skins"] = [{"joints": [foot, leg, head, hips]}]
    file.channel(file.animation(), leg, "rotation", [0, 0.05, 0.1], [turn("x", k) for k in range(3)])
    clip = read_clip(put(tmp_path, "a.glb", file))
    assert clip.skeleton.names == ("Hips", "Head", "LeftLeg", "LeftFoot")
    assert clip.skeleton.parents == (-1, 0, 0, 2)


def test_matrix_nodes(tmp_path: Path) -> None:
    """A column-major matrix with a turn of 90 degrees about Y, a scale of 2 and a place."""
    file = Gltf()
    matrix = [0, 0, -2, 0, 0, 2, 0, 0, 2, 0, 0, 0, 3, 0, 0, 1]
    root = file.node("Top", matrix=matrix)
    file, at = person(root, file, 0.5)
    path = [(0, 0.45, 0.1 * k) for k in range(3)]
    file.channel(file.animation(), at["Hips"], "translation", [0, 0.05, 0.1], path)
    clip = read_clip(put(tmp_path, "a.glb", file))
    # (3, 0, 0) + R_y(90) 2 (0, 0.45, 0.1 k) = (3 + 0.2 k, 0.9, 0).
    np.testing.assert_allclose(clip.root_pos, [(3 + 0.2 * k, 0, 0.9) for k in range(3)], atol=1e-6)
    np.testing.assert_allclose(clip.positions()[0, 3] - clip.root_pos[0], (0, 0.1, 0), atol=1e-6)


def test_samplers_with_their_own_key_times(tmp_path: Path) -> None:
    """LINEAR, STEP and CUBICSPLINE against the formulas of the specification, frame by frame."""
    file, at = person()
    animation = file.animation()
    fine = [k / 24 for k in range(13)]
    file.channel(animation, at["Hips"], "translation", fine, [(0, 0.9, 0.02 * k) for k in range(13)])
    a, b = turn("x", 0), turn("x", 80)
    file.channel(animation, at["Spine"], "rotation", [0.0, 0.5], [a, [-x for x in b]])
    file.channel(animation, at["Head"], "rotation", [0.0, 0.25, 0.5], [a, b, turn("z", 30)], "STEP")
    v0, v1, out, into = np.array(a), np.array(b), np.array((0.3, 0.1, 0, 0)), np.array((0, 0, 0.4, 0.1))
    cubic = [np.zeros(4), v0, out, into, v1, np.zeros(4)]
    file.channel(animation, at["LeftLeg"], "rotation", [0.0, 0.5], cubic, "CUBICSPLINE")
    clip = read_clip(put(tmp_path, "a.glb", file))
    assert clip.fps == 24.0 and clip.frames == 13
    for k in range(13):
        u = k / 12
        lerp = slerp(wxyz(a), wxyz(b), np.asarray(u, dtype=float))
        step = wxyz(a if k < 6 else b if k < 12 else turn("z", 30))
        p = (2 * u**3 - 3 * u**2 + 1) * v0 + 0.5 * (u**3 - 2 * u**2 + u) * out
        p = p + (3 * u**2 - 2 * u**3) * v1 + 0.5 * (u**3 - u**2) * into
        curve = wxyz(tuple(p / np.linalg.norm(p)))
        for joint, want in ((1, lerp), (2, step), (3, curve)):
            # Z up turns the axes of rotation with everything else: (w, x, -z, y).
            w, x, y, z = want.tolist()
            got = quat_to_matrix(clip.rot[k, joint])
            np.testing.assert_allclose(
                got, quat_to_matrix(np.array((w, x, -z, y), dtype=float)), atol=2e-6, rtol=0
            )


def test_normalised_sparse_and_interleaved_accessors(tmp_path: Path) -> None:
    """The same rotations as floats, as normalised shorts, sparsely and between other values."""
    times = [0.0, 0.1, 0.2, 0.3]
    turns = np.array([turn("x", 20 * k) for k in range(4)])
    clips = []
    for way in ("float", "short", "byte", "sparse", "interleaved"):
        file, at = person()
        if way == "float":
            output = file.accessor(turns)
        elif way == "short":
            output = file.accessor(np.round(turns * 32767), "<i2", normalized=True)
        elif way == "byte":
            output = file.accessor(np.round(turns * 127), "<i1", normalized=True)
        elif way == "sparse":
            output = file.accessor(np.tile(turns[0], (4, 1)))
            sparse = {
                "count": 3,
                "indices": {"bufferView": file.view(bytes([1, 2, 3])), "componentType": 5121},
                "values": {"bufferView": file.view(turns[1:].astype("<f4").tobytes())},
            }
            file.doc["accessors"][output]["sparse"] = sparse
        else:
            output = file.accessor(turns)
            rows = b"".join(struct.pack("<3f4f", 9, 9, 9, *q) for q in turns)
            view = file.view(rows, byteStride=28)
            file.doc["accessors"][output].update(bufferView=view, byteOffset=12)
        file.channel(file.animation(), at["LeftLeg"], "rotation", times, output)
        clips.append(read_clip(put(tmp_path, f"{way}.glb", file)))
    for clip, slack in zip(clips[1:], (1e-4, 1e-2, 0, 0), strict=True):
        np.testing.assert_allclose(clip.rot, clips[0].rot, atol=slack + 1e-12)


def test_the_longest_animation_or_the_one_asked_for(tmp_path: Path) -> None:
    file, at = walker()
    times = [0.0, 0.5, 1.0, 1.5]
    file.channel(file.animation("wave"), at["Head"], "rotation", times, [turn("x", k) for k in range(4)])
    path = put(tmp_path, "a.glb", file)
    clip = read_clip(path)
    assert "Of 2 animations the longest, 1 'wave' (1.50 s), was taken" in clip.skeleton.source.notes[0]
    assert read_clip(path, take="walk").frames == read_clip(path, take="0").frames == 7
    with pytest.raises(PoiseError) as error:
        read_clip(path, take="run")
    assert str(error.value) == (
        f"{path}: it has no animation 'run'. Known, by number or name: 0 'walk', 1 'wave'"
    )


@pytest.mark.parametrize(
    ("times", "fps", "frames", "note"),
    [
        ([k / 60 for k in range(9)], 60.0, 9, ""),
        ([k * 1001 / 30000 for k in range(9)], 30000 / 1001, 9, ""),
        ([k / 120 for k in range(900, 909)], 120.0, 9, ""),
        ([k / 30 for k in (0, 1, 2, 3, 7, 8, 12)], 30.0, 13, ""),
        ([0, 0.033, 0.071, 0.104, 0.137, 0.2], 60.0, 13, "not evenly spaced; they were read at 60"),
        ([0, 0.5, 1.0], 30.0, 31, "Most keys stand 0.5 s apart; they were read at 30"),
    ],
)
def test_frame_rates(tmp_path: Path, times: list[float], fps: float, frames: int, note: str) -> None:
    file, at = person()
    turns = [turn("x", 3.0 * k) for k in range(len(times))]
    file.channel(file.animation(), at["Spine"], "rotation", times, turns)
    path = put(tmp_path, "a.glb", file)
    clip = read_clip(path)
    assert clip.fps == pytest.approx(fps, rel=1e-12) and clip.frames == frames
    assert any(note in n for n in clip.skeleton.source.notes) if note else not clip.skeleton.source.notes
    again = read_clip(path, fps=50)
    assert again.fps == 50 and again.frames == int((times[-1] - times[0]) * 50 + 0.02) + 1


def test_centimetres_are_told(tmp_path: Path) -> None:
    file, at = person(size=100.0)
    file.channel(
        file.animation(), at["Spine"], "rotation", [0, 0.05, 0.1], [turn("x", k) for k in range(3)]
    )
    clip = read_clip(put(tmp_path, "a.glb", file))
    assert clip.skeleton.source.unit_m == 0.01
    np.testing.assert_allclose(clip.root_pos[0], (0, 0, 0.9), atol=1e-7)
    assert "one unit is taken as 0.01 m" in clip.skeleton.source.notes[0]
    assert read_clip(tmp_path / "a.glb", unit_m=0.02).root_pos[0, 2] == pytest.approx(1.8)


def test_a_still_root_gives_way_to_the_travelling_hips(tmp_path: Path) -> None:
    file = Gltf()
    root = file.node("Root", translation=[0, 0, 1])
    file, at = person(root, file)
    file.doc["skins"][0]["joints"].insert(0, root)
    animation = file.animation()
    path = [(0, 0.9, 0.1 * k) for k in range(3)]
    file.channel(animation, at["Hips"], "translation", [0, 0.05, 0.1], path)
    clip = read_clip(put(tmp_path, "a.glb", file))
    assert clip.skeleton.names[0] == "Hips"
    np.testing.assert_allclose(clip.root_pos[:, 1], (-1, -1.1, -1.2), atol=1e-6)
    # With a second branch the root stays, and the hips' travel becomes its path.
    ik = file.node("ik_foot", root, translation=[0.2, 0, 0])
    file.doc["skins"][0]["joints"].append(ik)
    clip = read_clip(put(tmp_path, "b.glb", file))
    assert clip.skeleton.names[:2] == ("Root", "Hips") and clip.skeleton.source.travel_joint == "Hips"
    np.testing.assert_allclose(clip.positions()[:, 1, 1], (-1, -1.1, -1.2), atol=1e-6)
    assert "the travel of 'Hips' became the root's path" in clip.skeleton.source.notes[0]


def test_scale_channels(tmp_path: Path) -> None:
    """A constant one is part of the bones; an animated one is told."""
    file, at = walker()
    animation = file.doc["animations"][0]
    file.channel(animation, at["Spine"], "scale", [0, 0.1], [(2, 2, 2)] * 2)
    clip = read_clip(put(tmp_path, "a.glb", file))
    np.testing.assert_allclose(clip.skeleton.offsets[2], (0, 0, 0.7), atol=1e-7)
    file.channel(animation, at["LeftLeg"], "scale", [0, 0.05, 0.1], [(1, 1, 1), (1, 1, 1), (2, 2, 2)])
    clip = read_clip(put(tmp_path, "b.glb", file))
    assert clip.skeleton.source.notes == (
        "The scale of 'LeftLeg' is animated; its median was taken for all frames",
    )
    np.testing.assert_allclose(clip.skeleton.offsets[4], (0, 0, -0.85), atol=1e-7)


def test_stretching_bones_are_kept_rigid_and_told(tmp_path: Path) -> None:
    file, at = walker()
    times = [0, 1 / 30, 2 / 30]
    file.channel(
        file.doc["animations"][0],
        at["Head"],
        "translation",
        times,
        [(0, 0.35, 0), (0, 0.35, 0), (0, 0.4, 0)],
    )
    clip = read_clip(put(tmp_path, "a.glb", file))
    assert "Joint 'Head' moves against its parent by up to" in clip.skeleton.source.notes[0]


def test_nodes_without_names_or_with_the_same(tmp_path: Path) -> None:
    file, at = walker()
    del file.doc["nodes"][at["Spine"]]["name"]
    file.doc["nodes"][at["LeftLeg"]]["name"] = "LeftFoot"
    clip = read_clip(put(tmp_path, "a.glb", file))
    assert clip.skeleton.names == ("Hips", "node_1", "Head", "LeftFoot", "LeftFoot_2")
    assert clip.skeleton.source.notes == (
        "The joint name 'LeftFoot' appears twice; the later one is called 'LeftFoot_2'",
    )


def test_cameras_and_meshes_are_no_joints(tmp_path: Path) -> None:
    """Without a skin, static nodes below the figure count, but not those that carry something."""
    file, at = walker(skin=False)
    file.node("LeftToe", at["LeftFoot"], translation=[0, 0, 0.1])
    file.node("Hat", at["Head"], mesh=0)
    camera = file.node("Camera", camera=0)
    animation = file.doc["animations"][0]
    file.channel(animation, camera, "translation", [0, 0.1], [(0, 0, 0), (1, 0, 0)])
    clip = read_clip(put(tmp_path, "a.glb", file))
    assert clip.skeleton.names == ("Hips", "Spine", "Head", "LeftLeg", "LeftFoot", "LeftToe")
    assert "1 animated nodes outside the figure were left out" in clip.skeleton.source.notes[0]


def test_channels_of_extensions_and_weights_are_passed_over(tmp_path: Path) -> None:
    file, _ = walker()
    animation = file.doc["animations"][0]
    animation["channels"] += [
        {"sampler": 0, "target": {"path": "pointer", "extensions": {"KHR_animation_pointer": {}}}},
        {"sampler": 0, "target": {"node": 0, "path": "weights"}},
    ]
    assert read_clip(put(tmp_path, "a.glb", file)).frames == 7


def test_mixamo_names_make_a_body(tmp_path: Path) -> None:
    """The prefix is kept in the names and does not hinder the anatomy."""
    file = Gltf()
    root = file.node("mixamorig:Hips", translation=[0, 0.95, 0])
    chains = (
        (
            ("Spine", (0, 0.1, 0)),
            ("Spine1", (0, 0.15, 0)),
            ("Neck", (0, 0.25, 0)),
            ("Head", (0, 0.1, 0)),
        ),
        *(
            ((f"{s}UpLeg", (x, -0.05, 0)), (f"{s}Leg", (0, -0.42, 0)), (f"{s}Foot", (0, -0.42, 0)))
            for s, x in (("Left", 0.1), ("Right", -0.1))
        ),
    )
    made = {"Hips": root}
    for chain in chains:
        up = root
        for name, place in chain:
            up = made[name] = file.node(f"mixamorig:{name}", up, translation=list(place))
    for s, x in (("Left", 1), ("Right", -1)):
        up = made["Spine1"]
        for name, d in (("Shoulder", 0.1), ("Arm", 0.1), ("ForeArm", 0.28), ("Hand", 0.26)):
            up = made[f"{s}{name}"] = file.node(f"mixamorig:{s}{name}", up, translation=[x * d, 0.02, 0])
    file.doc["skins"] = [{"joints": list(made.values())}]
    turns = [turn("x", 2 * k) for k in range(4)]
    file.channel(file.animation(), made["LeftLeg"], "rotation", [0, 0.05, 0.1, 0.15], turns)
    clip = read_clip(put(tmp_path, "a.glb", file))
    table = generate_table(clip.skeleton, clips=[clip])
    assert clip.skeleton.names[0] == "mixamorig:Hips" and len(table.rows) >= 15
