"""Trains the kinematic policy that is to come with Poise, on clips of CMU and DeepMimic.

    python benchmarks/endless_train.py --library FOLDER -o RUN [--steps 12000] [--minutes M]

FOLDER is that of `tracker/README.md`. Whole subjects of CMU are held out. Resumable.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch
from tracker import HELD_OUT, SIXTY, TWINS

from poise.jobs.endless.training import Endless, read_motions, train_generator
from poise.jobs.library.clips import LibraryConfig
from poise.jobs.open import open_run
from poise.learn.inbetween import BlockStats


def shown(stats: BlockStats) -> None:
    """Now and then a line."""
    if stats.step % 200 < 50:
        parts = {k: round(v, 2) for k, v in stats.parts.items()}
        print(f"step {stats.step} of {stats.steps}, {stats.samples_per_s:.0f}/s, {parts}", flush=True)


def main() -> None:
    """Reads, trains, writes the model into the run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--library", type=Path, required=True)
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument("--steps", type=int, default=12_000)
    parser.add_argument("--minutes", type=float)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=1)
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    config = Endless(steps=args.steps, seed=args.seed)
    how = LibraryConfig(rates=SIXTY, mirror=True)
    tracker = open_run(None).tracker
    motions = read_motions(
        args.library, tracker, config.net, HELD_OUT, print, leave_out=TWINS, config=how
    )
    args.out.mkdir(parents=True, exist_ok=True)
    model, _, _ = train_generator(motions, args.out, config, args.minutes, shown)
    model.save(args.out / "shipped.safetensors", half=True)


if __name__ == "__main__":
    main()
