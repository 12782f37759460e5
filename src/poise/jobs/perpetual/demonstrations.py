"""How coming back is learned: a library's recovery motions are more clips to track
(`env.recovery.planner`).

recovery clips of the library -> recovery motions from states that lie or stand -> tracked like its clips
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from poise.env import Recovery, Reference
from poise.env.recovery.falls import fall_states
from poise.env.recovery.get_up import GetUpPlanner
from poise.env.recovery.planner import recovery_motions
from poise.jobs.perpetual.progress import Stage
from poise.recipes.imitation import Imitation
from poise.recipes.perpetual.config import Perpetual
from poise.sim import make_backend

#: m: demonstrations begin no farther away.
FAR = 5.0
#: Characters that fall at once.
WORLDS = 256


def demonstrations(imitation: Imitation) -> Reference:
    """As many recovery motions to one place as `RecoveryPlan.demonstrations` says."""
    config: Perpetual = imitation.config
    humanoid, recovery_clips, count = (
        imitation.humanoid,
        imitation.recovery_clips,
        config.recovering.demonstrations,
    )
    assert recovery_clips is not None
    drop, seed = Recovery.phc(config.faithful, "primitive").drop, int(config.seed)
    backend = make_backend(humanoid.model, min(WORLDS, count), "cpu", threads=1)
    try:
        drop = replace(drop, count=-(-count // 2))
        falls = fall_states(backend, humanoid, imitation.task.pd, drop, seed)
    finally:
        backend.close()
    rate = imitation.reference.rate_hz
    motions = recovery_motions(
        GetUpPlanner(recovery_clips, humanoid.table, rate), falls, FAR, count, seed
    )
    return Reference(humanoid, list(motions.values()), rate, list(motions))


def practised(imitation: Imitation, stage: Stage) -> Imitation:
    """What a stage's characters practise: the library, in a stage that recovers with recovery motions
    besides, and in the stage of the recovery primitive recovery motions alone."""
    if imitation.recovery_clips is None or stage.recovers is None:
        return imitation
    shown = demonstrations(imitation)
    alone = stage.kind == "recovery"
    return replace(imitation, reference=shown if alone else imitation.reference.joined(shown))


def odds(imitation: Imitation, stage: Stage, library: Tensor, length: Tensor) -> Tensor:
    """Odds of the clips of what is `practised`, of `length (C,)` frames, from the odds `(L,)` of the
    library's: `RecoveryPlan.demonstration_share` of all episodes are recovery motions, or all are."""
    if imitation.recovery_clips is None or stage.recovers is None:
        return library
    length, share = length.cpu().double(), imitation.config.recovering.demonstration_share
    if stage.kind == "recovery":
        return length
    recovery_clips = length[len(library) :]
    return torch.cat(
        (library * (1 - share) / library.sum(), recovery_clips * share / recovery_clips.sum())
    )
