"""The imitation environment: many worlds, one reference, a list of terms."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from poise.control import PDTargets, Residual, Wrench
from poise.env.frame import DoneTerm, Frame, ObsTerm, Pose, RewardTerm
from poise.env.reference import Reference
from poise.errors import PoiseError
from poise.sim import Backend, NanGuard, body_linear_velocity_w
from poise.spatial import heading_quat


class EnvStep(NamedTuple):
    """One control step; see `poise.learn.protocols.Step` for what the learner reads in it.

    obs, final_obs `(N, O)`; reward `(N,)`; terminated (failed, or the clip was done to its end),
    truncated (time-out), failed `(N,)` bool; log: means by name.
    """

    obs: Tensor
    reward: Tensor
    terminated: Tensor
    truncated: Tensor
    final_obs: Tensor
    log: dict[str, float]
    failed: Tensor


@dataclass(frozen=True)
class TaskConfig:
    """Imitation as terms.

    obs, rewards, dones: the terms, in order. pd: how actions become joint targets. residual: the kind
    of residual force, None for plain DeepMimic. horizon: control steps until an episode times out.
    auto_reset: start a new episode where one ended (off while evaluating).
    """

    obs: tuple[ObsTerm, ...]
    rewards: tuple[RewardTerm, ...]
    dones: tuple[DoneTerm, ...]
    pd: PDTargets
    residual: Residual | None = None
    horizon: int = 300
    auto_reset: bool = True


class ImitationEnv:
    """N characters that imitate a reference; implements the learner's `VecEnv` protocol.

    An action is `hinges` joint actions followed by the residual's. At step t the character stands at
    reference frame t, acts toward frame t + 1, and is rewarded there.
    """

    def __init__(
        self,
        reference: Reference,
        backend: Backend,
        task: TaskConfig,
        substeps: int,
        seed: int = 0,
        weights: Tensor | None = None,
        guard: NanGuard | None = None,
    ):
        self.reference, self.backend, self.task, self.substeps = reference, backend, task, substeps
        self.num_envs, self.device = backend.num_envs, torch.device("cpu")
        self.hinges = len(reference.humanoid.hinges)
        if backend.model.nu != self.hinges:
            raise PoiseError(
                f"the model has {backend.model.nu} actuators, the body {self.hinges} hinges"
            )
        self._extra = task.residual.dims if task.residual else 0
        self.num_actions = self.hinges + self._extra
        self._guard = guard
        self._rng = torch.Generator().manual_seed(seed)
        seconds = (reference.length - 1).double()
        self._weights = seconds if weights is None else weights.double()
        n = self.num_envs
        self.clip = torch.zeros(n, dtype=torch.long)
        self.frame = torch.zeros(n, dtype=torch.long)
        self.age = torch.zeros(n, dtype=torch.long)
        self.action = torch.zeros(n, self.num_actions)
        self.wrench: Wrench | None = None
        self.terms: dict[str, Tensor] = {}
        self.imitation = torch.zeros(n)
        self.reset_to(self.clip, self.frame)
        self.num_obs = self._observe().shape[1]

    # --- episodes -----------------------------------------------------------------------------

    def reset(self) -> Tensor:
        """New episodes everywhere at random frames (reference state initialisation)."""
        self._restart(torch.arange(self.num_envs))
        return self._observe()

    def reseed(self, seed: int) -> None:
        """Makes the draws of all later starts repeatable; worlds stay where they are."""
        self._rng.manual_seed(seed)

    def reset_to(self, clip: Tensor, frame: Tensor) -> Tensor:
        """Starts world i exactly on `frame[i]` of `clip[i]`, both `(N,)`; returns observations.

        Frames past the end of a cyclic clip are where its later cycles are.
        """
        self.clip.copy_(clip)
        self.frame.copy_(frame)
        self.age.zero_()
        self.action.zero_()
        self.backend.write(None, *self.reference.coordinates(self.clip, self.frame))
        return self._observe() if hasattr(self, "num_obs") else torch.empty(0)

    def _restart(self, ids: Tensor) -> None:
        pick = torch.multinomial(self._weights, len(ids), replacement=True, generator=self._rng)
        # Uniform over the frames from which at least one step can be made.
        span = (self.reference.length[pick] - 1).double()
        u = torch.rand(len(ids), dtype=torch.float64, generator=self._rng)
        frame = torch.minimum((u * span).long(), self.reference.length[pick] - 2)
        self.clip[ids], self.frame[ids] = pick, frame
        self.age[ids] = 0
        self.action[ids] = 0.0
        self.backend.write(ids, *self.reference.coordinates(pick, frame))

    # --- stepping -----------------------------------------------------------------------------

    def step(self, actions: Tensor) -> EnvStep:
        """One control step for all worlds; `actions (N, A)`."""
        if actions.shape != (self.num_envs, self.num_actions):
            raise PoiseError(
                f"actions must be ({self.num_envs}, {self.num_actions}), got {tuple(actions.shape)}"
            )
        self.action = actions.float()
        drive, state = self.backend.drive, self.backend.state
        drive.clear()
        rows = self.reference.rows(self.clip, self.frame + 1)
        joints, extra = self.action[:, : self.hinges], self.action[:, self.hinges :]
        self.task.pd.apply(joints, self.reference.qpos[rows, 7:], drive)
        if self.task.residual is not None:
            self.wrench = self.task.residual.apply(extra, state.xpos, state.xquat, state.xipos, drive)
        if self._guard is not None:
            self._guard.step(self.substeps)
        else:
            self.backend.step(self.substeps)
        self.frame += 1
        self.age += 1
        view = self._frame(ahead=False)
        reward = torch.zeros(self.num_envs)
        self.imitation = torch.zeros(self.num_envs)
        for term in self.task.rewards:
            value = term.fn(view, **term.params)
            self.terms[term.name] = value
            reward += term.weight * value
            if term.imitation:
                self.imitation += term.weight * value
        failed = torch.zeros(self.num_envs, dtype=torch.bool)
        for done in self.task.dones:
            failed |= done.fn(view, **done.params)
        # A clip that is done to its end is a finished task, whose remaining return is known to be
        # zero; the phase in the observation tells the critic when. To bootstrap there would rest on
        # a state whose value is never learned, and the policy comes to exploit it.
        last = self.frame >= self.reference.length[self.clip] - 1
        terminated = failed | (last & ~self.reference.cyclic[self.clip])
        truncated = (self.age >= self.task.horizon) & ~terminated
        obs = final = self._observe(view)
        if self.task.auto_reset:
            ids = (terminated | truncated).nonzero().squeeze(-1)
            if len(ids):
                self._restart(ids)
                obs = self._observe()
        return EnvStep(obs, reward, terminated, truncated, final, self._log(), failed)

    def _log(self) -> dict[str, float]:
        log = {f"reward/{name}": float(value.mean()) for name, value in self.terms.items()}
        log["imitation"] = float(self.imitation.mean())
        if self.wrench is not None:
            log["help/force_n"] = float(self.wrench.force.norm(dim=-1).sum(-1).mean())
            log["help/torque_nm"] = float(self.wrench.torque.norm(dim=-1).sum(-1).mean())
        return log

    # --- views --------------------------------------------------------------------------------

    def pose(self) -> Pose:
        """The simulated characters now."""
        state, model = self.backend.state, self.backend.model
        qpos = state.qpos.float()
        return Pose(
            qpos,
            state.qvel.float(),
            state.xpos[:, 1:].float(),
            state.xquat[:, 1:].float(),
            body_linear_velocity_w(state, model)[:, 1:].float(),
            state.cvel[:, 1:, :3].float(),
            state.subtree_com[:, 1].float(),
            self.reference.local(qpos),
            heading_quat(qpos[:, 3:7]),
        )

    def where(self, env: int) -> str:
        """Which frame of which clip world `env` is at, for messages."""
        return f"{self.reference.names[int(self.clip[env])]} frame {int(self.frame[env])}"

    def _frame(self, ahead: bool) -> Frame:
        extra = self.action[:, self.hinges :]
        reg = self.task.residual.regularizer(extra) if self.task.residual else torch.ones(self.num_envs)
        return Frame(
            self.pose(),
            self.reference.gather(self.clip, self.frame),
            self.reference.gather(self.clip, self.frame + 1) if ahead else None,
            self.reference.phase(self.clip, self.frame),
            extra,
            reg,
            self.reference.min_height[self.clip],
        )

    def _observe(self, view: Frame | None = None) -> Tensor:
        view = view or self._frame(ahead=True)
        if view.ahead is None:
            ahead = self.reference.gather(self.clip, self.frame + 1)
            view = Frame(view.sim, view.ref, ahead, view.phase, view.residual, view.reg, view.min_height)
        return torch.cat([term.fn(view, **term.params) for term in self.task.obs], -1)

    # --- persistence --------------------------------------------------------------------------

    def state(self) -> dict[str, Tensor]:
        """Everything that a bit-exact continuation needs."""
        return {
            "sim": self.backend.snapshot(),
            "clip": self.clip.clone(),
            "frame": self.frame.clone(),
            "age": self.age.clone(),
            "action": self.action.clone(),
            "rng": self._rng.get_state(),
        }

    def load_state(self, state: dict[str, Tensor]) -> None:
        """Continues from `state()`."""
        self.backend.restore(state["sim"])
        for name in ("clip", "frame", "age"):
            getattr(self, name).copy_(state[name])
        self.action = state["action"].clone()
        self._rng.set_state(state["rng"])

    def close(self) -> None:
        """Frees the worlds."""
        self.backend.close()
