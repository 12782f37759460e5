"""Other characters in the same worlds: opponents that act by policies of their own."""

# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false
# pyright: reportUnknownVariableType=false, reportMissingTypeStubs=false
from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from scipy.ndimage import gaussian_filter1d
from torch import Tensor

from poise.body import Humanoid
from poise.control import Compliance, Stiffness
from poise.env import Reference
from poise.env.controls import steps
from poise.env.env import ImitationEnv
from poise.env.events import EpisodeStart, Event, StatedEvent
from poise.env.frame import Frame, Observable
from poise.env.goal import Goal
from poise.env.scene_events import InScene, Switch, always, touches_of
from poise.env.task import Acts, EnvStep
from poise.env.yielding import DisplacedGoal
from poise.errors import PoiseError
from poise.jobs.track import imitation_of
from poise.jobs.track.placement import place
from poise.jobs.tracker import Tracker
from poise.kinematics import Kinematics, qpos_to_clip
from poise.machine import one_thread
from poise.motion.mirror import mirrored_clip
from poise.motion.rotations import heading_quat, lateral_heading, quat_mul, quat_rotate, yaw_quat
from poise.papers.compliant.motions import AT_SOMEBODY, hopping
from poise.papers.compliant.scenes import Chicken, HandInHand, SceneSetup
from poise.papers.compliant.scenes.body_scenes import CLASP, PARTNER, RIVAL, weighing
from poise.papers.compliant.scenes.stage import hand_of
from poise.recipes.imitation import Imitation
from poise.sim import Backend, Character, CharacterRows, Drive, Link, displaced


@dataclass(eq=False)
class Opponent(StatedEvent[Goal, Backend], Event):
    """Given to `TaskConfig.events`: a character of the scene that another environment drives, step by
    step with the one that holds the event.

    Unlike `Teams` it lets one environment be looked at as any other; the other's episodes begin where
    its clip does, with those of all worlds, and never end. At work it has that environment as `env`.

    Attributes:
        name: of the character in the scene.
        make: the environment on its rows, without automatic reset.
        policy: acts for it.
    """

    name: str
    make: Callable[[Backend], ImitationEnv]
    policy: Acts

    def enter(self, goal: Goal, backend: Backend) -> None:
        if not isinstance(backend, CharacterRows) or backend.sim is None or len(backend.places) != 1:
            what = "an opponent needs a scene with one character and itself in each world"
            raise PoiseError(what, f"Opponent '{self.name}'", code="scene-needed")
        rows = backend.sim.characters(self.name)
        self._rows, self.env = rows, self.make(rows)
        self._zero = torch.zeros(rows.num_envs, dtype=torch.long, device=rows.device)
        self._obs = self.env.reset_to(self._zero, self._zero)
        self._held: tuple[Tensor, ...] = ()

    def look(self, ids: Tensor | None) -> None:
        """It begins anew where all worlds do."""
        if ids is None or len(ids) == len(self._zero):
            self._obs = self.env.reset_to(self._zero, self._zero)

    def before_step(self, drive: Drive) -> bool:
        """Its action for the control step that begins."""
        actuation = self.env.controls.actuation
        self.env.drive(self.policy.act(self._obs))
        more = actuation.before() or actuation.pd.interpolate
        self._held, self._k = actuation.held(), 0
        self._rows.push()
        return more

    def before_substep(self, drive: Drive) -> None:
        if self._k:
            self._rows.pull()
        self.env.controls.actuation.substep(self._held, self._k, self.env.substeps)
        self._k += 1
        self._rows.push()

    def after_step(self) -> None:
        self._rows.pull()
        self._obs = self.env.renew(self.env.judge()).obs


class Teams:
    """Environments that share the N worlds of a scene.

    Each is one body with one policy: its own goal, terms, events and help. They act at the same time,
    and then the worlds are stepped once.

    sim = SceneSim(Scene((Character(tall, "anna"), Character(short, "ben"))), num_envs=16)
    teams = Teams(
        {name: task.env(backend=sim.characters(name), guard=False) for name, task in tasks.items()}
    )
    teams.reset()
    step = teams.step({"anna": ..., "ben": ...})

    Args:
        envs: environments on characters of one `SceneSim`, by name.
        ends: whether episodes end per "character", or for all of a "world" at once: where one ends,
            those of the others are cut off like by a time-out.
    """

    def __init__(
        self, envs: Mapping[str, ImitationEnv], ends: Literal["character", "world"] = "character"
    ):
        if not envs:
            raise PoiseError("teams need at least one environment", "Teams", code="environment-missing")
        self.envs, self.ends, self._rows = dict(envs), ends, dict[str, CharacterRows]()
        for name, env in envs.items():
            if not isinstance(env.backend, CharacterRows):
                raise PoiseError(
                    "a team's characters are those of a scene",
                    f"Teams '{name}'",
                    "Make its environment with backend=SceneSim(...).characters(...)",
                    code="scene-needed",
                )
            self._rows[name] = env.backend
        first = next(iter(self._rows.values()))
        self._world = first.world
        if any(rows.world is not self._world for rows in self._rows.values()):
            raise PoiseError(
                "teams act in one scene, these are in several", "Teams", code="scene-differs"
            )
        claimed = [place.name for rows in self._rows.values() for place in rows.places]
        twice = next((name for name in claimed if claimed.count(name) > 1), None)
        if twice is not None:
            raise PoiseError(f"'{twice}' is in two teams", "Teams", code="name-repeated")
        self._substeps = {env.substeps for env in envs.values()}
        if len(self._substeps) != 1:
            raise PoiseError(
                "teams need the same physics steps per control step", "Teams", code="rate-differs"
            )

    @property
    def num_worlds(self) -> int:
        """N."""
        return self._world.num_envs

    def reset(self) -> dict[str, Tensor]:
        """New episodes everywhere; each team's observations."""
        for env in self.envs.values():
            env.reset()
        return {name: env.observe() for name, env in self.envs.items()}

    @one_thread()
    def step(self, actions: Mapping[str, Tensor]) -> dict[str, EnvStep]:
        """One control step for all; `actions` `(N K, A)` of each team."""
        missing = self.envs.keys() ^ actions.keys()
        if missing:
            known = ", ".join(self.envs)
            raise PoiseError(
                f"'{min(missing)}' has no action or no team",
                "Teams",
                f"Teams: {known}",
                code="action-missing",
            )
        for name, env in self.envs.items():
            env.drive(actions[name])
        (substeps,) = self._substeps
        steps([env.controls.actuation for env in self.envs.values()], self._advance, substeps)
        judged = {name: env.judge() for name, env in self.envs.items()}
        if self.ends == "world":
            self._end_together(judged)
        return {name: env.renew(judged[name]) for name, env in self.envs.items()}

    def close(self) -> None:
        """Frees the worlds."""
        self._world.close()

    def _advance(self, count: int) -> None:
        for rows in self._rows.values():
            rows.push()
        self._world.step(count)
        for rows in self._rows.values():
            rows.pull()

    def _end_together(self, judged: Mapping[str, EnvStep]) -> None:
        n = self.num_worlds
        over = torch.zeros(n, dtype=torch.bool, device=self._world.device)
        for step in judged.values():
            over |= (step.terminated | step.truncated).view(n, -1).any(1)
        for step in judged.values():
            many = len(step.terminated) // n
            step.truncated.logical_or_(over.repeat_interleave(many) & ~step.terminated)


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


def rival_stage(scene: Chicken, tracker: Tracker, stage: SceneSetup) -> tuple[SceneSetup, Imitation]:
    """The stage with the opponent in it, and the opponent's task; its event comes by `opposing`."""
    clip = hopping(tracker, yaw=math.pi, ways=AT_SOMEBODY)
    task = weighed(imitation_of(tracker, [place(clip, tracker)]), scene.other, APART_M)
    felt = touches_of("back", "character", task.humanoid.bodies, f"{RIVAL}/")
    task = replace(
        task,
        task=replace(
            task.task,
            events=(InScene(metered=("hit",), felt=tuple(t.name for t in felt)),),
            dones=(),
            help_by="all",
        ),
    )
    rival = Character(task.humanoid, RIVAL, soft=True)
    return stage._replace(props=(rival,), touches=(*stage.touches, *felt)), task


#: m, between both hands of two people; s, over which the way of the one follows that of the other.
HANDS_APART_M, FOLLOWS_S = 0.14, 0.5


def partner_stage(
    scene: HandInHand, tracker: Tracker, task: Imitation, stage: SceneSetup
) -> tuple[SceneSetup, Imitation]:
    """The stage with a partner in it who does the task's motion in a mirror, on a way beside the
    character's so that hand stays by hand; and the partner's task, whose event comes by `opposing`.

    In a sharp turn the partner's feet slide, since it steps like one who turns the other way.

    Raises:
        PoiseError: the body has no hand on the other side or no two thighs, or its joints' names tell no
            sides.
    """
    body, mine = task.humanoid, task.reference
    hand = hand_of(body, scene.side, "hands")
    theirs = hand_of(body, "right" if scene.side == "left" else "left", "hands")
    qpos = mine.qpos[: int(mine.length[0])].double().numpy()
    clip = qpos_to_clip(qpos, body.table, body.skeleton, mine.rate_hz, name=task.library.names[0])
    seen = mirrored_clip(clip).replaced(skeleton=clip.skeleton)
    made = imitation_of(tracker, [place(seen, tracker)])
    moved = made.reference.qpos.double().numpy().copy()
    pos, other = (r.pose.pos.double().numpy() for r in (mine, made.reference))
    even = partial(gaussian_filter1d, sigma=FOLLOWS_S * mine.rate_hz, axis=0, mode="nearest")
    # How the partner is turned, so that it looks where the character does.
    across = even(_across(body, pos))
    turned = yaw_quat(even(np.unwrap(_angle(across) - _angle(_across(body, other)))))
    moved[:, 3:7] = quat_mul(turned, moved[:, 3:7])
    # Where its root is while hand is by hand: beside the character's, which sways to the other side.
    out = across / np.linalg.norm(across, axis=1, keepdims=True)
    arm = quat_rotate(turned, other[:, theirs] - other[:, 0])[:, :2]
    aside = out if scene.side == "left" else -out
    root, sways = pos[:, 0, :2], pos[:, 0, :2] - even(pos[:, 0, :2])
    beside = even(pos[:, hand, :2] + HANDS_APART_M * aside - arm - root)
    moved[:, :2] = root + beside - 2 * (sways * out).sum(1, keepdims=True) * out
    reference = Reference(made.humanoid, [moved], mine.rate_hz, made.library.names)
    link = Link("theirs", CLASP, f"{PARTNER}/{body.bodies[theirs]}", "ball", measured=True)
    part = InScene(felt=(link.name,), events=(Switch(link.name, always),))
    own = replace(made.task, events=(part,), dones=(), help_by="all")
    partner = Character(made.humanoid, PARTNER)
    stage = stage._replace(props=(*stage.props, partner), links=(*stage.links, link))
    return stage, replace(made, reference=reference, task=own)


def _across(body: Humanoid, pos: np.ndarray) -> np.ndarray:
    """`(T, 2)` m, level, from the right thigh to the left one, of bodies' places `(T, B, 3)`."""
    by = {body.table.rows[i].side: i for i in body.rows_of("thigh")}
    if not {"left", "right"} <= by.keys():
        raise PoiseError(
            "the skeleton has no two thighs, by which two people look the same way",
            hint=f"Its bodies are {', '.join(body.bodies)}",
            code="body-part-missing",
        )
    return (pos[:, by["left"]] - pos[:, by["right"]])[:, :2]


def _angle(way: np.ndarray) -> np.ndarray:
    return np.arctan2(way[:, 1], way[:, 0])


def opposing(
    task: Imitation,
    policy: Acts,
    given: Compliance | Stiffness | None,
    begin: Callable[[ImitationEnv], Any] | None = None,
    name: str = RIVAL,
) -> Opponent:
    """The opponent, or partner, as an event, which gives way as the player does.

    begin: is told the opponent's environment before the policy acts in it. name: of its character.
    """
    own = replace(task, task=replace(task.task, compliance=given))

    def make(rows: Backend) -> ImitationEnv:
        env = own.env(auto_reset=False, help_scale=0.0, guard=False, backend=rows)
        if begin is not None:
            begin(env)
        return env

    return Opponent(name, make, policy)


class Undisplaced(NamedTuple):
    """q (-) u of N characters (Sec. 4.2): what they would be if they did not give way.

    pos `(N, B, 3)` m and quat `(N, B, 4)` of all bodies in the world, local `(N, J, 4)` turns of hinged
    bodies, heading `(N, 4)`; before `(N, B, 3)` m, pos one control step earlier.
    """

    pos: Tensor
    quat: Tensor
    local: Tensor
    heading: Tensor
    before: Tensor


class Shifted(Event):
    """Gives terms `frame.shifted`, see `Undisplaced`; given to `TaskConfig.events`.

    The displacement is taken back in the coordinates in which it was added (`sim.displaced`): hinge by
    hinge, where the logarithm of a joint's turn is the difference of its angles, and of the root.

    Attributes:
        before: `(N, B, 3)` m, where the bodies were when the last control step began; in a new episode
            where their velocities say.
    """

    def __init__(self, goal: Goal, backend: Backend):
        table, n, here = goal.humanoid.table, backend.num_envs, backend.device
        self._backend, self._rate = backend, goal.rate_hz
        self._kinematics = Kinematics(table, "float32")
        nothing = torch.zeros(n, goal.humanoid.model.nv, dtype=torch.float64, device=here)
        self._u = goal.offset if isinstance(goal, DisplacedGoal) else nothing
        self.before = torch.zeros(n, len(table.rows), 3, device=here)

    def tells(self) -> Mapping[str, Tensor | Observable]:
        return {"shifted": self._shifted, "shifted/u": self._u, "shifted/before": self.before}

    def begin(self, episodes: EpisodeStart) -> None:
        body = self._kinematics(*(x.float() for x in episodes.start))
        self.before[episodes.rows] = body.pos - body.linvel / self._rate

    def before_step(self, drive: Drive) -> bool:
        """A control step begins."""
        state = self._backend.state
        if bool(self._u.any()):
            undone = displaced(state.qpos.double(), -self._u).float()
            self.before.copy_(self._kinematics(undone).pos)
        else:
            self.before.copy_(state.xpos[:, 1:])
        return False

    def rows(self) -> dict[str, Tensor]:
        return {"shifted/before": self.before}

    def _shifted(self, frame: Frame) -> Undisplaced:
        qpos = displaced(frame.source("qpos").double(), -frame.source("shifted/u")).float()
        body, root, left = self._kinematics(qpos), qpos[:, 3:7], frame.context.left
        heading = heading_quat(root) if left is None else lateral_heading(root, left)
        local = frame.context.local(qpos)
        return Undisplaced(body.pos, body.quat, local, heading, frame.source("shifted/before"))
