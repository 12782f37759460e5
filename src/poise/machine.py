"""Differences between systems: how many cores there are, and how torch uses them while worlds step."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator


def cores() -> int:
    """The cores that this process may use; where the system does not say that, those of the machine."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Torch computes on one thread within, as on the command line, and afterwards on as many as before.

    The physics of many worlds uses the cores; torch's own threads, which wait for work by spinning,
    would take them from it. OMP_NUM_THREADS overrules it. It may be entered again within itself.
    """
    import torch

    before = torch.get_num_threads()
    if before == 1 or "OMP_NUM_THREADS" in os.environ:
        yield
        return
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
