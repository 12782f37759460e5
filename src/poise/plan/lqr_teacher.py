"""A teacher that keeps characters on paths that need no help."""

from __future__ import annotations

import torch
from torch import Tensor

from poise.env.env import ImitationEnv
from poise.plan.trajopt_config import Trajectories
from poise.sim import difference
from poise.spatial import quat_conj, quat_mul, quat_rotate


class LqrTeacher:
    """Acts in one `ImitationEnv` with full knowledge of its state, whatever its observation is.

        u = u_path + K d, where d is how far the character is from its path

    reach: rad, the most that feedback changes a target. near: mean cost of a state's deviations up to
    which its linear model says anything; beyond, the action is no lesson (`known`). A residual force is
    never used. A teacher for `poise.learn.clone`, and a policy that `poise.eval` can score.
    """

    def __init__(self, env: ImitationEnv, paths: Trajectories, reach: float = 0.6, near: float = 0.03):
        self.env, self.paths, self.reach, self.near = env, paths, reach, near
        self.known: Tensor | None = None

    @torch.no_grad()
    def act(self, obs: Tensor) -> Tensor:
        """Actions `(N, A)` for the worlds as they stand now; `obs` is not looked at."""
        env, reference = self.env, self.env.reference
        rows = reference.rows(env.clip, env.frame)
        off = self._off(rows)
        self.known = (off.square() * self.paths.price).mean(1) < self.near
        change = torch.einsum("nij,nj->ni", self.paths.feedback[rows], off)
        target = self.paths.target[rows] + change.clamp(-self.reach, self.reach)
        ahead = reference.rows(env.clip, env.frame + 1)
        action = env.task.pd.action(target, reference.hinges[ahead].float())
        extra = env.num_actions - action.shape[1]
        return torch.cat((action, action.new_zeros(len(action), extra)), 1)

    def _off(self, rows: Tensor) -> Tensor:
        """`(N, 2 nv)` from the paths to the characters, as the paths' clips see it."""
        env, state = self.env, self.env.backend.state
        qpos, qvel = self.paths.qpos[rows], self.paths.qvel[rows]
        carry = env.reference.carry(env.clip, env.frame)
        if carry is None:
            return torch.cat((difference(state.qpos, qpos), state.qvel - qvel), 1).float()
        turn, move = carry
        # Back to the first cycle, where the path is.
        back = quat_conj(turn)
        place = quat_rotate(back, state.qpos[:, :3] - move)
        here = torch.cat((place, quat_mul(back, state.qpos[:, 3:7]), state.qpos[:, 7:]), 1)
        speed = torch.cat((quat_rotate(back, state.qvel[:, :3]), state.qvel[:, 3:]), 1)
        return torch.cat((difference(here, qpos), speed - qvel), 1).float()
