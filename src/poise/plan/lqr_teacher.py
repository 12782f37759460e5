"""The LQR teacher: it keeps characters on optimised trajectories that need no help."""

from __future__ import annotations

import torch
from torch import Tensor

from poise.env.env import ImitationEnv
from poise.plan.trajopt_config import Trajectories
from poise.sim import difference
from poise.spatial import quat_conj, quat_mul, quat_rotate


class LqrTeacher:
    """Acts in one `ImitationEnv` with full knowledge of its state, whatever its observation is.

        u = u_trajectory + K d, where d is how far the character is from its trajectory

    A residual force is never used. A teacher for `poise.learn.clone`, and a policy that `poise.eval` can
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
