"""The imitation environment as Gymnasium knows environments: many worlds at once, or one."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from torch import Tensor

from poise.env.env import EnvStep, ImitationEnv
from poise.errors import PoiseError

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
        raise PoiseError(f"the action limit must be above 0, got {limit}")
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
