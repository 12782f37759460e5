"""Runs of the imitation controller: begun, trained, and played in scenes (Secs. 4, 5.3).

run = opened("run")                      # what poise train compliant-imitation wrote
run.play(HandInHand(lead=0.5)).write(Path("out"))
"""

# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false
from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from poise.control import Compliance
from poise.env import Acts, Reference
from poise.env.pushes import Pushes
from poise.errors import PoiseError
from poise.jobs.open import Run
from poise.jobs.run_file import RUN_FILE, body_facts, held_run, policy_for, write_run
from poise.jobs.tracker import Tracker
from poise.kinematics import qpos_to_clip
from poise.learn import IterationStats, PolicyBundle, RunResult, Until, run
from poise.learn.checkpoint import only_writer
from poise.motion import ClipLibrary
from poise.papers.compliant.imitation_controller import (
    RECIPE,
    CompliantImitation,
    build,
    config_of,
    trainer,
)
from poise.papers.compliant.scene_play import Looked, Played, looked_at, played
from poise.papers.compliant.scenes import PlayScene
from poise.papers.compliant.scenes.body_scenes import HandInHand, PullScene
from poise.recipes.imitation import Imitation
from poise.settings import to_data

#: Scenes in which forces come at the hands, as the controller has learned.
SCENES: tuple[type[PlayScene], ...] = (HandInHand, PullScene)


def begin(folder: Path, library: ClipLibrary, config: CompliantImitation) -> Imitation:
    """Builds the task and writes the run file; a folder that holds another run is refused."""
    held = (folder / RUN_FILE).exists()
    if held:
        held_run(folder, RECIPE["name"], config, config_of, library)
    made = build(library, config)
    if not held:
        meta = {"recipe": RECIPE["name"], "config": to_data(config)}
        write_run(folder, library, meta | body_facts(made.humanoid, made.library.names))
    return made


def train(
    made: Imitation,
    folder: Path,
    until: Until,
    on_iteration: Callable[[IterationStats], bool | None] | None = None,
    threads: int = 0,
    tensorboard: bool = True,
) -> RunResult:
    """Trains until a limit; goes on where a run of the folder stopped."""
    with ExitStack() as held:
        held.enter_context(only_writer(folder))
        learner = trainer(made, threads)
        held.callback(learner.close)
        return run(learner, until, folder, 10, on_iteration, tensorboard)


class ControllerRun(Run):
    """A run of the imitation controller: `Run`, whose policy knows its own clips alone."""

    @cached_property
    def task(self) -> Imitation:
        """The task of the run's clips, without chains."""
        assert self.file is not None
        return build(self.file.library(), replace(self.config, chains=0))

    @property
    def policy(self) -> PolicyBundle:
        """The latest policy."""
        return self.trained[0]

    @cached_property
    def trained(self) -> tuple[PolicyBundle, dict[str, Any]]:
        """The latest policy and what its checkpoint says."""
        return policy_for(self.path, self.task.humanoid, 0.0)

    @cached_property
    def tracker(self) -> Tracker:
        raise PoiseError(
            "its policy knows only the clips that it was trained on, and cannot track others",
            self.path,
            "Give the run of poise train perpetual",
            code="policy-of-own-clips",
        )

    def play(
        self,
        scene: PlayScene,
        level: float | None = None,
        count: int = 16,
        seconds: float = 8.0,
        threads: int = 0,
        name: str = "",
    ) -> Played:
        """A scene in which the controller stands, with compliance and without.

        level: of compliance, None for that of the training.

        Raises:
            PoiseError: a scene in which no force comes at a hand.
        """
        if not isinstance(scene, SCENES):
            raise PoiseError(
                "the imitation controller has learned forces at its hands alone",
                name or "play",
                "Play hands or pull",
                code="option-not-applicable",
            )
        policy, said = self.trained
        given = self.config.level if level is None else level
        both = [
            staged(self.task, scene, policy, seconds, x, count, threads, said) for x in (given, None)
        ]
        return played(scene, both[0], both[1], name)


def still(made: Imitation, seconds: float) -> Imitation:
    """The same task with one goal: the first frame of the clip whose root goes the slowest, held."""
    reference, body = made.reference, made.humanoid
    rows = [
        slice(s, s + n) for s, n in zip(reference.start.tolist(), reference.length.tolist(), strict=True)
    ][: len(made.library)]
    speeds = [float(reference.qvel[r, :2].norm(dim=-1).mean()) for r in rows]
    k = int(np.argmin(speeds))
    frames = max(3, round(seconds * reference.rate_hz) + 1)
    qpos = reference.qpos[rows[k]][:1].numpy().repeat(frames, 0)
    clip = qpos_to_clip(qpos, body.table, body.skeleton, reference.rate_hz, name="standing")
    goal = Reference(body, [qpos], reference.rate_hz, [clip.name])
    report = replace(made.report, clips=(replace(made.report.clips[k], name=clip.name),))
    return replace(made, library=ClipLibrary.of(clip), reference=goal, report=report)


def staged(
    made: Imitation,
    scene: PlayScene | None,
    acts: Acts,
    seconds: float,
    level: float | None,
    count: int,
    threads: int = 0,
    said: dict[str, Any] | None = None,
) -> Looked:
    """Episodes in which a policy stands in a scene, without the training's pushes.

    scene: None where nobody touches, from the same starts as `HandInHand`'s. level: of compliance, None
    for a character that does not give way. said: what its checkpoint says.
    """
    task = still(made, seconds)
    calm = tuple(e for e in task.task.events if not isinstance(e, Pushes))
    compliance = None if level is None else Compliance(level)
    if scene is None:
        own = replace(task.task, events=calm, compliance=compliance)
        return looked_at(HandInHand(), acts, replace(task, task=own), count, threads, said)
    stage = scene.stage(task.humanoid, task.reference)
    own = replace(task.task, events=(*calm, *stage.events), compliance=compliance)
    around = {"props": stage.props, "links": stage.links, "touches": stage.touches}
    return looked_at(scene, acts, replace(task, task=own, **around), count, threads, said)
