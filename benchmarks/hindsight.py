"""A policy that yields without being told a force: hindsight perturbation (CHIP), on top of the policy
that comes with Poise.

    python benchmarks/hindsight.py --clips CLIP [CLIP ...] --work DIR -o FILE.json [--minutes M]

Hands are pushed while the policy goes on learning to stand and to do the clips; what it is to reach
stays where it is, and the goal that it sees lies where a spring of the commanded stiffness would have to
pull from. Then a standing character's hands are pushed with 10 N: the policy before, and the one that
has learned, both with goals that do not move. Resumable.
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from going_on import as_lesson, gone_on

import poise
from poise.control import Stiffness
from poise.env.pushes import Pushes
from poise.formats import read_clip
from poise.jobs.open import open_run
from poise.jobs.track import imitation_of, track
from poise.jobs.track.placement import place
from poise.jobs.tracker import Tracker
from poise.learn import Until
from poise.motion import Clip
from poise.papers.compliant.figures import measure
from poise.papers.compliant.motions import standing
from poise.recipes.imitation import Imitation

WALK = Path(poise.__file__).parent / "data/walk.bvh"
#: N/m that are asked for; N and s of the pushes; s between them.
ASKED, NEWTONS, LASTS_S, EVERY_S = 100.0, (0.0, 25.0), 1.0, (0.0, 0.6)
#: N with which is measured.
MEASURED_N = 10.0


def lesson(tracker: Tracker, clips: Sequence[Clip], worlds: int, seed: int) -> Imitation:
    """Standing, two times, the clips, and hands that are pushed."""
    still = standing(tracker, 4.0).library.clips[0]
    task = imitation_of(tracker, [place(c, tracker) for c in (still, still, *clips)])
    push = Pushes(NEWTONS, EVERY_S, LASTS_S, task.humanoid.rows_of("hand"), seed=seed)
    own = replace(
        task.task, events=(*task.task.events, push),
        compliance=Stiffness(ASKED, hindsight=True),
    )  # fmt: skip
    return as_lesson(tracker, task, own, worlds, seed)


def figures(tracker: Tracker) -> dict[str, Any]:
    """How stiff hands are that no goal gives way for, by direction, and how a walk is tracked."""
    made = measure(tracker, None, newtons=lambda _: MEASURED_N, threads=1)
    flat = [m.stiffness for m in made if not m.direction[2] and math.isfinite(m.stiffness)]
    every = [m.stiffness for m in made if math.isfinite(m.stiffness)]
    walk = track(read_clip(WALK), tracker, controller="policy", supports="none", threads=1)
    return {
        "horizontal_n_per_m": round(statistics.median(flat), 1),
        "all_n_per_m": round(statistics.median(every), 1),
        "each_n_per_m": [round(m.stiffness, 1) for m in made], "fell": sum(m.fell for m in made),
        "walk_whole": not walk.failures, "walk_mpjpe_mm": round(walk.card.mpjpe_mm, 1),
        "walk_global_mm": round(walk.card.mpjpe_global_mm, 1),
    }  # fmt: skip


def main() -> None:
    """Trains, measures before and after, writes FILE.json."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--clips", type=Path, nargs="+", required=True)
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--minutes", type=float, default=25.0)
    parser.add_argument("--worlds", type=int, default=128)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("-o", type=Path, required=True)
    args = parser.parse_args()
    torch.set_num_threads(1)
    tracker = open_run(None).tracker
    task = lesson(tracker, [read_clip(p) for p in args.clips], args.worlds, args.seed)
    after = gone_on(tracker, task, args.work, Until(minutes=args.minutes))
    found = {
        "command": "python benchmarks/hindsight.py --clips CLIPS --work DIR -o FILE.json",
        "clips": [p.stem for p in args.clips], "asked_n_per_m": ASKED, "minutes": args.minutes,
        "before": figures(tracker), "after": figures(after),
    }  # fmt: skip
    args.o.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
