"""What a policy gains that was trained with a video estimator's noise, beside one that was not.

    python benchmarks/tracker.py --library FOLDER --from POLICY -o noise --noise 0.25 0.5 ...
    python benchmarks/tracker.py --library FOLDER --from POLICY -o plain ...
    python benchmarks/noise_training.py --clips bandai_bvh --every 4 --policy noise=noise plain=plain \
        --json benchmarks/noise_training.json

Every clip at every strength of the noise, by the policy alone and without help; "tracker" is the policy
that comes with Poise. Rows of policies that are not asked for stay as they are.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import torch
from speed import machine

from poise.jobs.open import open_run
from poise.jobs.track.noise import robustness
from poise.learn.checkpoint import write_atomic
from poise.motion import read_clip
from poise.motion.noise import robustness_levels


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--clips", type=Path, required=True)
    parser.add_argument("--every", type=int, default=1)
    parser.add_argument("--policy", nargs="*", default=[], metavar="NAME=RUN")
    parser.add_argument("--strengths", type=float, nargs="+", default=[0.0, 0.25, 0.5, 1.0])
    parser.add_argument("--json", type=Path, required=True)
    a = parser.parse_args()
    torch.set_num_threads(1)
    files = sorted(p for p in a.clips.rglob("*") if p.suffix in (".bvh", ".amc"))[:: a.every]
    clips, levels = [read_clip(p) for p in files], robustness_levels(strengths=a.strengths)
    said: dict[str, Any] = json.loads(a.json.read_text()) if a.json.exists() else {}
    said |= {"command": "benchmarks/noise_training.py", "machine": machine(), "clips": len(clips)}
    for given in a.policy or ["tracker"]:
        name, _, path = given.partition("=")
        tracker = open_run(Path(path) if path else None).tracker
        result = robustness(tracker, clips, levels, tell=lambda s, n=name: print(n, s, flush=True))
        row = {"samples": tracker.about.get("samples"), **result.to_dict()}
        said.setdefault("rows", {})[name] = row
        write_atomic(a.json, (json.dumps(said, indent=1) + "\n").encode())


if __name__ == "__main__":
    main()
