"""FBX that is written: its records, read by a reader of their own, by ufbx and by Blender."""

from __future__ import annotations

import importlib.util
import json
import os
import struct
import subprocess
import sys
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from poise.formats import WRITERS, read_clip, write_clip
from poise.motion import Clip
from toy_human import human, swing

#: Z up, metres, to Y up, centimetres.
TURN = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])


def _records(data: bytes, at: int, stop: int) -> list[tuple[str, list[Any], list[Any]]]:
    out: list[tuple[str, list[Any], list[Any]]] = []
    while at < stop:
        end, count, size, named = struct.unpack_from("<IIIB", data, at)
        if end == 0:
            return out
        name = data[at + 13 : at + 13 + named].decode()
        values, place = [], at + 13 + named
        begin = place
        for _ in range(count):
            value, place = _value(data, place)
            values.append(value)
        assert place == begin + size
        out.append((name, values, _records(data, place, end)))
        at = end
    return out


def _value(data: bytes, at: int) -> tuple[Any, int]:
    kind = chr(data[at])
    if kind in "ldfi":
        _, packed, size = struct.unpack_from("<III", data, at + 1)
        raw = data[at + 13 : at + 13 + size]
        dtype = {"l": "<i8", "d": "<f8", "f": "<f4", "i": "<i4"}[kind]
        return np.frombuffer(zlib.decompress(raw) if packed else raw, dtype), at + 13 + size
    if kind == "S":
        (size,) = struct.unpack_from("<I", data, at + 1)
        return data[at + 5 : at + 5 + size].decode(), at + 5 + size
    code, size = {"L": ("<q", 8), "I": ("<i", 4), "D": ("<d", 8)}[kind]
    return struct.unpack_from(code, data, at + 1)[0], at + 1 + size


def _places(path: Path, names: tuple[str, ...]) -> tuple[np.ndarray, float]:
    """`(T, J, 3)` cm, Y up, and the rate, by the records alone."""
    data = path.read_bytes()
    assert (
        data.startswith(b"Kaydara FBX Binary  \x00\x1a\x00")
        and struct.unpack_from("<I", data, 23)[0] == 7400
    )
    top = {name: inside for name, _, inside in _records(data, 27, len(data))}
    settings = {v[0]: v[4] for n, v, _ in top["GlobalSettings"][1][2] if n == "P"}
    models, curves, nodes = {}, {}, {}
    for name, values, inside in top["Objects"]:
        if name == "Model":
            held = {v[0]: v[4:] for _, v, _ in inside[1][2]}
            models[values[0]] = values[1].split("\0")[0], held["Lcl Translation"]
        elif name == "AnimationCurve":
            rows = {n: v[0] for n, v, _ in inside}
            curves[values[0]] = rows["KeyTime"], rows["KeyValueFloat"]
    for _, (kind, a, b, *what), _ in top["Connections"]:
        if kind == "OP" and a in curves:
            nodes.setdefault(b, {})[what[0]] = curves[a]
    parents = {a: b for _, (kind, a, b, *_), _ in top["Connections"] if a in models}
    turns, moves = {}, {}
    for _, (kind, a, b, *what), _ in top["Connections"]:
        if kind == "OP" and a in nodes:
            table = np.stack([nodes[a][f"d|{axis}"][1] for axis in "XYZ"], -1).astype(float)
            (turns if what[0] == "Lcl Rotation" else moves)[b] = table
    times = next(iter(curves.values()))[0]
    world: dict[int, tuple[np.ndarray, Rotation]] = {}
    for number, (_, place) in models.items():
        turn = Rotation.from_euler("xyz", turns[number], degrees=True)
        at = moves.get(number, np.tile(place, (len(times), 1)))
        if parents[number]:
            above, carried = world[parents[number]]
            at, turn = above + carried.apply(at), carried * turn
        world[number] = at, turn
    by_name = {models[n][0]: at for n, (at, _) in world.items()}
    assert settings["UpAxis"] == 1 and settings["UnitScaleFactor"] == 1.0
    rate = 46_186_158_000 / float(np.diff(times).mean())
    assert abs(settings["CustomFrameRate"] - rate) < 1e-4
    return np.stack([by_name[n] for n in names], 1), rate


def _turning() -> Clip:
    """A motion with whole turns and joints straight up, where Euler angles are hard to follow."""
    clip = swing(seconds=2.0, speed=1.0, bend=2.0)
    angle = np.linspace(0.0, 5 * np.pi, clip.frames)
    rot = clip.rot.copy()
    rot[:, 0] = np.stack((np.cos(angle / 2), 0 * angle, 0 * angle, np.sin(angle / 2)), -1)
    rot[:, 8] = np.stack((np.cos(angle / 4), 0 * angle, np.sin(angle / 4), 0 * angle), -1)
    return clip.replaced(rot=rot)


@pytest.mark.parametrize("clip", [swing(), _turning()], ids=["swing", "turns"])
def test_places_are_those_of_the_clip(clip: Clip, tmp_path: Path):
    write_clip(clip, tmp_path / "x.fbx")
    there, rate = _places(tmp_path / "x.fbx", clip.skeleton.names)
    assert rate == pytest.approx(clip.fps, abs=1e-6)
    np.testing.assert_allclose(there / 100, clip.positions() @ TURN.T, atol=1e-5)


def test_angles_do_not_leap(tmp_path: Path):
    """Between two keys a reader goes the straight way, so angles follow each other."""
    from poise.formats.fbx_write import _angles

    clip = _turning()
    assert np.abs(np.diff(_angles(clip.rot), axis=0)).max() < 120.0
    assert ".fbx" in WRITERS


def test_ufbx_reads_it_as_it_was_written(tmp_path: Path):
    pytest.importorskip("ufbx")
    clip = swing(fps=29.97)
    write_clip(clip, tmp_path / "x.fbx")
    again = read_clip(tmp_path / "x.fbx")
    assert again.skeleton.names == human().names and again.frames == clip.frames
    assert again.fps == pytest.approx(29.97, rel=1e-4)
    np.testing.assert_allclose(again.positions(), clip.positions(), atol=1e-4)


_BLENDER = """
import bpy, json, sys
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.import_scene.fbx(filepath=sys.argv[1])
body = next(o for o in bpy.data.objects if o.type == "ARMATURE")
scene, out = bpy.context.scene, []
first, last = (round(x) for x in body.animation_data.action.frame_range)
for frame in range(first, last + 1):
    scene.frame_set(frame)
    out.append({b.name: list((body.matrix_world @ b.matrix).translation) for b in body.pose.bones})
json.dump({"rows": out, "fps": scene.render.fps / scene.render.fps_base}, open(sys.argv[2], "w"))
"""


def test_blender_shows_it_within_a_tenth_of_a_millimetre(tmp_path: Path):
    named = os.environ.get("POISE_BPY_PYTHON")
    if named is None and importlib.util.find_spec("bpy") is None:
        pytest.skip("needs bpy, or POISE_BPY_PYTHON")
    clip = swing()
    write_clip(clip, tmp_path / "x.fbx")
    script, told = tmp_path / "b.py", tmp_path / "told.json"
    script.write_text(_BLENDER)
    line = [named or sys.executable, str(script), str(tmp_path / "x.fbx"), str(told)]
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    subprocess.run(line, check=True, capture_output=True, timeout=240, env=environment)
    held = json.loads(told.read_text())
    shown = np.array([[row[n] for n in clip.skeleton.names] for row in held["rows"]])
    assert held["fps"] == pytest.approx(clip.fps) and len(shown) == clip.frames
    np.testing.assert_allclose(shown, clip.positions(), atol=1e-4)
