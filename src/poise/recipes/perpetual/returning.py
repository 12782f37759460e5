"""How coming back is learned: ways back of a library are more clips to track (`env.guide`).

ways of the library -> demonstrations from wherever somebody lies or stands -> tracked like its clips
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from poise.env import Recovery, Reference
from poise.env.falls import fall_states
from poise.env.rising import Rising
from poise.env.way_back import return_motions
from poise.env.ways import Ways, find_ways
from poise.recipes.imitation import Imitation
from poise.recipes.perpetual.config import Perpetual
from poise.recipes.perpetual.progress import Stage
from poise.recipes.perpetual.recovery import standing, walking_clips
from poise.sim import make_backend

#: m: demonstrations begin no farther away.
FAR = 5.0
#: Characters that fall at once.
WORLDS = 256


def known_ways(config: Perpetual, reference: Reference) -> Ways | None:
    """What a library knows of coming back; None where recovery is not learned by it."""
    if not (config.recovery and config.recovering.ways) or config.shapes.count > 1:
        return None
    return find_ways(reference, standing(reference), walking_clips(reference))


def demonstrations(imitation: Imitation) -> Reference:
    """As many ways back as `RecoveryPlan.ways` says, to one place, for a library that knows any."""
    config: Perpetual = imitation.config
    humanoid, ways, count = imitation.humanoid, imitation.ways, config.recovering.ways
    assert ways is not None
    drop, seed = Recovery.phc(config.faithful, "primitive").drop, int(config.seed)
    backend = make_backend(humanoid.model, min(WORLDS, count), "cpu", threads=1)
    try:
        drop = replace(drop, count=-(-count // 2))
        falls = fall_states(backend, humanoid, imitation.task.pd, drop, seed)
    finally:
        backend.close()
    rate = imitation.reference.rate_hz
    motions = return_motions(Rising(ways, humanoid.table, rate), falls, FAR, count, seed)
    return Reference(humanoid, list(motions.values()), rate, list(motions))


def practised(imitation: Imitation, stage: Stage) -> Imitation:
    """What a stage's characters practise: the library, in a stage that recovers with its ways back, and
    as the primitive of recovery nothing else."""
    if imitation.ways is None or stage.recovers is None:
        return imitation
    shown = demonstrations(imitation)
    alone = stage.kind == "recovery"
    return replace(imitation, reference=shown if alone else imitation.reference.joined(shown))


def odds(imitation: Imitation, stage: Stage, library: Tensor, length: Tensor) -> Tensor:
    """Odds of the clips of what is `practised`, of `length (C,)` frames, from the odds `(L,)` of the
    library's: `RecoveryPlan.way_share` of all episodes are ways back, or all of them."""
    if imitation.ways is None or stage.recovers is None:
        return library
    length, share = length.cpu().double(), imitation.config.recovering.way_share
    if stage.kind == "recovery":
        return length
    ways = length[len(library) :]
    return torch.cat((library * (1 - share) / library.sum(), ways * share / ways.sum()))
