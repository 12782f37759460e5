"""Hostile files, runs and commands, made by a few lines each: what broke an early Poise, and what it
withstood.

What is changed in a run, a policy or a model is the table of `tests/jobs/test_strange_files.py`, and
what stands here beside it.
"""

from __future__ import annotations

import base64
import io
import json
import math
import os
import shutil
import struct
import subprocess
import sys
import zipfile
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout, suppress
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

import poise
import poise.cli.convert
import poise.cli.doctor
import poise.cli.eval
import poise.cli.inbetween
import poise.cli.track
import poise.jobs.runs
from benchmarks.common.clips import WALK
from poise.errors import PoiseError
from poise.formats import read_clip, write_clip
from poise.motion import Clip, describe, resample

#: Makes and reads one thing in a folder, by its name.
CASES: dict[str, Callable[[Path], Any]] = {}


#: kB that a process held when it began to read.
HELD: list[int] = []


def held(most: bool = False) -> int:
    """kB that this process holds, or held at most since that was last forgotten."""
    lines, name = Path("/proc/self/status").read_text().splitlines(), "VmHWM:" if most else "VmRSS:"
    return next(int(line.split()[1]) for line in lines if line.startswith(name))


def case(name: str) -> Callable[[Callable[[Path], Any]], Callable[[Path], Any]]:
    """Registers what makes a hostile file and reads it."""

    def add(make: Callable[[Path], Any]) -> Callable[[Path], Any]:
        if name in CASES:
            raise ValueError(f"two cases are called '{name}'")
        CASES[name] = make
        return make

    return add


def read(folder: Path, name: str, data: str | bytes, **options: Any) -> Clip:
    """Writes a file and reads it as `poise info` does."""
    (folder / name).write_bytes(data if isinstance(data, bytes) else data.encode())
    return info(folder / name, **options)


def info(path: Path, **options: Any) -> Clip:
    """Reads a file and describes it. Memory counts from here on: making it takes some, too."""
    Path("/proc/self/clear_refs").write_text("5")
    HELD.append(held())
    clip = read_clip(path, **options)
    describe(clip)
    return clip


def command(*argv: str | Path) -> str:
    """What a command writes on the standard output.

    Raises:
        PoiseError: its sentence, where it ends with 2. RuntimeError: it ends with anything but 0 and 2.
    """
    from poise.cli.main import main

    out, err = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err):
        code = main([str(a) for a in argv])
    # What it was doing stands before its sentence.
    said = " ".join(err.getvalue().split()).rpartition("error: ")[2]
    if code == 2 and "Traceback" not in said:
        raise PoiseError(said, code="command-line")
    if code != 0:
        raise RuntimeError(f"exit code {code}: {said[-200:]}")
    return out.getvalue()


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


@case("USD, 100,000 nested prims")
def _(folder: Path) -> Any:
    return read(folder, "a.usda", "#usda 1.0\n" + 'def "a" {' * 100_000 + "}" * 100_000)


@case("USD, 50,000 nested dictionaries")
def _(folder: Path) -> Any:
    text = "{ dictionary a = " * 50_000 + "{}" + "}" * 50_000
    return read(folder, "a.usda", "#usda 1.0\n( customLayerData = " + text + ")")


@case("USD, a value of 100,000 brackets")
def _(folder: Path) -> Any:
    text = 'def "a" {\ncustom float3 x = ' + "(" * 100_000 + "1" + ")" * 100_000 + "\n}"
    return read(folder, "a.usda", "#usda 1.0\n" + text)


@case("USD in bytes, byte 97 set to 2")
def _(folder: Path) -> Any:
    write_clip(read_clip(WALK), folder / "a.usdc")
    data = (folder / "a.usdc").read_bytes()
    return read(folder, "b.usdc", data[:97] + b"\x02" + data[98:])


@case("USD, 1,999,000 poses out of four keys")
def _(folder: Path) -> Any:
    return few_keys(folder, 1_999_000)


@case("USD, 200,000 poses out of four keys")
def _(folder: Path) -> Any:
    return few_keys(folder, 200_000)


def few_keys(folder: Path, poses: int) -> Clip:
    """Three joints with four keys that lie so that their common step makes many poses."""
    joints = '["a", "a/b", "a/b/c"]'
    still = "[(1, 0, 0, 0), (1, 0, 0, 0), (1, 0, 0, 0)]"
    keys = "".join(f"{t}: {still}, " for t in (0, 1, 3, poses - 1))
    places = "".join(f"{t}: [({0.1 * k}, 1, 0), (0, 0.5, 0), (0, 0.4, 0)], "
                     for k, t in enumerate((0, 1, 3, poses - 1)))  # fmt: skip
    eye = "( (1,0,0,0), (0,1,0,0), (0,0,1,0), (0,0,0,1) )"
    text = f"""#usda 1.0
( metersPerUnit = 1
  upAxis = "Y"
  timeCodesPerSecond = 1000 )
def SkelRoot "r" {{
  def Skeleton "s" ( prepend apiSchemas = ["SkelBindingAPI"] ) {{
    uniform token[] joints = {joints}
    uniform matrix4d[] bindTransforms = [{eye}, {eye}, {eye}]
    uniform matrix4d[] restTransforms = [{eye}, {eye}, {eye}]
    rel skel:animationSource = </r/m>
  }}
  def SkelAnimation "m" {{
    uniform token[] joints = {joints}
    quatf[] rotations.timeSamples = {{ {keys} }}
    half3[] scales = [(1, 1, 1), (1, 1, 1), (1, 1, 1)]
    float3[] translations.timeSamples = {{ {places} }}
  }}
}}
"""
    return read(folder, "a.usda", text)


@case("USD that refers to itself")
def _(folder: Path) -> Any:
    return read(folder, "a.usda", '#usda 1.0\ndef "R" ( references = </R> )\n{\n}\n')


def mjcf(line: str, folder: Path) -> Any:
    """A body with one hostile line."""
    from poise.body import read_mjcf

    head = "<mujoco><worldbody><body name='pelvis'><freejoint/><geom size='.1'/></body></worldbody>"
    (folder / "a.xml").write_text(f"{head}{line}</mujoco>")
    return read_mjcf(folder / "a.xml")


for _name, _line in {
    "texture": "<asset><texture type='2d' builtin='flat' width='60000' height='60000'/></asset>",
    "hfield": "<asset><hfield name='h' nrow='40000' ncol='40000' size='1 1 1 1'/></asset>",
    "nuserdata": "<size nuserdata='2000000000'/>",
    "nkey": "<size nkey='2000000000'/>",
    "replicate": "<worldbody><replicate count='100000'><body/></replicate></worldbody>",
    "flexcomp": "<worldbody><flexcomp name='f' type='grid' count='300 300 300' dim='3'/></worldbody>",
    "include": "<include file='../../secret.xml'/>",
    "plug-in": "<extension><plugin plugin='mujoco.elasticity.cable'/></extension>",
    "nested": "<worldbody>" + "<body>" * 20_000 + "</body>" * 20_000 + "</worldbody>",
}.items():
    case(f"MJCF, {_name}")(lambda f, x=_line: mjcf(x, f))  # type: ignore[misc]


PERSON = {
    "RHip": (-0.1, 0.9, 0), "LHip": (0.1, 0.9, 0), "RKnee": (-0.1, 0.5, 0.02), "LKnee": (0.1, 0.5, 0.02),
    "RAnkle": (-0.1, 0.1, 0), "LAnkle": (0.1, 0.1, 0), "RShoulder": (-0.18, 1.4, 0),
    "LShoulder": (0.18, 1.4, 0), "RElbow": (-0.2, 1.1, -0.01), "LElbow": (0.2, 1.1, -0.01),
    "RWrist": (-0.2, 0.86, 0.06), "LWrist": (0.2, 0.86, 0.06), "Neck": (0, 1.45, 0),
    "Head": (0, 1.7, 0.02),
}  # fmt: skip


PLACES = np.array(list(PERSON.values())) + np.arange(8)[:, None, None] * (0.001, 0.002, 0.01)


def bvh(rate: str) -> str:
    """The walk with another frame time."""
    text = WALK.read_text()
    start = text.index("Frame Time:")
    return text[:start] + f"Frame Time: {rate}" + text[text.index("\n", start) :]


def deepmimic(duration: str) -> str:
    """Frames of another length, each of the 44 numbers that the format asks for."""
    one = [1.0, 0.0, 0.0, 0.0]
    row = [0, 0.85, 0, *one, *one, *one, *one, -0.5, *one, *one, 0.0, *one, 0.0, *one, *one, 0.7]
    text = json.dumps(row)[1:]
    return '{"Loop": "none", "Frames": [' + ", ".join([f"[{duration}, {text}"] * 30) + "]}"


def keypoints_trc(rate: str, step: float) -> str:
    """A person's keypoints, with a rate and times."""
    rows = [f"{k + 1}\t{k * step:.12g}\t" + "\t".join(f"{v:.4f}" for v in frame.ravel())
            for k, frame in enumerate(PLACES)]  # fmt: skip
    head = "PathFileType\t4\t(X/Y/Z)\tx.trc\nDataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\n"
    head += f"{rate}\t{rate}\t8\t{len(PERSON)}\tm\nFrame#\tTime\t" + "\t\t\t".join(PERSON) + "\n\n"
    return head + "\n".join(rows) + "\n"


def table(step: float) -> str:
    """The same as a table with times."""
    head = "time," + ",".join(f"{n}_{a}" for n in PERSON for a in "xyz")
    return (
        head
        + "\n"
        + "".join(
            f"{k * step:.12g}," + ",".join(f"{v:.4f}" for v in frame.ravel()) + "\n"
            for k, frame in enumerate(PLACES)
        )
    )


def keypoints(folder: Path, fps: float) -> Any:
    """The same as arrays."""
    np.savez(folder / "a.npz", positions=PLACES, names=np.array(list(PERSON)), fps=fps)
    return info(folder / "a.npz")


def own(folder: Path, fps: float) -> Any:
    """The walk in Poise's own arrays."""
    write_clip(read_clip(WALK), folder / "s.poise.npz")
    with np.load(folder / "s.poise.npz") as file:
        np.savez(folder / "a.poise.npz", **{**file, "fps": np.array(fps)})
    return info(folder / "a.poise.npz")


def amass(folder: Path, fps: float) -> Any:
    """A body of AMASS."""
    poses = np.zeros((12, 156))
    poses[:, 0], poses[:, 20] = np.pi / 2, np.linspace(0, 1, 12)
    np.savez(folder / "a.npz", poses=poses, trans=np.zeros((12, 3)), betas=np.zeros(16),
             gender="female", mocap_framerate=fps)  # fmt: skip
    return info(folder / "a.npz")


def mot(step: str) -> str:
    """Angles of OpenSim."""
    names = "time pelvis_tilt pelvis_list pelvis_rotation pelvis_tx pelvis_ty pelvis_tz knee_angle_r"
    rows = [f"{k * float(step):.17g}\t0\t0\t0\t0\t0.94\t0\t{k}" for k in range(6)]
    head = "Coordinates\nversion=1\nnRows=6\nnColumns=8\ninDegrees=yes\nendheader\n"
    return head + "\t".join(names.split()) + "\n" + "\n".join(rows) + "\n"


def usd(folder: Path, codes: str) -> Any:
    """The walk with other time codes."""
    write_clip(read_clip(WALK), folder / "s.usda")
    lines = (folder / "s.usda").read_text().split("\n")
    changed = [f"    timeCodesPerSecond = {codes}" if "timeCodesPerSecond" in x else x for x in lines]
    return read(folder, "a.usda", "\n".join(changed))


for _t in ("1e-9", "1e-7", "1e-5", "1e-300", "1e-310", "5e-324"):
    case(f"BVH, frame time {_t}")(lambda f, t=_t: read(f, "a.bvh", bvh(t)))  # type: ignore[misc]


for _t in ("1e-9", "1e-300"):
    case(f"DeepMimic, frames of {_t} s")(lambda f, t=_t: read(f, "a.txt", deepmimic(t)))  # type: ignore[misc]


case("MOT, times that step by 1e-9 s")(lambda f: read(f, "a.mot", mot("1e-9")))


case("TRC, DataRate 99999999")(lambda f: read(f, "a.trc", keypoints_trc("99999999", 1e-8)))


case("TRC, times that step by 5e-8 s")(lambda f: read(f, "a.trc", keypoints_trc("0", 5e-8)))


case("CSV of keypoints, times that step by 5e-8 s")(lambda f: read(f, "a.csv", table(5e-8)))


for _r in (1e6, 1e300, 1e-300):
    case(f"npz of keypoints, rate {_r:g}")(lambda f, r=_r: keypoints(f, r))  # type: ignore[misc]


case("npz of Poise, rate 1e300")(lambda f: own(f, 1e300))


case("npz of AMASS, rate 1e5")(lambda f: amass(f, 1e5))


for _c in ("9e7", "1e-300"):
    case(f"USD, timeCodesPerSecond {_c}")(lambda f, c=_c: usd(f, c))  # type: ignore[misc]


for _r in (1e6, 1e300):
    case(f"--fps {_r:g}")(lambda f, r=_r: read(f, "a.bvh", WALK.read_text(), fps=r))  # type: ignore[misc]


case("convert --resample 1e9")(lambda f: resample(read_clip(WALK), 1e9))


_TESTS = Path(__file__).resolve().parents[1]


sys.path += [str(_TESTS), str(_TESTS / "jobs")]


strange: Any = import_module("test_strange_files")


OLD, said = strange.OLD, strange.said


NAN = float("nan")


RESUME = strange.RESUME | {
    "help that is no number": strange.held("env/help", lambda x: x * NAN),
    "iteration -5": said("iteration", to=-5),
    "seconds that are no number": strange.held(
        "trainer/counters", lambda x: x * NAN if x.is_floating_point() else x
    ),
}


EVAL = strange.EVAL | {
    "num_obs a list": said("num_obs", to=[335]),
    "hidden of a million twice": said("policy", "hidden", to=[1_000_000, 1_000_000]),
}


def run_with(folder: Path, file: str, change: Any) -> Path:
    """A small run with one file changed."""
    run = folder / "run"
    shutil.copytree(OLD / "imitate", run)
    strange.changed(OLD / "imitate" / file, change, run / file)
    return run


def resumed(folder: Path, change: Any) -> Any:
    """Goes on with it."""
    from poise.jobs.open import open_run
    from poise.jobs.runs import train
    from poise.learn import Until

    run = run_with(folder, "checkpoint.safetensors", change)
    return train(open_run(run).task, run, Until(iterations=9), threads=1, tensorboard=False)


def tracked(folder: Path, change: Any) -> str:
    """Uses a policy file."""
    strange.changed(OLD / "tracker.safetensors", change, folder / "policy.safetensors")
    return command(
        "track", OLD / "walk.bvh", "--policy", folder / "policy.safetensors", "-o", folder / "o"
    )


def filled(folder: Path, change: Any) -> str:
    """Uses a model file."""
    shipped = Path(poise.__file__).parent / "data/inbetween/model.safetensors"
    strange.changed(shipped, change, folder / "model.safetensors")
    return command(
        "inbetween", OLD / "walk.bvh", "--keyframes", "0,20", "--model", folder / "model.safetensors",
        "-o", folder / "out.bvh",
    )  # fmt: skip


def _each(what: str, changes: dict[str, Any], use: Any) -> None:
    for name, change in changes.items():
        case(f"{what}, {name}")(lambda f, c=change: use(f, c))  # type: ignore[misc]


_each("resume", RESUME, resumed)


_each("checkpoint", EVAL, lambda f, c: command("eval", run_with(f, "checkpoint.safetensors", c)))


_each("run file", strange.RUN, lambda f, c: command("eval", run_with(f, "run.safetensors", c)))


_each("policy", strange.POLICY, tracked)


_each("model", strange.MODEL, filled)


@case("two trainings in one run folder")
def _(folder: Path) -> Any:
    """The second one is refused while the first one holds the folder."""
    from poise.learn.checkpoint import only_writer

    run = folder / "run"
    shutil.copytree(OLD / "imitate", run)
    code = (
        "from poise.learn.checkpoint import only_writer\nfrom pathlib import Path\n"
        f"with only_writer(Path({str(run)!r})):\n print('held', flush=True)\n input()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as other:
        assert other.stdout is not None
        other.stdout.readline()
        try:
            with only_writer(run):
                raise RuntimeError("the folder has two writers")
        finally:
            other.kill()


@case("convert onto a symbolic link")
def _(folder: Path) -> Any:
    (folder / "kept.bvh").write_text("kept")
    (folder / "link.bvh").symlink_to(folder / "kept.bvh")
    try:
        command("convert", WALK, folder / "link.bvh", "--force")
    finally:
        if not (folder / "link.bvh").is_symlink():
            raise RuntimeError("the link is gone")


@case("convert onto a named pipe")
def _(folder: Path) -> Any:
    os.mkfifo(folder / "pipe.bvh")
    return command("convert", WALK, folder / "pipe.bvh", "--force")


@case("convert below a file")
def _(folder: Path) -> Any:
    (folder / "file").write_text("no folder")
    return command("convert", WALK, folder / "file" / "x.bvh")


@case("imitate into a folder with a dot")
def _(folder: Path) -> Any:
    """Right: it is a folder. One iteration of the smallest training."""
    from poise.cli.options import places

    if places(folder / "run_v1.0") != (folder / "run_v1.0", None):
        raise RuntimeError("it was taken for a file")


@case("a clip that is changed while it is read")
def _(folder: Path) -> Any:
    """Right or refused: the file is cut to half of its bytes by another process, again and again."""
    path, data = folder / "a.bvh", WALK.read_bytes()
    path.write_bytes(data)
    code = (
        f"import os\np = {str(path)!r}\nd = open(p, 'rb').read()\nfor k in range(20000):\n"
        " with open(p, 'r+b') as f:\n  f.truncate(len(d) // 2 if k % 2 else len(d))\n  f.write(d[:9999])"
    )
    with subprocess.Popen([sys.executable, "-c", code]) as other:
        try:
            for _ in range(20):
                with suppress(PoiseError):
                    read_clip(path)
        finally:
            other.kill()
