"""The stages of a progressive multiplicative policy (PHC, section 3.2, Alg. 1), each a `PolicyBundle`.

    first = first_column(num_obs, num_actions, generator=g)    # or columns_of(a cloned policy)
    second = next_column(first, generator=g)                   # the first one is frozen
    whole = compose(second, generator=g)                       # all are frozen, the composer learns

Each is trained by `Trainer(..., warm_start=WarmStart(bundle, critic))`, is saved and loaded as any
policy, and is the start of the next. Columns share the first one's observation normaliser, which no
longer changes from the second column on.
"""

from __future__ import annotations

import copy
from typing import Any

import torch

from poise.errors import PoiseError
from poise.learn.composer import Combine, Composer, Weights
from poise.learn.networks import MLP, GaussianPolicy, ProgressiveNet, RunningNorm, Start
from poise.learn.policy import PolicyBundle


def first_column(
    num_obs: int,
    num_actions: int,
    hidden: tuple[int, ...] = (256, 128),
    activation: str = "relu",
    std: float | tuple[float, ...] = 0.1,
    lateral: bool = False,
    learn_std: bool = False,
    obs_clip: float = 5.0,
    *,
    generator: torch.Generator,
) -> PolicyBundle:
    """The first primitive, untrained; `lateral` decides for all later ones whether they look at it.

    PHC has hidden (1024, 512), relu and exp(-2.9) = 0.055 as std.
    """
    net = ProgressiveNet(num_obs, hidden, num_actions, activation, lateral, generator=generator)
    shape = _shape(net, obs_clip)
    return PolicyBundle(RunningNorm(num_obs, obs_clip), GaussianPolicy(net, std, learn_std), shape)


def columns_of(bundle: PolicyBundle, lateral: bool = False) -> PolicyBundle:
    """A trained perceptron, such as a cloned one, as the first primitive; acts as before."""
    mean = bundle.policy.mean
    if not isinstance(mean, MLP) or isinstance(bundle.policy, Composer):
        raise PoiseError(
            "only a single perceptron can become the first primitive", code="policy-of-primitives"
        )
    rng = torch.Generator().manual_seed(0)
    hidden = tuple(bundle.shape["hidden"])
    net = ProgressiveNet(
        mean.num_in, hidden, mean.num_out, bundle.shape["activation"], lateral, generator=rng
    )
    net.column(0).load_state_dict(mean.state_dict())
    return _with_net(bundle, net.to(mean.last.weight.device), bundle.policy.log_std.detach())


def next_column(
    bundle: PolicyBundle, start: Start = "copy", *, generator: torch.Generator
) -> PolicyBundle:
    """One primitive more, which alone learns; those before it and the normaliser are frozen.

    start: "copy" of the last column, as PHC's code does it (the paper's weight sharing), or "random",
    with lateral connections as the paper describes it. Its action noise is that of the last column.
    """
    net, log_std = _columns(bundle).copy(), primitive_log_std(bundle)
    net.log_std.copy_(log_std)
    net.add(start, generator)
    return _with_net(bundle, net, log_std[-1])


def primitive(bundle: PolicyBundle, k: int) -> PolicyBundle:
    """Primitive k of columns or of a composer as a policy of its own, to be evaluated."""
    net = _columns(bundle).copy()
    if not 0 <= k < len(net):
        raise PoiseError(f"there is no primitive {k} among {len(net)}", code="index-outside")
    net.keep(k + 1)
    return _with_net(bundle, net, primitive_log_std(bundle)[k])


def compose(
    bundle: PolicyBundle,
    combine: Combine = "product",
    weights: Weights = "softmax",
    hidden: tuple[int, ...] | None = None,
    std: float = 0.1,
    learn_std: bool = False,
    joint: bool = False,
    *,
    generator: torch.Generator,
) -> PolicyBundle:
    """All primitives frozen under an untrained composer; see `Composer`.

    PHC's paper takes "product", its code "means" with "relu" or "silu".

    Args:
        hidden: of the composer, by default as the primitives'.
        joint: all learn together, from a fresh normaliser if there is no other.
    """
    net, log_std = _columns(bundle).copy(), primitive_log_std(bundle)
    hidden = net.hidden if hidden is None else hidden
    policy = Composer(
        net,
        log_std,
        hidden,
        net.activation,
        combine,
        weights,
        std,
        learn_std,
        joint,
        generator=generator,
    )
    norm = copy.deepcopy(bundle.norm)
    norm.fixed = not joint
    own = {"composer_hidden": list(hidden), "combine": combine, "weights": weights, "joint": joint}
    return PolicyBundle(norm, policy, _shape(net, norm.clip) | {"kind": "composer"} | own)


def primitive_log_std(bundle: PolicyBundle) -> torch.Tensor:
    """log sigma `(K, A)` with which each primitive was trained."""
    policy, log_std = bundle.policy, _columns(bundle).log_std.clone()
    if not isinstance(policy, Composer):
        log_std[-1] = policy.log_std.detach()
    return log_std


def count(bundle: PolicyBundle) -> int:
    """K, the number of primitives of columns or of a composer."""
    return len(_columns(bundle))


def _columns(bundle: PolicyBundle) -> ProgressiveNet:
    policy = bundle.policy
    net = policy.primitives if isinstance(policy, Composer) else policy.mean
    if not isinstance(net, ProgressiveNet):
        raise PoiseError(
            "the policy has no primitives", hint="Make it one with columns_of", code="no-primitives"
        )
    return net


def _with_net(bundle: PolicyBundle, net: ProgressiveNet, log_std: torch.Tensor) -> PolicyBundle:
    """The bundle's normaliser with these columns, the last of which has the noise `log_std (A,)`."""
    norm = copy.deepcopy(bundle.norm)
    norm.fixed = len(net) > 1
    policy = GaussianPolicy(net, log_std.exp().tolist(), bundle.policy.log_std.requires_grad)
    with torch.no_grad():
        # Without the rounding of exp and log.
        policy.log_std.copy_(log_std)
    return PolicyBundle(norm, policy.to(log_std.device), _shape(net, norm.clip))


def _shape(net: ProgressiveNet, obs_clip: float) -> dict[str, Any]:
    return {
        "kind": "progressive",
        "hidden": list(net.hidden),
        "activation": net.activation,
        "obs_clip": obs_clip,
        "columns": len(net),
        "lateral": net.lateral,
    }
