"""Hostile files, read one by one: what comes of each, in what time and memory.

python benchmarks/attack.py --json benchmarks/attack.json

Every file is made here, by a few lines. It is read in a process of its own, which is stopped after two
minutes of processor time or at 6 GB. `ok` says that it was read or refused in one sentence, within 30 s
of processor time and 1.5 GB; making the file is part of both.
"""

from __future__ import annotations

import argparse
import json
import math
import multiprocessing
import resource
import struct
import tempfile
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
import torch

import poise
from poise.errors import PoiseError
from poise.motion import Clip, read_clip, resample, write_clip

WALK = Path(poise.__file__).parent / "data/walk.bvh"
SECONDS, BYTES, STOP_S, STOP_BYTES = 30.0, 1.5e9, 120, 6 << 30
CASES: dict[str, Callable[[Path], Any]] = {}


def case(name: str) -> Callable[[Callable[[Path], Any]], Callable[[Path], Any]]:
    """Registers what makes a hostile file and reads it."""

    def add(make: Callable[[Path], Any]) -> Callable[[Path], Any]:
        CASES[name] = make
        return make

    return add


def read(folder: Path, name: str, data: str | bytes) -> Clip:
    """Writes a file and reads it as `poise info` does."""
    (folder / name).write_bytes(data if isinstance(data, bytes) else data.encode())
    return info(folder / name)


def info(path: Path) -> Clip:
    """Reads a file and describes it."""
    from poise.motion import describe

    clip = read_clip(path)
    describe(clip)
    return clip


def chain(joints: int, wide: bool = False) -> str:
    """A BVH whose joints hang below, or beside, one another."""
    text = ["HIERARCHY", "ROOT Hips", "{", "OFFSET 0 0 0", "CHANNELS 6 Xposition Yposition Zposition "
            "Zrotation Xrotation Yrotation"]  # fmt: skip
    for k in range(joints):
        text += [f"JOINT j{k}", "{", f"OFFSET 0 {150 / (1 if wide else joints)} 0",
                 "CHANNELS 3 Zrotation Xrotation Yrotation"]  # fmt: skip
        text += ["End Site", "{", "OFFSET 0 1 0", "}", "}"] if wide else []
    text += [] if wide else ["End Site", "{", "OFFSET 0 1 0", "}"] + ["}"] * joints
    row = " ".join(["0"] * (6 + 3 * joints))
    return "\n".join([*text, "}", "MOTION", "Frames: 4", "Frame Time: 0.02", *[row] * 4]) + "\n"


for _rate in ("1e-9", "1e-7", "1e-5", "1e-300", "5e-324"):
    case(f"BVH, frame time {_rate}")(
        lambda f, r=_rate: read(f, "a.bvh", _with_time(r))  # type: ignore[misc]
    )
for _joints in (600, 1900):
    case(f"BVH, a chain of {_joints} joints")(lambda f, n=_joints: read(f, "a.bvh", chain(n)))  # type: ignore[misc]
    case(f"BVH, {_joints} joints wide")(lambda f, n=_joints: read(f, "a.bvh", chain(n, True)))  # type: ignore[misc]


def _with_time(rate: str) -> str:
    text = WALK.read_text()
    start = text.index("Frame Time:")
    return text[:start] + f"Frame Time: {rate}" + text[text.index("\n", start) :]


@case("BVH, a skeleton of 100,000 lines")
def _(folder: Path) -> Any:
    return read(folder, "a.bvh", chain(25_000))


@case("ASF, 600,000 bones")
def _(folder: Path) -> Any:
    bones = "".join(f"begin\nname b{k}\nlength 1\nend\n" for k in range(600_000))
    (folder / "a.asf").write_text(":version 1.10\n:bonedata\n" + bones + ":hierarchy\n")
    return read(folder, "a_1.amc", ":fully-specified\n:degrees\n1\nroot 0 0 0 0 0 0\n")


@case("convert --resample 1e9")
def _(folder: Path) -> Any:
    return resample(read_clip(WALK), 1e9)


@case("DeepMimic, frames of 1e-9 s")
def _(folder: Path) -> Any:
    row = [1e-9, 0, 0.9, 0, *[1.0, 0, 0, 0] * 4, 0.1, *[1.0, 0, 0, 0, 0.1] * 1, *[0.0] * 14]
    return read(folder, "a.txt", json.dumps({"Loop": "none", "Frames": [row[:44]] * 30}))


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


@case("npz, a directory of a million entries")
def _(folder: Path) -> Any:
    name = b"a.npy"
    entry = struct.pack(
        "<4s6H3L5H2L", b"PK\x01\x02", 20, 20, 0, 0, 0, 0, 0, 0, 0, len(name), 0, 0, 0, 0, 0, 0
    )
    entries = (entry + name) * 1_000_000
    local = struct.pack("<4s5H3L2H", b"PK\x03\x04", 20, 0, 0, 0, 0, 0, 0, 0, len(name), 0) + name
    end = struct.pack("<4s4H2LH", b"PK\x05\x06", 0, 0, 0xFFFF, 0xFFFF, len(entries), len(local), 0)
    return read(folder, "a.npz", local + entries + end)


@case("glTF, 100 MB of empty objects")
def _(folder: Path) -> Any:
    return read(folder, "a.gltf", '{"asset":{"version":"2.0"},"extras":[' + "{}," * 33_000_000 + "{}]}")


@case("CSV, a comment of one word of 100,000 letters")
def _(folder: Path) -> Any:
    head = ",".join(f"{n}_{a}" for n in ("a", "b", "c", "d", "e") for a in "xyz")
    return read(folder, "a.csv", f"# \x0b{head}\x0b{'a' * 100_000}\n{head}\n1,2\n")


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


@case("TRC, a label of 100,000 underscores")
def _(folder: Path) -> Any:
    return read(folder, "a.trc", trc(["_" * 100_000, *(f"m{k}" for k in range(20))]))


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


@case("BVH, 20 minutes four times too fast")
def _(folder: Path) -> Any:
    return to_and_fro(folder, 20, True)


@case("BVH, an hour at 30 a second")
def _(folder: Path) -> Any:
    return to_and_fro(folder, 60, False)


def child(pipe: Connection, name: str, folder: str) -> None:
    """Makes and reads; what came of it goes into the pipe."""
    resource.setrlimit(resource.RLIMIT_CPU, (STOP_S, STOP_S))
    resource.setrlimit(resource.RLIMIT_DATA, (STOP_BYTES, STOP_BYTES))
    torch.set_num_threads(1)
    try:
        CASES[name](Path(folder))
        said = ("read", "")
    except PoiseError as error:
        said = ("refused", str(error).replace(folder + "/", ""))
    except BaseException as error:
        said = ("fault", f"{type(error).__name__}: {error}"[:300])
    own, below = (resource.getrusage(k) for k in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    seconds = own.ru_utime + own.ru_stime + below.ru_utime + below.ru_stime
    pipe.send((*said, seconds, max(own.ru_maxrss, below.ru_maxrss) * 1024))


def outcome(name: str) -> dict[str, Any]:
    """One row of the table."""
    context = multiprocessing.get_context("fork")
    with tempfile.TemporaryDirectory() as folder:
        here, there = context.Pipe()
        process = context.Process(target=child, args=(there, name, folder))
        begun = time.monotonic()
        process.start()
        there.close()
        try:
            kind, said, seconds, memory = here.recv()
        except EOFError:
            process.join()
            kind, said, seconds, memory = f"exit code {process.exitcode}", "", float(STOP_S), 0
        process.join()
    fine = kind in ("read", "refused") and len(said) < 310 and seconds < SECONDS and memory < BYTES
    wall = time.monotonic() - begun
    return {"what": name, "outcome": kind, "said": said, "cpu_s": round(seconds, 1),
            "wall_s": round(wall, 1), "peak_mb": round(memory / 1e6), "ok": fine}  # fmt: skip


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--only", default="", help="part of a name")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    torch.set_num_threads(1)
    rows = []
    for name in CASES:
        if args.only in name:
            rows.append(outcome(name))
            print(json.dumps(rows[-1]), flush=True)
    if args.json is not None:
        args.json.write_text(json.dumps({"rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
