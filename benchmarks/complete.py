"""From keyframes a second apart to a body, on held-out dances, jumps, walks.

python benchmarks/complete.py --data DIR -o FILE.json [--clips dance001 jump] [--no-speeds]

Written as it goes; a row measured anew takes the place of the one before. Rows name the policy and
the network that they are of by the first digits of their SHA-256; rows without are of earlier ones.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import time
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from poise.formats import read_clip
from poise.jobs.complete import complete
from poise.jobs.inbetween.fill import inbetween, shipped_model
from poise.jobs.open import open_run
from poise.motion import trim

#: Of subjects and sources that neither the network nor the policy has learned from, but for DeepMimic's.
CLIPS = (
    ("other/mass_bvh/dance.bvh", False), ("cmu_bvh/ad/dance001.bvh", False),
    ("cmu_amc/11/11_01.amc", False), ("cmu_amc/38/38_01.amc", False), ("cmu_amc/39/39_02.amc", False),
    ("lafan1_bvh/walk4_subject1.bvh", False), ("cmu_amc/01/01_01.amc", False),
    ("deepmimic_txt/humanoid3d_jump.txt", False), ("deepmimic_txt/humanoid3d_jump.txt", True),
    ("other/mass_bvh/dance.bvh", True),
)  # fmt: skip
#: Shares of its time in which the jump is to be done.
HURRIED = (0.5, 0.35)
SECONDS = 8.0
#: Dances, jumps and walks that are filled alone.
KINEMATIC = (
    "cmu_amc/0[1-9]/*.amc", "cmu_amc/3[589]/*.amc", "cmu_bvh/ad/*.bvh", "deepmimic_txt/*.txt",
    "other/mass_bvh/*.bvh", "other/bandai_bvh/*dance*.bvh",
)  # fmt: skip
FORTY = 60


def measure(path: Path, retime: bool, share: float = 1.0) -> dict[str, Any]:
    """One clip with a keyframe each second, to be done in a share of its time."""
    clip = read_clip(path)
    clip = trim(clip, 0, min(clip.frames, round(SECONDS * clip.fps)) - 1)
    keys = [*range(0, clip.frames - round(0.5 * clip.fps), round(clip.fps)), clip.frames - 1]
    begun, worked = time.perf_counter(), time.process_time()
    times = None if share == 1.0 else [share * k / clip.fps for k in keys]
    run = open_run(None).tracker
    done = complete(clip, keys, run, threads=1, supports="none", retime=retime, times=times)
    took = time.perf_counter() - begun
    speed = float(np.linalg.norm(np.diff(clip.positions(), axis=0), axis=-1).max() * clip.fps)
    return {
        "clip": path.stem, "keyframes": len(keys), "retimed": retime,
        "controller": done.tracked.controller,
        "whole": not done.tracked.failures, "key_mm": round(float(np.mean(done.met_mm)), 1),
        "key_worst_mm": round(max(done.met_mm), 1), "of_its_time": share,
        "longer": round(done.at[-1] / max(1, share * keys[-1]), 2),
        "source_fastest": round(speed, 1), "seconds": round(took, 1),
        "seconds_of_clip": round(clip.seconds, 1), "under_load": round(os.getloadavg()[0], 1),
        "cpu_seconds": round(time.process_time() - worked, 1),
        "kept_exactly": bool(np.abs(done.filled.clip.positions()[list(done.at)]
                                    - clip.positions()[keys]).max() < 1e-6),
        "faults": [f.sentence() for f in done.filled.faults],
        "stages": [_rounded(s.to_dict()) for s in done.stages], **weights(),
    }  # fmt: skip


def weights() -> dict[str, str]:
    """Which policy and network these are."""
    found = {"policy": shipped(), "network": shipped_model()}
    return {k: hashlib.sha256(v.read_bytes()).hexdigest()[:8] for k, v in found.items()}


def shipped() -> Path:
    """The file of the policy that comes with Poise."""
    return Path(str(files("poise"))) / "data" / "tracker.safetensors"


def _rounded(row: dict[str, Any]) -> dict[str, Any]:
    return {k: round(v, 1) if isinstance(v, float) else v for k, v in row.items()}


def speeds(data: Path) -> dict[str, Any]:
    """The fastest joint of filled motion, by what people reach and by the recorded clip."""
    rows: list[list[Any]] = []
    for path in sorted(p for glob in KINEMATIC for p in data.glob(glob))[:FORTY]:
        clip = read_clip(path)
        clip = trim(clip, 0, min(clip.frames, round(SECONDS * clip.fps)) - 1)
        keys = [*range(0, clip.frames - round(0.5 * clip.fps), round(clip.fps)), clip.frames - 1]
        if len(keys) < 2:
            continue
        made = inbetween(clip, keys, adapt=0)
        fast = [
            np.linalg.norm(np.diff(c.positions(), axis=0), axis=-1).max() * c.fps
            for c in (clip, made.clip)
        ]
        rows.append([path.stem, round(max(made.over), 2), round(float(fast[1] / fast[0]), 2)])
    over, beside = np.array([r[1] for r in rows]), np.array([r[2] for r in rows])
    return {
        "clips": len(rows), "within_limits": int((over <= 1.0).sum()),
        "within_1.5_of_recorded": int((beside <= 1.5).sum()), "rows": rows,
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("-o", type=Path, required=True)
    parser.add_argument("--clips", nargs="*", help="only those with one of these words in their name")
    parser.add_argument("--no-speeds", action="store_true", help="not the fastest joints of many clips")
    args = parser.parse_args()
    found = json.loads(args.o.read_text()) if args.o.exists() else {}
    found["command"] = "python benchmarks/complete.py"
    rows = {(r["clip"], r["retimed"], r.get("of_its_time", 1.0)): r for r in found.get("rows", [])}

    def keep() -> None:
        found["rows"] = list(rows.values())
        args.o.write_text(json.dumps(found, indent=1) + "\n")

    jump = next(name for name, _ in CLIPS if "jump" in name)
    cases = [(name, retime, 1.0) for name, retime in CLIPS]
    cases += [(jump, retime, share) for share in HURRIED for retime in (False, True)]
    for name, retime, share in cases:
        if args.clips is None or any(word in name for word in args.clips):
            row = measure(args.data / name, retime, share)
            rows[row["clip"], row["retimed"], share] = row
            keep()
    if not args.no_speeds:
        found["speeds"] = speeds(args.data)
        keep()


if __name__ == "__main__":
    main()
