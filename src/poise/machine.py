"""What differs between systems: how many cores there are."""

from __future__ import annotations

import os


def cores() -> int:
    """The cores that this process may use; where the system does not say that, those of the machine."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
