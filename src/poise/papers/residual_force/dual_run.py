"""Runs of the dual policy: begun, and opened with motions of its kinematic policy that are followed.

run = opened("run")                      # what poise train dual-policy wrote
run.episode(0), run.score()

run/
    generator.safetensors   the kinematic policy that is followed
    run.safetensors         the run file, as of every run (`jobs.run_file`)
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from poise.body import Humanoid
from poise.env import Reference
from poise.errors import PoiseError
from poise.jobs.endless.model import GENERATOR, GeneratorModel, load_generator
from poise.jobs.open import Run
from poise.jobs.run_file import RUN_FILE, RunFile, body_facts, held_run, write_run
from poise.jobs.tracker import Tracker
from poise.kinematics import fit_humanoid, qpos_to_clip
from poise.motion import Clip, ClipLibrary
from poise.papers.residual_force.dual_policy import DualPolicy, build, dual_task
from poise.recipes.imitation import Imitation
from poise.settings import from_data, to_data

#: The recipe, as run files name it.
NAME = "dual-policy"
#: Motions of a run that are played and scored, and segments of each; the seed from which they are drawn.
SHOWN, SEGMENTS, SEED = 4, 5, 0


def config_of(data: Mapping[str, Any], where: Path | str | None = None) -> DualPolicy:
    """The settings that a run holds as JSON data."""
    return from_data(DualPolicy, data, where)


def begin(folder: Path, model: GeneratorModel | None, tracker: Tracker, config: DualPolicy) -> Imitation:
    """Builds the task on a policy's body and writes the run file, with the kinematic policy beside it.

    model: by default that of the run that is there, and of a new one that of Poise.

    Raises:
        PoiseError: the folder holds another run or one of another kinematic policy, the kinematic policy
            is of another body, or it makes frames at another rate.
    """
    if (folder / RUN_FILE).exists():
        file = held_run(folder, NAME, config, config_of)
        own = load_generator(folder / GENERATOR)
        if model is not None and dict(model.about) != dict(own.about):
            raise PoiseError(
                "the folder holds a run of another kinematic policy",
                folder,
                "Leave the kinematic policy out, or choose another folder",
                code="settings-differ",
            )
        return followed(file, config)
    model = model or load_generator()
    if model.fps != config.sim.control_hz:
        raise PoiseError(
            f"the kinematic policy makes {model.fps:g} frames a second, the task has "
            f"{config.sim.control_hz:g} control steps",
            hint=f"Give --set sim.control_hz={model.fps:g}",
            code="rate-differs",
        )
    made = build(model.generator(tracker.humanoid), tracker.humanoid, tracker.example, config)
    made.check(config.num_envs)
    library, meta = ClipLibrary.of(tracker.example), {"recipe": NAME, "config": to_data(config)}
    folder.mkdir(parents=True, exist_ok=True)
    model.save(folder / GENERATOR)
    write_run(folder, library, meta | body_facts(tracker.humanoid, library.names))
    return made


def followed(file: RunFile, config: DualPolicy) -> Imitation:
    """The task of a run, which follows its kinematic policy."""
    humanoid, example = _body(file)
    model = load_generator(file.path.parent / GENERATOR)
    return build(model.generator(humanoid), humanoid, example, config)


def _body(file: RunFile) -> tuple[Humanoid, Clip]:
    example = file.library().clips[0]
    humanoid = file.body(example.skeleton)
    assert humanoid is not None
    return humanoid, example


def shown(model: GeneratorModel, humanoid: Humanoid, example: Clip, config: DualPolicy) -> Imitation:
    """The task of following `SHOWN` motions of the kinematic policy, of `SEGMENTS` segments each, of
    which terms are told z."""
    made, rng = model.generator(humanoid).remembering(SHOWN), torch.Generator().manual_seed(SEED)
    every, parts, known = torch.arange(SHOWN), list[Tensor](), list[Tensor]()
    motion = made.begin(SHOWN, rng)
    first = motion.shape[1] - 1
    for _ in range(SEGMENTS):
        parts.append(made.generate(motion[:, -made.past :], every, rng))
        motion = torch.cat((motion, parts[-1]), 1)
        assert made.latent is not None
        known.append(made.latent.clone())
    motions = [m.numpy() for m in motion[:, first:]]
    table, names = humanoid.table, [f"motion {k + 1}" for k in range(SHOWN)]
    clips = tuple(
        qpos_to_clip(q, table, example.skeleton, model.fps, name=n)
        for q, n in zip(motions, names, strict=True)
    )
    reference = Reference(humanoid, motions, model.fps, names)
    task = dual_task(config, humanoid, made.future, torch.stack(known, 1))
    library = ClipLibrary(clips)
    report = fit_humanoid(library, rate_hz=model.fps, table=table, widens=False)[2]
    return Imitation(library, humanoid, reference, report, config, task)


class DualRun(Run):
    """A run of the dual policy: `Run`, whose clips are motions of its kinematic policy."""

    @cached_property
    def task(self) -> Imitation:
        """The task of following motions of the kinematic policy."""
        assert self.file is not None
        humanoid, example = _body(self.file)
        return shown(load_generator(self.path / GENERATOR), humanoid, example, self.config)

    @cached_property
    def tracker(self) -> Tracker:
        raise PoiseError(
            "its policy follows its own kinematic policy, and cannot track others",
            self.path,
            "Give the run of poise train perpetual",
            code="policy-of-own-clips",
        )
