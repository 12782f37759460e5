"""What many characters find of the motions that the policy alone loses (`jobs.track.recovering`)."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import torch
from field.table import field_table
from perpetual_measure import Run

from poise.env import Acts, ImitationEnv
from poise.jobs.perpetual.evaluation import evaluate_clips
from poise.jobs.track.recovering import look_for, replay
from poise.plan import SamplingConfig, SamplingResult
from poise.recipes.imitation import Imitation
from poise.score.episodes import run_episodes
from poise.score.rollouts import RolloutSet

Tell = Callable[[str], None]


def searched(
    run: Run, task: Imitation, data: str, clips: Sequence[int], config: SamplingConfig, threads: int,
    tell: Tell,
) -> dict[str, Any]:  # fmt: skip
    """The field's table of clips where those that the policy alone loses are searched, and what each of
    these took. Alone, each clip is by itself, as `poise track` has it: trajectories part on rounding."""
    alone = evaluate_clips(task, run.policy, torch.tensor(clips), threads=1, worlds=1)
    rows: list[dict[str, Any]] = []
    found: dict[int, SamplingResult] = {}
    for c, won in zip(clips, alone.succeeded.tolist(), strict=True):
        if won:
            continue
        began = time.perf_counter()
        found[c] = look_for(run.tracker, task, config, c, threads)
        name, f = task.reference.names[c], found[c]
        row = {"clip": name, "steps": len(f.actions), "reached": f.reached, "tries": f.tries}
        rows.append(row | {"seconds": round(time.perf_counter() - began, 1)})
        tell(f"{name}: {f.reached} of {len(f.actions)} steps in {rows[-1]['seconds']:.0f} s")

    def make(worlds: int) -> ImitationEnv:
        return task.bare().env(worlds, None, False, 1, help_scale=0.0, guard=False)

    def rollouts() -> Iterator[RolloutSet]:
        for c in clips:
            acts: Acts = replay(found[c], run.policy) if c in found else run.policy
            clip = torch.tensor([c])
            yield run_episodes(make, acts, clip, torch.zeros_like(clip), cycles=1)[0]

    table = field_table(rollouts(), method=f"{run.name}, searched", data=data).to_dict()
    each = [r["seconds"] / r["steps"] for r in rows]
    return {
        "table": table, "alone": int(alone.succeeded.sum()), "searched": len(rows),
        "found": sum(r["reached"] == r["steps"] for r in rows), "per_clip": rows,
        "characters": config.characters, "threads": threads,
        "seconds_of_a_second": round(run.imitation.config.sim.control_hz * statistics.median(each), 2)
        if each else None,
    }  # fmt: skip
