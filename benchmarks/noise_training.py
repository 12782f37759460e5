"""What a policy gains that was trained with a video estimator's noise, beside one that was not.

    python benchmarks/tracker.py --library FOLDER --from POLICY -o noise --noise 0.25 0.5 ...
    python benchmarks/tracker.py --library FOLDER --from POLICY -o plain ...
    python benchmarks/noise_training.py --clips bandai_bvh --every 4 --policy noise=noise plain=plain \
        --own noise --json benchmarks/noise_training.json

Every clip at every strength of the noise, by the policy alone and without help; "tracker" is the policy
that comes with Poise. With --own the clips of that run, as it was told them, too. Rows of policies that
are not asked for stay as they are.
"""

from __future__ import annotations

import argparse
import functools
import json
from pathlib import Path
from typing import Any

import torch
from speed import machine

from poise.formats import read_clip
from poise.jobs.open import open_run
from poise.jobs.perpetual.evaluation import evaluate_clips
from poise.jobs.track.noise import robustness
from poise.jobs.tracker import Tracker
from poise.learn.checkpoint import write_atomic
from poise.motion.noise import robustness_levels
from poise.recipes.imitation import Imitation


def on_its_own(task: Imitation, tracker: Tracker) -> dict[str, dict[str, Any]]:
    """Clips done and shares until failure by strength, on the clips of a run with noise."""
    results = evaluate_clips(task, tracker.policy, threads=1)
    names = task.library.names
    rows: dict[str, dict[str, Any]] = {}
    for strength in (0.0, *task.config.noise):
        those = [k for k, n in enumerate(names) if float(n.partition("~")[2] or 0) == strength]
        share = results.tracked[those] / results.frames[those]
        rows[f"x{strength:g}"] = {
            "clips": len(those),
            "done": int(results.succeeded[those].sum()),
            "tracked": round(float(share.mean()), 4),
            "off_mm": round(float(results.global_mm[those].nanmean()), 1),
        }
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--clips", type=Path, required=True)
    parser.add_argument("--every", type=int, default=1)
    parser.add_argument("--policy", nargs="*", default=[], metavar="NAME=RUN")
    parser.add_argument("--strengths", type=float, nargs="+", default=[0.0, 0.25, 0.5, 1.0])
    parser.add_argument("--own", type=Path, help="the run that was trained with noise")
    parser.add_argument("--skip", action="store_true", help="--own alone")
    parser.add_argument("--json", type=Path, required=True)
    a = parser.parse_args()
    torch.set_num_threads(1)
    own = open_run(a.own).task if a.own else None
    files = sorted(p for p in a.clips.rglob("*") if p.suffix in (".bvh", ".amc"))[:: a.every]
    clips, levels = [read_clip(p) for p in files], robustness_levels(strengths=a.strengths)
    said: dict[str, Any] = json.loads(a.json.read_text()) if a.json.exists() else {}
    said |= {"command": "benchmarks/noise_training.py", "machine": machine(), "clips": len(clips)}
    for given in a.policy or ["tracker"]:
        name, _, path = given.partition("=")
        tracker = open_run(Path(path) if path else None).tracker
        row = said.setdefault("rows", {}).setdefault(name, {})
        row["samples"] = tracker.about.get("samples")
        if not a.skip:
            told = functools.partial(print, name, flush=True)
            row |= robustness(tracker, clips, levels, tell=told).to_dict()
        if own is not None:
            row["own"] = on_its_own(own, tracker)
            print(name, row["own"], flush=True)
        write_atomic(a.json, (json.dumps(said, indent=1) + "\n").encode())


if __name__ == "__main__":
    main()
