"""A library of motion in a humanoid's coordinates, packed so that one gather serves any batch."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np
import torch
from mujoco.batch import MODEL_FIELDS
from torch import Tensor

from poise.body import Humanoid, make_spec
from poise.env.bins import MotionBins
from poise.env.evaluate import Recorded
from poise.env.frame import FIELDS, Pose, PoseLayout, PosePlace
from poise.errors import PoiseError
from poise.kinematics import Kinematics, cycle_step, cycle_velocity, qpos_velocity
from poise.motion.rotations import heading_quat, quat_mul, quat_rotate

#: Bodies in the one model that makes poses of many frames: a call is for so many at once.
MANY = 16


class Poser:
    """Makes poses of coordinates of one humanoid.

    kinematics: float64, on the CPU. device: where `local` works in float32.
    """

    def __init__(self, humanoid: Humanoid, device: torch.device | str = "cpu"):
        self.humanoid = humanoid
        self.kinematics = Kinematics(humanoid.table)
        self._fast = Kinematics(humanoid.table, "float32")
        self._made: dict[int, tuple[Any, ...]] = {}
        self._turned = Recorded(self._turns)

    def __call__(self, qpos: Tensor, qvel: Tensor) -> Pose:
        """The poses of `qpos (F, 7 + n)` and `qvel (F, 6 + n)`, float64."""
        body = self.kinematics(qpos, qvel)
        return Pose(
            qpos.float(),
            qvel.float(),
            body.pos.float(),
            body.quat.float(),
            body.linvel.float(),
            body.angvel.float(),
            _centre_of_mass(self.humanoid, body.pos, body.quat),
            self.local(qpos.float()),
            heading_quat(qpos[:, 3:7].float()),
        )

    def live(self, qpos: Tensor, qvel: Tensor) -> Pose:
        """The same poses by MuJoCo: for the frames that become known in a step, for which torch takes
        longer. What a frame's pose is does not depend on the others, to the last bit."""
        frames, n = len(qpos), len(self.humanoid.bodies)
        pos, quat, centres, cvel = (np.empty((frames, *k)) for k in ((n, 3), (n, 4), (3,), (n, 6)))
        made, at, q, v = (pos, quat, centres, cvel), 0, qpos.numpy(), qvel.numpy()
        for count, (model, data, at_q, at_v, *views) in zip(
            (MANY, 1), self._worlds(frames), strict=True
        ):
            to = at + (frames - at) // count * count
            # Attributes of MjData are made anew at every access, which takes longer than the kinematics.
            for i in range(at, to, count):
                at_q[:], at_v[:] = q[i : i + count], v[i : i + count]
                mujoco.mj_kinematics(model, data)
                mujoco.mj_comPos(model, data)
                mujoco.mj_comVel(model, data)
                for out, view in zip(made, views, strict=True):
                    out[i : i + count] = view
            at = to
        turning, moving = cvel[..., :3], cvel[..., 3:]
        # v(xpos) = v(c) + omega x (xpos - c), see `sim.body_linear_velocity_w`.
        arm = pos - centres[:, None]
        for k, (i, j) in enumerate(((1, 2), (2, 0), (0, 1))):
            moving[..., k] += turning[..., i] * arm[..., j] - turning[..., j] * arm[..., i]
        small, local, heading = self._turned(qpos)
        arrays = (pos, quat, moving, turning, centres)
        at_pos, at_quat, linvel, angvel, com = (torch.from_numpy(x) for x in arrays)
        return Pose(
            small,
            qvel.float(),
            at_pos.float(),
            at_quat.float(),
            linvel.float(),
            angvel.float(),
            com.float(),
            local,
            heading,
        )

    def _turns(self, qpos: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        small = qpos.float()
        return small, self.local(small), heading_quat(small[:, 3:7])

    def _worlds(self, frames: int) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
        """Models and data of `MANY` bodies and of one, with views of what goes in and comes out; the
        former only for so many frames."""
        one = self._world(1)
        return (self._world(MANY) if frames >= MANY else one), one

    def _world(self, count: int) -> tuple[Any, ...]:
        if count not in self._made:
            model = self.humanoid.model
            if count > 1:
                model = make_spec(self.humanoid.table, count).compile()
            data, n = mujoco.MjData(model), len(self.humanoid.bodies)
            bodies = (x[1:].reshape(count, n, -1) for x in (data.xpos, data.xquat, data.cvel))
            at_pos, at_quat, at_cvel = bodies
            self._made[count] = (
                model,
                data,
                data.qpos.reshape(count, -1),
                data.qvel.reshape(count, -1),
                at_pos,
                at_quat,
                data.subtree_com[1::n],
                at_cvel,
            )
        return self._made[count]

    def local(self, qpos: Tensor) -> Tensor:
        """`(F, J, 4)` wxyz local turns of hinged bodies."""
        return self._fast.local_quats(qpos)

    def layout(self) -> PoseLayout:
        """Where the numbers of this humanoid's poses stand in packed rows."""
        qpos = torch.zeros(1, self.humanoid.model.nq, dtype=torch.float64)
        qpos[:, 3] = 1.0
        return PoseLayout(self(qpos, torch.zeros(1, self.humanoid.model.nv, dtype=torch.float64)))


def _centre_of_mass(humanoid: Humanoid, pos: Tensor, quat: Tensor) -> Tensor:
    """`(F, 3)` float32 m of the body's parts, as its compiled model has them."""
    mass = torch.tensor(humanoid.model.body_mass[1:])
    inertial = torch.tensor(humanoid.model.body_ipos[1:])
    centre = pos + quat_rotate(quat, inertial.expand_as(pos))
    return ((centre * mass[:, None]).sum(-2) / mass.sum()).float()


# Tensors that references have one row of for each clip or each frame.
_JOINED = (
    *("qpos", "qvel", "hinges", "length", "cyclic", "min_height"),
    *("cycle_turn", "cycle_travel", "body"),
)
# The last columns of packed poses, which say of what clip they are.
_PLACE = slice(-len(PosePlace._fields), None)


@dataclass(frozen=True, eq=False)
class GoalRows:
    """The frames of a reference as goals: R rows of packed poses, see `PoseLayout`.

    Attributes:
        judged: `(R, W)` float32, by which characters are judged.
        told: `(R, W)` float32, what policies are told: `judged` itself, or something else.
        after: `(R,)`, the row that follows each row.
    """

    judged: Tensor
    told: Tensor
    after: Tensor

    @property
    def misleads(self) -> bool:
        """True where policies are told another motion than the one that judges characters."""
        return self.told is not self.judged

    @property
    def place(self) -> Tensor:
        """`(R, 4)` what the rows say of their clips, as a view."""
        return self.judged[:, _PLACE]

    def to(self, device: torch.device) -> GoalRows:
        """The same rows on `device`."""
        judged = self.judged.to(device)
        return GoalRows(judged, self.told.to(device) if self.misleads else judged, self.after.to(device))

    @classmethod
    def joined(cls, parts: Sequence[GoalRows]) -> GoalRows:
        """The rows of all parts, one part after another."""
        judged = torch.cat([p.judged for p in parts])
        told = torch.cat([p.told for p in parts]) if any(p.misleads for p in parts) else judged
        first = torch.tensor([0, *(len(p.judged) for p in parts)]).cumsum(0).tolist()
        after = torch.cat([p.after + row for p, row in zip(parts, first, strict=False)])
        return cls(judged, told, after)


class Reference:
    """Reference motion at the control rate, all clips end to end.

    Frames of clip c are rows `start[c] .. start[c] + length[c] - 1`. The last frame of a cyclic clip is
    its first one cycle later (`kinematics.close_cycle`); the clip goes on with its first frames, moved
    and turned to where the last frame stands.

    Args:
        bodies: S bodies of the same joints and hinges, of which `humanoid` is the first; None: it alone.
        body: `(C,)`, the body that each clip is for; by default the first.
    """

    def __init__(
        self,
        humanoid: Humanoid,
        motions: Sequence[np.ndarray],
        rate_hz: float,
        names: Sequence[str],
        cyclic: Sequence[bool] | None = None,
        bodies: Sequence[Humanoid] | None = None,
        body: Sequence[int] | None = None,
    ):
        cyclic = [False] * len(motions) if cyclic is None else list(cyclic)
        if not motions or len(names) != len(motions) or len(cyclic) != len(motions):
            raise PoiseError(
                f"a reference needs as many names as motions, got {len(names)} and {len(motions)}",
                code="count-differs",
            )
        for name, q in zip(names, motions, strict=True):
            if len(q) < 3:
                raise PoiseError(
                    f"the clip has {len(q)} frames at {rate_hz:g} Hz and needs at least 3",
                    name,
                    code="clip-too-short",
                )
        self.humanoid, self.rate_hz, self.names = humanoid, rate_hz, tuple(names)
        self.bodies = (humanoid,) if bodies is None else tuple(bodies)
        self.body = torch.tensor([0] * len(motions) if body is None else list(body))
        if self.bodies[0] is not humanoid or len(self.body) != len(motions):
            raise PoiseError(
                "a reference needs a body for each clip, and its own as the first", code="count-differs"
            )
        self.poser = Poser(humanoid)
        self.kinematics = self.poser.kinematics
        qpos = torch.tensor(np.concatenate(motions), dtype=torch.float64)
        speed = [cycle_velocity if c else qpos_velocity for c in cyclic]
        qvel = torch.tensor(
            np.concatenate([of(q, rate_hz) for of, q in zip(speed, motions, strict=True)])
        )
        self.qpos, self.qvel = qpos, qvel
        self.hinges = qpos[:, 7:].contiguous()
        self.length = torch.tensor([len(q) for q in motions])
        self.start = torch.cumsum(self.length, 0) - self.length
        self.cyclic = torch.tensor(cyclic)
        self.min_height = torch.stack(
            [p.min() for p in torch.split(qpos[:, 2].float(), self.length.tolist())]
        )
        self.any_cyclic = bool(self.cyclic.any())
        #: Its clips cut into motion bins.
        self.bins = MotionBins.cut(self.length, self.cyclic, rate_hz)
        clip = torch.arange(len(motions)).repeat_interleave(self.length)
        frame = torch.arange(len(qpos)) - self.start[clip]
        end = (frame == self.length[clip] - 1) & ~self.cyclic[clip]
        told = self.phase(clip, frame), self.min_height[clip], end.float(), self.body[clip].float()
        pose = self._poses(qpos, qvel, self.body[clip])
        #: Where the numbers of packed poses stand.
        self.layout = PoseLayout(pose)
        packed = self.layout.pack(pose, torch.stack(told, 1))
        #: The frames as goals.
        self.goal_rows = GoalRows(packed, packed, self.rows(clip, frame + 1))
        # What one cycle adds: the turn and the horizontal travel from the first to the last frame.
        steps = [cycle_step(q) for q in motions]
        self.cycle_turn = torch.from_numpy(np.stack([turn for turn, _ in steps]))
        self.cycle_travel = torch.from_numpy(np.stack([travel for _, travel in steps]))

    def to(self, device: torch.device) -> Reference:
        """The same motions with what environments read on `device`; `kinematics` stays on the CPU."""
        if self.qpos.device == device:
            return self
        there = copy.copy(self)
        for name, value in vars(self).items():
            if isinstance(value, Tensor):
                setattr(there, name, value.to(device))
        there.bins, there.goal_rows = self.bins.to(device), self.goal_rows.to(device)
        there.poser = Poser(self.humanoid, device)
        return there

    def joined(self, *others: Reference) -> Reference:
        """The clips of this one and then those of others, which are for the same body and rate."""
        parts, out = (self, *others), copy.copy(self)
        for name in _JOINED:
            setattr(out, name, torch.cat([getattr(p, name) for p in parts]))
        out.goal_rows = GoalRows.joined([p.goal_rows for p in parts])
        out.names = tuple(name for p in parts for name in p.names)
        out.start = torch.cumsum(out.length, 0) - out.length
        out.any_cyclic = any(p.any_cyclic for p in parts)
        cut = MotionBins.cut(out.length.cpu(), out.cyclic.cpu(), self.rate_hz)
        out.bins = cut.to(self.qpos.device)
        return out

    def _poses(self, qpos: Tensor, qvel: Tensor, body: Tensor) -> Pose:
        """The poses of frames, of which each is one of the body `body (F,)`."""
        if len(self.bodies) == 1:
            return self.poser(qpos, qvel)
        rows = [(body == k).nonzero().squeeze(-1) for k in range(len(self.bodies))]
        pairs = zip(rows, self.bodies, strict=True)
        parts = [Poser(humanoid)(qpos[own], qvel[own]) for own, humanoid in pairs]
        back = torch.cat(rows).argsort()
        return Pose(*(torch.cat([getattr(p, name) for p in parts])[back] for name in FIELDS))

    def local(self, qpos: Tensor) -> Tensor:
        """`(N, J, 4)` wxyz local turns of hinged bodies."""
        return self.poser.local(qpos)

    @property
    def frames(self) -> int:
        """Total number of frames."""
        return len(self.qpos)

    @property
    def seconds(self) -> float:
        """Total duration."""
        return float((self.length - 1).sum()) / self.rate_hz

    def rows(self, clip: Tensor, frame: Tensor) -> Tensor:
        """Row of `frame (N)` of `clip (N)`; frames of cyclic clips wrap, others hold the last."""
        last = self.length[clip] - 1
        if self.any_cyclic:
            frame = torch.where(self.cyclic[clip], torch.remainder(frame, last), frame)
        return self.start[clip] + torch.minimum(frame, last)

    def phase(self, clip: Tensor, frame: Tensor) -> Tensor:
        """Place in the clip, 0 to 1 `(N)` float32."""
        last = self.length[clip] - 1
        if self.any_cyclic:
            frame = torch.where(self.cyclic[clip], torch.remainder(frame, last), frame)
        return torch.minimum(frame, last).float() / last.float()

    @property
    def pose(self) -> Pose:
        """Every frame of every clip, as it stands in the clip."""
        return self.layout.unpacked(self.goal_rows.judged)

    def with_pose(self, pose: Pose) -> Reference:
        """The same clips with other goals: every frame's pose, of the same shapes as `pose` has."""
        other, packed = copy.copy(self), self.layout.pack(pose, self.goal_rows.place)
        other.goal_rows = replace(self.goal_rows, judged=packed, told=packed)
        return other

    def told(self, motions: Sequence[np.ndarray]) -> Reference:
        """The same clips, of which policies are told something else, such as an estimator's output.

        What comes next, and what actions add to, is of `motions`; where characters begin and what they
        are judged by stays.

        Args:
            motions: `(T, 7 + n)` for each clip, of as many frames.

        Raises:
            PoiseError: not so many clips or frames.
        """
        if [len(q) for q in motions] != self.length.tolist():
            raise PoiseError(
                "what policies are told needs a frame for each of the clips' frames",
                code="count-differs",
            )
        speed = [cycle_velocity if c else qpos_velocity for c in self.cyclic.tolist()]
        moves = [of(q, self.rate_hz) for of, q in zip(speed, motions, strict=True)]
        qpos, qvel = (torch.tensor(np.concatenate(x), dtype=torch.float64) for x in (motions, moves))
        other = copy.copy(self)
        pose = self._poses(qpos, qvel, self.body.repeat_interleave(self.length))
        told = self.layout.pack(pose, self.goal_rows.place)
        other.goal_rows, other.hinges = replace(self.goal_rows, told=told), qpos[:, 7:].contiguous()
        return other

    @property
    def misleads(self) -> bool:
        """True where policies are told another motion than the one that judges characters."""
        return self.goal_rows.misleads

    def gather(self, clip: Tensor, frame: Tensor) -> Pose:
        """The reference pose of `frame (N)` of `clip (N)`; cyclic clips are carried on."""
        return self.layout.unpacked(self.gather_packed(clip, frame))

    def gather_packed(
        self, clip: Tensor, frame: Tensor, rows: Tensor | None = None, told: bool = False
    ) -> Tensor:
        """The same poses as rows `(N, W)` of all their numbers, for `unpacked`.

        rows: what `self.rows(clip, frame)` gives, where it is known already. told: as policies are told.
        """
        table = self.goal_rows.told if told else self.goal_rows.judged
        packed = table.index_select(0, self.rows(clip, frame) if rows is None else rows)
        carry = self.carry(clip, frame)
        if carry is None:
            return packed
        pose = _carried(self.layout.unpacked(packed), carry[0].float(), carry[1].float())
        return self.layout.pack(pose, packed[:, _PLACE])

    def packed(self, rows: Tensor) -> Tensor:
        """Packed poses of `rows (N)` as they stand in their clips."""
        return self.goal_rows.judged.index_select(0, rows)

    def follow(
        self, rows: Tensor, clip: Tensor, frame: Tensor, held: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """The row after each of `rows (N)`, and its packed pose as policies are told it; it is frame
        `frame + 1` of `clip`.

        held: `(N)` bool, where the rows stay and are frame `frame`.
        """
        after = self.goal_rows.after.index_select(0, rows)
        rows = after if held is None else torch.where(held, rows, after)
        if not self.any_cyclic:
            return rows, self.goal_rows.told.index_select(0, rows)
        ahead = frame + 1 if held is None else frame + 1 - held.long()
        return rows, self.gather_packed(clip, ahead, rows, told=True)

    def coordinates(self, clip: Tensor, frame: Tensor) -> tuple[Tensor, Tensor]:
        """`qpos (N, 7 + n)` and `qvel (N, 6 + n)`, float64, of the poses that `gather` gives."""
        rows = self.rows(clip, frame)
        qpos, qvel, carry = self.qpos[rows], self.qvel[rows], self.carry(clip, frame)
        if carry is None:
            return qpos, qvel
        turn, move = carry
        pos, quat = quat_rotate(turn, qpos[:, :3]) + move, quat_mul(turn, qpos[:, 3:7])
        # The root's angular velocity is in its own frame, so it turns along by itself.
        linear = quat_rotate(turn, qvel[:, :3])
        return torch.cat((pos, quat, qpos[:, 7:]), -1), torch.cat((linear, qvel[:, 3:]), -1)

    def carry(self, clip: Tensor, frame: Tensor) -> tuple[Tensor, Tensor] | None:
        """The turn `(N, 4)` and then the move `(N, 3)` m of the cycles before `frame`; None if none."""
        if not self.any_cyclic:
            return None
        cycles = torch.where(
            self.cyclic[clip], frame // (self.length[clip] - 1), torch.zeros_like(frame)
        )
        if not bool((cycles > 0).any()):
            return None
        turn = torch.zeros(len(clip), 4, dtype=torch.float64, device=clip.device)
        turn[:, 0] = 1.0
        move = torch.zeros(len(clip), 3, dtype=torch.float64, device=clip.device)
        for k in range(int(cycles.max())):
            more = (cycles > k)[:, None]
            # x -> turn1 x + travel1, applied once per cycle
            move = torch.where(
                more, quat_rotate(self.cycle_turn[clip], move) + self.cycle_travel[clip], move
            )
            turn = torch.where(more, quat_mul(self.cycle_turn[clip], turn), turn)
        return turn, move


def _carried(pose: Pose, turn: Tensor, move: Tensor) -> Pose:
    """Poses turned by `turn (N, 4)` and then moved by `move (N, 3)` m."""
    turns = turn[:, None].expand(*pose.pos.shape[:-1], 4)
    pos = quat_rotate(turns, pose.pos) + move[:, None]
    quat = quat_mul(turns, pose.quat)
    return Pose(
        torch.cat((pos[:, 0], quat[:, 0], pose.qpos[:, 7:]), -1),
        torch.cat((quat_rotate(turn, pose.qvel[:, :3]), pose.qvel[:, 3:]), -1),
        pos,
        quat,
        quat_rotate(turns, pose.linvel),
        quat_rotate(turns, pose.angvel),
        quat_rotate(turn, pose.com) + move,
        pose.local,
        quat_mul(turn, pose.heading),
    )


def differing(models: Sequence[mujoco.MjModel]) -> dict[str, np.ndarray]:
    """The model fields in which some model is unlike the first, each as `(S, ...)`.

    Physics settings (`opt`) are those of the first for all.

    Raises:
        PoiseError: the models have not the same structure.
    """
    out: dict[str, np.ndarray] = {}
    for name in sorted(MODEL_FIELDS):
        values = [getattr(m, name, None) for m in models if not name.startswith("opt.")]
        arrays = [v for v in values if isinstance(v, np.ndarray)]
        if not arrays or all(np.array_equal(a, arrays[0]) for a in arrays):
            continue
        if arrays[0].dtype.kind != "f" or any(a.shape != arrays[0].shape for a in arrays):
            raise PoiseError(
                f"the bodies differ in more than numbers: MuJoCo's '{name}' is not the same",
                hint="Give bodies with the same joints, hinges and kinds of shapes",
                code="bodies-differ",
            )
        out[name] = np.stack(arrays)
    return out


#: Coordinates of episodes' starts: qpos `(n, nq)` and qvel `(n, nv)`, float64.
Start = tuple[Tensor, Tensor]
