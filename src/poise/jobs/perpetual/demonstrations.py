"""What a policy is shown: the library's recovery motions as more clips to track
(`env.recovery.planner`), an expert to clone, and optimised trajectories that the expert follows.

recovery clips of the library -> recovery motions from states that lie or stand -> tracked like its clips
"""

from __future__ import annotations

from dataclasses import replace
from math import ceil
from pathlib import Path

import torch
from torch import Tensor

from poise.env import Recovery, Reference
from poise.env.recovery.falls import fall_states
from poise.env.recovery.get_up import GetUpPlanner
from poise.env.recovery.planner import recovery_motions
from poise.errors import PoiseError
from poise.jobs.perpetual.stage_order import Stage
from poise.jobs.warm_start import TrainingCallbacks
from poise.learn import CloneConfig, load_checkpoint, save_checkpoint
from poise.plan import Trajectories, TrajectoryOptimizer
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
    backend = make_backend(imitation.model, min(WORLDS, count), "cpu", threads=1)
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


#: Control steps that the clone sees of each frame of the library, and the most in all: a step is kept as
#: 4 bytes for every number of observation and action, 3.4 kB for 20 bodies, so 2.2 GB.
PER_FRAME, MOST = 16, 640_000
#: The same for the LQR teacher: its feedback takes more to learn.
PER_FRAME_OF_PATHS, MOST_OF_PATHS = 60, 1_000_000
#: From so many control steps on, more rounds are of more use than more steps in each.
MANY = 200_000
#: Worlds for which `CloneConfig` states its steps; in more of them fewer do.
USUAL = 512


def clone_for(frames: int, worlds: int, paths: bool = False) -> CloneConfig:
    """The settings of cloning for a library of `frames` at the control rate, in so many `worlds`.

    Never less than `CloneConfig`'s own 56 steps in 3 rounds, which are 115,000 control steps in 512
    worlds and enough for some minutes of motion. A library of 31,000 frames gets 496,000 in 6 rounds: 4
    times as many, over which the regression takes 5 times as long.

    paths: the teacher is an LQR teacher on optimised trajectories and must stay near to them: less
        noise, more steps.
    """
    each, most = (PER_FRAME_OF_PATHS, MOST_OF_PATHS) if paths else (PER_FRAME, MOST)
    plain, wanted = CloneConfig(), min(each * frames, most)
    if wanted <= MANY:
        rounds, epochs = plain.rounds, plain.epochs
    else:
        rounds, epochs = 5, (6, 3)
    steps = ceil(wanted / ((rounds + 1) * worlds))
    noise = (0.0, 0.5, 1.0) if paths else plain.noise
    least = ceil(plain.steps * min(1.0, USUAL / worlds))
    return CloneConfig(steps=max(least, steps), rounds=rounds, epochs=epochs, noise=noise)


#: The file of a run folder with the trajectories of its clips, as far as they were optimised.
PATHS = "paths.safetensors"


def find_paths(
    imitation: Imitation, folder: Path, threads: int, tell: TrainingCallbacks
) -> Trajectories:
    """A trajectory for every clip; goes on with what the folder holds of an unfinished optimisation."""
    config: Perpetual = imitation.config
    assert config.trajopt is not None
    search = TrajectoryOptimizer(imitation.reference, config.sim, config.trajopt, threads)
    path, names = folder / PATHS, list(imitation.reference.names)
    if path.exists():
        state, meta = load_checkpoint(path)
        if meta.get("clips") != names or state["qpos"].shape != search.qpos.shape:
            raise PoiseError(
                "it holds trajectories of other clips", path, "Remove it, or choose another folder"
            )
        search.load_state(state)
    while not search.done:
        stats = search.iterate()
        save_checkpoint(path, search.state(), {"kind": "paths", "clips": names})
        if tell.path is not None:
            tell.path(stats, config.trajopt.iterations)
    return search.trajectories()
