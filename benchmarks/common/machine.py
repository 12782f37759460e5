"""What a benchmark ran on, and the clocks it uses."""

from __future__ import annotations

import os
import platform
import statistics
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import mujoco
import torch

from poise import __version__


def cores() -> int:
    """The cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def machine() -> dict[str, Any]:
    """The machine and the versions, as every result states them."""
    load = round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else None
    return {
        "cores": cores(),
        "machine": platform.machine(),
        "system": platform.system(),
        "load_before": load,
        "python": platform.python_version(),
        "torch": torch.__version__.split("+")[0],
        "mujoco": mujoco.__version__,
        "poise": __version__,
    }


def memory_mb() -> float:
    """Resident memory of this process in MB, NaN where the system does not say."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except (OSError, ValueError, IndexError):
        return float("nan")
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def median(values: Sequence[float], digits: int = 3) -> float:
    """The median, rounded."""
    return round(statistics.median(values), digits)


class Clock:
    """Adds up the seconds spent in calls of some objects' methods, by name."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    def read(self) -> dict[str, float]:
        """The sums so far, which then start anew."""
        out, self.seconds = self.seconds, dict.fromkeys(self.seconds, 0.0)
        return out

    @contextmanager
    def on(self, owner: Any, method: str, name: str) -> Iterator[None]:
        """Times every call of `owner.method` within the block."""
        plain = getattr(owner, method)
        self.seconds.setdefault(name, 0.0)

        def timed(*args: Any, **options: Any) -> Any:
            start = time.perf_counter()
            try:
                return plain(*args, **options)
            finally:
                self.seconds[name] += time.perf_counter() - start

        setattr(owner, method, timed)
        try:
            yield
        finally:
            delattr(owner, method)
