"""Recordings of functions of tensors, which are replayed without Python's share of the time."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

TensorFunction = Callable[..., tuple[Tensor, ...]]

#: Where a slice without an end ends.
_END = torch.iinfo(torch.int64).max
#: Calls after which a function is recorded that is often called: making a recording takes as long as
#: some fifty of them.
OFTEN = 100


class Recorded:
    """A function of tensors on the CPU that is recorded once it is called often, see `record`.

    What it returns is not to be written into.
    """

    def __init__(self, plain: TensorFunction):
        self._function, self._left = plain, OFTEN

    def __call__(self, *given: Tensor) -> tuple[Tensor, ...]:
        self._left -= 1
        if self._left == 0 and given[0].device.type == "cpu":
            self._function = record(self._function, given)
        return self._function(*given)


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
            graph = _traced(plain, given)
        except RuntimeError:
            return plain
    # What a recording would freeze, such as a value that was asked for, torch only warns of.
    if any(issubclass(w.category, torch.jit.TracerWarning) for w in told):
        return plain
    _drop_whole_slices(graph)
    recorded = torch._C._create_function_from_graph("replayed", graph)

    def replay(*given: Tensor) -> tuple[Tensor, ...]:
        # What every operation otherwise notes for gradients is a sixth of the time of one world.
        with torch.inference_mode():
            return recorded(*given)

    return replay


def _traced(plain: TensorFunction, given: tuple[Tensor, ...]) -> Any:
    """The operations of `plain(*given)`.

    `torch.jit.trace` does the same, but keeps the function and its constants until the process ends,
    which is some MB for every environment.
    """
    names = [f"given{k}" for k in range(len(given))]
    return torch._C._create_graph_by_tracing(plain, given, lambda _: "", True, False, None, names)[0]


def _drop_whole_slices(graph: Any) -> None:
    """Takes out the `[:]` of every `x[:, 2:]`, which a recording would run as a step of its own."""
    for node in graph.findAllNodes("aten::slice"):
        source, _, *bounds = node.inputs()
        if [b.toIValue() for b in bounds] == [0, _END, 1]:
            node.output().replaceAllUsesWith(source)
            node.destroy()
