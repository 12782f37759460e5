"""An adversarial style reward, with and without: Deep Compliant Control's discriminator beside the
imitation reward, on top of the policy that comes with Poise, while the character gives way.

    python benchmarks/adversarial_style.py --clips CLIP [...] --unseen CLIP [...] --work DIR -o FILE.json

Two trainings from the same policy, for equally many control steps, with hands pushed and a level of
compliance of 0.16: by the imitation reward alone, and by half of it and half the discriminator's,
r = 1 - 0.2 (D - 1)^2 without a floor (Eqs. 12 and 13). Then each policy alone does the clips and others
that neither has trained on. Resumable.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from going_on import as_lesson, gone_on

from poise.control import Compliance
from poise.env.observations import style_terms
from poise.env.pushes import Pushes
from poise.formats import read_clip
from poise.jobs.open import open_run
from poise.jobs.track import imitation_of, track
from poise.jobs.track.placement import place
from poise.jobs.tracker import Tracker
from poise.learn import AmpConfig, Until
from poise.motion import Clip
from poise.recipes.imitation import Imitation

LEVEL = 0.16
FIGURES = ("succ", "mpjpe_mm", "mpjpe_global_mm", "acc_mm_per_frame2", "foot_slide_mm_per_s", "jerk")


def lesson(tracker: Tracker, clips: Sequence[Clip], worlds: int, seed: int) -> Imitation:
    """The clips with hands that are pushed, and goals that give way."""
    task = imitation_of(tracker, [place(c, tracker) for c in clips])
    push = Pushes((10.0, 60.0), (0.5, 1.5), 0.3, task.humanoid.rows_of("hand"), seed=seed)
    own = replace(
        task.task, events=(*task.task.events, push), compliance=Compliance(LEVEL),
        style=style_terms(task.humanoid),
    )  # fmt: skip
    return as_lesson(tracker, task, own, worlds, seed)


def figures(tracker: Tracker, clips: Sequence[Clip]) -> dict[str, float]:
    """Means over clips, by the policy alone."""
    made = [track(c, tracker, controller="policy", supports="none", threads=1) for c in clips]
    cards = [m.card.to_dict() for m in made]
    return {k: round(float(np.mean([c[k] for c in cards])), 2) for k in FIGURES}


def main() -> None:
    """Trains twice, looks three times, writes FILE.json."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--clips", type=Path, nargs="+", required=True)
    parser.add_argument("--unseen", type=Path, nargs="+", required=True)
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--samples", type=int, default=1_000_000)
    parser.add_argument("--worlds", type=int, default=128)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("-o", type=Path, required=True)
    args = parser.parse_args()
    torch.set_num_threads(1)
    tracker = open_run(None).tracker
    clips, unseen = ([read_clip(p) for p in paths] for paths in (args.clips, args.unseen))
    task = lesson(tracker, clips, args.worlds, args.seed)
    found: dict[str, Any] = {
        "command": "python benchmarks/adversarial_style.py --clips C --unseen C --work DIR -o FILE.json",
        "samples": args.samples, "clips": [p.stem for p in args.clips],
        "unseen": [p.stem for p in args.unseen], "rows": {},
    }  # fmt: skip
    ways = {"before": tracker}
    for name, style in (("without", None), ("with", AmpConfig.compliant(product=False))):
        ways[name] = gone_on(tracker, task, args.work / name, Until(samples=args.samples), style)
    for name, policy in ways.items():
        row = {"clips": figures(policy, clips), "unseen": figures(policy, unseen)}
        found["rows"][name] = row
        print(name, row, flush=True)
        args.o.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
