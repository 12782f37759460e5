"""A policy that is learned on top of another one: what it adds to the other's actions."""

# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false
# pyright: reportUnknownVariableType=false
from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from poise.env.env import ImitationEnv
from poise.env.task import Acts, EnvStep
from poise.machine import one_thread
from poise.papers.compliant.scenes.ball import FictionalForces


@dataclass(frozen=True)
class Added:
    """What the actions of a policy on top are.

    Attributes:
        seen: observations that the policy below takes, the first ones of the environment's; the others
            are those of the one on top.
        reach: rad, what an action of 1 adds to each joint's action; 0 leaves the joints alone.
        forces: whether six more actions are fictional forces, see `scenes.ball`.
    """

    seen: int
    reach: float = 0.0
    forces: bool = False

    def width(self, hinges: int) -> int:
        """How many actions that are."""
        return (hinges if self.reach else 0) + (6 if self.forces else 0)

    def apply(self, env: ImitationEnv, below: Tensor, own: Tensor) -> Tensor:
        """The environment's actions `(N, A)`: those of the policy below and what is added to them."""
        joints = env.hinges if self.reach else 0
        if self.forces:
            forces = env.plugin(FictionalForces)
            assert forces is not None
            forces.asked = own[:, joints:].clone()
        if not joints:
            return below
        out = below.clone()
        out[:, :joints] += self.reach * own[:, :joints]
        return out


class OnTop:
    """An environment for a policy that is learned on top of another one; the learner's `VecEnv`.

    Args:
        env: observes what both see.
        policy: the one below, which does not change.
        added: what is learned.
    """

    def __init__(self, env: ImitationEnv, policy: Acts, added: Added):
        self.env, self.policy, self.added = env, policy, added
        self.num_envs, self.device = env.num_envs, env.device
        self.num_obs = env.num_obs - added.seen
        self.num_actions = added.width(env.hinges)
        self._seen = env.observe()[:, : added.seen].clone()

    def reset(self) -> Tensor:
        """New episodes everywhere."""
        return self._own(self.env.reset())

    @one_thread()
    def step(self, actions: Tensor) -> EnvStep:
        """One control step of both."""
        below = self.policy.act(self._seen)
        step = self.env.step(self.added.apply(self.env, below, actions))
        own = self._own(step.obs)
        return step._replace(obs=own, final_obs=step.final_obs[:, self.added.seen :].clone())

    def _own(self, obs: Tensor) -> Tensor:
        self._seen = obs[:, : self.added.seen].clone()
        return obs[:, self.added.seen :].clone()

    def state(self) -> dict[str, Tensor]:
        """That of the environment."""
        return self.env.state()

    def load_state(self, state: dict[str, Tensor]) -> None:
        """Goes on from `state()`."""
        self.env.load_state(state)
        self._own(self.env.observe())

    def close(self) -> None:
        """Frees the worlds."""
        self.env.close()


class Topped:
    """A policy with what was learned on top of it, as one that acts on an environment's observations.

    begin: binds it to the environment, in which it sets what is no action.
    """

    def __init__(self, policy: Acts, top: Acts, added: Added):
        self._policy, self._top, self._added = policy, top, added
        self._env: ImitationEnv | None = None

    def begin(self, env: ImitationEnv) -> None:
        """Acts in an environment from now on."""
        self._env = env

    def act(self, obs: Tensor) -> Tensor:
        """Mean actions `(N, A)`."""
        assert self._env is not None
        with torch.no_grad():
            seen = self._added.seen
            own = self._top.act(obs[:, seen:])
            return self._added.apply(self._env, self._policy.act(obs[:, :seen]), own)
