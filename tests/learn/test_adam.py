"""Adam steps as torch's own does, to the bit, and a checkpoint of either is the other's."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from poise.learn.adam import Adam
from poise.learn.checkpoint import load_optimizer_state, optimizer_state


def weights() -> list[torch.nn.Parameter]:
    rng = torch.Generator().manual_seed(0)
    return [torch.nn.Parameter(torch.randn(n, 37, generator=rng)) for n in (5, 64, 1)]


def stepped(optimizer: Any, params: list[torch.nn.Parameter], steps: int, seed: int) -> None:
    rng = torch.Generator().manual_seed(seed)
    for k in range(steps):
        optimizer.zero_grad(set_to_none=True)
        for i, p in enumerate(params):
            # One of them has no gradient at first.
            if i or k > 1:
                p.grad = torch.randn(p.shape, generator=rng) * 10.0 ** (k - 3)
        optimizer.param_groups[0]["lr"] = 1e-3 * (k + 1)
        optimizer.step()


@pytest.mark.parametrize("how", [{"fused": True}, {"fused": False}, {"fused": False, "amsgrad": True}])
@pytest.mark.parametrize("decay", [0.0, 0.3])
def test_it_is_torchs_to_the_bit(how: dict[str, bool], decay: float) -> None:
    mine, theirs = weights(), weights()
    a = Adam(mine, 1e-3, (0.9, 0.98), weight_decay=decay, **how)
    make: Any = torch.optim.AdamW if decay else torch.optim.Adam
    b = make(theirs, 1e-3, (0.9, 0.98), weight_decay=decay, **how)
    for optimizer, params in ((a, mine), (b, theirs)):
        stepped(optimizer, params, 6, 1)
    assert all(torch.equal(x, y) for x, y in zip(mine, theirs, strict=True))
    one, two = optimizer_state(a), optimizer_state(b)
    assert one.keys() == two.keys() and all(torch.equal(one[k], two[k]) for k in one)
    # Each goes on from what the other had.
    c, d = Adam(mine, weight_decay=decay, **how), make(theirs, weight_decay=decay, **how)
    load_optimizer_state(c, two)
    load_optimizer_state(d, one)
    for optimizer, params in ((c, mine), (d, theirs)):
        stepped(optimizer, params, 3, 2)
    assert all(torch.equal(x, y) for x, y in zip(mine, theirs, strict=True))


def test_groups_decay_on_their_own() -> None:
    a, b = weights()[:2]
    groups = [{"params": [a], "weight_decay": 0.5}, {"params": [b], "weight_decay": 0.0}]
    before = a.detach().clone(), b.detach().clone()
    optimizer = Adam(groups, lr=0.1)
    for p in (a, b):
        p.grad = torch.zeros_like(p)
    optimizer.step()
    torch.testing.assert_close(a.detach(), before[0] * 0.95)
    assert torch.equal(b.detach(), before[1])
