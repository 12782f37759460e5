"""Test-time adaptation of an in-betweening network (Skeleton2Humanoid, section 3.2, Eqs. 1, 2 and 4).

Only what the network itself says is used, never the truth: where it predicts that a foot stands, the
foot should not move, and the root should take the shorter way.

    L_contact = sum_t sum_f |p_f(t+1) - p_f(t)| contact_f(t+1)      (1)    t = 0 .. T-2, f: ankles, toes
    L_smooth  = sum_t ||r(t+1) - r(t)||_2                           (2)
    L_test    = L_contact + beta L_smooth                           (4)

Frame 0 is the last one that was seen, frames 1 .. T-1 are the transition. The paper gives neither beta,
nor the optimiser, nor which weights move; these are settings here.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, TypeVar

import torch
from torch import Tensor, nn

from poise.errors import PoiseError
from poise.learn.rollout import TrainingError
from poise.nets.transition import Filled, Known, TransitionNet, joint_positions
from poise.settings import validate

N = TypeVar("N", bound=nn.Module)


@dataclass(frozen=True)
class Adaptation:
    """How a network is adapted to what it is asked."""

    iterations: int = 5
    """Passes over the test set, or over one sequence; choose them on validation."""
    steps: Literal["whole", "minibatch"] = "whole"
    """whole: one step of each pass, down the mean loss of all sequences. minibatch: a step after each
    `batch` of them, as the paper's "several epochs on the whole test data" reads."""
    lr: float = 1e-5
    beta: float = 0.01
    """Weight of the root's path."""
    contacts: Literal["detached", "paper"] = "detached"
    """detached: predicted contacts only weigh. paper: gradients flow through them as Eq. 1 is written,
    so that predicting no contact at all also lowers the loss."""
    optimizer: Literal["sgd", "adam"] = "adam"
    batch: int = 128
    """Sequences of which gradients are computed at once; with `steps="whole"` it changes memory and time
    alone."""

    def __post_init__(self) -> None:
        if self.iterations < 0 or self.lr <= 0 or self.beta < 0 or self.batch < 1:
            raise PoiseError(
                f"iterations and beta must be at least 0, lr above 0, batch at least 1, got {self}"
            )
        validate(self)


def contact_loss(feet: Tensor, contact: Tensor) -> Tensor:
    """Eq. 1 `(N)` of foot joints `(N, T, F, 3)` m, frame 0 the last one seen, and their predicted
    contacts `(N, T - 1, F)` in frames 1 .. T - 1."""
    step = torch.diff(feet, dim=1).square().sum(-1)
    # The root of zero has no slope, and a foot that stands still has none to give.
    moved = torch.where(step > 0, step, torch.ones_like(step)).sqrt() * (step > 0)
    return (moved * contact).sum((1, 2))


def smoothness_loss(root: Tensor) -> Tensor:
    """Eq. 2 `(N)` of root paths `(N, T, 3)` m, frame 0 the last one seen: the length of the path."""
    step = torch.diff(root, dim=1).square().sum(-1)
    return (torch.where(step > 0, step, torch.ones_like(step)).sqrt() * (step > 0)).sum(1)


def test_loss(net: TransitionNet, known: Known, filled: Filled, config: Adaptation) -> Tensor:
    """Eq. 4 `(N)` of transitions that a network gave."""
    feet = list(net.layout.feet)
    seen = joint_positions(net.layout, known.offsets, known.past_root[:, -1:], known.past_rot[:, -1:])
    path = torch.cat((seen, filled.pos), 1)[:, :, feet]
    contact = filled.contact if config.contacts == "paper" else filled.contact.detach()
    root = torch.cat((known.past_root[:, -1:], filled.root), 1)
    return contact_loss(path, contact) + config.beta * smoothness_loss(root)


def adapt(
    net: N,
    known: Known,
    length: int,
    config: Adaptation | None = None,
    on_iteration: Callable[[int, N, float], None] | None = None,
) -> N:
    """A copy of the network adapted to a whole test set of one length; the given one stays as it is.

    With `steps="whole"` an iteration is one step down the mean loss of all sequences, so that as many
    iterations do as much to a large set as to the small one that they were chosen on.

    Args:
        known: all sequences; the gradients of `config.batch` at a time are computed, in order.
        on_iteration: called with its number (from 1), the network so far and the mean loss before it.

    Raises:
        TrainingError: the loss became infinite or not a number.
    """
    config = config or Adaptation()
    own = copy.deepcopy(net)
    params = [p for p in own.parameters() if p.requires_grad_(True) is p]
    kind = torch.optim.Adam if config.optimizer == "adam" else torch.optim.SGD
    optimizer = kind(params, lr=config.lr)
    count, often = len(known.target_root), config.steps == "minibatch"
    for iteration in range(1, config.iterations + 1):
        total = 0.0
        optimizer.zero_grad(set_to_none=True)
        for low in range(0, count, config.batch):
            part = Known(*(x[low : low + config.batch] for x in known))
            own_count = len(part.target_root)
            with torch.enable_grad():
                losses = test_loss(own, part, own.fill(part, length), config)  # type: ignore[arg-type]
                (losses.sum() / (own_count if often else count)).backward()
            total += float(losses.detach().sum()) / count
            if often:
                _stepped(optimizer, total)
                optimizer.zero_grad(set_to_none=True)
        if not often:
            _stepped(optimizer, total)
        if on_iteration is not None:
            on_iteration(iteration, own, total)
    for p in params:
        p.requires_grad_(False)
    return own


def _stepped(optimizer: torch.optim.Optimizer, loss: float) -> None:
    if not loss < float("inf"):
        raise TrainingError("the loss of the adaptation is not finite", hint="Lower its lr")
    optimizer.step()
