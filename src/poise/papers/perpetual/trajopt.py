"""Trajectory optimisation: a motion near each clip that physics allows without help, and its teacher."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from typing import Annotated

import mujoco
import numpy as np
import torch
from torch import Tensor

from poise.env.env import ImitationEnv
from poise.env.reference import Reference
from poise.errors import PoiseError
from poise.motion.rotations import quat_conj, quat_mul, quat_rotate
from poise.papers.perpetual.lqr import Regulator, driven, linearise, regulate
from poise.plan.expert import ExpertConfig, make_plan
from poise.settings import Limit, Positive, Range, validate
from poise.sim import CpuBackend, SimConfig, alone, difference


@dataclass(frozen=True)
class TrajOptConfig:
    """How trajectories are optimised.

    Attributes:
        iterations: number of iterations; 0 optimises nothing.
        sizes: rad, of the differences in the first and in the last iteration, see `lqr`.
        segment_s: seconds of a shooting segment; each segment chooses its own step.
        place_m: m, error of the root's place that costs 1.
        turn: rad, error of the root's attitude that costs 1.
        joint: rad, error of a joint that costs 1.
        speed: m/s, error of the root's velocity that costs 1.
        spin: rad/s, error of the root's angular velocity that costs 1.
        joint_speed: rad/s, error of a joint's velocity that costs 1.
        effort: rad, deviation of a joint's target that costs 1.
        help_n: N, force on the root that costs 1 at first.
        help_nm: N m, torque on the root that costs 1 at first.
        less: factor on the help after an iteration in segments with a mean error cost below `good`.
        least: share at which the help ends, next to nothing; the trajectories themselves are without
            help.
        good: mean error cost of a segment below which its help becomes less.
        bad: mean error cost of a segment above which its help comes back, up to the whole.
        astray: mean error cost from which on a segment begins again on its reference, with the help
            of three iterations ago.
        steps: step sizes of the line search, of which the best is taken.
        lost: error of a whole body, in units of what costs 1, beyond which a step is no choice.
        blur: the feedback of a frame is the mean over so many frames before and after it; from frame to
            frame it jumps, which a network learns last.
        plan: the scripted expert with which it begins.
    """

    iterations: Annotated[int, Range(0)] = 11
    sizes: Annotated[tuple[float, float], Range(0, above=True)] = (0.1, 0.065)
    segment_s: Positive = 2.0
    place_m: float = 0.3
    turn: float = 0.4
    joint: float = 0.5
    speed: float = 1.5
    spin: float = 4.0
    joint_speed: float = 8.0
    effort: float = 0.5
    help_n: float = 100.0
    help_nm: float = 30.0
    less: Annotated[float, Range(0, 1, above=True, below=True)] = 0.6
    least: float = 0.02
    good: float = 4.0
    bad: Limit = 10.0
    astray: Limit = 25.0
    steps: tuple[float, ...] = (1.0, 0.6, 0.3, 0.1, 0.03, 0.0)
    lost: Limit = 1.2
    blur: int = 3
    plan: ExpertConfig = field(default_factory=ExpertConfig)

    def __post_init__(self) -> None:
        validate(self)
        if 0.0 not in self.steps:
            raise PoiseError(
                "one of the steps must be 0, with which a trajectory stays",
                "TrajOptConfig",
                code="out-of-range",
            )

    def size(self, iteration: int) -> float:
        """Size of the differences at an iteration, rad; it falls geometrically."""
        first, last = self.sizes
        return first * (last / first) ** min(1.0, iteration / max(1, self.iterations - 1))


@dataclass(frozen=True, eq=False)
class Trajectories:
    """One optimised trajectory per clip; row r stands where row r of the reference does.

    Attributes:
        qpos: `(F, nq)` float64.
        qvel: `(F, nv)` float64.
        target: `(F, n)` rad float32, servo targets.
        feedback: `(F, n, 2 nv)` float32, how the targets change with the deviation (`sim.difference`,
            then velocities).
        price: `(2 nv)`, what the squares of deviations cost in the optimisation.
    """

    qpos: Tensor
    qvel: Tensor
    target: Tensor
    feedback: Tensor
    price: Tensor


@dataclass(frozen=True)
class TrajOptStats:
    """What an iteration came to, over all frames.

    Attributes:
        iteration: its number, from 1.
        error_m: mean distance of the root from the reference, m.
        help_n: mean force that still helps, N.
        unhelped: share of the frames where help has ended.
        seconds: of all iterations so far.
    """

    iteration: int
    error_m: float
    help_n: float
    unhelped: float
    seconds: float


#: rad that a target may be away from the reference; rad/s beyond which a world has gone bad.
REACH, WILD = 2.5, 200.0
#: What is paid for a state that is not finite, and for one that is lost.
AWFUL, LOST = 1e4, 1e9


@dataclass(eq=False)
class Segments:
    """Rows of some motions, one after another: their trajectory, which is changed, and what judges it.

    Attributes:
        qpos: `(F, nq)`, positions of the trajectory.
        qvel: `(F, nv)`, its velocities.
        action: `(F, nu + 6)`, its actions, see `lqr.linearise`.
        rest: `(F, nu + 6)`, actions of no effort.
        ahead: `(F, nu)` rad, hinge angles of the reference's next rows.
        ref_qpos: `(F, nq)`, positions of the reference.
        ref_qvel: `(F, nv)`, its velocities.
        share: `(F,)`, share of the help at each row.
        last: `(F,)` bool, whether the row ends a motion.
    """

    qpos: Tensor
    qvel: Tensor
    action: Tensor
    rest: Tensor
    ahead: Tensor
    ref_qpos: Tensor
    ref_qvel: Tensor
    share: np.ndarray
    last: np.ndarray


def at_once(lengths: Sequence[int], most: int) -> list[list[int]]:
    """Clips of so many frames in order, cut into parts of at most `most` frames each, or of one clip."""
    parts, held = [list[int]()], 0
    for clip, length in enumerate(lengths):
        if parts[-1] and held + length > most:
            parts.append([])
            held = 0
        parts[-1].append(clip)
        held += length
    return parts


def segments(lengths: np.ndarray, size: int, shift: int) -> np.ndarray:
    """`(S, 2)` first row and end of segments of about `size` steps; the first of a motion has `shift`
    of them.

    The end of a segment is the row where the next begins, or the last of its motion.
    """
    out, at = [], 0
    for length in lengths.tolist():
        steps = length - 1
        cuts = [x for x in range(shift or size, steps - size // 4, size) if x >= size // 4]
        edges = [0, *cuts, steps]
        out += [(at + a, at + b) for a, b in pairwise(edges)]
        at += length
    return np.array(out)


@torch.no_grad()
def best_steps(
    model: mujoco.MjModel,
    path: Segments,
    gains: Regulator,
    cut: np.ndarray,
    steps: Sequence[float],
    lost: float,
    prices: tuple[np.ndarray, float],
    drive: tuple[Tensor, int, int],
) -> tuple[np.ndarray, np.ndarray]:
    """Rolls all segments `cut (S, 2)` out with all steps at once, and keeps the best of each in `path`.

    A rollout acts by u = u_path + step k + K d and pays what `regulate` minimises, with the value
    function for where it ends. A segment ends beside the next one's beginning: the gap is for the next
    iteration to close.

    Args:
        lost: error of the body, in units of what costs 1, from which on a rollout is no choice.
        prices: of the state `(2 nv)`, and of targets.
        drive: units of the wrench, physics steps, threads.

    Returns:
        `(S,)` the steps taken, and the mean costs of the states' errors.
    """
    (price, effort), (unit, substeps, threads) = prices, drive
    count, joints, nv = len(cut), model.nu, model.nv
    n = torch.from_numpy(cut[:, 1] - cut[:, 0]).repeat(len(steps))
    begin = torch.from_numpy(cut[:, 0]).repeat(len(steps))
    step = torch.tensor(steps, dtype=torch.float64).repeat_interleave(count)[:, None]
    feed, forward = torch.from_numpy(gains.feedback), torch.from_numpy(gains.forward).double()
    value, slope = torch.from_numpy(gains.value), torch.from_numpy(gains.slope)
    cost_of, share = torch.from_numpy(price), torch.from_numpy(path.share)
    total, worlds = int(n.max()), len(n)
    qs, vs = (path.qpos.new_empty(total + 1, worlds, x.shape[1]) for x in (path.qpos, path.qvel))
    us = path.action.new_empty(total, worlds, path.action.shape[1])
    paid, error = torch.zeros(2, worlds, dtype=torch.float64)
    gone = torch.zeros(worlds, dtype=torch.bool)
    backend = CpuBackend(model, worlds, threads)
    q, v = path.qpos[begin].clone(), path.qvel[begin].clone()
    for t in range(total + 1):
        row, on = begin + n.clamp_max(t), t < n
        qs[t], vs[t] = q, v
        off = torch.cat((difference(q, path.qpos[row]), v - path.qvel[row]), 1)
        wrong = torch.cat((difference(q, path.ref_qpos[row]), v - path.ref_qvel[row]), 1)
        wrong = (wrong.square() * cost_of).sum(1)
        gone |= ~((wrong / (2 * nv)).sqrt() < lost) & (t <= n)
        ends = (n == t).nonzero().squeeze(-1)
        if len(ends):
            d, r = off[ends].clamp(-10.0, 10.0).nan_to_num(10.0), row[ends]
            d32 = d.float()
            paid[ends] += torch.einsum("ni,nij,nj->n", d32, value[r], d32).double()
            paid[ends] += 2.0 * (slope[r] * d).sum(1)
        if t == total:
            break
        change = torch.einsum("nij,nj->ni", feed[row], off.float().nan_to_num(0.0)).double()
        act = path.action[row] + step * forward[row] + change
        near = path.ahead[row]
        targets = torch.minimum(torch.maximum(act[:, :joints], near - REACH), near + REACH)
        act = torch.cat((targets, act[:, joints:]), 1).nan_to_num(0.0)
        us[t] = act
        apart = act - path.rest[row]
        wrong = wrong.nan_to_num(AWFUL).clamp_max(AWFUL)
        price_t = wrong + effort * apart[:, :joints].square().sum(1)
        price_t += apart[:, joints:].square().sum(1) / share[row] ** 2
        paid += torch.where(on, price_t, 0.0)
        error += torch.where(on, wrong, 0.0)
        q, v = backend.successors(q, v, *driven(act, nv, unit), substeps)
        bad = ~(q.isfinite().all(1) & v.isfinite().all(1) & (v.abs().amax(1) < WILD))
        q[bad], v[bad] = path.ref_qpos[row[bad]], path.ref_qvel[row[bad]]
        gone |= bad & on
    backend.close()
    paid = paid.nan_to_num(1e12) + LOST * gone
    best = paid.view(len(steps), count).argmin(0)
    pick = best * count + torch.arange(count)
    for s, w in enumerate(pick.tolist()):
        a, b = cut[s]
        # The last row of a motion belongs to its last segment.
        end = b + int(path.last[b])
        path.qpos[a:end], path.qvel[a:end] = qs[: end - a, w], vs[: end - a, w]
        path.action[a:b] = us[: b - a, w]
    return np.array(steps)[best.numpy()], (error[pick] / n[pick]).numpy()


#: Worlds that compute differences, and rows of which a linear model is kept at once (35 kB each).
WORLDS, ROWS = 1024, 4000
#: Damping never leaves these.
DAMPING = (1e-3, 30.0)


class TrajectoryOptimizer:
    """Optimises the trajectories of all clips, an iteration at a time.

    The optimiser is iLQR along all clips at once (Tassa et al. 2012), with three additions for a human
    on stiff contacts:

    - `lqr.linearise` takes the linear model over large differences, about a tenth of a radian;
    - at first a wrench on the root may help; its price rises wherever the character is near its
      reference: the curriculum of residual forces (Skeleton2Humanoid, Eq. 9), for each shooting segment
      by itself;
    - each segment of some seconds chooses its own step, among rollouts that are made side by side
      (multiple shooting), since one hard second must not hold up a minute of motion.

    Raises:
        PoiseError: clips of several bodies.
    """

    def __init__(
        self, reference: Reference, sim: SimConfig, config: TrajOptConfig | None = None, threads: int = 0
    ):
        if len(reference.bodies) > 1:
            raise PoiseError(
                "trajectories are optimised for one body",
                hint="Train without body shapes",
                code="single-body-only",
            )
        self.reference, self.config, self.sim = reference, config or TrajOptConfig(), sim
        self.threads, model = threads, alone(reference.humanoid, sim)
        self.model, self.joints = model, model.nu
        self.iteration, self.seconds = 0, 0.0
        c, nv = self.config, model.nv
        price = np.empty(2 * nv)
        price[:3], price[3:6], price[6:nv] = c.place_m, c.turn, c.joint
        price[nv : nv + 3], price[nv + 3 : nv + 6], price[nv + 6 :] = c.speed, c.spin, c.joint_speed
        self.price = 1.0 / price**2
        self.unit = torch.tensor([c.help_n] * 3 + [c.help_nm] * 3, dtype=torch.float64)
        self.starts, self.lengths = reference.start.numpy(), reference.length.numpy()
        self.last = np.zeros(reference.frames, dtype=bool)
        self.last[self.starts + self.lengths - 1] = True
        self.after = np.arange(reference.frames) + ~self.last
        plan = make_plan(reference, c.plan)
        force = [np.concatenate((x.root_force, x.root_torque), 1) for x in plan.parts]
        # A last frame is left by no step.
        wrench = torch.from_numpy(np.concatenate([np.concatenate((f, 0 * f[:1])) for f in force]))
        kp = torch.tensor(model.actuator_gainprm[:, 0])
        lifted = reference.hinges + plan.lift.double()
        self.ahead = reference.hinges[self.after]
        wish = torch.lerp(lifted, lifted[self.after], c.plan.lead) + plan.torque.double() / kp
        #: What costs no effort: the torques of inverse dynamics, and no wrench.
        self.rest = torch.cat((wish, torch.zeros_like(wrench)), 1)
        #: The action that goes with the reference.
        self.first = torch.cat((wish, wrench / self.unit), 1)
        self.qpos, self.qvel = reference.qpos.clone(), reference.qvel.clone()
        self.action = self.first.clone()
        self.share, self.damping = np.ones(reference.frames), np.full(reference.frames, 0.25)

    @property
    def done(self) -> bool:
        """Whether all iterations were made."""
        return self.iteration >= self.config.iterations

    def iterate(self) -> TrajOptStats:
        """One iteration over all clips."""
        begun = time.perf_counter()
        for clips in at_once(self.lengths.tolist(), ROWS):
            self._improve(clips)
        self.iteration += 1
        self.seconds += time.perf_counter() - begun
        off = (self.qpos[:, :3] - self.reference.qpos[:, :3]).norm(dim=1).mean()
        force = (self.action[:, -6:-3] * self.unit[:3]).norm(dim=1).mean()
        free = float((self.share <= self.config.least).mean())
        return TrajOptStats(self.iteration, float(off), float(force), free, self.seconds)

    def trajectories(self) -> Trajectories:
        """The trajectories as they are now, with feedback that uses no wrench."""
        frames, n = self.reference.frames, 2 * self.model.nv
        feedback = torch.zeros(frames, self.joints, n)
        for clips in at_once(self.lengths.tolist(), ROWS):
            rows = self._rows(clips)
            gains = self._regulate(rows, self.lengths[clips], self.config.sizes[1], helped=False)
            feedback[rows] = torch.from_numpy(gains.feedback)
        target, price = self.action[:, : self.joints].float(), torch.from_numpy(self.price).float()
        return Trajectories(self.qpos, self.qvel, target, self._blurred(feedback), price)

    def _blurred(self, feedback: Tensor) -> Tensor:
        """Means over the frames around each, as far as its clip has them."""
        clip = torch.from_numpy(np.repeat(np.arange(len(self.lengths)), self.lengths))
        moving = torch.from_numpy(~self.last)
        total, count = torch.zeros_like(feedback), torch.zeros(len(feedback))
        for by in range(-self.config.blur, self.config.blur + 1):
            row = (torch.arange(len(feedback)) + by).clamp(0, len(feedback) - 1)
            # A last frame has no feedback; the clamped rows beyond the ends are seen by their distance.
            known = (clip[row] == clip) & moving[row] & (row - torch.arange(len(row)) == by)
            rows = known.nonzero().squeeze(-1)
            total[rows] += feedback[row[rows]]
            count += known
        return total / count.clamp_min(1.0)[:, None, None]

    # --- persistence --------------------------------------------------------------------------

    def state(self) -> dict[str, Tensor]:
        """All that the next iteration depends on."""
        return {
            "qpos": self.qpos, "qvel": self.qvel, "action": self.action,
            "share": torch.from_numpy(self.share), "damping": torch.from_numpy(self.damping),
            "iteration": torch.tensor(self.iteration), "seconds": torch.tensor(self.seconds),
        }  # fmt: skip

    def load_state(self, state: dict[str, Tensor]) -> None:
        """Goes on from `state()`."""
        self.qpos, self.qvel, self.action = (state[k].clone() for k in ("qpos", "qvel", "action"))
        self.share, self.damping = (state[k].numpy().copy() for k in ("share", "damping"))
        self.iteration, self.seconds = int(state["iteration"]), float(state["seconds"])

    # --- one iteration ------------------------------------------------------------------------

    @cached_property
    def _worlds(self) -> CpuBackend:
        """Compute differences; their number is that of a few frames, or of all that there are."""
        each = 2 * (2 * self.model.nv + self.action.shape[1]) + 1
        return CpuBackend(self.model, max(each, min(WORLDS, each * len(self.qpos))), self.threads)

    def _rows(self, clips: Sequence[int]) -> Tensor:
        spans = [np.arange(self.starts[c], self.starts[c] + self.lengths[c]) for c in clips]
        return torch.from_numpy(np.concatenate(spans))

    def _regulate(self, rows: Tensor, lengths: np.ndarray, size: float, helped: bool) -> Regulator:
        """The regulator of the clips that have these rows."""
        own = rows.numpy()
        moving = torch.from_numpy(np.flatnonzero(~self.last[own]))
        r = rows[moving]
        how = (self.unit, self.sim.substeps, size)
        linear = linearise(self._worlds, self.qpos[r], self.qvel[r], self.action[r], *how)
        n, m = 2 * self.model.nv, self.action.shape[1] if helped else self.joints
        a, b = np.zeros((len(own), n, n), np.float32), np.zeros((len(own), n, m), np.float32)
        a[moving], b[moving] = linear.a, linear.b[:, :, :m]
        then = torch.from_numpy(self.after)[r]
        gap = np.zeros((len(own), n))
        gap[moving] = _apart(linear.qpos, linear.qvel, self.qpos[then], self.qvel[then]).numpy()
        reference = self.reference.qpos[rows], self.reference.qvel[rows]
        error = _apart(self.qpos[rows], self.qvel[rows], *reference).numpy()
        effort = (self.action - self.rest)[rows, :m].numpy()
        price = np.full((len(own), m), 1.0 / self.config.effort**2)
        price[:, self.joints :] = 1.0 / self.share[own, None] ** 2
        damping = self.damping[own] if helped else None
        return regulate(a, b, gap, error, effort, self.price, price, lengths, damping)

    def _improve(self, clips: list[int]) -> None:
        c, rows, lengths = self.config, self._rows(clips), self.lengths[clips]
        gains = self._regulate(rows, lengths, c.size(self.iteration), helped=True)
        # Borders are elsewhere every other time, so that what jumps there can close.
        size = round(c.segment_s * self.sim.control_hz)
        cut = segments(lengths, size, size // 2 if self.iteration % 2 else 0)
        own = rows.numpy()
        here = Segments(
            self.qpos[rows], self.qvel[rows], self.action[rows], self.rest[rows], self.ahead[rows],
            self.reference.qpos[rows], self.reference.qvel[rows], self.share[own], self.last[own],
        )  # fmt: skip
        # From the reference itself a first step may lead far away and still be right.
        lost = c.lost if self.iteration else 9.0
        prices = self.price, 1.0 / c.effort**2
        drive = self.unit, self.sim.substeps, self.threads
        taken, error = best_steps(self.model, here, gains, cut, c.steps, lost, prices, drive)
        self.qpos[rows], self.qvel[rows], self.action[rows] = here.qpos, here.qvel, here.action
        for (begin, end), step, cost in zip(cut, taken, error, strict=True):
            r = own[begin:end]
            if step >= 0.6:
                self.damping[r] *= 0.5
            elif step <= 0.1:
                self.damping[r] *= 2.0 if step else 4.0
            if cost < c.good:
                self.share[r] = np.maximum(self.share[r] * c.less, c.least)
            elif cost > c.astray:
                self.qpos[r], self.qvel[r] = self.reference.qpos[r], self.reference.qvel[r]
                self.action[r], self.damping[r] = self.first[r], 0.25
                self.share[r] = np.minimum(self.share[r] / c.less**3, 1.0)
            elif cost > c.bad:
                self.share[r] = np.minimum(self.share[r] / c.less, 1.0)
        np.clip(self.damping, *DAMPING, out=self.damping)


def _apart(qpos: Tensor, qvel: Tensor, since_q: Tensor, since_v: Tensor) -> Tensor:
    """The tangent state `(N, 2 nv)` from one to another."""
    return torch.cat((difference(qpos, since_q), qvel - since_v), 1)


class LqrTeacher:
    """Acts in one `ImitationEnv` with full knowledge of its state, whatever its observation is.

        u = u_trajectory + K d, where d is how far the character is from its trajectory

    No residual force is used. A teacher for `poise.learn.clone`, and a policy that `poise.score` can
    score.

    Args:
        env: the environment that it acts in.
        trajectories: one per clip of the environment's reference.
        reach: rad, the most that feedback changes a target.
        near: mean cost of a state's deviations up to which its linear model says anything; beyond, the
            action is no lesson (`known`).
    """

    def __init__(
        self, env: ImitationEnv, trajectories: Trajectories, reach: float = 0.6, near: float = 0.03
    ):
        self.env, self.trajectories, self.reach, self.near = env, trajectories, reach, near
        self.known: Tensor | None = None

    @torch.no_grad()
    def act(self, obs: Tensor) -> Tensor:
        """Actions `(N, A)` for the worlds as they stand now; `obs` is not looked at."""
        env, reference = self.env, self.env.reference
        rows = reference.rows(env.clip, env.frame)
        off = self._off(rows)
        self.known = (off.square() * self.trajectories.price).mean(1) < self.near
        change = torch.einsum("nij,nj->ni", self.trajectories.feedback[rows], off)
        target = self.trajectories.target[rows] + change.clamp(-self.reach, self.reach)
        ahead = reference.rows(env.clip, env.frame + 1)
        action = env.task.pd.action(target, reference.hinges[ahead].float())
        extra = env.num_actions - action.shape[1]
        return env.unfiltered(torch.cat((action, action.new_zeros(len(action), extra)), 1))

    def _off(self, rows: Tensor) -> Tensor:
        """`(N, 2 nv)` from the trajectories to the characters, as the trajectories' clips see it."""
        env, state = self.env, self.env.backend.state
        qpos, qvel = self.trajectories.qpos[rows], self.trajectories.qvel[rows]
        carry = env.reference.carry(env.clip, env.frame)
        if carry is None:
            return torch.cat((difference(state.qpos, qpos), state.qvel - qvel), 1).float()
        turn, move = carry
        # Back to the first cycle, where the trajectory is.
        back = quat_conj(turn)
        place = quat_rotate(back, state.qpos[:, :3] - move)
        here = torch.cat((place, quat_mul(back, state.qpos[:, 3:7]), state.qpos[:, 7:]), 1)
        speed = torch.cat((quat_rotate(back, state.qvel[:, :3]), state.qvel[:, 3:]), 1)
        return torch.cat((difference(here, qpos), speed - qvel), 1).float()
