"""Golden runs: what Poise makes of fixed inputs, kept and compared while the code is moved about.

    python benchmarks/golden.py FOLDER --poise OLD/bin/poise     # made once, by an installed wheel
    python benchmarks/golden.py OTHER --against FOLDER           # made again, and compared

Every run is one command with a seed, on one thread. Compared are the bytes of what it wrote, and where
these differ the largest difference between numbers in the same place; what tells the time is left out.
A difference that was made on purpose is named in the commit that makes it.
"""

from __future__ import annotations

import argparse
import json
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
WALK = str(ROOT / "src/poise/data/walk.bvh")
#: Of the development set, for runs that need other motion; a run whose file is absent is left out.
SETS = Path.home() / ".cache/poise/data"
DANCE = str(SETS / "deepmimic_txt/humanoid3d_dance_a.txt")
SPIN = str(SETS / "deepmimic_txt/humanoid3d_spinkick.txt")
SIT = str(SETS / "cmu_amc/rfc")
POSES = str(SETS / "noisy/pose2sim/single")
ONE = ["--threads", "1"]

#: Commands by name; {out} is the run's folder, {tmp} what other runs wrote.
RUNS: dict[str, list[str]] = {
    "track_policy": ["track", WALK, "-o", "{out}", "--controller", "policy"],
    "track_lookahead": ["track", DANCE, "-o", "{out}", "--controller", "lookahead", "--budget=64", *ONE],
    "track_search": [
        "track",
        SPIN,
        "-o",
        "{out}",
        "--controller",
        "search",
        "--characters=64",
        "--rounds=1",
        *ONE,
    ],
    "recover": ["track", SPIN, "-o", "{out}", "--controller", "policy", "--recover"],
    "chain": ["track", WALK, DANCE, "-o", "{out}", "--controller", "policy"],
    "push": ["push", WALK, "-o", "{out}", "--controller", "policy", "--at", "chest", "--force", "80"],
    "noise": ["track", WALK, "-o", "{out}", "--controller", "policy", "--noise", "video:0.5"],
    "count": ["track", WALK, "-o", "{out}", "--controller", "policy", "--count", "3"],
    "own_body": ["track", DANCE, "-o", "{out}", "--controller", "policy", "--body", "own"],
    "range": [
        "track",
        DANCE,
        "-o",
        "{out}",
        "--budget=128",
        "--from",
        "{tmp}/track_lookahead",
        *ONE,
        "--range",
        "0.5-1.5",
    ],
    "keypoints": ["track", DANCE, "-o", "{out}", "--controller", "policy", "--policy", "keypoints"],
    "imitate": [
        "imitate",
        WALK,
        "-o",
        "{out}",
        "--iterations",
        "20",
        "--from",
        "none",
        "--envs",
        "64",
        *ONE,
    ],
    "perpetual": [
        "train",
        "perpetual",
        "--library",
        "{lib}",
        "-o",
        "{out}",
        "--iterations",
        "5",
        "--envs",
        "64",
        "--single",
        "--no-style",
        *ONE,
    ],
    "perpetual_stages": [
        "train",
        "perpetual",
        "--library",
        "{lib}",
        "-o",
        "{out}",
        "--iterations=5",
        "--envs=64",
        *ONE,
    ],
    "inbetween": ["inbetween", WALK, "-o", "{out}/walk.bvh", "--keyframes", "0,30,60,85"],
    "complete": [
        "complete",
        WALK,
        "-o",
        "{out}",
        "--keyframes",
        "0,30,60,85",
        "--controller",
        "policy",
        *ONE,
    ],
    "dream": ["dream", "-o", "{out}", "--seconds", "20", "--controller", "policy", "--seed", "3"],
    "door": ["play", "compliant", "door", "-o", "{out}", "--controller", "policy", "--count", "2", *ONE],
    "hands": ["play", "compliant", "hands", "-o", "{out}", "--controller", "policy", "--count=2", *ONE],
    "doctor": ["doctor", DANCE, "--fix", "-o", "{out}/mended.bvh"],
    "retarget": ["retarget", DANCE, "--onto", WALK, "-o", "{out}/moved.bvh"],
}
#: Keys and files that tell the time or the version.
TIMES = re.compile(r"second|time|speed|_ms|version|wall|per_s$|created|host|stamp|digest", re.I)
NUMBER = re.compile(r"[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?")
LEFT_OUT = {"report.html", "log.csv", "events", "lock"}


def made(name: str, folder: Path, poise: str) -> float:
    """Seconds that a run took."""
    out = folder / name
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    lib = folder / "library"
    if not lib.exists():
        lib.mkdir()
        for file in (DANCE, SPIN, DANCE.replace("dance_a", "walk")):
            shutil.copy(file, lib)
    command = [c.format(out=out, tmp=folder, lib=lib) for c in RUNS[name]]
    began = time.monotonic()
    done = subprocess.run([poise, *command], capture_output=True, text=True, check=False)
    said = done.stdout + done.stderr
    (out / "said.txt").write_text(f"exit {done.returncode}\n{said}")
    return time.monotonic() - began


def flat(value: Any, at: str = "") -> dict[str, Any]:
    """Numbers and texts of JSON by their place, without times."""
    if isinstance(value, dict):
        parts = [flat(v, f"{at}/{k}") for k, v in value.items() if not TIMES.search(str(k))]
    elif isinstance(value, list):
        parts = [flat(v, f"{at}/{i}") for i, v in enumerate(value)]
    else:
        return {at: value}
    return {k: v for part in parts for k, v in part.items()}


def numbers(path: Path) -> tuple[Any, np.ndarray]:
    """The part of a file that must be the same, and its numbers, which may differ in the last digits."""
    if path.suffix == ".json":
        of = flat(json.loads(path.read_text()))
        real = {k: v for k, v in of.items() if isinstance(v, float | int) and not isinstance(v, bool)}
        rest = {k: v for k, v in of.items() if k not in real}
        return (sorted(real), rest), np.array([real[k] for k in sorted(real)], dtype=float)
    if path.suffix == ".safetensors":
        from safetensors.numpy import load_file

        of = load_file(path)
        shapes = [(k, of[k].shape) for k in sorted(of)]
        return shapes, np.concatenate([of[k].ravel().astype(float) for k in sorted(of)] or [np.zeros(0)])
    if path.suffix in (".npz",):
        with np.load(path, allow_pickle=False) as of:
            real = {k: of[k] for k in of.files if of[k].dtype.kind in "fiu"}
        return sorted(real), np.concatenate([real[k].ravel().astype(float) for k in sorted(real)])
    text = path.read_text(errors="replace")
    return NUMBER.sub("#", text), np.array([float(x) for x in NUMBER.findall(text)])


def difference(here: Path, there: Path) -> str | None:
    """How two files differ, None where they are the same."""
    if here.read_bytes() == there.read_bytes():
        return None
    (shape, a), (other, b) = numbers(here), numbers(there)
    if shape != other or a.shape != b.shape:
        return "other content"
    off = np.abs(a - b)[np.isfinite(a) & np.isfinite(b)]
    return None if not len(off) or off.max() == 0 else f"{off.max():.3g}"


def compared(name: str, folder: Path, against: Path) -> list[str]:
    """Differences of a run's files, a line each."""
    out = []
    files = {p.relative_to(against / name) for p in (against / name).rglob("*") if p.is_file()}
    files |= {p.relative_to(folder / name) for p in (folder / name).rglob("*") if p.is_file()}
    for file in sorted(files):
        if file.name in LEFT_OUT or file.name.startswith("events") or file.name == "said.txt":
            continue
        here, there = folder / name / file, against / name / file
        if not (here.exists() and there.exists()):
            out.append(f"{file}: only {'before' if there.exists() else 'now'}")
        elif how := difference(here, there):
            out.append(f"{file}: {how}")
    said = [(f / name / "said.txt").read_text().splitlines()[0] for f in (folder, against)]
    return out + ([f"{said[1]} -> {said[0]}"] if said[0] != said[1] else [])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--poise", default=str(Path(sys.executable).parent / "poise"))
    parser.add_argument("--against", type=Path)
    parser.add_argument("--only", nargs="*", default=list(RUNS))
    a = parser.parse_args()
    bad = 0
    for name in a.only:
        if any(c.startswith(str(SETS)) and not Path(c).exists() for c in RUNS[name]):
            print(f"{name}: its file is not here")
            continue
        took = made(name, a.folder, a.poise)
        told = compared(name, a.folder, a.against) if a.against else []
        first = (a.folder / name / "said.txt").read_text().splitlines()[0]
        print(f"{name}: {took:.0f} s, {first}" + "".join(f"\n    {line}" for line in told), flush=True)
        bad += bool(told)
    if a.against:
        print(f"{len(a.only) - bad} of {len(a.only)} runs agree")
        sys.exit(bool(bad))


if __name__ == "__main__":
    main()
