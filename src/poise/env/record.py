"""Recordings of tensor functions: the operations of one call, replayed without Python."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any, cast

import torch
from torch import Tensor

TensorFunction = Callable[..., tuple[Tensor, ...]]

#: Where a slice without an end ends.
_END = torch.iinfo(torch.int64).max


def record(plain: TensorFunction, given: tuple[Tensor, ...]) -> TensorFunction:
    """What `plain(*given)` does, as one call for any number of worlds (TorchScript).

    It is the same operations in the same order, without Python's share: half of the time for hundreds
    of worlds, most of it for one. It runs in torch's inference mode: copy what it makes before giving
    it to code that may want gradients. A function with operations that depend on values, such as an `if`
    on a tensor, cannot be recorded: it is given back as it is.
    """
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        try:
            recorded = cast(Any, torch.jit.trace(plain, given, check_trace=False))
        except RuntimeError:
            return plain
    # What a recording would freeze, such as a value that was asked for, torch only warns of.
    if any(issubclass(w.category, torch.jit.TracerWarning) for w in told):
        return plain
    _drop_whole_slices(recorded.graph)

    def replay(*given: Tensor) -> tuple[Tensor, ...]:
        # What every operation otherwise notes for gradients is a sixth of the time of one world.
        with torch.inference_mode():
            return recorded(*given)

    return replay


def _drop_whole_slices(graph: Any) -> None:
    """Takes out the `[:]` of every `x[:, 2:]`, which a recording would run as a step of its own."""
    for node in graph.findAllNodes("aten::slice"):
        source, _, *bounds = node.inputs()
        if [b.toIValue() for b in bounds] == [0, _END, 1]:
            node.output().replaceAllUsesWith(source)
            node.destroy()
