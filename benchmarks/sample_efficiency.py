"""How much is learned from how many samples: the paper's setting, additive PPO, and PPO from the clone.

    python benchmarks/sample_efficiency.py --data FOLDER [--samples 1000000] [--seeds 2] [--threads N]

RFC's cartwheel, the same physics, body, reward and help (100 N, kept) for all, so that only what is
learned with differs: "paper" observes the phase, acts with absolute targets and has the paper's PPO
(50,000 samples a batch), "additive" is ours from nothing, "expert" is ours from the cloned expert; its
samples are counted. Every point is the deterministic policy from 64 start frames to the clip's end.
Finished runs are kept in `--work`; the JSON and the plot are made from all of them.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import numpy as np
import torch

from poise.body import BodyConfig
from poise.formats import read_clip
from poise.jobs.runs import evaluate
from poise.jobs.warm_start import clone_expert, finetuning
from poise.learn import Trainer
from poise.recipes.imitation import Imitation
from poise.recipes.residual_force import ResidualForce, build
from poise.score.report import line_plot
from poise.sim import SimConfig

KINDS = ("paper", "additive", "expert")
CLIP = ("cmu_amc/rfc/90_02.amc", "cmu_amc/rfc/08.asf")


def settings(kind: str, seed: int) -> ResidualForce:
    """The compared settings; the paper's on the same physics."""
    ours = ResidualForce(help_limit=100.0, help_start=None, seed=seed, expert=kind == "expert")
    if kind != "paper":
        return ours
    same = {"sim": SimConfig(), "body": BodyConfig(), "done": "bodies", "horizon": 300}
    return ResidualForce.paper(seed=seed, residual_std=0.3, help_capped=True, **same)


def trainer_of(task: Imitation, threads: int) -> Trainer:
    """A trainer from nothing, or from the clone."""
    if not task.config.expert:
        return task.trainer(threads)
    start = clone_expert(task, threads)
    return task.trainer(threads, warm_start=start, ppo=finetuning(task.ppo()))


def one(data: Path, kind: str, seed: int, samples: int, every: int, threads: int) -> dict:
    """One learning curve: rows of samples, seconds, Succ, imitation reward, joint error in mm."""
    clip = read_clip(data / CLIP[0], skeleton=data / CLIP[1])
    task, begun, rows = build(clip, settings(kind, seed)), time.perf_counter(), []
    trainer = trainer_of(task, threads)
    due = 0
    while True:
        if trainer.samples >= due:
            card = evaluate(task, trainer.policy(), {}, most=64).card
            seconds = round(time.perf_counter() - begun, 1)
            row = (trainer.samples, seconds, card.succ, card.reward["total"], card.mpjpe_mm)
            rows.append([round(float(x), 4) for x in row])
            print(kind, seed, rows[-1], flush=True)
            due = trainer.samples + every
        if trainer.samples >= samples:
            break
        trainer.iterate()
    trainer.env.close()
    return {"rows": rows, "threads": threads}


def plot(runs: dict[str, dict], path: Path) -> None:
    """Share of start frames tracked to the end, over samples: mean and range over seeds."""
    series = []
    for kind in KINDS:
        curves = [np.array(r["rows"]) for k, r in runs.items() if k.startswith(kind)]
        if not curves:
            continue
        x = np.unique(np.concatenate([c[:, 0] for c in curves]))
        x = x[(x >= max(c[0, 0] for c in curves)) & (x <= min(c[-1, 0] for c in curves))]
        y = np.array([np.interp(x, c[:, 0], c[:, 2]) for c in curves])
        series.append((kind, x, y.mean(0), (y.min(0), y.max(0))))
    line_plot(series, "Cartwheel with at most 100 N, by samples", "samples", "succ", path)


def main() -> None:
    """Runs what has not been run yet."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--samples", type=int, default=1_000_000)
    parser.add_argument("--every", type=int, default=50_000)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--threads", type=int, default=0)
    parser.add_argument("--work", type=Path, default=Path("runs/sample_efficiency"))
    args = parser.parse_args()
    torch.set_num_threads(1)
    args.work.mkdir(parents=True, exist_ok=True)
    runs: dict[str, dict] = {}
    for seed in range(args.seeds):
        for kind in KINDS:
            kept = args.work / f"{kind}_{args.samples}_{seed}.json"
            if not kept.exists():
                run = one(args.data, kind, seed, args.samples, args.every, args.threads)
                kept.write_text(json.dumps(run))
            runs[f"{kind}/{seed}"] = json.loads(kept.read_text())
    out = Path(__file__).with_suffix(".json")
    command = f"python benchmarks/sample_efficiency.py --data FOLDER --samples {args.samples}"
    lines = ",\n".join(f"  {json.dumps(name)}: {json.dumps(run)}" for name, run in runs.items())
    columns = ["samples", "seconds", "succ", "imitation reward", "mpjpe_mm"]
    head = json.dumps({"command": command, "columns": columns}, indent=1).rstrip("}").rstrip()
    out.write_text(f'{head},\n "runs": {{\n{lines}\n }}\n}}\n')
    plot(runs, out.with_suffix(".svg"))


if __name__ == "__main__":
    main()
