"""How long until a clip is tracked with help, with the authors' reward, with their help, and with none.

    python benchmarks/zero_help.py --data FOLDER --clip NAME [--minutes M] [--seed S] [--threads N]
        [--work FOLDER] [--scratch]
    python benchmarks/zero_help.py --collect [--work FOLDER]

FOLDER holds the clips as listed in CLIPS. One run per call, from reading the file; all seconds are wall
seconds and count the checks. Every `--check` seconds the deterministic policy is simulated to the end
from 64 start frames under the help that training has left. The run ends when every start frame succeeds
without help, or at `--minutes`. A run that was interrupted is begun anew.

R is Residual Force Control's reward with its authors' weights (rotation 0.3, velocity 0.1, end effectors
0.45, centre of mass 0.1, residual 0.05), mean per step; its residual term counts newtons over 100.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import time
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import torch

from poise.formats import read_clip
from poise.jobs.result import Result
from poise.jobs.runs import begin, evaluate, train, trained_policy
from poise.learn import IterationStats, Until
from poise.motion import ClipLibrary
from poise.recipes.imitation import Imitation
from poise.recipes.residual_force import ResidualForce, task
from poise.score import RolloutSet
from poise.score.report import line_plot

RFC, CMU, MIMIC = "cmu_amc/rfc", "cmu_amc/02", "deepmimic_txt"
#: Path, skeleton, frames per second where the file's default is wrong, and for the clips of the paper
#: what its authors' released policies reach: R from random start frames on a cleaned reference, N, N m.
CLIPS: dict[str, tuple[str, str | None, float | None, tuple[float, float, float] | None]] = {
    "05_06": (f"{RFC}/05_06.amc", "01.asf", None, (0.698, 15, 32)),
    "05_07": (f"{RFC}/05_07.amc", "01.asf", None, (0.840, 16, 21)),
    "05_13": (f"{RFC}/05_13.amc", "01.asf", None, (0.843, 18, 27)),
    "90_02": (f"{RFC}/90_02.amc", "08.asf", None, (0.769, 21, 24)),
    "90_05": (f"{RFC}/90_05.amc", "08.asf", None, (0.786, 21, 25)),
    # In flight these two fall with four times gravity at 120 frames per second, with gravity at 60.
    "90_08": (f"{RFC}/90_08.amc", "08.asf", 60.0, (0.760, 17, 24)),
    "90_11": (f"{RFC}/90_11.amc", "08.asf", 60.0, (0.792, 23, 24)),
    **{k: (f"{CMU}/{k}.amc", None, None, None) for k in ("02_01", "02_03", "02_04", "02_05")},
    **{
        k: (f"{MIMIC}/humanoid3d_{k}.txt", None, None, None)
        for k in ("walk", "run", "cartwheel", "spin", "kick")
    },
}
USABLE, DONE = 0.9, 1.0


def authors_reward(r: RolloutSet) -> float:
    """R, from terms that were worked out with the authors' definitions."""
    alive, t = r.alive, r.reward
    force, torque = (x.norm(dim=-1).sum(-1) / 100.0 for x in (r.force, r.torque))
    residual = torch.exp(-(force.square() + torque.square()))
    value = 0.3 * t["pose"] + 0.1 * t["velocity"] + 0.45 * t["end_effectors"] + 0.1 * t["centre_of_mass"]
    return float((value + 0.05 * residual)[alive].mean())


class Watch:
    """Checks a training now and then, and ends it when nothing is left to be gained."""

    def __init__(self, imitation: Imitation, run: Path, begun: float, every: float, goal: tuple | None):
        code = replace(imitation.config, faithful="code")
        self.judged = replace(imitation, task=task(code, imitation.humanoid))
        self.run, self.begun, self.every, self.goal = run, begun, every, goal
        self.next, self.rows, self.marks = 0.0, [], {}

    def __call__(self, stats: IterationStats) -> bool | None:
        if self.seconds < self.next:
            return None
        row = self.check(64)
        self.next = self.seconds + self.every
        return False if row["help_limit"] == 0 and row["succ"] >= DONE and self.all_succeed() else None

    @property
    def seconds(self) -> float:
        return time.perf_counter() - self.begun

    def all_succeed(self) -> bool:
        return self.check(None)["succ"] >= DONE

    def check(self, starts: int | None) -> dict:
        policy, meta = trained_policy(self.run, self.judged)
        result = evaluate(self.judged, policy, meta, most=starts)
        card, r = result.card, authors_reward(result.rollouts)
        row = {
            "seconds": round(self.seconds),
            "samples": int(meta["samples"]),
            "starts": card.episodes,
            "help_limit": round(float(meta["help_limit"]), 2),
            "succ": round(card.succ, 4),
            "mpjpe_mm": round(card.mpjpe_mm, 1),
            "reward": round(r, 4),
            "force_n": round(card.help.force_mean_n, 2),
            "torque_nm": round(card.help.torque_mean_nm, 2),
        }
        self.rows.append(row)
        print(json.dumps(row), flush=True)
        self.mark(row)
        return row

    def mark(self, row: dict) -> None:
        reached = {"first_usable": row["succ"] >= USABLE}
        if self.goal is not None:
            as_good = row["succ"] >= DONE and row["reward"] >= self.goal[0]
            reached["authors_reward"] = as_good
            less = row["force_n"] <= self.goal[1] and row["torque_nm"] <= self.goal[2]
            reached["authors_reward_and_help"] = as_good and less
        reached["no_help"] = row["help_limit"] == 0 and row["succ"] >= 0.95 and row["mpjpe_mm"] <= 60
        for name, yes in reached.items():
            if yes:
                self.marks.setdefault(name, row["seconds"])


def collect(work: Path) -> None:
    """All finished runs in one JSON, in the order of CLIPS, and a plot of the paper's clips."""
    order = list(CLIPS)
    runs = [json.loads(path.read_text()) for path in work.glob("*/zero_help.json")]
    runs.sort(key=lambda r: (order.index(r["clip"]), r["seed"]))
    out = Path(__file__).with_suffix(".json")
    command = "python benchmarks/zero_help.py --data FOLDER --clip CLIP --seed SEED"
    lines = ",\n".join(f"  {json.dumps(run)}" for run in runs)
    head = json.dumps({"command": command}, indent=1).rstrip("}").rstrip()
    out.write_text(f'{head},\n "runs": [\n{lines}\n ]\n}}\n')
    series = []
    for run in runs:
        # Those of the paper; sixteen lines would be no picture.
        if run["seed"] == 0 and CLIPS[run["clip"]][3] is not None:
            x, y = (np.array([c[key] for c in run["checks"]]) for key in ("seconds", "help_limit"))
            series.append((run["clip"], x / 60.0, y))
    line_plot(series, "Help that is left while training", "minutes", "limit, N", out.with_suffix(".svg"))
    print(out)


def main() -> None:
    """One run, one JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path)
    parser.add_argument("--clip", choices=list(CLIPS))
    parser.add_argument("--collect", action="store_true", help="gather finished runs into one JSON")
    parser.add_argument("--minutes", type=float, default=45.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=0)
    parser.add_argument("--scratch", action="store_true", help="without the cloned expert")
    parser.add_argument("--check", type=float, default=30.0)
    parser.add_argument("--work", type=Path, default=Path("runs/zero_help"))
    args = parser.parse_args()
    if args.collect:
        return collect(args.work)
    if args.data is None or args.clip is None:
        parser.error("--data and --clip are needed")
    begun = time.perf_counter()
    if args.threads:
        torch.set_num_threads(args.threads)
    path, asf, fps, goal = CLIPS[args.clip]
    folder = (args.data / path).parent
    skeleton = folder / asf if asf else None
    clip = read_clip(args.data / path, skeleton=skeleton, fps=fps)
    out = args.work / f"{args.clip}-s{args.seed}"
    start = not args.scratch
    config = ResidualForce(help_start=100.0, help_limit=0.0, seed=args.seed, expert=start)
    imitation = begin(out / "run", ClipLibrary.of(clip), config)
    print("\n".join(imitation.report.sentences()), flush=True)
    watch = Watch(imitation, out / "run", begun, args.check, goal)
    train(imitation, out / "run", Until(minutes=args.minutes), watch, args.threads, tensorboard=False)
    final = watch.check(None)
    policy, meta = trained_policy(out / "run", imitation)
    result = evaluate(imitation, policy, meta)
    Result(imitation, result, run=out / "run").write(out)
    report = {
        "clip": args.clip,
        "seed": args.seed,
        "expert": start,
        "seconds_to": watch.marks,
        "final": final,
        "help": asdict(result.card.help),
        "mass_kg": round(imitation.humanoid.mass, 1),
        "clip_seconds": round(clip.seconds, 2),
        "threads": args.threads or len(os.sched_getaffinity(0)),
        "machine": f"{platform.machine()}, {len(os.sched_getaffinity(0))} cores",
        "checks": watch.rows,
    }
    target = out / "zero_help.json"
    target.write_text(json.dumps(report, indent=1) + "\n")
    print(target)


if __name__ == "__main__":
    main()
