"""The players of a chicken fight: how heavy they are, and the opponent that hops, too."""

# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false
# pyright: reportUnknownVariableType=false
from __future__ import annotations

import math
from dataclasses import replace

from poise.control import Compliance, Stiffness
from poise.env import ImitationEnv, Reference
from poise.env.events import InScene, touches_of
from poise.jobs.track import imitation_of
from poise.jobs.track.placement import place
from poise.jobs.tracker import Tracker
from poise.papers.compliant.hopping import AT_SOMEBODY, hopping
from poise.papers.compliant.opponent import Opponent
from poise.papers.compliant.scenes import Chicken, Stage
from poise.papers.compliant.scenes.chicken import RIVAL, weighing
from poise.recipes.imitation import Imitation
from poise.sim import Backend, Character

#: m, between both pelvises at first.
APART_M = 0.85


def weighed(task: Imitation, kg: float, ahead_m: float = 0.0) -> Imitation:
    """A task of a body that weighs so much, `ahead_m` along X from where it was."""
    body, reference = weighing(task.humanoid, kg), task.reference
    qpos = reference.qpos.double().numpy().copy()
    qpos[:, 0] += ahead_m
    names, frames = task.library.names, reference.length.tolist()
    ends = [sum(frames[: k + 1]) for k in range(len(frames))]
    motions = [qpos[end - n : end] for end, n in zip(ends, frames, strict=True)]
    moved = Reference(body, motions, reference.rate_hz, names)
    return replace(task, humanoid=body, reference=moved)


def rival_stage(scene: Chicken, tracker: Tracker, stage: Stage) -> tuple[Stage, Imitation]:
    """The stage with the opponent in it, and the opponent's task; its plug-in comes by `opposing`."""
    clip = hopping(tracker, yaw=math.pi, ways=AT_SOMEBODY)
    task = weighed(imitation_of(tracker, [place(clip, tracker)]), scene.other, APART_M)
    felt = touches_of("back", "character", task.humanoid.bodies, f"{RIVAL}/")
    task = replace(task, task=replace(
        task.task, plugins=(InScene(felt=tuple(t.name for t in felt)),), dones=(), help_by="all"
    ))  # fmt: skip
    rival = Character(task.humanoid, RIVAL)
    return stage._replace(props=(rival,), touches=(*stage.touches, *felt)), task


def opposing(task: Imitation, tracker: Tracker, given: Compliance | Stiffness | None) -> Opponent:
    """The opponent as a plug-in, which gives way as the player does."""
    own = replace(task, task=replace(task.task, compliance=given))

    def make(rows: Backend) -> ImitationEnv:
        return own.env(auto_reset=False, help_scale=0.0, guard=False, backend=rows)

    return Opponent(RIVAL, make, tracker.policy)
