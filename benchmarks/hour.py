"""An hour of motion by one character: how often it falls, and whether it always comes back.

    python benchmarks/hour.py --clips FOLDER ... [--policy FILE] --json benchmarks/hour.json

All clips of the folders, in an order drawn by the seed, one after another and without help: a recovery
motion leads from the end of each to the start of the next, and back to a clip that was lost. Where they
are shorter than `--minutes` their mirror images follow. A clip that is lost nine times, or not come back
to within half a minute, is given up; a character that does not come to three clips in a row has fallen
for good, and the measurement ends there.
"""

from __future__ import annotations

import argparse
import json
import resource
import time
from pathlib import Path

import numpy as np
import torch
from speed import machine
from tracker import SIXTY, TWINS

from poise.body import BodyConfig
from poise.jobs.library.clips import LibraryConfig, Target
from poise.jobs.library.folder import library_of
from poise.jobs.open import open_run
from poise.jobs.track import TrackConfig, track
from poise.learn.checkpoint import write_atomic
from poise.motion import Clip, shifted
from poise.motion.windows import mirrored_clip


def in_a_row(
    folders: list[Path], target: Target, minutes: float, seed: int
) -> tuple[list[Clip], list[str]]:
    """Clips of so many minutes on the policy's body, each beginning at the origin, and what was said of
    those that were cut or left out since no body does them on a floor."""
    rates = LibraryConfig(rates=SIXTY, leave_out=TWINS)
    library, report = library_of(folders, target, config=rates, body=BodyConfig())
    order = np.random.default_rng(seed).permutation(len(library))
    clips = [library.clips[k] for k in order]
    clips += [mirrored_clip(c).replaced(name=f"{c.name}-mirrored") for c in clips]
    total, out = 0.0, list[Clip]()
    for clip in clips:
        if total >= 60 * minutes:
            break
        out.append(shifted(clip, (-clip.root_pos[0, 0], -clip.root_pos[0, 1], 0.0)))
        total += clip.seconds
    return out, report.sentences()


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--clips", type=Path, nargs="+", required=True)
    parser.add_argument("--policy", default=None)
    parser.add_argument("--name", default="tracker")
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, required=True)
    a = parser.parse_args()
    torch.set_num_threads(1)
    tracker = open_run(a.policy).tracker
    clips, notes = in_a_row(a.clips, tracker.target, a.minutes, a.seed)
    began = time.perf_counter()
    tracked = track(clips, tracker, TrackConfig(recover=True, controller="policy", supports="none"))
    losses, parts = tracked.losses, tracked.parts
    lost, back = (losses.lost, losses.back) if losses else ((), ())
    away = np.subtract(back, lost[: len(back)])
    row = {
        "clips": len(clips), "seconds_of_motion": round(sum(c.seconds for c in clips), 1),
        "seconds_simulated": round(len(tracked.evaluation.recordings[0].qpos) / 30.0, 1),
        "wall_s": round(time.perf_counter() - began, 1),
        "peak_mb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024),
        "done": sum(p.done for p in parts), "not_lost": sum(p.done and p.lost is None for p in parts),
        "losses": len(lost), "came_back": len(back),
        "away_s": {"mean": round(float(away.mean()), 2), "most": round(float(away.max()), 2)},
        "clips_given_up": len(losses.given_up) if losses else 0,
        "unrecovered": int(not parts[-1].done and parts[-1].begins is None),
        "given_up": [p.clip for p in parts if p.begins is not None and not p.done],
        "not_reached": sum(p.begins is None for p in parts),
        "cut_or_left_out": sum(": cut to " in n or ": left out" in n for n in notes),
    }  # fmt: skip
    said = json.loads(a.json.read_text()) if a.json.exists() else {"rows": {}}
    told = {"command": "benchmarks/hour.py", "machine": machine(), "seed": a.seed}
    said["rows"][a.name] = row | told | {"folders": [f.name for f in a.clips]}
    write_atomic(a.json, (json.dumps(said, indent=1) + "\n").encode())


if __name__ == "__main__":
    main()
