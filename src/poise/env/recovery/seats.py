"""Seats: a character goes to a box, sits down on it, and gets up again some seconds later.

No clip of the shipped library sits. The motion is planned on the body itself, for the height of the box:

    standing, back to the box -> down, the centre of mass over the feet -> upright -> the same back

Each frame of the way down keeps the feet where they stand. The trunk leans as far forward as brings the
centre of mass over the middle of the feet, so that a body that stopped anywhere would not fall.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated, NamedTuple

import mujoco
import numpy as np
import torch
from torch import Tensor

from poise.body import Humanoid
from poise.env.generator_goal import Footprint
from poise.env.recovery.get_up import GetUpPlanner, mixed, smooth
from poise.env.recovery.planner import way_to_stand
from poise.errors import PoiseError
from poise.motion.rotations import facing, heading_angle, turned
from poise.settings import Checked, Range

#: m, the lowest and the highest seat; m that one is wide at least.
LOWEST, HIGHEST, WIDE = 0.35, 0.5, 0.3
#: Of the way down, and of the way up as if it were done backwards: s that it takes, s that the trunk
#: takes until it is upright, and the power of the share of the way down that is the share of the way
#: back: below 1 hips go back before they go down; m by which the knees are ahead of the ankles. Between
#: them it comes forward on the seat for some s. s that is stood afterwards.
DOWN, UP, FORWARD_S, STANDS_S = (1.6, 0.8, 0.65, 0.15), (1.2, 0.6, 1.6, 0.18), 0.3, 0.3
#: rad, the most that the trunk leans forward, and as it sits; m that a seat gives way.
LEANS, SITS, SINKS = 1.1, 0.45, 0.01
#: rad by which arms swing forward for a rad by which the trunk leans.
SWINGS = 0.6
#: m from the seat's edge to the nearer ankle.
AWAY = 0.08
#: m from the edge to where it walks first, and how near it comes to that.
BEFORE, NEAR = 0.9, 0.6
#: m higher than it sits within which a root is on a seat.
ON_IT = 0.08
#: s that it sits, s from one visit to the next, s until the first one, each between two; s after which a
#: seat that was not come to is given up.
SIT_S, PAUSE_S, FIRST_S, GIVES_UP_S = (4.0, 7.0), (8.0, 16.0), (1.0, 3.0), 40.0


@dataclass(frozen=True)
class Seat(Checked):
    """A box that is sat on.

    Attributes:
        foot: seen from above. top: m, its height.
    """

    foot: Footprint
    top: Annotated[float, Range(LOWEST, HIGHEST, unit="m")]

    def sides(self) -> list[tuple[np.ndarray, np.ndarray, float]]:
        """Of each side that is wide enough: the middle of its edge `(2)` m, the direction away from it
        `(2)`, and m to either side along the edge where there is room."""
        out = list[tuple[np.ndarray, np.ndarray, float]]()
        for k in range(4):
            angle = self.foot.yaw + k * math.pi / 2
            away = np.array([math.cos(angle), math.sin(angle)])
            deep, wide = (self.foot.size[(k + j) % 2] / 2 for j in (0, 1))
            if 2 * wide >= WIDE and 2 * deep >= WIDE:
                out.append((np.array(self.foot.pos) + deep * away, away, max(0.0, wide - WIDE / 2)))
        return out


class SitMotion(NamedTuple):
    """How a body sits down.

    Attributes:
        down, up: `(T, 7 + n)`, from standing at ease to sitting upright, and back.
        gap: m by which the root stands before the seat's edge.
        height: m of the root above the seat.
    """

    down: Tensor
    up: Tensor
    gap: float
    height: float


def sit_down(humanoid: Humanoid, ease: Tensor, top: float, rate_hz: float) -> SitMotion:
    """From standing at ease at `ease (7 + n)` to sitting on a box that is `top` m high.

    Raises:
        PoiseError: a body without pelvis, thighs, shins and feet.
    """
    sitter = _Sitter(humanoid, ease.numpy())
    down, up = (sitter.motion(top, rate_hz, *how) for how in (DOWN, UP))
    share = smooth(torch.linspace(0, 1, round(FORWARD_S * rate_hz) + 1, dtype=torch.float64))
    over = mixed(down[-1:].expand(len(share), -1), up[-1:].expand(len(share), -1), share)
    return SitMotion(down, torch.cat((over[:-1], up.flip(0))), sitter.gap, sitter.low)


class _Limb(NamedTuple):
    """A limb: its hinges' columns among the degrees of freedom, MuJoCo's body at its end, and where that
    is at ease, m, and how it is turned, wxyz."""

    dofs: np.ndarray
    end: int
    pos: np.ndarray
    quat: np.ndarray


class _Sitter:
    """A body whose feet stay while its root moves."""

    def __init__(self, humanoid: Humanoid, ease: np.ndarray):
        self.model, self.ease = humanoid.model, ease
        self.data = mujoco.MjData(self.model)
        self.data.qpos[:] = ease
        mujoco.mj_forward(self.model, self.data)
        angle = heading_angle(torch.tensor(ease[3:7]))
        left = np.zeros(3)
        mujoco.mju_rotVecQuat(left, np.array(humanoid.left), ease[3:7])
        left = np.array([left[0], left[1], 0.0]) / max(float(np.hypot(*left[:2])), 1e-6)
        self.left, self.ahead, self.heading = left, np.cross(left, [0.0, 0.0, 1.0]), angle
        rows = humanoid.table.rows

        def limb(side: str, *kinds: str) -> _Limb | None:
            found = [
                next((i for i, r in enumerate(rows) if (r.kind, r.side) == (kind, side)), None)
                for kind in kinds
            ]
            bodies = [i + 1 for i in found if i is not None]
            if len(bodies) < len(kinds):
                return None
            dofs, end = np.flatnonzero(np.isin(self.model.dof_bodyid, bodies)), bodies[-1]
            return _Limb(dofs, end, self.data.xpos[end].copy(), self.data.xquat[end].copy())

        sides = ("left", "right")
        self.legs = [x for x in (limb(s, "thigh", "shin", "foot") for s in sides) if x is not None]
        self.arms = [x for x in (limb(s, "upper_arm") for s in sides) if x is not None]
        if len(self.legs) < 2:
            raise PoiseError("the body has no two legs to sit with", code="body-part-missing")
        thigh, shin = (
            next(i for i, r in enumerate(rows) if r.kind == kind and r.side == "left") + 1
            for kind in ("thigh", "shin")
        )
        self.upper = float(np.linalg.norm(self.model.body_pos[shin]))
        self.lower = float(np.linalg.norm(self.model.body_pos[self.legs[0].end]))
        self.hip = self.data.xpos[thigh] - self.data.qpos[:3]
        # m from the root down to what rests on a seat: the pelvis, or thighs that lie level.
        pelvis = max((float(g.size[0]) for g in rows[0].geoms), default=0.1)
        thick = max((float(g.size[0]) for g in rows[thigh - 1].geoms), default=0.05)
        self.low = max(pelvis, thick - float(self.hip[2]))
        # Over the middle of the feet, where the weight is.
        soles = [self.data.geom_xpos[self.model.geom_bodyid == leg.end].mean(0) for leg in self.legs]
        self.over = float(np.mean(soles, 0) @ self.ahead)

    @property
    def gap(self) -> float:
        """m from the edge to the root that stands before it: the nearer ankle has its room."""
        return AWAY - min(float((leg.pos - self.ease[:3]) @ self.ahead) for leg in self.legs)

    def behind(self, top: float, tucked: float) -> float:
        """m by which the root of a body that sits so high is behind where it stands: the thighs reach
        back from the knees."""
        ankle = np.mean([leg.pos for leg in self.legs], 0)
        rise = top + self.low - SINKS + self.hip[2] - (ankle[2] + math.sqrt(self.lower**2 - tucked**2))
        reach = math.sqrt(max(self.upper**2 - rise**2, 0.0)) - tucked
        return reach - float(ankle @ self.ahead - (self.ease[:3] + self.hip) @ self.ahead)

    def motion(
        self, top: float, rate_hz: float, down_s: float, upright_s: float, later: float, tucked: float
    ) -> Tensor:
        """From standing to sitting upright, see `DOWN`."""
        down, up = round(down_s * rate_hz), round(upright_s * rate_hz)
        back, high = self.behind(top, tucked), top + self.low - SINKS
        frames, lean, q = list[np.ndarray](), 0.0, self.ease.copy()
        for share in smooth(torch.linspace(0, 1, down + 1, dtype=torch.float64)).tolist():
            z = float(self.ease[2]) + share * (high - float(self.ease[2]))
            x = back * share**later
            q, lean = self._balanced(q, x, z, lean)
            frames.append(q)
        last = lean
        for share in smooth(torch.linspace(0, 1, up + 1, dtype=torch.float64)).tolist()[1:]:
            q = self._posed(q, back, high, last + share * (SITS - last))
            frames.append(q)
        return torch.tensor(np.array(frames))

    def _balanced(self, q: np.ndarray, back: float, z: float, lean: float) -> tuple[np.ndarray, float]:
        """The pose with the centre of mass over the feet, and how far it leans, rad."""
        low, high = max(0.0, lean - 0.15), min(LEANS, lean + 0.15)
        for _ in range(6):
            lean = 0.5 * (low + high)
            q = self._posed(q, back, z, lean)
            mujoco.mj_comPos(self.model, self.data)
            ahead = float(self.data.subtree_com[1] @ self.ahead) - self.over
            low, high = (low, lean) if ahead > 0 else (lean, high)
        return q, lean

    def _posed(self, q: np.ndarray, back: float, z: float, lean: float) -> np.ndarray:
        """The body with its root so far back, so high and leaning so far, its feet where they stand;
        begins to look from `q (7 + n)`."""
        data, model = self.data, self.model
        q = q.copy()
        q[:3] = self.ease[:3] - back * self.ahead
        q[2] = z
        q[3:7] = _multiplied(self._about_left(lean), self.ease[3:7])
        # Arms hang, and swing forward as the trunk leans.
        reach = self._about_left(-SWINGS * lean)
        lows, highs = model.jnt_range[1:].T
        jac_p, jac_r = np.zeros((3, model.nv)), np.zeros((3, model.nv))
        for _ in range(12):
            data.qpos[:] = q
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            worst = 0.0
            for leg in self.legs:
                off, spin = leg.pos - data.xpos[leg.end], _spin(data.xquat[leg.end], leg.quat)
                mujoco.mj_jacBody(model, data, jac_p, jac_r, leg.end)
                # A rad of the foot counts as much as 0.2 m: an ankle has its range.
                jac = np.concatenate((jac_p, 0.2 * jac_r))[:, leg.dofs]
                error = np.concatenate((off, 0.2 * spin))
                q[leg.dofs + 1] += _step(jac, error)
                worst = max(worst, float(np.abs(error).max()))
            for arm in self.arms:
                mujoco.mj_jacBody(model, data, jac_p, jac_r, arm.end)
                error = _spin(data.xquat[arm.end], _multiplied(reach, arm.quat))
                q[arm.dofs + 1] += _step(jac_r[:, arm.dofs], 0.2 * error)
            q[7:] = np.clip(q[7:], lows, highs)
            if worst < 1e-3:
                break
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        return q

    def _about_left(self, angle: float) -> np.ndarray:
        """wxyz of a turn about the axis to the left, rad."""
        return np.concatenate(([math.cos(0.5 * angle)], math.sin(0.5 * angle) * self.left))


def _multiplied(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """a b of two rotations, wxyz."""
    out = np.zeros(4)
    mujoco.mju_mulQuat(out, a, b)
    return out


def _spin(now: np.ndarray, goal: np.ndarray) -> np.ndarray:
    """`(3)` rad about the world's axes from one rotation, wxyz, to another."""
    out = np.zeros(3)
    mujoco.mju_quat2Vel(out, _multiplied(goal, now * [1.0, -1.0, -1.0, -1.0]), 1.0)
    return out


def _step(jac: np.ndarray, error: np.ndarray) -> np.ndarray:
    """rad by which hinges turn to make an error smaller: damped least squares, 0.3 at most."""
    return np.clip(jac.T @ np.linalg.solve(jac @ jac.T + 1e-4 * np.eye(len(error)), error), -0.3, 0.3)


class Visit(NamedTuple):
    """A character's time on a seat.

    Attributes:
        world: which character. step: the control step in which it set out to sit down. seat: which one.
        sat_s: s for which its pelvis was on the seat. back: whether it stood again after that.
    """

    world: int
    step: int
    seat: int
    sat_s: float
    back: bool


@dataclass(eq=False)
class _State:
    """The visits of a character to seats: it goes about until `next`; then it goes to a side of a seat,
    and gives that up at `until`; `sits` while it follows the planned motion.

    at, out: m `(2)`, the place at the edge, and the direction away from it. sat: control steps on it.
    """

    next: int = 0
    until: int = 0
    seat: int = -1
    at: np.ndarray = field(default_factory=lambda: np.zeros(2))
    out: np.ndarray = field(default_factory=lambda: np.zeros(2))
    sits: bool = False
    begun: int = 0
    sat: int = 0


class Seats:
    """Leads characters to seats and plans how they sit down and get up again; see `Recovering`.

    Args:
        seats: that there are. humanoid: the characters' body. get_up: how they walk.
        count: characters. blocks: boxes in which nobody stands before a seat. seed: of times.

    Attributes:
        visits: that are over, see `Visit`.
    """

    def __init__(
        self,
        seats: Sequence[Seat],
        humanoid: Humanoid,
        get_up: GetUpPlanner,
        count: int,
        blocks: Sequence[Footprint] = (),
        seed: int = 0,
    ):
        self.seats, self.get_up, self.blocks = tuple(seats), get_up.walks_calmly(), tuple(blocks)
        self.visits, self._rng = list[Visit](), np.random.default_rng(seed)
        self._rate, ease = get_up.rate_hz, facing(get_up.recovery_clips.ease, 0.0).double()
        made = {s.top: sit_down(humanoid, ease, s.top, self._rate) for s in self.seats}
        self._motions = [made[s.top] for s in self.seats]
        self._ahead = float(np.arctan2(*_Sitter(humanoid, ease.numpy()).ahead[1::-1]))
        self._worlds = [_State(next=self._later(FIRST_S)) for _ in range(count)]

    def _later(self, between: tuple[float, float]) -> int:
        return round(float(self._rng.uniform(*between)) * self._rate)

    def leads(self, world: int, step: int, root: np.ndarray) -> np.ndarray | None:
        """`(2)` m to which a character is to go now, None where it is free; it stands at `root (2)`."""
        state = self._worlds[world]
        if state.sits or step < state.next:
            return None
        if state.seat < 0 and not self._chosen(state, step, root):
            return None
        if step > state.until:
            state.seat, state.next = -1, step + self._later(PAUSE_S)
            return None
        return state.at + BEFORE * state.out

    def due(self, world: int, root: np.ndarray) -> bool:
        """Whether a character that is led stands before its seat, where the planned motion begins."""
        state = self._worlds[world]
        if state.seat < 0 or state.sits:
            return False
        off = root - state.at
        before, beside = (
            float(off @ state.out),
            abs(float(off[0] * state.out[1] - off[1] * state.out[0])),
        )
        return before > BEFORE - NEAR and beside < NEAR and float(np.hypot(*off)) < BEFORE + NEAR

    def motion(self, world: int, step: int, qpos: Tensor, moves: Tensor | None) -> Tensor:
        """`(T, 7 + n)` from `qpos (7 + n)`, whose root moves with `moves (2)` m/s, to the seat and to
        standing before it again."""
        state = self._worlds[world]
        sit, ease = self._motions[state.seat], self.get_up.recovery_clips.ease
        heading = float(np.arctan2(state.out[1], state.out[0])) - self._ahead
        place = facing(ease, heading).double()
        place[:2] = torch.tensor(state.at + sit.gap * state.out)
        way = way_to_stand(self.get_up, qpos, place, moves)
        angle = heading_angle(way[-1, 3:7])
        down, up = (turned(q, angle, sit.down[0, :2], way[-1, :2]) for q in (sit.down, sit.up))
        rests = down[-1:].expand(self._later(SIT_S), -1)
        stands = down[:1].expand(max(1, round(STANDS_S * self._rate)), -1)
        state.sits, state.begun, state.sat = True, step, 0
        return torch.cat((way, down, rests, up, stands))

    def watch(self, world: int, qpos: np.ndarray) -> None:
        """Counts how long a character's pelvis is on its seat."""
        state = self._worlds[world]
        if state.sits:
            seat = self.seats[state.seat]
            near = float(qpos[2]) < seat.top + self._motions[state.seat].height + ON_IT
            state.sat += near and float(seat.foot.depth(torch.tensor(qpos[:2]))) > 0

    def over(self, world: int, step: int, back: bool) -> None:
        """A visit has come to its end, or the character has lost it."""
        state = self._worlds[world]
        if state.sits:
            sat = state.sat / self._rate
            self.visits.append(Visit(world, state.begun, state.seat, sat, back))
        state.sits, state.seat, state.next = False, -1, step + self._later(PAUSE_S)

    def sits(self, world: int) -> bool:
        """Whether a character follows a planned motion of a visit."""
        return self._worlds[world].sits

    def _chosen(self, state: _State, step: int, root: np.ndarray) -> bool:
        """Chooses the side of a free seat that is nearest to a character; none where there is none."""
        taken = {s.seat for s in self._worlds}
        best = math.inf
        for k, seat in enumerate(self.seats):
            for edge, out, wide in seat.sides() if k not in taken else ():
                along = np.array([-out[1], out[0]])
                at = edge + along * float(np.clip((root - edge) @ along, -wide, wide))
                stand = torch.tensor(at + BEFORE * out)
                far = float(np.hypot(*(at + BEFORE * out - root)))
                blocked = any(float(b.depth(stand, 0.3)) > 0 for b in self.blocks if b != seat.foot)
                if far < best and not blocked:
                    best, state.seat, state.at, state.out = far, k, at, out
        if best < math.inf:
            state.until = step + round(GIVES_UP_S * self._rate)
        return best < math.inf
