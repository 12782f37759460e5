"""The network that comes with Poise by difficulty, over whole clips, in samples and after adaptation.

    python benchmarks/inbetween_strata.py --library FOLDER --onto FOLDER/.../02_01.amc --work DIR
        -o FILE.json [--skeleton REGEX=FILE.asf] [--model FILE] [--parts strata clips samples adaptation]

All on the clips that `inbetween_cmu.py` keeps apart (`FINAL`); iterations of adaptation are chosen on
`VALIDATION`. Written as it goes.

strata: windows sorted by L2P of interpolation at 30 frames, in thirds; and as many of the easiest as
have 2.3 on average, which is what interpolation has on LAFAN1's.
clips: keyframes every 15 and 30 frames over whole clips, mean distance of joints to the recorded ones.
samples: five motions of a gap of a second in the middle of clips: how many differ from the best guess in
the order of steps or by 0.15 m in the root's path, and how many the doctor finds no fault in.
adaptation: at 30 frames, as a step down the mean loss of all windows, in minibatches, and with beta 0.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from dataclasses import asdict, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from inbetween import choose_iterations, known_of, some_of
from inbetween_baselines import Baseline
from inbetween_cmu import WAYS, config_of

from poise.jobs.inbetween.fill import shipped_model
from poise.jobs.inbetween.inbetween_training import Task, begin
from poise.kinematics.feet import standing_labels
from poise.learn.inbetween_model import InbetweenModel, adapt, load_model
from poise.learn.transition import FilledGap
from poise.metrics import l2p
from poise.motion import Clip, Skeleton
from poise.motion.rotations import forward_kinematics, normalize
from poise.motion.windows import FrameBank
from poise.score.gaps import TestSet, evaluate, predict, score, test_set
from poise.synthesis.filler import Filling, Gap, interpolated
from poise.synthesis.inbetween import fill_keyframes

PARTS = ("strata", "clips", "samples", "adaptation")
#: L2P of interpolation at 30 frames on LAFAN1.
LAFAN1_L2P = 2.3
LENGTHS = (5, 15, 30, 45)


def some(test: TestSet, rows: torch.Tensor) -> TestSet:
    """Some windows of a test set."""
    parts = {k: getattr(test, k)[rows] for k in ("root", "rot", "pos", "quat", "offsets")}
    return test._replace(**parts)


def by_window(net: Any, test: TestSet, length: int = 30) -> torch.Tensor:
    """L2P `(N)` of each window."""
    made, _ = predict(net, test, length)
    pos, _ = test.truth(length)
    own, _ = forward_kinematics(test.parents, test.offsets[:, None], made.root.to(pos), made.rot.to(pos))
    return torch.stack([l2p(a[None], b[None], test.std) for a, b in zip(own, pos, strict=True)])


def strata(model: InbetweenModel, test: TestSet, line: Baseline) -> dict[str, Any]:
    """Figures of interpolation and of the network in windows of one difficulty."""
    hard = by_window(line, test)
    order = hard.argsort()
    third = len(order) // 3
    mean = hard[order].cumsum(0) / torch.arange(1, len(order) + 1)
    like = order[: max(1, int((mean <= LAFAN1_L2P).sum()))]
    groups = {
        "easiest third": order[:third], "middle third": order[third : 2 * third],
        "hardest third": order[2 * third :], "as hard as LAFAN1": like,
    }  # fmt: skip
    return {
        name: {
            "windows": len(rows),
            "interpolation": [asdict(r) for r in evaluate(line, some(test, rows), LENGTHS)],
            "network": [asdict(r) for r in evaluate(model.net, some(test, rows), LENGTHS)],
        }
        for name, rows in groups.items()
    }


def clips_of(bank: FrameBank) -> list[Clip]:
    """The clips of a bank, on their own bones."""
    out = []
    for k, name in enumerate(bank.clips):
        rows = slice(int(bank.first[k]), int(bank.first[k + 1]))
        skeleton = Skeleton(bank.names, bank.parents, bank.offsets[k].double().numpy(), bank.ends)
        rot = normalize(bank.rot[rows].double()).numpy()
        out.append(Clip(skeleton, bank.root[rows].double().numpy(), rot, bank.fps, name))
    return out


def whole_clip(model: InbetweenModel, clip: Clip, every: int) -> dict[str, Any]:
    """A clip with a keyframe every so many frames, interpolated and filled."""
    keys = list(range(0, clip.frames, every))
    gaps = [Gap(a, b) for a, b in pairwise(keys)]
    end, truth = keys[-1] + 1, clip.positions()

    def off(made: Clip) -> float:
        return round(1000 * float(np.linalg.norm(made.positions() - truth, axis=-1)[:end].mean()), 1)

    filled = fill_keyframes(clip, keys, model)
    return {
        "clip": clip.name, "every": every, "gaps": len(gaps), "filled_mm": off(filled.clips[0]),
        "interpolated_mm": off(interpolated(clip, *clip.tensors(), gaps)),
        "faults": len(filled.faults), "over_limit": round(max(filled.over), 2),
    }  # fmt: skip


def steps(clip: Clip, feet: tuple[int, ...]) -> list[tuple[bool, ...]]:
    """Which feet stand, in the order in which that changes."""
    points = torch.tensor(clip.positions()[:, list(feet)])
    rows = [tuple(bool(x) for x in row) for row in standing_labels((points,), clip.fps)[0]]
    return [row for k, row in enumerate(rows) if not k or row != rows[k - 1]]


def samples(model: InbetweenModel, clip: Clip, feet: tuple[int, ...]) -> dict[str, Any]:
    """Five motions of a gap of a second."""
    a = clip.frames // 2 - round(0.5 * clip.fps)
    gap = (a, a + round(clip.fps))
    filled = fill_keyframes(clip, gap, model, Filling(samples=5))
    guess, *others = filled.clips
    paths = [float(np.linalg.norm(c.root_pos - guess.root_pos, axis=-1).max()) for c in others]
    order = [steps(c, feet) != steps(guess, feet) for c in others]
    bad = [sum(f.sample == k for f in filled.faults) for k in range(5)]
    return {
        "clip": clip.name, "root_apart_m": [round(x, 3) for x in paths], "other_steps": sum(order),
        "differ": sum(s or p > 0.15 for s, p in zip(order, paths, strict=True)),
        "faults_by_sample": bad, "without_faults": bad.count(0),
    }  # fmt: skip


def adaptation(model: InbetweenModel, choices: TestSet, final: TestSet) -> dict[str, Any]:
    """Rows at 30 frames before and after each way of adaptation."""
    few, n = some_of(choices, 24), 30
    out: dict[str, Any] = {"before": asdict(evaluate(model.net, final, (n,))[0])}
    before = evaluate(model.net, few, (n,))[0]

    def worth(filled: FilledGap) -> float:
        """Less slide is worth no more than a hundredth of L2P."""
        now = score(few, filled, n)
        return now.slide_mm if now.l2p <= 1.01 * before.l2p else float("inf")

    for name, way in WAYS.items():
        count, _ = choose_iterations(model.net, known_of(few, n), n, worth, way, most=6)
        own = adapt(model.net, known_of(final, n), n, replace(way, iterations=count))
        out[name] = {"iterations": count, **asdict(evaluate(own, final, (n,))[0])}
    return out


def main() -> None:
    """All that is asked for, part by part."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--library", type=Path, required=True)
    parser.add_argument("--onto", type=Path, required=True)
    parser.add_argument("--skeleton", nargs="*", default=[])
    parser.add_argument("--never", nargs="*", default=[])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--model", type=Path)
    parser.add_argument("--parts", nargs="*", default=list(PARTS), choices=PARTS)
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("-o", type=Path, required=True)
    args = parser.parse_args()
    torch.set_num_threads(1)
    task: Task = begin(args.work, args.library, config_of(args), 0.0, 1, print)[0]
    model, protocol, held = load_model(shipped_model(args.model)), task.config.protocol, task.validation
    assert held is not None
    bank = protocol.split(task.bank, "final")
    test = test_set(bank, held.std, protocol)
    found: dict[str, Any] = json.loads(args.o.read_text()) if args.o.exists() else {}

    def keep(name: str, value: Any) -> None:
        found[name] = value
        args.o.write_text(json.dumps(found, indent=1) + "\n")

    keep("command", "python benchmarks/inbetween_strata.py --library FOLDER --onto FILE --work DIR")
    keep("model", {**model.meta, "windows": len(test.root), "measured": time.strftime("%Y-%m-%d")})
    if "strata" in args.parts:
        keep("strata", strata(model, test, Baseline("interpolation", task.data.layout)))
    clips = [c for c in clips_of(bank) if c.frames >= 61]
    if "samples" in args.parts:
        keep("samples", [samples(model, c, bank.feet) for c in clips[::2]])
    if "clips" in args.parts:
        keep("clips", [whole_clip(model, c, every) for every in (15, 30) for c in clips])
    if "adaptation" in args.parts:
        keep("adaptation", adaptation(model, held, test))
    print(args.o, os.getloadavg())


if __name__ == "__main__":
    main()
