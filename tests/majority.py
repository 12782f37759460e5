"""What a policy has learned is judged by the majority of three seeds."""

from __future__ import annotations

from collections.abc import Callable


def majority(check: Callable[[int], None]) -> None:
    """Calls check(seed) until it passed, or raised AssertionError, for two of the seeds 0, 1 and 2."""
    failed: list[AssertionError] = []
    for seed in range(3):
        try:
            check(seed)
        except AssertionError as wrong:
            failed.append(wrong)
        if len(failed) == 2:
            raise failed[1]
        if seed + 1 - len(failed) == 2:
            return
