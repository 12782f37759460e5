"""A trained policy on its own: normaliser and network, without the trainer."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from poise.learn.checkpoint import check_fits, load_checkpoint, save_checkpoint
from poise.learn.state import State, load_module, prefixed, take
from poise.nets import MLP, GaussianPolicy, RunningNorm


@dataclass(eq=False)
class PolicyBundle:
    """A policy that acts on raw observations; it satisfies the `Policy` protocol.

    norm: the observations' normaliser. policy: the Gaussian over actions.
    shape: what rebuilds the networks (hidden, activation, obs_clip). meta: the checkpoint's data.
    """

    norm: RunningNorm
    policy: GaussianPolicy
    shape: dict[str, Any]
    meta: dict[str, Any] = field(default_factory=dict)

    @classmethod
    def make(
        cls,
        num_obs: int,
        num_actions: int,
        hidden: tuple[int, ...] = (256, 128),
        activation: str = "relu",
        std: float | tuple[float, ...] = 0.1,
        learn_std: bool = False,
        obs_clip: float = 5.0,
        *,
        generator: torch.Generator,
    ) -> PolicyBundle:
        """An untrained policy whose mean action is nearly 0."""
        mean = MLP(num_obs, hidden, num_actions, activation, last_scale=0.1, generator=generator)
        shape = {"hidden": list(hidden), "activation": activation, "obs_clip": obs_clip}
        return cls(RunningNorm(num_obs, obs_clip), GaussianPolicy(mean, std, learn_std), shape)

    @property
    def num_obs(self) -> int:
        """O, the width of an observation."""
        return self.policy.mean.num_in

    @property
    def num_actions(self) -> int:
        """A, the width of an action."""
        return self.policy.mean.num_out

    @torch.no_grad()
    def act(self, obs: Tensor) -> Tensor:
        """The mean action `(N, A)` for raw observations `(N, O)`."""
        return self.policy.forward(self.norm.forward(obs))

    @torch.no_grad()
    def sample(self, obs: Tensor, generator: torch.Generator) -> Tensor:
        """An action `(N, A)` drawn as in training."""
        return self.policy.sample(self.norm(obs), generator)[0]

    def to(self, device: torch.device | str) -> PolicyBundle:
        """Moves it to where it shall act; returns itself."""
        self.norm.to(device)
        self.policy.to(device)
        return self

    def copy(self) -> PolicyBundle:
        """An independent copy, which later training does not change."""
        return copy.deepcopy(self)

    def state(self) -> State:
        """Copies of all tensors, under "norm/" and "policy/"."""
        return prefixed("norm", self.norm.state_dict()) | prefixed("policy", self.policy.state_dict())

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Restores what `state` returned into networks of the same sizes."""
        load_module(self.norm, state, "norm")
        load_module(self.policy, state, "policy")

    def identity(self, character: str) -> dict[str, Any]:
        """What a checkpoint states about the policy so that `load_policy` can rebuild it."""
        sizes = {"num_obs": self.num_obs, "num_actions": self.num_actions}
        return {"character": character, **sizes, "policy": self.shape}

    def save(
        self, path: str | Path, character: str = "", metadata: Mapping[str, Any] | None = None
    ) -> None:
        """Writes the policy alone as a checkpoint of the kind "policy"."""
        meta = {"kind": "policy", **self.identity(character), "metadata": dict(metadata or {})}
        save_checkpoint(path, self.state(), meta)


@dataclass(frozen=True, eq=False)
class WarmStart:
    """What reinforcement learning may start from.

    policy: weights and observation statistics. critic: `PPO.state()` entries under "critic/" and
    "return_norm/", or None for an untrained critic. samples, seconds: what it cost to make.
    """

    policy: PolicyBundle
    critic: State | None = None
    samples: int = 0
    seconds: float = 0.0


def load_policy(
    path: str | Path,
    character: str | None = None,
    num_obs: int | None = None,
    num_actions: int | None = None,
) -> PolicyBundle:
    """The policy in a checkpoint, of a whole trainer or of a policy alone.

    Whatever is given of `character`, `num_obs` and `num_actions` must match, or a `PoiseError`
    says what was found and what was expected.
    """
    tensors, meta = load_checkpoint(path)
    check_fits(meta, path, character=character, num_obs=num_obs, num_actions=num_actions)
    shape = meta["policy"]
    std = tuple(take(tensors, "policy/log_std").exp().tolist())
    bundle = PolicyBundle.make(
        meta["num_obs"],
        meta["num_actions"],
        tuple(shape["hidden"]),
        shape["activation"],
        std,
        obs_clip=shape["obs_clip"],
        generator=torch.Generator().manual_seed(0),
    )
    bundle.load_state(tensors)
    bundle.meta = meta
    return bundle
