"""Trains an in-betweening network that may come with Poise, on clips of the CMU motion capture database.

    python benchmarks/inbetween_cmu.py --library FOLDER --onto FOLDER/.../02_01.amc --steps 6000
        [--work DIR] [--out src/poise/data/inbetween/model.safetensors]

All clips are brought onto one subject's skeleton; the whole of the subjects in `HELD_OUT` is kept apart.
Writes the model in half precision and, beside this script, `inbetween_cmu.json`: clips, cost, figures on
the held-out subjects next to those of interpolation, and after test-time adaptation; its settings are
chosen on subjects 03, 11 and 14, and its figures are of subject 05's dances. Resumable.

CMU's files state 120 frames a second throughout, but some were captured at 60: subject 90 falls with
four times the gravity at 120, and the salsa of subjects 60 and 61 would be danced at 360 beats a minute.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
from pathlib import Path

import torch
from inbetween import adapted_rows, cost, truth_rows
from inbetween_baselines import Baseline

from poise.eval.inbetween import Protocol, evaluate, test_set
from poise.jobs.inbetween.training import Inbetween, begin, train
from poise.jobs.library.clips import LibraryConfig
from poise.learn.between import BetweenTraining
from poise.learn.inbetween import BlockStats
from poise.learn.model import save_model
from poise.nets.between import BetweenConfig

#: Whole subjects that are not learned from: dances of 05, a kick of 11, uneven ground of 03, boxing and
#: exercises of 14.
HELD_OUT = r"-(05|11|03|14)_\d"
#: The same subjects apart: settings of the adaptation are chosen on some, its figures are of the others.
CHOICES = Protocol("CMU", final=r"-05_\d", validation=r"-(11|03|14)_\d")
SIXTY = (("(^|-)90_", 60.0), ("salsa", 60.0))
LENGTHS = (5, 15, 30, 45)
#: A network of 5 million weights learns so little motion by heart; half of it with dropout does less so.
SIZES = BetweenConfig(width=192, layers=6, heads=6, feedforward=640)
TRAINING = BetweenTraining(dropout=0.15)


def config_of(args: argparse.Namespace) -> Inbetween:
    """What is trained on what."""
    stated = tuple((a, b) for a, b in (pair.split("=", 1) for pair in args.skeleton))
    reading = LibraryConfig(rates=SIXTY, skeletons=stated, leave_out=tuple(args.never))
    return Inbetween(
        name="CMU",
        validation=HELD_OUT,
        # By steps alone feet would stand in 18 % of the frames, and none would be held.
        contacts="floor",
        mirror=True,
        stretch=1.3,
        seed=args.seed,
        onto=str(args.onto),
        reading=reading,
        between=SIZES,
        between_training=TRAINING,
    )


def shown(stats: BlockStats) -> None:
    """Now and then a line."""
    if stats.step % 500 < 50 or stats.step == stats.steps:
        held = {k: round(v, 3) for k, v in stats.parts.items() if k.startswith("validation/l2p")}
        print(f"step {stats.step} of {stats.steps}, {stats.samples_per_s:.0f}/s, {held}", flush=True)


def main() -> None:
    """Trains, writes the model and its figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--library", type=Path, required=True)
    parser.add_argument("--onto", type=Path, required=True, help="a clip on the skeleton to learn")
    parser.add_argument("--skeleton", nargs="*", default=[], help="REGEX=FILE.asf of AMC files")
    parser.add_argument("--never", nargs="*", default=[], help="REGEX of clips to leave out")
    parser.add_argument("--steps", type=int, default=6000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=len(os.sched_getaffinity(0)))
    parser.add_argument("--work", type=Path, default=Path("runs/inbetween-cmu"))
    parser.add_argument("--out", type=Path, default=Path("src/poise/data/inbetween/model.safetensors"))
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    task, steps = begin(args.work, args.library, config_of(args), 0.0, args.steps, print)
    print(f"{len(task.bank.clips)} clips, {task.data.frames} frames with mirrored ones", flush=True)
    model, _, stopped = train(
        task, args.work, steps, on_block=shown, tensorboard=False, validate_every=1000
    )
    if stopped:
        return
    args.out.parent.mkdir(parents=True, exist_ok=True)
    save_model(args.out, model, half=True)
    held = task.validation
    assert held is not None
    rows = {
        "network": evaluate(model.net, held, LENGTHS),
        "interpolation": evaluate(Baseline("interpolation", task.data.layout), held, LENGTHS),
        "zero-velocity": evaluate(Baseline("zero-velocity", task.data.layout), held, LENGTHS),
    }
    choices, dances = (
        test_set(CHOICES.split(task.bank, part), held.std, CHOICES) for part in ("validation", "final")
    )
    adapted, chosen = adapted_rows(model, choices, dances)
    line = Baseline("interpolation", task.data.layout)
    apart = {
        "recorded": truth_rows(dances), "interpolation": evaluate(line, dances),
        "network": evaluate(model.net, dances), "network + TTA": adapted,
    }  # fmt: skip
    parts = {p: [c for c in task.bank.clips if task.config.protocol.part_of(c) == p]
             for p in ("train", "validation")}  # fmt: skip
    found = {
        **model.meta, "frames_with_mirrored": task.data.frames, "windows": len(held.root),
        "rows": {k: [dataclasses.asdict(r) for r in v] for k, v in rows.items()},
        "adaptation": {
            "windows": len(dances.root), "windows_of_choices": len(choices.root), "chosen": chosen,
            "rows": {k: [dataclasses.asdict(r) for r in v] for k, v in apart.items()},
        },
        **cost(model, dances),
        "learned_from": parts["train"], "held_out": parts["validation"],
        "machine": f"{args.threads} threads, no GPU",
    }  # fmt: skip
    Path(__file__).with_suffix(".json").write_text(json.dumps(found, indent=2) + "\n")
    print(args.out, args.out.stat().st_size)


if __name__ == "__main__":
    main()
