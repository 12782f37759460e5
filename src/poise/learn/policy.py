"""A trained policy on its own, without the trainer: normaliser, network, and what its critic tells."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from poise.errors import PoiseError
from poise.learn.checkpoint import (
    PolicyMeta,
    State,
    check_fits,
    load_checkpoint,
    load_module,
    prefixed,
    save_checkpoint,
)
from poise.learn.composer import Composer
from poise.learn.networks import MLP, GaussianPolicy, ProgressiveNet, RunningNorm
from poise.settings import check_data


@dataclass(eq=False)
class PolicyBundle:
    """A policy that acts on raw observations; it satisfies the `Policy` protocol.

    Attributes:
        norm: the observations' normaliser.
        policy: the Gaussian over actions.
        shape: what rebuilds the networks (hidden, activation, obs_clip and, but for a single
            perceptron, its kind with what `poise.learn.primitives` adds).
        meta: the checkpoint's data.
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
        """An untrained policy with a mean action of nearly 0."""
        mean = MLP(num_obs, hidden, num_actions, activation, last_scale=0.1, generator=generator)
        shape = {"hidden": list(hidden), "activation": activation, "obs_clip": obs_clip}
        return cls(RunningNorm(num_obs, obs_clip), GaussianPolicy(mean, std, learn_std), shape)

    @classmethod
    def rebuild(cls, num_obs: int, num_actions: int, shape: Mapping[str, Any]) -> PolicyBundle:
        """An untrained policy of a checkpoint's `shape`; its state is to be loaded.

        Raises:
            PoiseError: a kind of policy that this version does not know.
        """
        rng = torch.Generator().manual_seed(0)
        hidden, activation, clip = tuple(shape["hidden"]), shape["activation"], shape["obs_clip"]
        # Policies of before there were kinds are perceptrons.
        kind = shape.get("kind", "perceptron")
        if kind == "perceptron":
            return cls.make(num_obs, num_actions, hidden, activation, 1.0, obs_clip=clip, generator=rng)
        if kind not in ("progressive", "composer"):
            raise PoiseError(
                f"a policy of the kind '{kind}' is unknown",
                hint="Use the version of Poise that saved it",
                code="unknown-choice",
            )
        lateral = shape["lateral"]
        net = ProgressiveNet(num_obs, hidden, num_actions, activation, lateral, generator=rng)
        for _ in range(shape["columns"] - 1):
            net.add("random", rng)
        norm = RunningNorm(num_obs, clip)
        if kind == "progressive":
            # Frozen columns keep the normaliser they were trained with, and the others share it.
            norm.fixed = len(net) > 1
            return cls(norm, GaussianPolicy(net, 1.0), dict(shape))
        policy = Composer(
            net,
            torch.zeros(len(net), num_actions),
            tuple(shape["composer_hidden"]),
            activation,
            shape["combine"],
            shape["weights"],
            joint=shape["joint"],
            generator=rng,
        )
        norm.fixed = not policy.joint
        return cls(norm, policy, dict(shape))

    @property
    def num_obs(self) -> int:
        """O, the width of an observation."""
        return self.policy.num_obs

    @property
    def num_actions(self) -> int:
        """A, the width of an action."""
        return self.policy.num_actions

    @property
    def learns_itself(self) -> bool:
        """Whether training goes on with these very networks and not with a perceptron of the config."""
        return self.shape.get("kind", "perceptron") != "perceptron"

    @torch.no_grad()
    def act(self, obs: Tensor) -> Tensor:
        """The mean action `(N, A)` for raw observations `(N, O)`."""
        return self.policy.act(self.norm.forward(obs))

    @torch.no_grad()
    def sample(self, obs: Tensor, generator: torch.Generator) -> Tensor:
        """An action `(N, A)` drawn as in training."""
        return self.policy.act(self.norm(obs), generator)

    def to(self, device: torch.device | str) -> PolicyBundle:
        """Moves it to where it shall act; returns itself."""
        self.norm.to(device)
        self.policy.to(device)
        return self

    def copy(self) -> PolicyBundle:
        """An independent copy, which later training does not change."""
        return copy.deepcopy(self)

    def with_actions(self, count: int) -> PolicyBundle:
        """The same policy for so many actions: later ones are left out, such as those of a force that
        helps no more, and further ones are 0 in every state, with a deviation of 1."""
        out = PolicyBundle.rebuild(self.num_obs, count, self.shape)
        wanted, kept = out.state(), min(count, self.num_actions)

        def fitted(name: str, value: Tensor) -> Tensor:
            if value.shape == wanted[name].shape:
                return value
            made = torch.zeros_like(wanted[name])
            made[:kept] = value[:kept]
            return made

        out.load_state({k: fitted(k, v) for k, v in self.state().items()})
        return out

    def seeing(self, factors: Tensor) -> PolicyBundle:
        """The same policy that acts on `x` as this one on `factors (O,) * x`, such as metres as if its
        body had another size."""
        out = self.copy()
        state = out.state()
        for name, power in (("mean", 1), ("shift", 1), ("std", 1), ("m2", 2)):
            own = state[f"norm/{name}"]
            state[f"norm/{name}"] = (own.double() / factors.double() ** power).to(own)
        out.load_state(state)
        return out

    def widened(self, num_obs: int, columns: Tensor) -> PolicyBundle:
        """The same policy for observations of `num_obs` numbers, of which it reads those at `columns
        (O,)`. What it does not read yet has weights of 0, a mean of 0 and a deviation of 1."""
        out = PolicyBundle.rebuild(num_obs, self.num_actions, self.shape)
        state = spread(self.state(), out.state(), columns)
        fresh = torch.ones(num_obs, dtype=torch.bool)
        fresh[columns] = False
        state["norm/std"][fresh] = 1.0
        state["norm/m2"][fresh] = state["norm/count"]
        out.load_state(state)
        out.meta = dict(self.meta)
        return out

    def clipped(self, at: float) -> PolicyBundle:
        """The same policy with observations clipped so many deviations from their means."""
        out = self.copy()
        out.norm.clip = at
        out.shape = {**out.shape, "obs_clip": at}
        return out

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


def spread(state: Mapping[str, Tensor], like: Mapping[str, Tensor], columns: Tensor) -> State:
    """Copies of tensors that are as large as those of `like`: those that are narrower fill `columns`
    of zeros."""
    out = {k: v.clone() for k, v in state.items()}
    for name, value in like.items():
        if out[name].shape != value.shape:
            out[name] = torch.zeros_like(value)
            out[name][..., columns] = state[name]
    return out


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

    def of(self, policy: PolicyBundle) -> Value:
        """The same critic behind another policy's normaliser."""
        out = copy.copy(self)
        out.norm = policy.norm
        return out

    @torch.no_grad()
    def __call__(self, obs: Tensor) -> Tensor:
        """`(N,)` for raw observations `(N, O)`."""
        return self.scale.inverse(self.critic(self.norm.forward(obs))).squeeze(-1)

    def state(self) -> State:
        """What it is made of."""
        scale = prefixed("return_norm", self.scale.state_dict())
        return prefixed("critic", self.critic.state_dict()) | scale


@dataclass(frozen=True, eq=False)
class WarmStart:
    """What reinforcement learning may start from.

    Attributes:
        policy: weights and observation statistics; a policy that is no plain perceptron, such as a
            column or a composer of `poise.learn.primitives`, goes on learning itself, whatever sizes
            and action noise the config has.
        critic: `PPO.state()` entries under "critic/" and "return_norm/", or None for an untrained
            critic.
        samples: control steps that it cost to make.
        seconds: time that it cost to make.
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
    tensors, meta = load_checkpoint(path, PolicyMeta)
    check_fits(meta, path, character=character, num_obs=num_obs, num_actions=num_actions)
    return policy_in(tensors, meta, path)


def policy_in(tensors: Mapping[str, Tensor], meta: Mapping[str, Any], path: str | Path) -> PolicyBundle:
    """The policy that a checkpoint's tensors and metadata describe; `path` says where, for errors.

    Raises:
        PoiseError: they do not belong together, or there are weights that are no numbers.
    """
    check_data(PolicyMeta, meta, path)
    own = {k: v for k, v in tensors.items() if k.startswith(("norm/", "policy/"))}
    shape, hint = meta["policy"], "The file is damaged or was changed; take another one"
    sizes = (meta["num_obs"], *shape["hidden"], meta["num_actions"])
    need = shape.get("columns", 1) * sum(a * b for a, b in pairwise(sizes))
    # What is stated is compared with what is there before networks of that size are made.
    if min(*sizes, need) < 1 or need > sum(v.numel() for v in own.values()):
        raise PoiseError(
            f"its weights are not those of layers {' x '.join(map(str, sizes))}",
            path,
            hint,
            code="weights-unfit",
        )
    try:
        bundle = PolicyBundle.rebuild(meta["num_obs"], meta["num_actions"], shape)
        bundle.load_state(own)
    except PoiseError as problem:
        raise PoiseError(problem.what, path, problem.hint or hint, code=problem.code) from None
    except (KeyError, TypeError, ValueError, RuntimeError) as problem:
        raise PoiseError(
            f"its policy cannot be rebuilt ({problem})", path, hint, code="file-damaged"
        ) from None
    bad = [k for k, v in own.items() if v.is_floating_point() and not bool(v.isfinite().all())]
    if bad:
        raise PoiseError(
            f"'{bad[0]}' holds values that are no finite numbers", path, hint, code="not-finite"
        )
    bundle.meta = dict(meta)
    return bundle
