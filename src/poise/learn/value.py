"""What a trained critic tells of a state, kept beside its policy."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from poise.learn.policy import PolicyBundle
from poise.learn.state import State, load_module, prefixed
from poise.nets import MLP, RunningNorm


class Value:
    """V(o): the discounted rewards that a policy is still to earn, as its critic predicts them.

    Args:
        policy: its normaliser is applied to observations first.
        state: entries of `PPO.state()` under "critic/" and "return_norm/".
        activation: of the critic's hidden layers, as it was trained.

    Raises:
        PoiseError: entries are missing, or of other sizes.
    """

    def __init__(self, policy: PolicyBundle, state: Mapping[str, Tensor], activation: str = "relu"):
        layers = sorted(k for k in state if k.startswith("critic/") and k.endswith("weight"))
        widths = tuple(len(state[k]) for k in layers)
        rng = torch.Generator().manual_seed(0)
        self.norm, self.scale = policy.norm, RunningNorm(1, clip=math.inf)
        self.critic = MLP(policy.num_obs, widths[:-1], 1, activation, generator=rng)
        load_module(self.critic, state, "critic")
        load_module(self.scale, state, "return_norm")

    @torch.no_grad()
    def __call__(self, obs: Tensor) -> Tensor:
        """`(N,)` for raw observations `(N, O)`."""
        return self.scale.inverse(self.critic(self.norm.forward(obs))).squeeze(-1)

    def state(self) -> State:
        """What it is made of."""
        scale = prefixed("return_norm", self.scale.state_dict())
        return prefixed("critic", self.critic.state_dict()) | scale
