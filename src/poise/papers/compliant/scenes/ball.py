"""A ball on a rod that stands on the head (Deep Compliant Control, Sec. 5.4)."""

# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false
# pyright: reportUnknownVariableType=false
from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar

import mujoco
import torch
from torch import Tensor

from poise.body import Humanoid
from poise.control import Compliance, Stiffness
from poise.env.events import EpisodeStart, Felt, Force, StatedEvent
from poise.env.frame import DoneTerm, Frame, ObsTerm, RewardTerm
from poise.env.goal import Goal
from poise.env.pushes import Pushes
from poise.env.reference import Reference
from poise.env.scene_events import InScene, RandomEvent, Switch, Varied, near
from poise.env.yielding import DisplacedGoal
from poise.errors import PoiseError
from poise.motion.rotations import heading_quat, into_heading, quat_rotate
from poise.papers.compliant.scenes.stage import LINKED, Given, SceneSetup
from poise.score import Spread
from poise.settings import Checked, Positive, Range, validate
from poise.sim import Backend, CharacterRows, Drive, Link, SceneSim
from poise.sim.props import Vector, solid

#: Sharpness of the reward, 1/m^2 (Sec. 5.4).
SHARPNESS = 2.0
#: m, the rod's length where nothing else is said.
USUAL_M = 1.0
#: m above the head's joint where the rod stands.
UP_M = 0.2
#: m by which the rod's middle may be farther from the head when it is put there.
NEAR_M = 0.15
#: N for a fictional force of 1 that a policy asks for, and the most of one.
UNIT_N, MOST_N = 100.0, 150.0
#: Makes of a rod that is drawn for each episode, and a number without a factor in common with it.
MAKES, APART = 16, 7
#: Of the linear law, N/m and N s/m.
GAIN, DAMPING = 700.0, 250.0
#: The length of each world's rod, as terms read it.
LENGTH = "rod/length"
#: Of the angle at which a rod counts as fallen.
COS_45 = math.cos(math.pi / 4)
FLAT, UPWARD = torch.tensor([1.0, 1.0, 0.0]), torch.tensor([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Rod(Checked):
    """A free rod that stands on its lower end and carries a ball on the upper one; one body, with the
    lower end as its origin. Nothing touches it, so that what it stands on must be a link.

    Attributes:
        name: how the scene calls it.
        length: m, from the lower end to the ball's centre.
        radius: m, of the ball.
        mass: kg, of the ball; the rod has a tenth of it.
        pos: m, its lower end at first.
    """

    name: str = "rod"
    length: Positive = 1.0
    radius: Positive = 0.08
    mass: Positive = 0.5
    pos: Vector = (0.0, 0.0, 0.0)

    def add(self, spec: mujoco.MjSpec) -> None:
        """Adds one body."""
        body = spec.worldbody.add_body(name=self.name, pos=list(self.pos))
        body.add_freejoint(name=self.name)
        rod, ball = [0.0, 0.0, self.length / 2], [0.0, 0.0, self.length]
        thin = [0.015, self.length / 2]
        solid(body, f"{self.name}/rod", "capsule", thin, False, pos=rod, mass=0.1 * self.mass)
        solid(body, f"{self.name}/ball", "sphere", [self.radius], False, pos=ball, mass=self.mass)


@dataclass(frozen=True)
class Balance:
    """A rod with a ball on its end stands on the head, free to tilt.

    Two fictional forces, at the head and at the root, act on nothing but the goal, which gives way to
    them: so the character moves as it wants the ball to go. A linear law sets them, of where the ball is
    and how fast, against where the head would be without giving way; a policy that learns the scene adds
    to them, six numbers. Since nothing moves by such a force in the simulation, `Stiffness` and
    algorithm1 give way to it, eq8 does not.

    Attributes:
        length: m, of the rod.
        lengths: m, between which each episode's rod is drawn; None: all have `length`.
        masses: kg, between which the ball's is drawn; None: as a `Rod` has it.
        spread: rad, how far it is tilted at first, at random.
        gain, damping: of the linear law, N/m and N s/m.
        pushes: N, of a push at the chest for 0.1 s every 2 to 3 s from all around; 0 is none.
        seed: of the draws.
    """

    rate_hz: ClassVar[float | None] = None
    starts: ClassVar[Spread] = LINKED

    length: Annotated[float, Range(0.1, 5, unit="m")] = USUAL_M
    lengths: Annotated[tuple[float, float] | None, Range(0.1, 5, rising=True, unit="m")] = None
    masses: Annotated[tuple[float, float] | None, Range(0.01, 50, rising=True, unit="kg")] = None
    spread: Annotated[float, Range(0, 1, below=True, unit="rad")] = 0.02
    gain: float = GAIN
    damping: float = DAMPING
    pushes: Annotated[float, Range(0, 10_000, below=True, unit="N")] = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        validate(self, "ball")

    def stage(self, humanoid: Humanoid, reference: Reference) -> SceneSetup:
        """The rod, its joint on the head, the fictional forces and the task's terms.

        Raises:
            PoiseError: a body without a head.
        """
        heads = humanoid.rows_of("head")
        if not heads:
            names = ", ".join(humanoid.bodies)
            raise PoiseError(
                "the skeleton has no head, which 'ball' needs",
                hint=f"It has {names}",
                code="body-part-missing",
            )
        head = heads[-1]
        pose = reference.pose
        x, y, z = (float(v) for v in pose.pos[0, head])
        rods = self.rods((x, y, z + UP_M))
        top, longest = rods[0], max(rod.length for rod in rods)
        # The rod's foot above the head, in the head's own frame.
        up = torch.tensor([0.0, 0.0, UP_M])
        to = quat_rotate(pose.quat[0, head] * torch.tensor([1.0, -1.0, -1.0, -1.0]), up)
        a, b, c = (float(v) for v in to)
        link = Link("stands", humanoid.bodies[head], top.name, "ball", to=(a, b, c))
        close = near(humanoid.bodies[head], top.name, UP_M + longest + NEAR_M)
        stands = Switch(link.name, lambda sim: close(sim) & ~leans(sim), leans)
        # A rod of one make has nothing to draw.
        told = {LENGTH: torch.tensor([rod.length for rod in rods])}
        drawn = (Varied(tuple((rod,) for rod in rods), told, self.seed),) if len(rods) > 1 else ()
        part = InScene(
            sees=(top.name,),
            events=(*drawn, Tilted(top, self.spread, self.seed), stands),
        )
        chest = (humanoid.rows_of("spine") or (0,))[-1]
        force, rate = (self.pushes, self.pushes), reference.rate_hz
        push = Pushes(force, (2.0, 3.0), 0.1, (chest,), rate, self.seed)
        pushes = (push,) if self.pushes else ()
        known = {"head": head, "length": None if drawn else top.length}
        return SceneSetup(
            (top,), (link,), (), (part, *pushes, FictionalForces(self, head)),
            (ObsTerm("task/ball", ball_seen, known),),
            (RewardTerm("task/above", above, 0.5, known, imitation=False),),
            (DoneTerm("task/dropped", dropped),), True, yields=fictional,
        )  # fmt: skip

    def rods(self, pos: Vector) -> tuple[Rod, ...]:
        """The makes of the rod, with the lower end at `pos`: one, or `MAKES` over the lengths and masses
        that are stated, neither growing with the other."""
        usual = Rod()
        lengths, masses = self.lengths or (self.length,) * 2, self.masses or (usual.mass,) * 2
        if lengths[0] == lengths[1] and masses[0] == masses[1]:
            return (Rod(length=lengths[0], mass=masses[0], pos=pos),)
        share = [k / (MAKES - 1) for k in range(MAKES)]
        m, kg = ([low + s * (high - low) for s in share] for low, high in (lengths, masses))
        return tuple(Rod(length=m[k], mass=kg[APART * k % MAKES], pos=pos) for k in range(MAKES))


def fictional(given: Given | None) -> Given:
    """What feels forces that are not simulated: a stiffness, or by a level the law that looks ahead."""
    if isinstance(given, Compliance):
        return replace(given, law="algorithm1")
    return given or Stiffness(1000.0, 0.02, series=False)


@dataclass
class Tilted(RandomEvent):
    """A rod that begins each episode upright but for a random tilt about X and Y.

    Attributes:
        rod: the prop.
        spread: rad, to either side.
        seed: of the draws.
    """

    rod: Rod
    spread: float
    seed: int

    def enter(self, sim: SceneSim, control_hz: float) -> None:
        super().enter(sim, control_hz)
        self._sim = sim

    def begin(self, episodes: EpisodeStart) -> None:
        worlds = episodes.worlds
        half = 0.5 * self.between(-self.spread, self.spread, len(worlds), 2)
        qpos = torch.zeros(len(worlds), 7, dtype=torch.float64)
        qpos[:, :3], qpos[:, 3] = torch.tensor(self.rod.pos), 1.0
        qpos[:, 4:6] = half
        qpos[:, 3:] /= qpos[:, 3:].norm(dim=1, keepdim=True)
        here = self._sim.backend.device
        still = torch.zeros(len(worlds), 6, dtype=torch.float64, device=here)
        self._sim.place(self.rod.name, qpos.to(here), still, worlds)


@dataclass
class FictionalForces(StatedEvent[Goal, Backend], Force):
    """The fictional forces of `Balance`, as an event.

    At work it has `asked` `(N, 6)`: the forces that a policy asks for in the control steps that come,
    at head and root, in units of `UNIT_N` and the heading's axes, beside the linear law; None for none.

    Attributes:
        law: the scene.
        head: the body's row.
    """

    law: Balance
    head: int

    def enter(self, goal: Goal, backend: Backend) -> None:
        if not isinstance(backend, CharacterRows) or backend.sim is None:
            raise PoiseError("'ball' needs the worlds of its scene", "ball", code="scene-needed")
        self.asked: Tensor | None = None
        self._rows, self._sim, self._goal = backend, backend.sim, goal
        like, n = backend.state.xpos, backend.num_envs
        self._body = torch.tensor([self.head + 1, 1], device=like.device).repeat(n, 1)
        self._force = like.new_zeros(n, 2, 3)
        self._length: Tensor | float = self.law.length
        if self.law.lengths is not None:
            ball = self._sim.scene.model.geom("rod/ball").id
            self._length = self._sim.backend.expand("geom_pos")[:, ball, 2:]

    def before_step(self, drive: Drive) -> bool:
        """A control step begins: sets the forces that are held for it."""
        law = self.law
        off, moves, up = self._ball()
        one = up * FLAT.to(off) * (law.gain * off + law.damping * moves)
        force = torch.stack((one, one), 1).to(self._force)
        if self.asked is not None:
            local = UNIT_N * self.asked.unflatten(1, (2, 3)).to(self._force)
            heading = heading_quat(self._rows.state.xquat[:, 1]).unsqueeze(1)
            force = force + quat_rotate(heading.to(local).expand(-1, 2, -1), local)
        size = force.norm(dim=-1, keepdim=True)
        self._force = force * (MOST_N / size.clamp_min(MOST_N))
        return False

    def ask(self, forces: Tensor) -> Tensor:
        """Asks for forces `(N, 6)`, see `asked`, where the ball is up: one that has fallen is let go.
        Whether it is, `(N, 1)`."""
        _, _, up = self._ball()
        self.asked = (up * forces).to(forces)
        return up.bool()

    def _ball(self) -> tuple[Tensor, Tensor, Tensor]:
        """Where the ball is against where the head would be, `(N, 3)` m, its velocity, and 1 where it is
        up `(N, 1)`."""
        off, moves = tipped(self._sim, self._length)
        off = off - self._head()
        return off, moves, (off[:, 2:] > 0.5 * self._length).to(off)

    def _head(self) -> Tensor:
        """`(N, 3)` where the head would be without giving way, m."""
        goal = self._goal.goal if isinstance(self._goal, DisplacedGoal) else self._goal
        return goal.layout.unpacked(goal.now()).pos[:, self.head]

    def felt(self) -> Felt:
        point = self._rows.state.xpos.gather(1, self._body.unsqueeze(-1).expand(-1, -1, 3))
        return Felt(self._body, point, self._force, driven=False)


def tipped(sim: SceneSim, length: float | Tensor) -> tuple[Tensor, Tensor]:
    """`(N, 3)` where the ball is, m, and how fast it moves, m/s. length: m, `(N, 1)` if they differ."""
    place, state = sim.scene.place("rod"), sim.backend.state
    pos, quat = state.xpos[:, place.body], state.xquat[:, place.body]
    arm = quat_rotate(quat, (length * UPWARD.to(quat)).expand_as(pos))
    qvel = state.qvel[:, place.dofs]
    return pos + arm, qvel[:, :3] + torch.linalg.cross(quat_rotate(quat, qvel[:, 3:]), arm)


def leans(sim: SceneSim) -> Tensor:
    """`(N,)` bool: the rod leans by more than 45 degrees, and falls off the head."""
    return upright_of(sim) < COS_45


def upright_of(sim: SceneSim) -> Tensor:
    """`(N,)` the cosine of the rod's angle to upright."""
    quat = sim.backend.state.xquat[:, sim.scene.place("rod").body].double()
    return quat_rotate(quat, torch.tensor([0.0, 0.0, 1.0]).to(quat).expand(len(quat), 3))[:, 2]


def arm_of(frame: Frame, length: float | None) -> tuple[Tensor, Tensor]:
    """`(N, 3)` m, the ball from the rod's foot, and what its height is above that of a rod of `USUAL_M`.

    length: m, of all rods; None: of each as `LENGTH` tells.
    """
    pos, quat = frame.source("rod/pos"), frame.source("rod/quat")
    if length is None:
        every = frame.source(LENGTH).unsqueeze(1) * UPWARD.to(pos)
        return quat_rotate(quat, every), every - USUAL_M * UPWARD.to(pos)
    arm, longer = (torch.tensor([0.0, 0.0, m]).to(pos) for m in (length, length - USUAL_M))
    return quat_rotate(quat, arm.expand_as(pos)), longer


def ball_seen(frame: Frame, head: int, length: float | None) -> Tensor:
    """p and v of ball and rod from the head, in the heading's axes `(N, 12)`, m and m/s.

    Heights are those of a rod of `USUAL_M`, so that a policy knows rods of other lengths, too.
    """
    pos, quat, qvel = (frame.source(f"rod/{k}") for k in ("pos", "quat", "qvel"))
    arm, longer = arm_of(frame, length)
    spin, sim = quat_rotate(quat, qvel[:, 3:]), frame.sim
    from_head, moves = pos - sim.pos[:, head], qvel[:, :3] - sim.linvel[:, head]
    turning = torch.linalg.cross(spin, arm)
    seen = arm - longer
    rows = (from_head + seen, moves + turning, from_head + 0.5 * seen, moves + 0.5 * turning)
    return into_heading(sim.heading, torch.stack(rows, 1)).flatten(1)


def above(frame: Frame, head: int, length: float | None) -> Tensor:
    """r = exp(-2 |p_ball - p_head|^2) along the floor."""
    arm = arm_of(frame, length)[0]
    off = (frame.source("rod/pos") + arm - frame.sim.pos[:, head])[:, :2]
    return torch.exp(-SHARPNESS * off.square().sum(-1))


def dropped(frame: Frame) -> Tensor:
    """`(N,)` bool: the rod leans by more than 45 degrees."""
    quat = frame.source("rod/quat")
    along = quat_rotate(quat, torch.tensor([0.0, 0.0, 1.0]).to(quat).expand(len(quat), 3))
    return along[:, 2] < COS_45
