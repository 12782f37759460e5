"""Trains an in-betweening network that may come with Poise, on clips of the CMU motion capture database.

    python benchmarks/inbetween_cmu.py --library FOLDER --onto FOLDER/.../02_01.amc --steps 6000
        [--work DIR] [--out src/poise/data/inbetween/model.safetensors]

All clips are brought onto one subject's skeleton; subjects of `FINAL` are kept apart.
Writes the model in half precision and, beside this script, `inbetween_cmu.json`: clips, cost, figures on
these subjects next to those of interpolation, subject by subject, and after test-time adaptation, the
iterations of which are chosen on `VALIDATION`. Resumable.

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
from inbetween import choose_iterations, cost, known_of, some_of, truth_rows
from inbetween_baselines import Baseline

from poise.jobs.inbetween.inbetween_training import Inbetween, Task, begin, train
from poise.jobs.library.clips import LibraryConfig
from poise.learn.between import BetweenConfig, BetweenTraining
from poise.learn.inbetween_model import (
    Adaptation,
    BlockStats,
    InbetweenModel,
    adapt,
    load_model,
    save_model,
)
from poise.learn.transition import FilledGap
from poise.score.gaps import GapRow, TestSet, evaluate, score, test_set

#: Whole subjects that are not learned from: dances of 05, a kick of 11, boxing and exercises of 14,
#: walks of 38, 39 and 43. The figures are of these.
FINAL = r"-(05|11|14|38|39|43)_\d"
#: Choices are made on subject 08 and on three dances for two, both dancers of which are kept apart.
VALIDATION = r"-08_\d|salsa-(11|13|14|26|28|29)$"
#: Takes of the same subjects under other names, found by their poses (12 to 20 mm from the same take's,
#: other takes are 20 to 30 away), and 01_01 a second time.
SAME_TAKES = (r"train.walking_(1[3-7]|3[5-9]|4[0-7]).extra", r"fairmotion")
SIXTY = (("(^|-)90_", 60.0), ("salsa", 60.0))
LENGTHS = (5, 15, 30, 45)
#: Test-time adaptation with a step down the mean loss of all windows, with one after each batch of 16
#: ("for several epochs"), and that without the term of smoothness.
WAYS = {
    "TTA": Adaptation(lr=1e-4),
    "TTA in minibatches": Adaptation(lr=3e-5, steps="minibatch", batch=16),
    "TTA in minibatches, beta 0": Adaptation(lr=3e-5, steps="minibatch", batch=16, beta=0.0),
}
#: A network of 5 million weights learns so little motion by heart; a third of it with dropout less so.
SIZES = BetweenConfig(width=192, layers=4, heads=6, feedforward=512)
TRAINING = BetweenTraining(batch=32, dropout=0.1, coded=0.3, kl=0.003)


def config_of(args: argparse.Namespace) -> Inbetween:
    """What is trained on what."""
    stated = tuple((a, b) for a, b in (pair.split("=", 1) for pair in args.skeleton))
    reading = LibraryConfig(rates=SIXTY, skeletons=stated, leave_out=(*SAME_TAKES, *args.never))
    return Inbetween(
        name="CMU",
        final=FINAL,
        validation=VALIDATION,
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
    if stats.step % 200 < 50 or stats.step == stats.steps:
        held = {k: round(v, 3) for k, v in stats.parts.items() if k.startswith("validation/l2p")}
        print(f"step {stats.step} of {stats.steps}, {stats.samples_per_s:.0f}/s, {held}", flush=True)


def names(task: Task, part: str) -> list[str]:
    """The clips of one part of the split."""
    return [c for c in task.bank.clips if task.config.protocol.part_of(c) == part]


def figures(model: InbetweenModel, task: Task, ways: dict[str, Adaptation]) -> dict:
    """Figures of all methods on the subjects held out, and of each of them."""
    protocol, choices = task.config.protocol, task.validation
    assert choices is not None
    final = test_set(protocol.split(task.bank, "final"), choices.std, protocol)
    line = Baseline("interpolation", task.data.layout)
    rows = {
        "recorded": truth_rows(final),
        "zero-velocity": evaluate(Baseline("zero-velocity", task.data.layout), final, LENGTHS),
        "interpolation": evaluate(line, final, LENGTHS),
        "network": evaluate(model.net, final, LENGTHS),
    }
    told: dict[str, dict] = {}
    for name, way in ways.items():
        rows[f"network + {name}"], told[name] = adapted(model, choices, final, way)
    chosen_on = {"interpolation": evaluate(line, choices, LENGTHS),
                 "network": evaluate(model.net, choices, LENGTHS)}  # fmt: skip
    subjects = {}
    for subject in sorted({c.split("-")[-1][:2] for c in names(task, "final")}):
        bank = task.bank.only(lambda n, of=subject: f"-{of}_" in n and protocol.part_of(n) == "final")
        test = test_set(bank, choices.std, protocol)
        pair = zip(evaluate(line, test, LENGTHS), evaluate(model.net, test, LENGTHS), strict=True)
        subjects[subject] = {
            "windows": len(test.root),
            "l2p": [[a.length, round(a.l2p, 3), round(b.l2p, 3)] for a, b in pair],
        }
    return {
        "windows": len(final.root), "rows": plain(rows), "adaptation": told,
        "l2p_of_interpolation_and_network": subjects,
        "windows_of_choices": len(choices.root), "rows_of_choices": plain(chosen_on),
        **cost(model, final),
    }  # fmt: skip


def plain(rows: dict[str, list[GapRow]]) -> dict[str, list[dict]]:
    """As JSON has it."""
    return {k: [dataclasses.asdict(r) for r in v] for k, v in rows.items()}


def adapted(
    model: InbetweenModel, choices: TestSet, final: TestSet, way: Adaptation
) -> tuple[list[GapRow], dict[str, int]]:
    """Rows after adaptation to all windows of each length, and how many iterations were chosen."""
    few = some_of(choices, 40)
    rows, counts = [], {}
    for n in LENGTHS:
        before = evaluate(model.net, few, (n,))[0]

        def worth(filled: FilledGap, n: int = n, before: GapRow = before) -> float:
            """Less slide is worth no more than a hundredth of L2P."""
            now = score(few, filled, n)
            return now.slide_mm if now.l2p <= 1.01 * before.l2p else float("inf")

        count, _ = choose_iterations(model.net, known_of(few, n), n, worth, way, most=10)
        own = adapt(model.net, known_of(final, n), n, dataclasses.replace(way, iterations=count))
        rows += evaluate(own, final, (n,))
        counts[str(n)] = count
    return rows, counts


def main() -> None:
    """Trains, writes the model and its figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--library", type=Path, required=True)
    parser.add_argument("--onto", type=Path, required=True, help="a clip on the skeleton to learn")
    parser.add_argument("--skeleton", nargs="*", default=[], help="REGEX=FILE.asf of AMC files")
    parser.add_argument("--never", nargs="*", default=[], help="REGEX of clips to leave out")
    parser.add_argument("--steps", type=int, default=6000)
    parser.add_argument(
        "--minutes", type=float, help="of this call; the model is what was learned so far"
    )
    parser.add_argument("--score", action="store_true", help="no training: only figures of --out")
    parser.add_argument("--adaptation", action="store_true", help="figures after it, too")
    parser.add_argument("--first", type=Path, help="a model that training begins from")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=len(os.sched_getaffinity(0)))
    parser.add_argument("--work", type=Path, default=Path("runs/inbetween-cmu"))
    parser.add_argument("--out", type=Path, default=Path("src/poise/data/inbetween/model.safetensors"))
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    task, steps = begin(args.work, args.library, config_of(args), 0.0, args.steps, print)
    print(f"{len(task.bank.clips)} clips, {task.data.frames} frames with mirrored ones", flush=True)
    if args.score:
        model = load_model(args.out)
    else:
        first = None if args.first is None else load_model(args.first)
        model, _, stopped = train(
            task, args.work, steps, args.minutes, shown, False, validate_every=200, first=first
        )
        if stopped:
            return
        args.out.parent.mkdir(parents=True, exist_ok=True)
        save_model(args.out, model, half=True)
    ways = WAYS if args.adaptation else {}
    found = {
        **model.meta, "frames_with_mirrored": task.data.frames, **figures(model, task, ways),
        "learned_from": names(task, "train"), "held_out": names(task, "final"),
        "choices": names(task, "validation"), "machine": f"{args.threads} threads, no GPU",
    }  # fmt: skip
    Path(__file__).with_suffix(".json").write_text(json.dumps(found, indent=2) + "\n")
    print(args.out, args.out.stat().st_size)


if __name__ == "__main__":
    main()
