"""Hostile motion files and bodies for `attack.py`: what broke an early Poise, and what it withstood."""

from __future__ import annotations

import base64
import json
import math
import struct
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from attack_case import WALK, case, command, info, read

from poise.formats import read_clip, write_clip
from poise.motion import Clip


def chain(joints: int, wide: bool = False) -> str:
    """A BVH with joints that hang below, or beside, one another."""
    text = ["HIERARCHY", "ROOT Hips", "{", "OFFSET 0 0 0", "CHANNELS 6 Xposition Yposition Zposition "
            "Zrotation Xrotation Yrotation"]  # fmt: skip
    for k in range(joints):
        text += [f"JOINT j{k}", "{", f"OFFSET 0 {150 / (1 if wide else joints)} 0",
                 "CHANNELS 3 Zrotation Xrotation Yrotation"]  # fmt: skip
        text += ["End Site", "{", "OFFSET 0 1 0", "}", "}"] if wide else []
    text += [] if wide else ["End Site", "{", "OFFSET 0 1 0", "}"] + ["}"] * joints
    row = " ".join(["0"] * (6 + 3 * joints))
    return "\n".join([*text, "}", "MOTION", "Frames: 4", "Frame Time: 0.02", *[row] * 4]) + "\n"


for _joints in (600, 1900):
    case(f"BVH, a chain of {_joints} joints")(lambda f, n=_joints: read(f, "a.bvh", chain(n)))  # type: ignore[misc]
    case(f"BVH, {_joints} joints wide")(lambda f, n=_joints: read(f, "a.bvh", chain(n, True)))  # type: ignore[misc]


@case("BVH, a skeleton of 100,000 lines")
def _(folder: Path) -> Any:
    return read(folder, "a.bvh", chain(25_000))


@case("ASF, 600,000 bones")
def _(folder: Path) -> Any:
    bones = "".join(f"begin\nname b{k}\nlength 1\nend\n" for k in range(600_000))
    (folder / "a.asf").write_text(":version 1.10\n:bonedata\n" + bones + ":hierarchy\n")
    return read(folder, "a_1.amc", ":fully-specified\n:degrees\n1\nroot 0 0 0 0 0 0\n")


def bomb(folder: Path, frames: int, numbers: int, kind: str, packed: bool = True) -> Clip:
    """An archive of zeros that unpacks to much."""
    arrays = {"poses": np.zeros((frames, numbers), kind), "trans": np.zeros((frames, 3), kind),
              "mocap_framerate": np.array(60.0), "betas": np.zeros(10)}  # fmt: skip
    (np.savez_compressed if packed else np.savez)(folder / "a.npz", **arrays)  # type: ignore[operator]
    del arrays
    return info(folder / "a.npz")


@case("npz bomb, 801,282 x 156 f4")
def _(folder: Path) -> Any:
    return bomb(folder, 801_282, 156, "f4")


@case("npz bomb, 3,787,878 x 66 f2")
def _(folder: Path) -> Any:
    return bomb(folder, 3_787_878, 66, "f2")


@case("npz, 160,256 x 156 f4 in 0.1 MB")
def _(folder: Path) -> Any:
    return bomb(folder, 160_256, 156, "f4")


def directory(folder: Path, count: int) -> Clip:
    """An archive of one array that its directory names many times."""
    name = b"a.npy"
    entry = struct.pack(
        "<4s6H3L5H2L", b"PK\x01\x02", 20, 20, 0, 0, 0, 0, 0, 0, 0, len(name), 0, 0, 0, 0, 0, 0
    )
    entries = (entry + name) * count
    local = struct.pack("<4s5H3L2H", b"PK\x03\x04", 20, 0, 0, 0, 0, 0, 0, 0, len(name), 0) + name
    end = struct.pack("<4s4H2LH", b"PK\x05\x06", 0, 0, 0xFFFF, 0xFFFF, len(entries), len(local), 0)
    return read(folder, "a.npz", local + entries + end)


@case("npz, a directory of a million entries")
def _(folder: Path) -> Any:
    return directory(folder, 1_000_000)


@case("npz, a directory of 4 million entries")
def _(folder: Path) -> Any:
    return directory(folder, 4_000_000)


@case("glTF, 1,899 joints of one name")
def _(folder: Path) -> Any:
    return read(folder, "a.gltf", skinned(1899, False, "joint"))


@case("glTF, a chain of 600 joints")
def _(folder: Path) -> Any:
    return read(folder, "a.gltf", skinned(600, True, "joint"))


def skinned(joints: int, deep: bool, name: str) -> str:
    """A skin with joints that hang below, or beside, one another; the first one travels."""
    data = np.array([0.0, 0.1, 0, 1, 0, 0, 1, 1], "<f4").tobytes()
    nodes: list[dict[str, Any]] = [
        {"name": name, "translation": [0, 1.5 / joints if deep else 1.5, 0]} for _ in range(joints)
    ]
    for k in range(joints - 1 if deep else 1):
        nodes[k]["children"] = [k + 1] if deep else list(range(1, joints))
    doc = {
        "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": nodes,
        "skins": [{"joints": list(range(joints))}],
        "buffers": [{"byteLength": len(data), "uri": "data:application/octet-stream;base64,"
                     + base64.b64encode(data).decode()}],
        "bufferViews": [{"buffer": 0, "byteOffset": 0, "byteLength": 8},
                        {"buffer": 0, "byteOffset": 8, "byteLength": 24}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 2, "type": "SCALAR"},
                      {"bufferView": 1, "componentType": 5126, "count": 2, "type": "VEC3"}],
        "animations": [{"samplers": [{"input": 0, "output": 1}],
                        "channels": [{"sampler": 0, "target": {"node": 0, "path": "translation"}}]}],
    }  # fmt: skip
    return json.dumps(doc)


@case("glTF, a buffer address of 5,000 letters")
def _(folder: Path) -> Any:
    text = skinned(3, False, "joint")
    start = text.index("data:application")
    return read(folder, "a.gltf", text[:start] + "x" * 5000 + text[text.index('"', start) :])


@case("glTF, 100 MB of empty objects")
def _(folder: Path) -> Any:
    return read(folder, "a.gltf", '{"asset":{"version":"2.0"},"extras":[' + "{}," * 33_000_000 + "{}]}")


@case("CSV, a comment of one word of 100,000 letters")
def _(folder: Path) -> Any:
    head = ",".join(f"{n}_{a}" for n in ("a", "b", "c", "d", "e") for a in "xyz")
    return read(folder, "a.csv", f"# \x0b{head}\x0b{'a' * 100_000}\n{head}\n1,2\n")


@case("CSV, a comment of one word of 20,000 letters")
def _(folder: Path) -> Any:
    head = ",".join(f"{n}_{a}" for n in ("a", "b", "c", "d", "e") for a in "xyz")
    return read(folder, "a.csv", f"# \x0b{head}\x0b{'a' * 20_000}\n{head}\n1,2\n")


@case("CSV, a column that lacks below 40 long names")
def _(folder: Path) -> Any:
    write_clip(read_clip(WALK), folder / "a.csv")
    lines = (folder / "a.csv").read_text().split("\n")
    at = next(k for k, line in enumerate(lines) if line[:1] != "#")
    lines[at] = ",".join(f"{'y' * 900}{k}" for k in range(lines[at].count(",") + 1))
    return read(folder, "a.csv", "\n".join(lines))


@case("CSV of Poise, an arm that hangs on another")
def _(folder: Path) -> Any:
    write_clip(read_clip(WALK), folder / "a.csv")
    text = (folder / "a.csv").read_text()
    start = text.index("# skeleton:") + len("# skeleton:")
    end = text.index("\n", start)
    record = json.loads(text[start:end])
    record["parents"][record["names"].index("RightArm")] = 1
    read(folder, "a.csv", text[:start] + json.dumps(record) + text[end:])
    return command("doctor", folder / "a.csv")


@case("npz of Poise, a letter that does not exist")
def _(folder: Path) -> Any:
    write_clip(read_clip(WALK), folder / "a.poise.npz")
    with np.load(folder / "a.poise.npz") as file:
        arrays = dict(file)
    arrays["names"].view(np.uint32)[0] = 0x110000
    with zipfile.ZipFile(folder / "b.poise.npz", "w") as archive:
        for name, value in arrays.items():
            with archive.open(f"{name}.npy", "w") as member:
                np.lib.format.write_array(member, value, allow_pickle=False)
    return info(folder / "b.poise.npz")


@case("CSV of keypoints below a licence of 40 kB")
def _(folder: Path) -> Any:
    names = (
        "RHip LHip RKnee LKnee RAnkle LAnkle RShoulder LShoulder RElbow LElbow RWrist LWrist Neck Head"
    )
    at = {"Hip": 0.9, "Knee": 0.5, "Ankle": 0.1, "Shoulder": 1.4, "Elbow": 1.1, "Wrist": 0.9,
          "Neck": 1.45, "Head": 1.7}  # fmt: skip
    head = ",".join(f"{n}_{a}" for n in names.split() for a in "xyz")
    row = []
    for n in names.split():
        side = -0.15 if n[0] == "R" else 0.15 if n[0] == "L" else 0.0
        row += [side, 0.1 if "Wrist" in n else 0.0, at[n.lstrip("RL") if n[0] in "RL" else n]]
    rows = [",".join(map(str, [*row])) for _ in range(8)]
    licence = "".join(f"# line {k} of a long licence text\n" for k in range(1200))
    return read(
        folder, "a.csv", licence + "# fps = 30, unit = m, up = Z\n" + head + "\n" + "\n".join(rows)
    )


def trc(names: list[str]) -> str:
    """A table of two frames."""
    head = (
        "PathFileType\t4\t(X/Y/Z)\tx.trc\nDataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tA\tB\tC\n"
    )
    head += f"30\t30\t2\t{len(names)}\tm\t30\t1\t2\nFrame#\tTime\t" + "\t\t\t".join(names) + "\n\n"
    row = "\t".join(["0.1"] * 3 * len(names))
    return head + f"1\t0\t{row}\n2\t0.03\t{row}\n"


@case("TRC, 100,000 labels")
def _(folder: Path) -> Any:
    return read(folder, "a.trc", trc([f"m{k}" for k in range(100_000)]))


@case("TRC, 600,000 labels")
def _(folder: Path) -> Any:
    return read(folder, "a.trc", trc([f"m{k}" for k in range(600_000)]))


@case("TRC, a label of 20,000 underscores")
def _(folder: Path) -> Any:
    return read(folder, "a.trc", trc(["_" * 20_000, *(f"m{k}" for k in range(20))]))


@case("TRC, a label of 100,000 underscores")
def _(folder: Path) -> Any:
    return read(folder, "a.trc", trc(["_" * 100_000, *(f"m{k}" for k in range(20))]))


def to_and_fro(folder: Path, minutes: float, fast: bool) -> Clip:
    """The walk forwards and backwards for minutes, at its rate or four times too fast."""
    clip = read_clip(WALK)
    fps = 120.0 if fast else clip.fps
    turn = math.ceil(minutes * 60 * fps / (2 * clip.frames))
    order = np.tile(np.r_[np.arange(clip.frames), np.arange(clip.frames)[::-1]], turn)
    made = Clip(clip.skeleton, clip.root_pos[order], clip.rot[order], fps, "long")
    write_clip(made, folder / "a.bvh")
    del made, order
    return info(folder / "a.bvh")


for _minutes in (5, 10, 20, 60):
    case(f"BVH, {_minutes} minutes four times too fast")(
        lambda f, m=_minutes: to_and_fro(f, m, True)  # type: ignore[misc]
    )


@case("BVH, an hour at 30 a second")
def _(folder: Path) -> Any:
    return to_and_fro(folder, 60, False)
