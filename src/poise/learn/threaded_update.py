"""Two cores in one iteration: the critic beside the policy, and the policy in two parts."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

import torch
from torch import Tensor, nn

T = TypeVar("T")

#: Products of rows and weights from which a minibatch is worth two threads.
WORTH = 100_000_000


class ThreadedUpdate:
    """Starts work in threads of their own, made when the first is asked for."""

    def __init__(self) -> None:
        self._pool: ThreadPoolExecutor | None = None

    def __call__(self, parallel: bool, work: Callable[..., T], *args: Any) -> Callable[[], T]:
        """Starts `work`, or does it at once where not `parallel`; gives what waits for its result."""
        if not parallel:
            result = work(*args)
            return lambda: result
        if self._pool is None:
            # One for the critic, one for the second part of the policy's minibatch.
            self._pool = ThreadPoolExecutor(2, "update", torch.set_num_threads, (1,))
        return self._pool.submit(work, *args).result


def parts_of(index: Tensor, weights: int, processes: int) -> tuple[Tensor, ...]:
    """A minibatch's rows in the parts of which gradients are computed apart, by whichever thread.

    So a sum is of the same numbers with one thread and with two. On a GPU, in one of several processes
    and of little work it is one part.
    """
    whole = index.device.type != "cpu" or processes > 1 or index.numel() * weights < WORTH
    return (index,) if whole else index.tensor_split(2)


def mean_gradient(
    parts: Sequence[Tensor],
    params: Sequence[nn.Parameter],
    loss_and_terms: Callable[[Tensor], tuple[Tensor, Tensor]],
    beside: ThreadedUpdate,
    parallel: bool,
) -> Tensor:
    """Fills `params` with the gradient of the mean loss over all rows of `parts`; the mean terms `(K,)`.

    loss_and_terms: of some rows, the mean loss with a gradient and terms without.
    """
    rows = sum(part.numel() for part in parts)

    def part_of(index: Tensor) -> tuple[tuple[Tensor | None, ...], Tensor]:
        loss, terms = loss_and_terms(index)
        share = index.numel() / rows
        return torch.autograd.grad(loss * share, params, allow_unused=True), terms * share

    others = [beside(parallel, part_of, part) for part in parts[1:]]
    try:
        gradient, terms = part_of(parts[0])
    finally:
        # No thread outlives the step.
        found = [other() for other in others]
    for param, value in zip(params, gradient, strict=True):
        param.grad = value
    for more, their_terms in found:
        for mine, theirs in zip(gradient, more, strict=True):
            if mine is not None and theirs is not None:
                mine.add_(theirs)
        terms = terms + their_terms
    return terms
