"""Imitates a walk and RFC's cartwheel from reading the file to the score card.

    python benchmarks/first_light.py --data FOLDER [--minutes M] [--only CLIP] [--out FILE.json]

FOLDER holds the CMU clips as `cmu_amc/02/02_01.amc` and `cmu_amc/rfc/90_02.amc`. Training takes
`--minutes` per clip; `wall_seconds` also counts reading, evaluation and writing.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import time
from pathlib import Path

import torch

from poise.formats import read_clip
from poise.jobs.result import Result
from poise.jobs.runs import begin, evaluate, train, trained_policy
from poise.learn import Until
from poise.motion import ClipLibrary
from poise.recipes.residual_force import ResidualForce

CLIPS = {
    "02_01 walk": ("cmu_amc/02/02_01.amc", None),
    "90_02 cartwheel": ("cmu_amc/rfc/90_02.amc", "cmu_amc/rfc/08.asf"),
}


def imitate(data: Path, name: str, minutes: float, out: Path, seed: int) -> dict:
    """One clip from its file to its score; wall seconds count everything."""
    begun = time.perf_counter()
    path, asf = CLIPS[name]
    clip = read_clip(data / path, skeleton=data / asf if asf else None)
    config = ResidualForce(help_limit=100.0, help_start=None, seed=seed)
    imitation = begin(out / "run", ClipLibrary.of(clip), config)
    train(imitation, out / "run", Until(minutes=minutes))
    policy, meta = trained_policy(out / "run", imitation)
    evaluation = evaluate(imitation, policy, meta)
    Result(imitation, evaluation, run=out / "run").write(out)
    card = evaluation.card.to_dict()
    for key in ("per_clip", "variants"):
        card.pop(key)
    card["wall_seconds"] = round(time.perf_counter() - begun, 1)
    card["mass_kg"] = round(imitation.humanoid.mass, 1)
    return card


def main() -> None:
    """Runs both clips and writes one JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--minutes", type=float, default=19.0, help="training minutes per clip")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", choices=list(CLIPS))
    parser.add_argument("--work", type=Path, default=Path("runs/first_light"))
    parser.add_argument("--out", type=Path, default=Path(__file__).with_suffix(".json"))
    args = parser.parse_args()
    torch.set_num_threads(1)
    found = json.loads(args.out.read_text()) if args.out.exists() else {}
    for name in [args.only] if args.only else CLIPS:
        folder = args.work / name.split()[0]
        result = imitate(args.data, name, args.minutes, folder, args.seed)
        command = f"--data FOLDER --minutes {args.minutes:g} --seed {args.seed} --only '{name}'"
        result["command"] = f"python benchmarks/first_light.py {command}"
        found[name] = result
        print(name, json.dumps({k: result[k] for k in ("succ", "mpjpe_mm", "help", "wall_seconds")}))
    found["machine"] = f"{len(os.sched_getaffinity(0))} cores, {platform.machine()}, no GPU"
    args.out.write_text(json.dumps(found, indent=2) + "\n")


if __name__ == "__main__":
    main()
