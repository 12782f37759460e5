"""Trains the kinematic policy that is to come with Poise, on clips of CMU and DeepMimic.

    python training/generator.py --library FOLDER -o RUN [--steps 6000] [--minutes M]

FOLDER is that of `training/README.md`, with what `looped.py` makes of its runs. Whole subjects of CMU
are held out. The library is read once, into the run's folder. Resumable; the same number of steps makes
the same weights.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import torch
from tracker import HELD_OUT, SIXTY, TWINS

from poise.jobs.endless.endless_training import Endless, begin, train_generator
from poise.jobs.endless.model import read_labels
from poise.jobs.library.clips import LibraryConfig
from poise.jobs.open import open_run
from poise.learn.inbetween_model import BlockStats

#: Exercises on one spot, which would be a third of the library, and takes at other speeds.
LEFT_OUT = (r"cmu_amc-29-", r"49_(09|1\d|2\d)", r"127_0[12]", "retimed")


def shown(stats: BlockStats) -> None:
    """Now and then a line."""
    if stats.step % 200 < 50:
        parts = {k: round(v, 2) for k, v in stats.parts.items()}
        print(f"step {stats.step} of {stats.steps}, {stats.samples_per_s:.0f}/s, {parts}", flush=True)


def settings(args: argparse.Namespace) -> Endless:
    """Those of the training."""
    config = Endless(steps=args.steps, seed=args.seed, balance=args.balance)
    how = replace(config.training, lr=args.lr, held=args.held, batch=args.batch, shorter=args.shorter)
    return replace(config, training=how)


def main() -> None:
    """Reads, trains, writes the model into the run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--library", type=Path, required=True)
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument("--steps", type=int, default=6_000)
    parser.add_argument("--lr", type=float, default=1e-3)
    parser.add_argument("--held", type=float, default=0.3)
    parser.add_argument("--batch", type=int, default=128)
    parser.add_argument("--balance", type=float, default=0.7)
    parser.add_argument("--hold-out", nargs="*", default=HELD_OUT, help="none: all is learned")
    parser.add_argument("--shorter", action="store_true")
    parser.add_argument("--minutes", type=float)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=1)
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    args.out.mkdir(parents=True, exist_ok=True)
    motions, config = begin(
        args.out,
        args.library,
        open_run(None).tracker,
        settings(args),
        hold_out=args.hold_out,
        leave_out=(*TWINS, *LEFT_OUT),
        reading=LibraryConfig(rates=SIXTY, mirror=True),
        tell=print,
    )
    labels = read_labels(Path(__file__).with_name("generator_labels.txt"))
    model, _, _ = train_generator(motions, args.out, config, args.minutes, shown, labels)
    model.save(args.out / "shipped.safetensors", half=True)


if __name__ == "__main__":
    main()
