"""The imitation environment as rsl_rl (version 5) knows environments: bring your own learner."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from poise.env.env import ImitationEnv
from poise.errors import PoiseError

if TYPE_CHECKING:
    from tensordict import TensorDict  # pyright: ignore[reportMissingModuleSource]

#: The observation group that both actor and critic see: `obs_groups={"actor": [GROUP], ...}`.
GROUP = "policy"


class RslRlVecEnv:
    """All worlds of an `ImitationEnv` with the members of `rsl_rl.env.VecEnv`.

    Observations are a TensorDict with one group, `"policy"`, `(N, O)` float32, not normalised.
    Time-outs alone are in `extras["time_outs"]`: rsl_rl bootstraps there with the value of the
    observation before the step. A clip done to its end is a finished task, with nothing to bootstrap.

    Args:
        env: the worlds, with automatic reset; they are reset here.
        device: where the learner wants its tensors.
    """

    def __init__(self, env: ImitationEnv, device: torch.device | str = "cpu"):
        if not env.task.auto_reset:
            raise PoiseError(
                "rsl_rl needs worlds that reset themselves, but auto_reset is off",
                hint="Make the ImitationEnv with auto_reset=True",
            )
        try:
            self._dict = import_module("tensordict").TensorDict
        except ImportError:
            raise PoiseError(
                "RslRlVecEnv needs tensordict, which is not installed",
                hint="Install it with: pip install 'poise-motion[rsl-rl]'",
            ) from None
        self.env, self.device = env, torch.device(device)
        self.num_envs, self.num_obs, self.num_actions = env.num_envs, env.num_obs, env.num_actions
        self.max_episode_length = env.task.horizon
        self.cfg: dict[str, Any] = {
            "observations": [term.name for term in env.task.obs],
            "rewards": {term.name: term.weight for term in env.task.rewards},
            "horizon": env.task.horizon,
            "clips": list(env.reference.names),
        }
        self._obs = env.reset().clone()

    @property
    def episode_length_buf(self) -> Tensor:
        """Control steps of the running episodes, `(N,)` int64; rsl_rl may set it to random ages."""
        return self.env.age.to(self.device)

    @episode_length_buf.setter
    def episode_length_buf(self, age: Tensor) -> None:
        self.env.age.copy_(age)

    @property
    def unwrapped(self) -> ImitationEnv:
        """The worlds themselves."""
        return self.env

    def get_observations(self) -> TensorDict:
        """The present observations."""
        return self._dict({GROUP: self._obs.to(self.device)}, batch_size=[self.num_envs])

    def reset(self) -> tuple[TensorDict, dict[str, Any]]:
        """New episodes everywhere."""
        with torch.inference_mode(False):
            self._obs = self.env.reset().clone()
        return self.get_observations(), {}

    def step(self, actions: Tensor) -> tuple[TensorDict, Tensor, Tensor, dict[str, Any]]:
        """One control step: observations, rewards `(N,)`, dones `(N,)` int64, extras."""
        # Rsl_rl collects in inference mode; its tensors could not be changed outside of it.
        with torch.inference_mode(False), torch.no_grad():
            out = self.env.step(actions.detach().to(self.env.device, copy=True))
            self._obs = out.obs.clone()
            dones = (out.terminated | out.truncated).long()
            time_outs = out.truncated & ~out.terminated
            reward = out.reward.clone()
        extras = {
            "time_outs": time_outs.to(self.device),
            # A name with a stroke stands for itself in rsl_rl's log.
            "log": {f"/{name}": value for name, value in out.log.items()},
        }
        return self.get_observations(), reward.to(self.device), dones.to(self.device), extras

    def close(self) -> None:
        """Frees the worlds."""
        self.env.close()
