"""The paper's ablations on a small library, each run one switch away from the one before it.

    python benchmarks/perpetual_ablations.py --library FOLDER --onto FILE -o RUNS [--samples 2000000]
    python benchmarks/perpetual.py --runs NAME=RUNS/NAME ... --parts table noise recovery owners curves

Trains every run of `LADDER` with the same samples, the cloning of the expert counted, without any help
and without a motion prior, and prints the second command. A run that was stopped is gone on with,
finished ones stay. `--worker K --workers N` takes every Nth run, for several processes at once.
"""

from __future__ import annotations

import argparse
import contextlib
from dataclasses import replace
from pathlib import Path

from tracker import SIXTY

from poise.body import BodyConfig
from poise.cli.train_perpetual import shown
from poise.cli.training import beginning
from poise.jobs.library.clips import LibraryConfig
from poise.jobs.perpetual.result import RESULT
from poise.jobs.perpetual.run import begin, clips_of, resume, train
from poise.jobs.run_file import RUN_FILE
from poise.learn import Until
from poise.recipes.perpetual import Perpetual

#: Every row adds what its name says to the one before; the last three stand for themselves.
LADDER = {
    "plain": {"termination": "all", "multiplicative": False, "recovery": False},
    "relaxed": {"multiplicative": False, "recovery": False},
    "multiplicative": {"progressive": False, "recovery": False},
    "progressive": {"recovery": False},
    "recovery": {},
    "one-large-network": {"single": True, "recovery": False},
    "absolute-rotations": {"action": "absolute", "recovery": False},
    "absolute-keypoints": {"action": "absolute", "goal": "keypoints", "recovery": False},
}


def settings(name: str, seed: int) -> Perpetual:
    """One run's."""
    additive = Perpetual.additive(help_start=0.0, max_primitives=2, single_hidden=(1024, 512), seed=seed)
    # A small library has fewer hard moments, and the budget is small.
    additive = replace(additive, num_envs=512)
    ppo = replace(additive.ppo, minibatch=2048)
    if name.startswith("absolute"):
        # Noise in shares of a joint's range.
        ppo = replace(ppo, std=0.02)
    return replace(additive, ppo=ppo, **LADDER[name])


def one(a: argparse.Namespace, name: str, seed: int) -> None:
    """Trains one run, or goes on with it."""
    out, config = a.out / f"{name}-{seed}", settings(name, seed)
    source = str(a.library)
    if (out / RESULT).exists():
        return
    if (out / RUN_FILE).exists():
        imitation = resume(out, config, source)
    else:
        how = LibraryConfig(rates=SIXTY)
        library, notes = clips_of(a.library, BodyConfig(), (), (), print, a.onto, how)
        print(*notes, sep="\n")
        imitation = begin(out, library, config, source)
    with contextlib.suppress(KeyboardInterrupt), shown() as show:
        train(imitation, out, Until(samples=a.samples), show, 1, beginning=beginning())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--library", type=Path, required=True)
    parser.add_argument("--onto", type=Path)
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument("--samples", type=int, default=2_000_000)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1])
    parser.add_argument("--only", nargs="+", choices=tuple(LADDER), default=list(LADDER))
    parser.add_argument("--worker", type=int, default=0)
    parser.add_argument("--workers", type=int, default=1)
    a = parser.parse_args()
    jobs = [(name, seed) for seed in a.seeds for name in a.only]
    for k, (name, seed) in enumerate(jobs):
        if k % a.workers == a.worker:
            print(f"{name}, seed {seed}")
            one(a, name, seed)
    runs = " ".join(f"{name}-{seed}={a.out}/{name}-{seed}" for name, seed in jobs)
    print(f"python benchmarks/perpetual.py --runs {runs} --parts table noise recovery owners curves")


if __name__ == "__main__":
    main()
