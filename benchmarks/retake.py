"""A part of 1.5 s simulated anew: how long that takes, and what its two seams are like.

python benchmarks/retake.py --data DIR -o benchmarks/retake.json
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

from poise.formats import read_clip
from poise.jobs.open import open_run
from poise.jobs.result import Result
from poise.jobs.track import track
from poise.jobs.track.retaking import FADE_S
from poise.jobs.track.simulation import Retake
from poise.motion import trim

#: Ten seconds of each at most.
CLIPS = (
    "cmu_bvh/fairmotion/01_01.bvh", "cmu_bvh/ad/dance001.bvh", "cmu_bvh/acrnn_salsa/02.bvh",
    "cmu_bvh/acrnn_indian/06.bvh", "cmu_bvh/acrnn_martial/03.bvh", "cmu_amc/02/02_01.amc",
    "cmu_amc/08/08_01.amc", "cmu_amc/39/39_02.amc", "lafan1_bvh/walk4_subject1.bvh",
    "deepmimic_txt/humanoid3d_dance_a.txt",
)  # fmt: skip
SECONDS, PART_S = 10.0, 1.5
#: Frames about the seams that count as part of them.
ABOUT = 2


def jerk(pos: torch.Tensor, rate: float) -> np.ndarray:
    """Mean over bodies of the third difference of `(T, B, 3)`, m/s^3, by the frame in its middle."""
    third = torch.diff(pos.double(), n=3, dim=0) * rate**3
    return np.pad(third.norm(dim=-1).mean(1).numpy(), (2, 1), mode="edge")


def measure(path: Path) -> dict[str, Any]:
    """One clip tracked, and a part in its middle tracked anew with another seed."""
    clip = read_clip(path)
    clip = trim(clip, 0, min(clip.frames, round(SECONDS * clip.fps)) - 1)
    run = open_run(None)
    begun = time.perf_counter()
    whole = track(clip, run, supports="none", threads=1)
    took = time.perf_counter() - begun
    if whole.failures:
        return {"clip": path.stem, "seconds": round(clip.seconds, 1), "whole": False}
    first = 0.4 * clip.seconds
    last = min(first + PART_S, clip.seconds)
    assert whole.simulation is not None
    begun = time.perf_counter()
    asked = Retake(whole.simulation, first, last)
    again = track(clip, run, supports="none", threads=1, seed=1, retake=asked)
    part = time.perf_counter() - begun
    return {
        "clip": path.stem, "seconds": round(clip.seconds, 1), "whole": not again.failures,
        "took_s": round(took, 1), "part_took_s": round(part, 1), **seams(whole, again),
        "note": next(n for n in again.notes if "anew" in n),
    }  # fmt: skip


def seams(whole: Result, again: Result) -> dict[str, float]:
    """Jerk about both seams beside that of the clip and of the earlier simulation; what else changed."""
    one, two = whole.evaluation.recordings[0].qpos, again.evaluation.recordings[0].qpos
    rate = whole.imitation.reference.rate_hz
    changed = np.flatnonzero(np.abs(one - two).max(1) > 0)
    fade = round(FADE_S * rate)
    a, b = int(changed[0]), int(changed[-1])
    frames = np.arange(len(one))
    about = np.abs(frames - a) <= ABOUT
    if b < len(one) - 1:
        about |= (frames >= b - fade) & (frames <= b + ABOUT)
    own = jerk(whole.imitation.reference.pose.pos, rate)
    before = jerk(whole.evaluation.rollouts.pos[0], rate)
    after = jerk(again.evaluation.rollouts.pos[0], rate)
    return {
        "changed_s": round((b - a + 1) / rate, 2),
        "seam_jerk": round(float(after[about].mean()), 1),
        "seam_jerk_most": round(float(after[about].max()), 1),
        "there_before": round(float(before[about].mean()), 1),
        "clip_jerk": round(float(own.mean()), 1), "clip_jerk_most": round(float(own.max()), 1),
        "simulated_jerk": round(float(before.mean()), 1),
        "simulated_jerk_most": round(float(before.max()), 1),
        "error_before_mm": round(whole.card.mpjpe_global_mm, 1),
        "error_after_mm": round(again.card.mpjpe_global_mm, 1),
    }  # fmt: skip


def main() -> None:
    """All clips, one after another, on one core."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("-o", type=Path, required=True)
    args = parser.parse_args()
    os.environ["OMP_NUM_THREADS"] = "1"
    torch.set_num_threads(1)
    rows = []
    for name in CLIPS:
        rows.append(measure(args.data / name))
        print(json.dumps(rows[-1]), file=sys.stderr, flush=True)
    command = "python benchmarks/retake.py --data DIR -o benchmarks/retake.json"
    args.o.write_text(json.dumps({"command": command, "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
