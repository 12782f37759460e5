"""From keyframes a second apart to a body, on held-out dances, jumps, walks.

python benchmarks/complete.py --data DIR -o benchmarks/complete.json
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np

from poise.jobs.complete import complete
from poise.jobs.inbetween.fill import inbetween
from poise.jobs.open import open_run
from poise.motion import read_clip, trim

#: Of subjects and sources that neither the network nor the policy has learned from, but for DeepMimic's.
CLIPS = (
    ("other/mass_bvh/dance.bvh", False), ("cmu_bvh/ad/dance001.bvh", False),
    ("cmu_amc/11/11_01.amc", False), ("cmu_amc/38/38_01.amc", False), ("cmu_amc/39/39_02.amc", False),
    ("lafan1_bvh/walk4_subject1.bvh", False), ("cmu_amc/01/01_01.amc", False),
    ("deepmimic_txt/humanoid3d_jump.txt", False), ("deepmimic_txt/humanoid3d_jump.txt", True),
    ("other/mass_bvh/dance.bvh", True),
)  # fmt: skip
SECONDS = 8.0
#: Dances, jumps and walks that are filled alone.
KINEMATIC = (
    "cmu_amc/0[1-9]/*.amc", "cmu_amc/3[589]/*.amc", "cmu_bvh/ad/*.bvh", "deepmimic_txt/*.txt",
    "other/mass_bvh/*.bvh", "other/bandai_bvh/*dance*.bvh",
)  # fmt: skip
FORTY = 60


def measure(path: Path, retime: bool) -> dict[str, Any]:
    """One clip with a keyframe each second."""
    clip = read_clip(path)
    clip = trim(clip, 0, min(clip.frames, round(SECONDS * clip.fps)) - 1)
    keys = [*range(0, clip.frames - round(0.5 * clip.fps), round(clip.fps)), clip.frames - 1]
    begun = time.perf_counter()
    done = complete(clip, keys, open_run(None).tracker, threads=1, supports="none", retime=retime)
    took = time.perf_counter() - begun
    speed = float(np.linalg.norm(np.diff(clip.positions(), axis=0), axis=-1).max() * clip.fps)
    return {
        "clip": path.stem, "keyframes": len(keys), "retimed": retime,
        "controller": done.tracked.controller,
        "whole": not done.tracked.failures, "key_mm": round(float(np.mean(done.met_mm)), 1),
        "key_worst_mm": round(max(done.met_mm), 1), "longer": round(done.at[-1] / max(1, keys[-1]), 2),
        "source_fastest": round(speed, 1), "seconds": round(took, 1),
        "stages": [_rounded(s.to_dict()) for s in done.stages],
    }  # fmt: skip


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
    args = parser.parse_args()
    rows = [measure(args.data / name, retime) for name, retime in CLIPS]
    out = {"command": "python benchmarks/complete.py", "rows": rows, "speeds": speeds(args.data)}
    args.o.write_text(json.dumps(out, indent=1) + "\n")


if __name__ == "__main__":
    main()
