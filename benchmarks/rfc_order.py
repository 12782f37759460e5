"""RFC-Implicit and RFC-Explicit against DeepMimic: imitation reward after equal samples.

    python benchmarks/rfc_order.py --data FOLDER [--samples 1000000] [--worker K --workers N]

Everything but the residual force is the same for the three methods: body, terms, PPO, seeds. The
imitation reward leaves out the regularizer (paper Sec. 6.1). Results of finished runs are kept in
`--work`, so that the command goes on where it was stopped; `--collect` only gathers them.
"""

from __future__ import annotations

import argparse
import json
import time
from itertools import product
from pathlib import Path

import numpy as np
import torch

from poise.jobs.runs import evaluate
from poise.learn import PPOConfig
from poise.motion.io import read_clip
from poise.recipes.residual_force import ResidualForce, build
from poise.view import line_plot

CLIPS = ("90_02", "90_05", "90_08", "05_13")
METHODS = ("deepmimic", "rfc-implicit", "rfc-explicit")
SEEDS = (0, 1)


def settings(name: str, method: str, seed: int) -> ResidualForce:
    """The compared setting: "poise" is the default recipe, "paper" its observation and action."""
    same = {"method": method, "seed": seed, "help_limit": 100.0, "help_start": None}
    if name == "poise":
        return ResidualForce(**same)
    more = {"observation": "phase", "action": "absolute", "done": "height"}
    return ResidualForce(ppo=PPOConfig(std=0.1, policy_lr=3e-4), **same, **more)


def one(data: Path, name: str, clip_name: str, method: str, seed: int, samples: int) -> dict:
    """Trains one policy for `samples` control steps; the curve and the final evaluation."""
    clip = read_clip(data / f"cmu_amc/rfc/{clip_name}.amc", skeleton=data / "cmu_amc/rfc/08.asf")
    imitation = build(clip, settings(name, method, seed))
    trainer = imitation.trainer(threads=1)
    curve, begun = [], time.perf_counter()
    while trainer.samples < samples:
        s = trainer.iterate()
        curve.append((s.samples, s.terms["imitation"], s.episode_length))
    card = evaluate(imitation, trainer.policy(), {"samples": trainer.samples}).card
    trainer.env.close()
    keep = curve[:: max(1, len(curve) // 60)]
    # Return per episode as in the paper's figure 2: reward per step times steps survived.
    last = curve[-max(1, len(curve) // 20) :]
    return {
        "imitation_last": float(np.mean([c[1] for c in last])),
        "return_last": float(np.mean([c[1] * c[2] for c in last])),
        "eval_imitation": card.reward["total"],
        "succ": card.succ,
        "mpjpe_mm": card.mpjpe_mm,
        "force_mean_n": card.help.force_mean_n,
        "torque_mean_nm": card.help.torque_mean_nm,
        "seconds": round(time.perf_counter() - begun, 1),
        "curve": [[c[0], round(c[1], 4), round(c[2], 2)] for c in keep],
    }


def summary(runs: dict) -> dict:
    """Means over seeds per clip and method, and over everything."""
    out: dict = {}
    for key in ("imitation_last", "return_last", "eval_imitation", "succ"):
        out[key] = {}
        for method in METHODS:
            cells = {}
            for clip in CLIPS:
                found = [
                    runs[k][key] for k in runs if k.split("/")[0] == clip and k.split("/")[1] == method
                ]
                if found:
                    cells[clip] = round(float(np.mean(found)), 4)
            if cells:
                out[key][method] = {**cells, "mean": round(float(np.mean(list(cells.values()))), 4)}
    return out


def plot(runs: dict, path: Path) -> None:
    """Mean curve over clips and seeds per method with the spread of its runs."""
    series = []
    for method in METHODS:
        curves = [np.array(runs[k]["curve"]) for k in runs if k.split("/")[1] == method]
        if curves:
            x = curves[0][:, 0]
            y = np.array([np.interp(x, c[:, 0], c[:, 1] * c[:, 2]) for c in curves])
            mean, err = y.mean(0), y.std(0) / np.sqrt(len(y))
            series.append((method, x, mean, (mean - err, mean + err)))
    line_plot(
        series, "Return per episode, mean of 4 clips and 2 seeds", "samples", "imitation return", path
    )


def main() -> None:
    """Runs what is not in the JSON yet."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--samples", type=int, default=1_000_000)
    parser.add_argument("--setting", choices=("poise", "paper"), default="poise")
    parser.add_argument("--worker", type=int, default=0)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--work", type=Path, default=Path("runs/rfc_order"))
    parser.add_argument("--collect", action="store_true", help="write JSON and plot from finished runs")
    args = parser.parse_args()
    torch.set_num_threads(1)
    args.work.mkdir(parents=True, exist_ok=True)
    jobs = list(product(SEEDS, CLIPS, METHODS))
    stem = f"{args.setting}_{args.samples}"
    if not args.collect:
        for k, (seed, clip, method) in enumerate(jobs):
            path = args.work / f"{stem}_{clip}_{method}_{seed}.json"
            if k % args.workers != args.worker or path.exists():
                continue
            result = one(args.data, args.setting, clip, method, seed, args.samples)
            path.write_text(json.dumps(result))
            print(path.name, {k: v for k, v in result.items() if k != "curve"}, flush=True)
    runs = {}
    for seed, clip, method in jobs:
        path = args.work / f"{stem}_{clip}_{method}_{seed}.json"
        if path.exists():
            runs[f"{clip}/{method}/{seed}"] = json.loads(path.read_text())
    out = Path(__file__).with_name(f"rfc_order_{args.setting}.json")
    command = (
        f"python benchmarks/rfc_order.py --data FOLDER --samples {args.samples} --setting {args.setting}"
    )
    lines = ",\n".join(f"  {json.dumps(name)}: {json.dumps(run)}" for name, run in runs.items())
    head = json.dumps({"command": command, "summary": summary(runs)}, indent=1).rstrip("}").rstrip()
    out.write_text(f'{head},\n "runs": {{\n{lines}\n }}\n}}\n')
    plot(runs, out.with_suffix(".svg"))


if __name__ == "__main__":
    main()
