"""How stepping scales with worlds and threads, and what memory the worlds take."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

from poise.recipes.imitation import Imitation
from speed.engine import Progress, Raw, exploring, record
from speed.machine import cores, median

WORLDS = (32, 64, 128, 256, 512, 1024, 2048)


def thread_counts() -> list[int]:
    """1, 2, 4, ... and all cores."""
    most, counts = cores(), [1]
    while counts[-1] * 2 < most:
        counts.append(counts[-1] * 2)
    return counts if counts[-1] == most else [*counts, most]


def bench_scaling(
    imitation: Imitation,
    worlds: Sequence[int] = WORLDS,
    threads: Sequence[int] | None = None,
    samples: int = 4096,
    repeats: int = 3,
    tell: Progress | None = None,
) -> list[dict[str, Any]]:
    """One row per number of worlds and threads: rates of stepping and of the raw limit, memory.

    `memory_mb` is what the worlds' own arrays take; a whole process stands in `bench_engine`.
    """
    rows = []
    for count in threads or thread_counts():
        for n in worlds:
            if tell is not None:
                tell(f"scaling, {n} worlds on {count} threads")
            rows.append(_row(imitation, n, count, max(2, samples // n), repeats))
    return rows


def _row(imitation: Imitation, n: int, threads: int, steps: int, repeats: int) -> dict[str, Any]:
    env = imitation.env(n, threads=threads)
    raw, rates, limits = Raw(env, threads), [], []
    env.reset()
    actions = exploring(imitation, env, steps)
    for action in actions[:4]:
        env.step(action)
    for _ in range(repeats):
        start = time.perf_counter()
        for action in actions:
            env.step(action)
        rates.append(n * steps / (time.perf_counter() - start))
        limits.append(n * steps / raw.seconds(record(env, actions)))
    # The state that is stepped and the guard's copy, derived fields, both observations.
    held = [env.backend.snapshot(derived=k == 0) for k in range(2)] + [env.reset()] * 2
    memory = sum(x.nbytes for x in held) / 1e6
    env.close()
    return {
        "envs": n,
        "threads": threads,
        "stepping_per_s": round(median(rates)),
        "raw_per_s": round(median(limits)),
        "stepping_of_raw": median([a / b for a, b in zip(rates, limits, strict=True)]),
        "memory_mb": round(memory, 1),
    }
