"""Frame rates that no motion has, in every format that states one, for `attack.py`."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from attack_case import WALK, case, info, read

from poise.formats import read_clip, write_clip
from poise.motion import resample

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


def trc(rate: str, step: float) -> str:
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


def add(name: str, make: Callable[[Path], Any]) -> None:
    """Registers one."""
    case(name)(make)


for _t in ("1e-9", "1e-7", "1e-5", "1e-300", "1e-310", "5e-324"):
    add(f"BVH, frame time {_t}", lambda f, t=_t: read(f, "a.bvh", bvh(t)))  # type: ignore[misc]
for _t in ("1e-9", "1e-300"):
    add(f"DeepMimic, frames of {_t} s", lambda f, t=_t: read(f, "a.txt", deepmimic(t)))  # type: ignore[misc]
add("MOT, times that step by 1e-9 s", lambda f: read(f, "a.mot", mot("1e-9")))
add("TRC, DataRate 99999999", lambda f: read(f, "a.trc", trc("99999999", 1e-8)))
add("TRC, times that step by 5e-8 s", lambda f: read(f, "a.trc", trc("0", 5e-8)))
add("CSV of keypoints, times that step by 5e-8 s", lambda f: read(f, "a.csv", table(5e-8)))
for _r in (1e6, 1e300, 1e-300):
    add(f"npz of keypoints, rate {_r:g}", lambda f, r=_r: keypoints(f, r))  # type: ignore[misc]
add("npz of Poise, rate 1e300", lambda f: own(f, 1e300))
add("npz of AMASS, rate 1e5", lambda f: amass(f, 1e5))
for _c in ("9e7", "1e-300"):
    add(f"USD, timeCodesPerSecond {_c}", lambda f, c=_c: usd(f, c))  # type: ignore[misc]
for _r in (1e6, 1e300):
    add(f"--fps {_r:g}", lambda f, r=_r: read(f, "a.bvh", WALK.read_text(), fps=r))  # type: ignore[misc]
add("convert --resample 1e9", lambda f: resample(read_clip(WALK), 1e9))
