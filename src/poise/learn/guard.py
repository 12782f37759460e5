"""Finds the first number that is not finite and says where it came from."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from poise.errors import PoiseError


class TrainingError(PoiseError):
    """Training met a number that is not finite; the weights are those before the fault."""


def check_finite(name: str, x: Tensor, log: Mapping[str, float] | None = None) -> None:
    """Raises a `TrainingError` with the first bad row of `x (N, ...)`.

    Args:
        name: what `x` is, such as "observation".
        log: the step's terms; those that are not finite are named too.
    """
    # One sum finds NaN and infinity alike at a fraction of the cost of a mask.
    if math.isfinite(float(x.sum())):
        return
    bad = (~torch.isfinite(x)).nonzero()
    if len(bad) == 0:
        return
    row, *entry = bad[0].tolist()
    place = f", entry {entry[0]}" if entry else ""
    terms = [k for k, v in (log or {}).items() if not math.isfinite(v)]
    named = f" (faulty terms: {', '.join(terms)})" if terms else ""
    raise TrainingError(
        f"the {name} is not finite{named}",
        f"environment row {row}{place}",
        "The simulation or a term has diverged there; the weights are those of the last good iteration",
    )
