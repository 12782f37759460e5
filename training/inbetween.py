"""Trains the in-betweening network that comes with Poise, on clips of the CMU motion capture database.

    python training/inbetween.py --library FOLDER --onto FOLDER/.../02_01.amc --steps 6000
        [--work DIR] [--out src/poise/data/inbetween/model.safetensors]

All clips are brought onto one subject's skeleton; subjects of `FINAL` are kept apart. Writes the model
in half precision; `python -m benchmarks inbetween-complete` measures it. Resumable.

CMU's files state 120 frames a second throughout, but some were captured at 60: subject 90 falls with
four times the gravity at 120, and the salsa of subjects 60 and 61 would be danced at 360 beats a minute.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from pathlib import Path

import torch

from poise.jobs.inbetween.inbetween_settings import Inbetween
from poise.jobs.inbetween.inbetween_training import begin, train
from poise.jobs.library.clips import LibraryConfig
from poise.learn.between import BetweenConfig, BetweenTraining
from poise.learn.inbetween_model import BlockStats, load_model, save_model

#: Whole subjects that are not learned from: dances of 05, a kick of 11, boxing and exercises of 14,
#: walks of 38, 39 and 43. The figures are of these.
FINAL = r"-(05|11|14|38|39|43)_\d"
#: Choices are made on subject 08 and on three dances for two, both dancers of which are kept apart.
VALIDATION = r"-08_\d|salsa-(11|13|14|26|28|29)$"
#: Takes of the same subjects under other names, found by their poses (12 to 20 mm from the same take's,
#: other takes are 20 to 30 away), and 01_01 a second time.
SAME_TAKES = (r"train.walking_(1[3-7]|3[5-9]|4[0-7]).extra", r"fairmotion")
RATES = (("(^|-)90_", 60.0), ("salsa", 60.0))
#: A network of 5 million weights learns so little motion by heart; a third of it with dropout less so.
SIZES = BetweenConfig(width=192, layers=4, heads=6, feedforward=512)
TRAINING = BetweenTraining(batch=32, dropout=0.1, coded=0.3, kl=0.003)


def config_of(
    onto: Path, skeletons: Sequence[str] = (), never: Sequence[str] = (), seed: int = 0
) -> Inbetween:
    """What is trained on what. skeletons: REGEX=FILE.asf of AMC files; never: clips that are left
    out."""
    stated = tuple((a, b) for a, b in (pair.split("=", 1) for pair in skeletons))
    return Inbetween(
        name="CMU",
        final=FINAL,
        validation=VALIDATION,
        # By steps alone feet would stand in 18 % of the frames, and none would be held.
        contacts="floor",
        mirror=True,
        stretch=1.3,
        seed=seed,
        onto=str(onto),
        reading=LibraryConfig(rates=RATES, skeletons=stated, leave_out=(*SAME_TAKES, *never)),
        between=SIZES,
        between_training=TRAINING,
    )


def shown(stats: BlockStats) -> None:
    """Now and then a line."""
    if stats.step % 200 < 50 or stats.step == stats.steps:
        held = {k: round(v, 3) for k, v in stats.parts.items() if k.startswith("validation/l2p")}
        print(f"step {stats.step} of {stats.steps}, {stats.samples_per_s:.0f}/s, {held}", flush=True)


def main() -> None:
    """Trains and writes the model."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--library", type=Path, required=True)
    parser.add_argument("--onto", type=Path, required=True, help="a clip on the skeleton to learn")
    parser.add_argument("--skeleton", nargs="*", default=[], help="REGEX=FILE.asf of AMC files")
    parser.add_argument("--never", nargs="*", default=[], help="REGEX of clips to leave out")
    parser.add_argument("--steps", type=int, default=6000)
    parser.add_argument(
        "--minutes", type=float, help="of this call; the model is what was learned so far"
    )
    parser.add_argument("--first", type=Path, help="a model that training begins from")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=len(os.sched_getaffinity(0)))
    parser.add_argument("--work", type=Path, default=Path("runs/inbetween-cmu"))
    parser.add_argument("--out", type=Path, default=Path("src/poise/data/inbetween/model.safetensors"))
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    config = config_of(args.onto, args.skeleton, args.never, args.seed)
    task, steps = begin(args.work, args.library, config, 0.0, args.steps, print)
    print(f"{len(task.bank.clips)} clips, {task.data.frames} frames with mirrored ones", flush=True)
    first = None if args.first is None else load_model(args.first)
    model, _, stopped = train(
        task, args.work, steps, args.minutes, shown, False, validate_every=200, first=first
    )
    if not stopped:
        args.out.parent.mkdir(parents=True, exist_ok=True)
        save_model(args.out, model, half=True)
        print(args.out, args.out.stat().st_size)


if __name__ == "__main__":
    main()
