"""The imitation environment as Gymnasium and as rsl_rl know environments: bring your own learner."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from torch import Tensor

from poise.env.task import EnvStep
from poise.errors import PoiseError

if TYPE_CHECKING:
    from tensordict import TensorDict

    from poise.env.env import ImitationEnv


Info = dict[str, Any]


class GymVectorEnv(VectorEnv):
    """All worlds of an `ImitationEnv` as one `gymnasium.vector.VectorEnv`.

    Observations `(N, O)` and actions `(N, A)` are float32. Where an episode ends, the world begins the
    next one in the same step: its last observation stands in `infos["final_obs"]`, as Gymnasium's
    SAME_STEP mode has it. `log` holds the last step's means by name.

    Args:
        env: the worlds, with automatic reset.
        limit: the action space is `[-limit, limit]` in the environment's own units (rad per unit of
            `PDTargets.scale` for joints, shares of the limit for residual forces), declared for
            learners that need bounds; actions are not clipped. Absolute joint targets need more
            than 1 rad or a larger `PDTargets.scale`.
    """

    def __init__(self, env: ImitationEnv, limit: float = 1.0):
        if not env.task.auto_reset:
            raise PoiseError(
                "the vector environment needs worlds that reset themselves, but auto_reset is off",
                hint="Make the ImitationEnv with auto_reset=True",
                code="auto-reset-needed",
            )
        self.env, self.num_envs = env, env.num_envs
        self.log: dict[str, float] = {}
        self.metadata = {"autoreset_mode": AutoresetMode.SAME_STEP, "render_modes": []}
        self.single_observation_space, self.single_action_space = _spaces(env, limit)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[np.ndarray, Info]:
        """New episodes everywhere; `seed` makes all that follows repeatable."""
        super().reset(seed=seed)
        _reseed(self.env, seed)
        return _array(self.env.reset()), {}

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, Info]:
        """One control step of all worlds: observations, rewards, terminations, truncations, infos."""
        out = self.env.step(_actions(actions))
        terminated, truncated = _ended(out)
        self.log = dict(out.log)
        infos: Info = {}
        over = terminated | truncated
        if over.any():
            last = np.full(self.num_envs, None, dtype=object)
            final = _array(out.final_obs)
            for i in np.flatnonzero(over):
                last[i] = final[i]
            infos |= {"final_obs": last, "_final_obs": over}
            infos |= {"final_info": {}, "_final_info": over}
        return _array(out.obs), _array(out.reward), terminated, truncated, infos

    def close_extras(self, **kwargs: Any) -> None:
        """Frees the worlds."""
        self.env.close()


class GymEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """A single world as a `gymnasium.Env`; the caller resets it when an episode ends.

    Args:
        env: one world without automatic reset.
        limit: see `GymVectorEnv`.
    """

    metadata = {"render_modes": []}  # noqa: RUF012 - Gymnasium's own form

    def __init__(self, env: ImitationEnv, limit: float = 1.0):
        if env.num_envs != 1 or env.task.auto_reset:
            raise PoiseError(
                f"a single environment needs one world without auto_reset, got {env.num_envs} with "
                f"auto_reset={env.task.auto_reset}",
                hint="Make the ImitationEnv with num_envs=1, auto_reset=False, or use GymVectorEnv",
                code="single-world-needed",
            )
        self.env = env
        self.observation_space, self.action_space = _spaces(env, limit)

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[np.ndarray, Info]:
        """A new episode at a random frame; `seed` makes all that follows repeatable."""
        super().reset(seed=seed)
        _reseed(self.env, seed)
        return _array(self.env.reset())[0], {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, Info]:
        """One control step: observation, reward, terminated, truncated, info."""
        out = self.env.step(_actions(np.asarray(action)[None]))
        terminated, truncated = _ended(out)
        return (
            _array(out.obs)[0],
            float(out.reward[0]),
            bool(terminated[0]),
            bool(truncated[0]),
            {"log": dict(out.log)},
        )

    def close(self) -> None:
        """Frees the world."""
        self.env.close()


def _spaces(env: ImitationEnv, limit: float) -> tuple[Box, Box]:
    if not limit > 0:
        raise PoiseError(f"the action limit must be above 0, got {limit}", code="out-of-range")
    obs = Box(-np.inf, np.inf, (env.num_obs,), np.float32)
    return obs, Box(-limit, limit, (env.num_actions,), np.float32)


def _reseed(env: ImitationEnv, seed: int | None) -> None:
    if seed is not None:
        env.reseed(seed)


def _actions(actions: np.ndarray) -> Tensor:
    return torch.as_tensor(np.array(actions, dtype=np.float32))


def _array(values: Tensor) -> np.ndarray:
    """A copy, since the environment may use its tensors again."""
    return np.array(values.detach().cpu().numpy(), dtype=np.float32)


def _ended(out: EnvStep) -> tuple[np.ndarray, np.ndarray]:
    return out.terminated.cpu().numpy().copy(), out.truncated.cpu().numpy().copy()


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
                code="auto-reset-needed",
            )
        try:
            self._dict = import_module("tensordict").TensorDict
        except ImportError:
            raise PoiseError(
                "RslRlVecEnv needs tensordict, which is not installed",
                hint="Install it with: pip install 'poise-motion[rsl-rl]'",
                code="extra-missing",
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
