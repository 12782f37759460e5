"""Opening a door with a hand on its knob (Deep Compliant Control, Sec. 5.4)."""

# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false
# pyright: reportUnknownVariableType=false
from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, ClassVar

import torch
from torch import Tensor

from poise.body import Humanoid
from poise.env.events import EpisodeStart
from poise.env.frame import DoneTerm, Frame, ObsTerm, RewardTerm
from poise.env.reference import Reference
from poise.env.scene_events import InScene, SceneEvent, ScenePart, SetDown, Varied
from poise.errors import PoiseError
from poise.motion.rotations import quat_conj, quat_rotate
from poise.papers.compliant.scenes.stage import STARTS, SceneSetup, hand_of
from poise.score import Spread
from poise.settings import Range, Share, validate
from poise.sim import Drive, Link, SceneSim
from poise.sim.props import Door

#: s of the motion: the hand is at the knob, lets go of it, and the motion ends; how wide it opens, rad.
GRIPS_S, LETS_GO_S, LASTS_S, OPENS = 1.4, 4.2, 5.0, 0.8
#: The angle that the task asks for, rad, and how fast the reward falls below it (Sec. 5.4).
WANTED, SHARPNESS = 0.7, 1.5
#: s after which the motion's door begins to open and before which it has, from grip and release on;
#: 1/m^2, how fast the reward falls off the knob's arc; N, the usual force across it.
OPENING_S, ARC_SHARPNESS, ACROSS_N = (0.1, 0.3), 10.0, 60.0
#: Makes of a door that is drawn for each episode; where each one's knob is, as terms read it.
MAKES, KNOB = 8, "door/knob"
#: How near the hand must come to the knob, m.
NEAR_M = 0.25
#: s after the hand should be at the knob, until it must be there.
LATE_S = 0.3
#: m, how loosely the weld holds the turn of the hand (`Link.turn_m`). Held as firmly as its place the
#: arm is a strut between torso and door, and a policy that has not learned with it falls.
TURN_M = 0.01
#: m, the knob from the middle of the hand along the way the door opens.
AHEAD_M = 0.06


@dataclass(frozen=True)
class DoorScene:
    """A door in front of the character, and a weld of its left hand and the knob while it opens it.

    The motion faces +X. Doors of all widths have their knob where the hand comes to; the hinge is on the
    right, farther away for wider ones. The force of the weld across the knob's way is felt alone.

    Attributes:
        width: m.
        weight: kg.
        made_for: m, how wide the door is for which the motion is made; None: this one. The paper has its
            character learn at 1 m and try up to 1.7.
        widths: m, between which each episode's door is drawn; None: all have `width`.
        arc: share of the task's reward that is paid for a hand on the knob's arc, see `on_arc`; none in
            the paper, which pays for the angle alone.
    """

    rate_hz: ClassVar[float | None] = None
    starts: ClassVar[Spread] = STARTS

    width: Annotated[float, Range(0, 10, above=True, below=True, unit="m")] = 1.0
    weight: Annotated[float, Range(0, 1000, above=True, below=True, unit="kg")] = 20.0
    made_for: Annotated[float, Range(0.5, 3, unit="m")] | None = None
    widths: Annotated[tuple[float, float] | None, Range(0.5, 3, rising=True, unit="m")] = None
    arc: Share = 0.5

    def __post_init__(self) -> None:
        validate(self, "door")

    def stage(self, humanoid: Humanoid, reference: Reference) -> SceneSetup:
        """The door, the weld and the task's terms.

        Raises:
            PoiseError: no left hand, or a door that is narrower than the body.
        """
        row, broad = hand_of(humanoid, "left", "door"), breadth(humanoid, reference)
        low, high = self.widths or (self.width,) * 2
        if low < broad:
            what = f"the door is {low:g} m wide and the body {broad:.2f} m: it cannot pass"
            raise PoiseError(what, "door", f"Give --width {broad + 0.2:.1f} or more", code="too-narrow")
        frame = min(round(GRIPS_S * reference.rate_hz), int(reference.length[0]) - 1)
        hand = float(reference.pose.pos[frame, row, 0]), float(reference.pose.pos[frame, row, 1])
        up, many = float(reference.pose.pos[frame, row, 2]), 1 if low == high else MAKES
        widths = [low + (high - low) * k / max(many - 1, 1) for k in range(many)]
        makes = tuple(self._make(w, hand, up, humanoid.bodies[row]) for w in widths)
        door, link = makes[0]
        told = {KNOB: torch.tensor([leaf.knob for leaf, _ in makes])}
        drawn = (Varied(makes, told),) if many > 1 else ()
        part = InScene(
            sees=(door.name,), felt=(link.name,), felt_part={link.name: across},
            events=(*drawn, SetDown(door.name, (0.0,)), Grip(humanoid.bodies[row], door, many > 1)),
        )  # fmt: skip
        known = {"row": row, "knob": None if drawn else torch.tensor(door.knob)}
        return SceneSetup(
            (door,), (link,), (), (part,),
            (ObsTerm("task/phase", phase), ObsTerm("task/knob", knob_seen, known)),
            (
                RewardTerm("task/open", opened, 1.0 - self.arc, imitation=False),
                RewardTerm("task/arc", on_arc, self.arc, known, imitation=False),
            ),
            (DoneTerm("task/missed", missed, known),), from_start=True,
        )  # fmt: skip

    def _make(self, width: float, hand: tuple[float, float], up: float, body: str) -> tuple[Door, Link]:
        """A door with its knob where the hand comes to, m, and its weld."""
        (x, y), usual = hand, Door(width=width, mass=self.weight, knob_up=up)
        ahead, along, _ = usual.knob
        door = replace(usual, pos=(x + AHEAD_M - ahead, y - along, 0.0))
        at = door.knob
        link = Link("grip", body, door.name, at=at, turn_m=TURN_M, measured=True, touch=False)
        return door, link


def breadth(humanoid: Humanoid, reference: Reference) -> float:
    """How broad a body is from shoulder to shoulder, or thigh to thigh, m."""
    rows, pos, widest = humanoid.table.rows, reference.pose.pos[0], 0.0
    for kind in ("upper_arm", "thigh"):
        sides = [i for i in humanoid.rows_of(kind) if rows[i].side]
        for a in sides:
            for b in sides:
                across_m = float((pos[a, :2] - pos[b, :2]).norm())
                thick = max((g.size[0] for g in rows[a].geoms), default=0.0)
                widest = max(widest, across_m + 2.0 * thick if a != b else 0.0)
    return widest


def way(sim: SceneSim, door: str = "door") -> Tensor:
    """`(N, 3)` along which the knob moves: the leaf's normal, away from its front."""
    quat = sim.backend.state.xquat[:, sim.scene.place(door).body].double()
    return quat_rotate(quat, torch.tensor([1.0, 0.0, 0.0]).to(quat).expand(len(quat), 3))


def across(part: ScenePart, force: Tensor) -> Tensor:
    """The part of a force that does not move the knob."""
    n = way(part.sim).to(force)
    return force - (force * n).sum(-1, keepdim=True) * n


def phase(frame: Frame) -> Tensor:
    """phi in [0, 1] `(N, 1)`, place in the motion."""
    return frame.phase.unsqueeze(1)


def knob_seen(frame: Frame, row: int, knob: Tensor | None) -> Tensor:
    """The knob from the hand, in the hand's axes, and how far the door is open `(N, 4)`, m and rad.

    knob: `(3,)` m in the leaf's frame, of all doors; None: of each as `KNOB` tells.
    """
    quat, pos = frame.source("door/quat"), frame.source("door/pos")
    there = pos + quat_rotate(quat, _knob(frame, knob)) - frame.sim.pos[:, row]
    seen = quat_rotate(quat_conj(frame.sim.quat[:, row]), there)
    return torch.cat((seen, angle(frame).unsqueeze(1)), 1)


def _knob(frame: Frame, knob: Tensor | None) -> Tensor:
    """`(N, 3)` m, in the leaf's frame."""
    pos = frame.source("door/pos")
    return (frame.source(KNOB) if knob is None else knob).to(pos).expand_as(pos)


def on_arc(frame: Frame, row: int, knob: Tensor | None) -> Tensor:
    """r = exp(-10 |p_hand - p|^2 - f / 60 N), p where the hand holds the knob of this door, turned about
    its hinge by the angle at which the motion has its own one, f the force across the knob's way; 1
    while the motion does not hold it.

    So a hand that follows the motion along the arc of another door is paid for the arc of this one, and
    for not being dragged onto it.
    """
    seconds = frame.phase * LASTS_S
    first, last = GRIPS_S + OPENING_S[0], LETS_GO_S - OPENING_S[1]
    x = ((seconds - first) / (last - first)).clamp(0.0, 1.0)
    half = 0.5 * OPENS * x * x * x * (10.0 + x * (6.0 * x - 15.0))
    nothing = torch.zeros_like(half)
    turn = torch.stack((half.cos(), nothing, nothing, -half.sin()), 1)
    held = _knob(frame, knob) - torch.tensor([AHEAD_M, 0.0, 0.0]).to(half)
    off = frame.source("door/pos") + quat_rotate(turn, held) - frame.sim.pos[:, row]
    reward = torch.exp(-ARC_SHARPNESS * off.square().sum(-1) - frame.source("load") / ACROSS_N)
    return torch.where((seconds > GRIPS_S) & (seconds < LETS_GO_S), reward, 1.0)


def missed(frame: Frame, row: int, knob: Tensor | None) -> Tensor:
    """The hand is not at the knob while the motion has it there `(N,)`.

    A hand that is held costs balance and the door's reward is not nothing for a closed one: without this
    end what is learned is to keep away from the knob.
    """
    seconds = frame.phase * LASTS_S
    due = (seconds > GRIPS_S + LATE_S) & (seconds < LETS_GO_S)
    return due & (knob_seen(frame, row, knob)[:, :3].norm(dim=1) > NEAR_M)


def angle(frame: Frame) -> Tensor:
    """How far the door is open, away from the character, rad `(N,)`."""
    return -frame.source("door/qpos")[:, 0]


def opened(frame: Frame) -> Tensor:
    """r = exp(-1.5 max(0, .7 - phi)), phi the angle of the door."""
    return torch.exp(-SHARPNESS * (WANTED - angle(frame)).clamp_min(0.0))


@dataclass
class Grip(SceneEvent):
    """The weld of a hand and a door's knob: on while the motion has it there and the hand is near.

    Attributes:
        hand: the body.
        door: the prop.
        varied: whether worlds have doors of different widths.
    """

    hand: str
    door: Door
    varied: bool = False

    def enter(self, sim: SceneSim, control_hz: float) -> None:
        self._sim, self._hz = sim, control_hz
        self._hand = sim.scene.model.body(self.hand).id
        self._leaf = sim.scene.place(self.door.name).body
        links = sim.scene.scene.links
        self._row = [link.name for link in links].index("grip")
        knob = torch.tensor(self.door.knob).to(sim.backend.device)
        self._knob = knob.expand(sim.num_envs, 3)
        if self.varied:
            # The place of the weld's hook on each world's leaf.
            hook = sim.scene.model.site(links[self._row].hook).id
            self._knob = sim.backend.expand("site_pos")[:, hook]
        self.steps = torch.zeros(sim.num_envs, dtype=torch.long, device=sim.backend.device)

    def rows(self) -> dict[str, Tensor]:
        return {"steps": self.steps}

    def begin(self, episodes: EpisodeStart) -> None:
        worlds = episodes.worlds
        self.steps[worlds] = 0
        self._sim.switch("grip", False, worlds)

    def before_step(self, drive: Drive) -> bool:
        state, seconds = self._sim.backend.state, self.steps / self._hz
        on = state["eq_active"][:, self._row].bool()
        if len(rows := (on & (seconds >= LETS_GO_S)).nonzero().squeeze(-1)):
            self._sim.switch("grip", False, rows)
        due = ~on & (seconds >= GRIPS_S) & (seconds < LETS_GO_S)
        quat = state.xquat[:, self._leaf].double()
        knob = state.xpos[:, self._leaf] + quat_rotate(quat, self._knob.to(quat))
        close = (state.xpos[:, self._hand] - knob).norm(dim=-1) < NEAR_M
        if len(rows := (due & close).nonzero().squeeze(-1)):
            self._sim.switch("grip", True, rows, self._knob[rows])
        return False

    def after_step(self) -> None:
        self.steps += 1
