"""Trajectory optimisation: a motion near each clip that physics allows without help, with feedback.

An expert that needs no residual force. It is found by iLQR along all clips at once (Tassa et al. 2012),
with three things that the motion of a human on stiff contacts asks for:

- the linear model is taken over differences of about a tenth of a radian (`plan.lqr`);
- at first a wrench on the root may help; its price rises wherever the character is near its reference:
  the curriculum of residual forces (Skeleton2Humanoid Eq. 9), for each shooting segment by itself;
- the step is chosen for each segment of some seconds by itself, among rollouts that are made side by
  side (multiple shooting), since one hard motion bin must not hold up a minute of motion.
"""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from poise.env.reference import Reference
from poise.errors import PoiseError
from poise.plan.expert import make_plan
from poise.plan.lqr import Regulator, linearise, regulate
from poise.plan.shooting import Segments, best_steps, segments
from poise.plan.trajopt_config import Trajectories, TrajOptConfig, TrajOptStats
from poise.sim import CpuBackend, SimConfig, alone, difference

#: Worlds that compute differences, and rows of which a linear model is kept at once (35 kB each).
WORLDS, ROWS = 4096, 4000
#: Damping never leaves these.
DAMPING = (1e-3, 30.0)


class TrajectoryOptimizer:
    """Optimises the trajectories of all clips, an iteration at a time.

    Raises:
        PoiseError: clips of several bodies.
    """

    def __init__(
        self, reference: Reference, sim: SimConfig, config: TrajOptConfig | None = None, threads: int = 0
    ):
        if len(reference.bodies) > 1:
            raise PoiseError("trajectories are optimised for one body", hint="Train without body shapes")
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
        worlds = self._worlds()
        for clips in self._parts():
            self._improve(clips, worlds)
        worlds.close()
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
        worlds = self._worlds()
        for clips in self._parts():
            rows = self._rows(clips)
            gains = self._regulate(rows, self.lengths[clips], worlds, self.config.sizes[1], helped=False)
            feedback[rows] = torch.from_numpy(gains.feedback)
        worlds.close()
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

    def _worlds(self) -> CpuBackend:
        return CpuBackend(self.model, min(WORLDS, 600 * len(self.qpos)), self.threads)

    def _parts(self) -> list[list[int]]:
        """Clips, some at a time, so that their linear models fit into memory."""
        parts: list[list[int]] = [[]]
        for clip, length in enumerate(self.lengths.tolist()):
            if parts[-1] and sum(self.lengths[parts[-1]]) + length > ROWS:
                parts.append([])
            parts[-1].append(clip)
        return parts

    def _rows(self, clips: Sequence[int]) -> Tensor:
        spans = [np.arange(self.starts[c], self.starts[c] + self.lengths[c]) for c in clips]
        return torch.from_numpy(np.concatenate(spans))

    def _regulate(
        self, rows: Tensor, lengths: np.ndarray, worlds: CpuBackend, size: float, helped: bool
    ) -> Regulator:
        """The regulator of the clips that have these rows."""
        own = rows.numpy()
        moving = torch.from_numpy(np.flatnonzero(~self.last[own]))
        r = rows[moving]
        how = (self.unit, self.sim.substeps, size)
        linear = linearise(worlds, self.qpos[r], self.qvel[r], self.action[r], *how)
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

    def _improve(self, clips: list[int], worlds: CpuBackend) -> None:
        c, rows, lengths = self.config, self._rows(clips), self.lengths[clips]
        gains = self._regulate(rows, lengths, worlds, c.size(self.iteration), helped=True)
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
