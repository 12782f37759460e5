"""Scenes of Sec. 5.2 and 5.3: throws, hands, chicken, trampoline, a pull at one hand."""

# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false
# pyright: reportUnknownVariableType=false
from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar, Literal

import mujoco
import numpy as np
import torch
from torch import Tensor

from poise.body import Humanoid
from poise.body.humanoid import make_humanoid
from poise.env.events import EpisodeStart
from poise.env.frame import DoneTerm, Frame
from poise.env.pushes import Push
from poise.env.reference import Reference
from poise.env.scene_events import (
    InScene,
    Move,
    SceneEvent,
    ScenePart,
    SetDown,
    Switch,
    Throw,
    always,
    touches_of,
)
from poise.errors import PoiseError
from poise.kinematics.forward import shapes_of
from poise.metrics.shape_points import foot_points
from poise.motion.rotations import quat_rotate
from poise.papers.compliant.scenes.stage import (
    CONTACTS_HZ,
    LINKED,
    STARTS,
    Given,
    SceneSetup,
    as_given,
    eased,
    feels,
    hand_of,
)
from poise.score import Spread
from poise.settings import Checked, Positive, Range, validate
from poise.sim import Drive, Link, Plane, SceneSim, Touch
from poise.sim.props import Ball, Box, Carrier, Vector, solid


@dataclass(frozen=True)
class HandInHand:
    """A partner's hand beside the character, joined to its hand by a ball joint.

    A hand that is carried goes straight, as fast as the motion goes on average and `lead` faster, and
    swings by `sway` along the way and up and down. A partner who is a person does the same motion in a
    mirror, gives way as the character does, and holds what weighs `CLASP_KG` between both hands.

    Attributes:
        side: of the character's hand.
        partner: whether the hand is "carried", or is that of a "person".
        lead: m/s.
        sway: m, to either side.
        every_s: s, the time of a swing.
    """

    rate_hz: ClassVar[float | None] = None
    starts: ClassVar[Spread] = LINKED

    side: Literal["left", "right"] = "left"
    partner: Literal["carried", "person"] = "carried"
    lead: Annotated[float, Range(-10, 10, above=True, below=True, unit="m/s")] = 0.0
    sway: Annotated[float, Range(0, 1, below=True, unit="m")] = 0.1
    every_s: Annotated[float, Range(0.1, above=True, unit="s")] = 2.0

    def __post_init__(self) -> None:
        validate(self, "hands")
        if self.partner == "person" and self.lead:
            raise PoiseError(
                "a partner who is a person goes as fast as the character",
                "hands",
                "Leave the lead out",
                code="settings-conflict",
            )

    def stage(self, humanoid: Humanoid, reference: Reference) -> SceneSetup:
        """The partner's hand where the character's is at first, and the link; its force is felt."""
        row = hand_of(humanoid, self.side, "hands")
        frames, pose = int(reference.length[0]), reference.pose
        x, y, z = (float(v) for v in pose.pos[0, row])
        learned = (feels(humanoid),), (eased(humanoid, HELD_SHARE),)
        if self.partner == "person":
            clasp = Ball(CLASP, 0.03, CLASP_KG, (x, y, z), touched=False)
            link = Link("hands", CLASP, humanoid.bodies[row], "ball", measured=True)
            begins = SetDown(CLASP, (x, y, z, 1.0, 0.0, 0.0, 0.0))
            part = InScene(felt=("hands",), events=(begins, Switch("hands", always)))
            return SceneSetup((clasp,), (link,), (), (part,), *learned, from_start=True)
        way = (pose.pos[frames - 1, 0, :2] - pose.pos[0, 0, :2]).double()
        speed = way * reference.rate_hz / max(1, frames - 1)
        size = float(speed.norm())
        # A motion that stays is led where its left is, or where it goes.
        ahead = speed / size if size > 0.1 else torch.tensor([0.0, 1.0]).double()
        velocity = speed + self.lead * ahead
        name, body = "partner", humanoid.bodies[row]
        prop = Carrier(name, (0.09, 0.09, 0.09), (x, y, z), touched=False)
        part = InScene(
            sees=(name,),
            felt=("hands",),
            events=(Move(name, self._path(velocity, ahead)), Switch("hands", always)),
        )
        link = Link("hands", name, body, "ball", measured=True)
        return SceneSetup((prop,), (link,), (), (part,), *learned, from_start=True)

    def _path(self, velocity: Tensor, ahead: Tensor) -> Callable[[Tensor], tuple[Tensor, Tensor]]:
        w = 2.0 * math.pi / self.every_s

        def path(seconds: Tensor) -> tuple[Tensor, Tensor]:
            t = seconds.double().unsqueeze(1)
            swing, rate = self.sway * torch.sin(w * t), self.sway * w * torch.cos(w * t)
            still = torch.zeros_like(t)
            qpos = torch.cat((velocity * t + ahead * swing, 0.5 * swing, still), 1)
            qvel = torch.cat((velocity + ahead * rate, 0.5 * rate, still), 1)
            return qpos, qvel

        return path


#: The thing that two people hold between them, and its kg.
CLASP, CLASP_KG = "clasp", 0.1
#: The usual force of each scene as a share of the character's weight, see `eased`.
HELD_SHARE, THROWN_SHARE, BUMPED_SHARE, LANDED_SHARE = 0.1, 0.1, 0.5, 1.0
#: What the other one is called in the scene.
RIVAL, PARTNER = "rival", "partner"
#: kg, of the paper's players.
HEAVY_KG, LIGHT_KG = 85.0, 36.0


#: s, how soft a punching bag is. A hard one wedges a player that has fallen under it.
BAG_S = 0.1
#: s into the motion from which on a player hops on one leg; m, a sole below that is on the floor; s
#: after a touch in which a player that learns may catch itself with the other foot.
ONE_LEG_S, SOLE_M, CATCHES_S = 1.2, 0.01, 1.0


class LiftedFoot:
    """The sole of the foot that a player lifts, which is the left one.

    Raises:
        PoiseError: the body has none.
    """

    def __init__(self, humanoid: Humanoid):
        rows = humanoid.table.rows
        found = next((i for i in humanoid.feet if rows[i].side == "left"), None)
        if found is None:
            raise PoiseError(
                "the skeleton has no left foot, which 'chicken' lifts",
                hint=f"Its bodies are {', '.join(humanoid.bodies)}",
                code="body-part-missing",
            )
        still = torch.zeros(len(rows), 3), torch.eye(4)[:1].expand(len(rows), 4)
        self.row, self.points = found, foot_points(*still, shapes_of(humanoid.table), [found])

    def height(self, pos: Tensor, quat: Tensor) -> Tensor:
        """m, of its lowest point `(N,)`, of bodies `pos (N, B, 3)` m and `quat (N, B, 4)`."""
        turn = quat[:, self.row, None].expand(-1, len(self.points), 4)
        arms = quat_rotate(turn, self.points.to(quat).expand(len(quat), -1, 3))
        return (pos[:, self.row, None] + arms)[..., 2].amin(1)

    def put_down(self, frame: Frame, share: float) -> Tensor:
        """Whether it is on the floor after that share of the motion, though nothing touched the player
        for `CATCHES_S` `(N,)`."""
        low = self.height(frame.sim.pos, frame.sim.quat) < SOLE_M
        return low & (frame.phase > share) & (frame.source("since") > CATCHES_S)


@dataclass(frozen=True)
class Chicken:
    """A player hops on one leg and bumps into what weighs as much as its opponent: a punching bag that
    comes at it from all around, as the paper trains it, or the opponent itself, hopping, too. Where it
    learns, it loses once it puts the other foot down, but not in the second after a blow.

    Masses scale inertia, gains and torques of the same body, so that each player alone moves alike.

    Attributes:
        mass, other: kg, of the player and its opponent.
        against: "bag", "rival", or "nobody".
        speed: m/s of the bag, drawn between.
        seed: of the draws.
    """

    rate_hz: ClassVar[float | None] = CONTACTS_HZ
    starts: ClassVar[Spread] = STARTS

    mass: Annotated[float, Range(2, 500, unit="kg")] = HEAVY_KG
    other: Annotated[float, Range(2, 500, unit="kg")] = LIGHT_KG
    against: Literal["bag", "rival", "nobody"] = "bag"
    speed: tuple[float, float] = (0.8, 1.2)
    seed: int = 0

    def __post_init__(self) -> None:
        validate(self, "chicken")

    def stage(self, humanoid: Humanoid, reference: Reference) -> SceneSetup:
        """The bag, its throws and all touches with it; of a rival the touches alone."""
        name = RIVAL if self.against == "rival" else "bag"
        touches = touches_of("felt", name, humanoid.bodies)
        felt = tuple(t.name for t in touches)
        hit = Touch("hit", name, "character")
        touches = (*touches, hit)
        if self.against == "rival":
            part = InScene(metered=(hit.name,), felt=felt)
            return SceneSetup((), (), touches, (part,), (feels(humanoid),), from_start=True)
        chest = humanoid.bodies[(humanoid.rows_of("spine") or (0,))[-1]]
        far = SetDown(name, (30.0, 0.0, 0.5, 1.0, 0.0, 0.0, 0.0))
        throw = Throw(name, chest, self.speed, 1.0, (2.0, 2.0), (-0.1, 0.1), self.seed)
        bag = Box(name, (0.35, 0.35, 0.9), (30.0, 0.0, 0.5), mass=self.other, soft_s=BAG_S)
        comes = (far,) if self.against == "nobody" else (far, throw)
        part = InScene(metered=(hit.name,), felt=felt, events=comes)
        lasts = (int(reference.length[0]) - 1) / reference.rate_hz
        down = DoneTerm("task/put_down", LiftedFoot(humanoid).put_down, {"share": ONE_LEG_S / lasts})
        return SceneSetup(
            (bag,),
            (),
            touches,
            (part,),
            (feels(humanoid),),
            (eased(humanoid, BUMPED_SHARE),),
            (down,),
            from_start=True,
        )


def weighing(humanoid: Humanoid, kg: float) -> Humanoid:
    """The same body with another mass; inertia, gains and torques grow with it.

    What it does under the same angles of its servos stays the same, and so does its policy.
    """
    table = humanoid.table
    s = kg / table.mass
    rows = tuple(
        replace(
            r, mass=s * r.mass, kp=s * r.kp, kd=s * r.kd, torque=s * r.torque, armature=s * r.armature
        )
        for r in table.rows
    )
    return make_humanoid(humanoid.skeleton, replace(table, rows=rows))


@dataclass(frozen=True)
class PullScene:
    """A constant force at one hand.

    Attributes:
        newtons: of it.
        side: of the hand.
        direction: of the force in the world, Z up, of any length.
        start_s: s, when it begins.
        lasts_s: s, for how long.
    """

    rate_hz: ClassVar[float | None] = None
    starts: ClassVar[Spread] = STARTS

    newtons: Annotated[float, Range(0, 1e4, above=True, below=True, unit="N")] = 20.0
    side: Literal["left", "right"] = "left"
    direction: tuple[float, float, float] = (0.0, 1.0, 0.0)
    start_s: Annotated[float, Range(0, unit="s")] = 0.5
    lasts_s: Annotated[float, Range(0, above=True, unit="s")] = 60.0

    def __post_init__(self) -> None:
        validate(self, "pull")
        if not any(self.direction):
            raise PoiseError("a pull needs a direction, got three times 0", "pull", code="out-of-range")

    def stage(self, humanoid: Humanoid, reference: Reference) -> SceneSetup:
        """The force at the hand's centre of mass."""
        row = hand_of(humanoid, self.side, "pull")
        unit = np.asarray(self.direction) / np.linalg.norm(self.direction)
        x, y, z = (float(self.newtons * v) for v in unit)
        rate = reference.rate_hz
        steps = max(1, round(self.lasts_s * rate))
        return SceneSetup(events=(Push(row, (x, y, z), round(self.start_s * rate), steps),))


@dataclass(frozen=True)
class Throws:
    """A ball that comes at the chest from all around, again and again.

    Attributes:
        mass: kg.
        speed: m/s along the ground, drawn between.
        every_s: s between throws, drawn between.
        seed: of the draws.
    """

    rate_hz: ClassVar[float | None] = CONTACTS_HZ
    starts: ClassVar[Spread] = STARTS

    mass: Annotated[float, Range(0, 100, above=True, below=True, unit="kg")] = 1.0
    speed: Annotated[tuple[float, float], Range(0, above=True, rising=True, unit="m/s")] = (2.0, 3.0)
    every_s: Annotated[tuple[float, float], Range(0, above=True, rising=True, unit="s")] = (1.0, 1.5)
    seed: int = 0

    def __post_init__(self) -> None:
        validate(self, "throws")

    def stage(self, humanoid: Humanoid, reference: Reference) -> SceneSetup:
        """A ball that waits far off, touches of each body, and throws; "hit" is metered."""
        chest = (humanoid.rows_of("spine") or (0,))[-1]
        touches = touches_of("felt", "ball", humanoid.bodies)
        hit = Touch("hit", "ball", "character")
        part = InScene(
            metered=(hit.name,),
            felt=tuple(t.name for t in touches),
            events=(
                SetDown("ball", (30.0, 0.0, 0.2, 1.0, 0.0, 0.0, 0.0)),
                Throw("ball", humanoid.bodies[chest], self.speed, every_s=self.every_s, seed=self.seed),
            ),
        )
        paid = (eased(humanoid, THROWN_SHARE),)
        return SceneSetup(
            (Ball(mass=self.mass),), (), (*touches, hit), (part,), (feels(humanoid),), paid
        )


#: s from bounce to bounce, and from a contact on for which the character gives way.
EVERY_S, GIVES_S = 3.0, 1.0
#: s: how long a bounce's actuators are up. N on the feet is contact.
UP_S, CONTACT_N = 0.12, 20.0
#: m, the floor below the plate.
BELOW_M = -1.0


@dataclass(frozen=True)
class Trampoline(Checked):
    """A plate that a spring and a damper at each corner hold at a height that is its control.

    It has three coordinates, the height above `pos`, m, and its tilts about X and Y, rad, and four
    controls, the heights wanted of the corners. Its own weight is carried.

    Attributes:
        name: how the scene calls it.
        size: `(x, y)` m.
        pos: m, the middle of its upper face at rest.
        mass: kg.
        stiffness: N/m, of each corner.
        damping: N s/m, of each corner.
    """

    name: str = "trampoline"
    size: Annotated[tuple[float, float], Range(0, above=True)] = (2.4, 2.4)
    pos: Vector = (0.0, 0.0, 0.0)
    mass: Positive = 20.0
    stiffness: Positive = 4000.0
    damping: Positive = 120.0

    def add(self, spec: mujoco.MjSpec) -> None:
        """Adds one body on a slide and two hinges, and its actuators "NAME/0" to "NAME/3"."""
        half, (x, y) = 0.02, self.size
        body = spec.worldbody.add_body(name=self.name, pos=list(self.pos), gravcomp=1.0)
        for kind, name, axis in (("SLIDE", "z", 2), ("HINGE", "x", 0), ("HINGE", "y", 1)):
            along = [float(i == axis) for i in range(3)]
            joint = getattr(mujoco.mjtJoint, f"mjJNT_{kind}")
            body.add_joint(name=f"{self.name}/{name}", type=joint, axis=along)
        solid(body, self.name, "box", [x / 2, y / 2, half], pos=[0.0, 0.0, -half], mass=self.mass)
        for k, (sx, sy) in enumerate(((-1, -1), (-1, 1), (1, -1), (1, 1))):
            name, corner = f"{self.name}/{k}", [sx * x / 2, sy * y / 2, 0.0]
            body.add_site(name=name, pos=corner)
            foot = [a + b for a, b in zip(self.pos, corner, strict=True)]
            spec.worldbody.add_site(name=f"{name}/foot", pos=foot)
            servo = spec.add_actuator(
                name=name,
                target=name,
                refsite=f"{name}/foot",
                trntype=mujoco.mjtTrn.mjTRN_SITE,
                gaintype=mujoco.mjtGain.mjGAIN_FIXED,
                biastype=mujoco.mjtBias.mjBIAS_AFFINE,
                gear=[0, 0, 1, 0, 0, 0],
            )
            servo.gainprm[0], servo.biasprm[1], servo.biasprm[2] = (
                self.stiffness,
                -self.stiffness,
                -self.damping,
            )


@dataclass(frozen=True)
class TrampolineScene:
    """A rigid plate on four linear actuators, which throws the character up every 3 s.

    Contacts of the feet are given way to for 1 s after the feet have come down again.

    Attributes:
        height: m, by which the actuators rise for a bounce.
        first: s, when the first bounce begins.
        heights: m, between which each episode's height is drawn; None: all have `height`.
    """

    rate_hz: ClassVar[float | None] = CONTACTS_HZ
    starts: ClassVar[Spread] = STARTS

    height: Annotated[float, Range(0, 1, unit="m")] = 0.15
    first: Annotated[float, Range(0, EVERY_S, below=True, unit="s")] = 1.0
    heights: Annotated[tuple[float, float] | None, Range(0, 1, rising=True, unit="m")] = None

    def __post_init__(self) -> None:
        validate(self, "trampoline")

    def stage(self, humanoid: Humanoid, reference: Reference) -> SceneSetup:
        """The plate in place of the floor, its bounces, and the feet's contacts."""
        # In the middle of what the motion crosses.
        low, high = torch.aminmax(reference.pose.pos[:, 0, :2], dim=0)
        x, y = (0.5 * (low + high)).tolist()
        plate = Trampoline(pos=(x, y, 0.0))
        feet = tuple(humanoid.bodies[i] for i in humanoid.feet)
        touches = touches_of("felt", plate.name, feet)
        names = tuple(t.name for t in touches)
        bounce = Bounce(plate.name, self.height, names, self.first, self.heights)
        part = InScene(
            sees=(plate.name,), felt=names, felt_part=dict.fromkeys(names, after_contact),
            events=(SetDown(plate.name, (0.0, 0.0, 0.0)), bounce),
        )  # fmt: skip
        return SceneSetup(
            (plate,),
            (),
            touches,
            (part,),
            (feels(humanoid),),
            (eased(humanoid, LANDED_SHARE),),
            from_start=True,
            floor=Plane(BELOW_M),
            yields=stands_still,
        )


def stands_still(given: Given | None) -> Given:
    """Gives way by the hinges alone: with the root the goal would slide away from under the feet."""
    return replace(as_given(given), root=False)


def after_contact(part: ScenePart, force: Tensor) -> Tensor:
    """A force where the character gives way just now, else 0."""
    bounce = next(h for h in part.events if isinstance(h, Bounce))
    return force * (bounce.gives > 0).to(force).unsqueeze(1)


@dataclass
class Bounce(SceneEvent):
    """A plate's actuators rise for a moment, every 3 s.

    At work it counts, each `(N,)`, `steps`, control steps since the episode began, and `gives`, those
    for which the character gives way yet; `air` is 1 where the feet have left the plate.

    Attributes:
        plate: its name.
        height: m.
        touches: of the feet with it.
        first: s, when the first bounce begins.
        heights: m, between which that of each episode is drawn, `rises` `(N,)`; None: all have `height`.
    """

    plate: str
    height: float
    touches: tuple[str, ...]
    first: float = 1.0
    heights: tuple[float, float] | None = None

    def enter(self, sim: SceneSim, control_hz: float) -> None:
        self._sim, self._hz = sim, control_hz
        self._controls = sim.scene.place(self.plate).controls
        here = sim.backend.device
        self.steps = torch.zeros(sim.num_envs, dtype=torch.long, device=here)
        self.gives, self.air = torch.zeros_like(self.steps), torch.zeros_like(self.steps)
        self.rises = torch.full((sim.num_envs,), self.height, dtype=torch.float64, device=here)

    def rows(self) -> dict[str, Tensor]:
        return {"steps": self.steps, "gives": self.gives, "air": self.air, "rises": self.rises}

    def begin(self, episodes: EpisodeStart) -> None:
        worlds = episodes.worlds
        for value in (self.steps, self.gives, self.air):
            value[worlds] = 0
        if self.heights is not None:
            low, high = self.heights
            drawn = torch.rand(len(worlds), generator=episodes.rng, dtype=torch.float64)
            self.rises[worlds] = low + (high - low) * drawn.to(self.rises.device)

    def before_step(self, drive: Drive) -> bool:
        since = self.steps / self._hz - self.first
        up = (since >= 0.0) & (since.remainder(EVERY_S) < UP_S)
        ctrl = self._sim.backend.drive.ctrl
        ctrl[:, self._controls] = (self.rises.to(ctrl) * up).unsqueeze(1)
        return False

    def after_step(self) -> None:
        self.steps += 1
        force = sum(self._sim.touch(name).force.norm(dim=-1) for name in self.touches)
        stands = torch.as_tensor(force) > CONTACT_N
        down = stands & (self.air > 0)
        self.gives = torch.where(down, round(GIVES_S * self._hz), (self.gives - 1).clamp_min(0))
        self.air = (~stands).long()
