"""What a training came to: the policy as a file, and its figures without help."""

from __future__ import annotations

import json
from dataclasses import dataclass

from poise.eval import ClipResults, RecoveryCard
from poise.jobs.perpetual.evaluation import FINAL_STAGE, evaluate_clips, try_recovery
from poise.jobs.perpetual.stage_initialisation import staged
from poise.jobs.perpetual.stage_order import Progress
from poise.jobs.perpetual.stage_trainer import StageTrainer
from poise.jobs.run_file import FINAL
from poise.learn.checkpoint import write_atomic
from poise.version import __version__

RESULT = "result.json"


@dataclass(frozen=True, eq=False)
class PerpetualResult:
    """How a training ended.

    last: the last iteration, None where nothing was left to do. interrupted: by Ctrl-C; then there is no
    `results`, which are those of the finished policy on every clip, without help. solved: nothing
    failed any more before the time was over. primitives: how many were trained, beside that of
    recovery. recovery: trials of it with the finished policy, None where it never learned any.
    """

    last: Progress | None
    interrupted: bool
    solved: bool
    primitives: int
    results: ClipResults | None
    recovery: RecoveryCard | None = None


def finish(stages: StageTrainer) -> tuple[ClipResults, RecoveryCard | None]:
    """The policy as a file, and what it does with every clip, without help, and in trials of recovery if
    it learned that, as `result.json`."""
    policy, t, stage = stages.policy(), stages.trainer, stages.stage
    imitation, where = staged(stages.imitation, stage), (stages.threads, stages.device)
    facts = {
        "method": imitation.config.method, "seed": imitation.config.seed, "stage": stage.name,
        "recovers": stages.recovers, "primitives": stages.primitives,
        "solved": stages.finished, "iterations": stages.iteration,
    }  # fmt: skip
    cost = {"samples": t.samples, "seconds": round(t.seconds, 1)}
    results, card = evaluate_clips(imitation, policy, None, 0.0, *where), None
    if stages.recovers:
        card = try_recovery(imitation, policy, imitation.config.recovering.final_trials, *where)
    stages.history.add(stages.iteration, FINAL_STAGE, 0.0, results)
    policy.save(stages.folder / FINAL, t.character, facts | cost)
    names, owner = imitation.library.names, stages.stage_record.owner.tolist()
    rows = [
        {
            "clip": names[c], "succeeded": bool(results.succeeded[k]), "frames": int(results.frames[k]),
            "tracked": int(results.tracked[k]), "mpjpe_mm": round(float(results.mpjpe_mm[k]), 3),
            "mpjpe_global_mm": round(float(results.global_mm[k]), 3), "primitive": owner[c] + 1,
        }
        for k, c in enumerate(results.clip.tolist())
    ]  # fmt: skip
    said = facts | cost | {
        "version": __version__, "help_n": 0.0, "succ": results.rate, "clips": len(rows),
        "mpjpe_global_mm": round(results.error_mm, 3),
        "recovery": {
            "policy": None if card is None else card.to_dict(), "primitive": stages.stage_record.recovery
        },
        "hardest": [names[c] for c in results.hardest(20)], "per_clip": rows,
    }  # fmt: skip
    write_atomic(stages.folder / RESULT, json.dumps(said, indent=2, allow_nan=False).encode())
    return results, card
