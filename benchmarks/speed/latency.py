"""How long one character takes for one control step, on one core."""

from __future__ import annotations

import statistics
import time
from contextlib import ExitStack
from typing import Any

import torch

from poise.learn import Policy
from poise.recipes.imitation import Imitation
from speed.machine import Clock


def bench_latency(
    imitation: Imitation, policy: Policy | None = None, steps: int = 600, helped: bool = False
) -> dict[str, Any]:
    """Policy, physics and observation of one deterministic character, in ms per control step.

    Rewards, failures and the guard against unstable states belong to training and are left out.

    policy: None takes an untrained one of the recipe's size, which costs the same. helped: with
    residual forces; without, as a character runs that was trained to need none.
    """
    task = imitation.bare(groups=True)
    env = task.env(1, 0, False, 1, help_scale=1.0 if helped else 0.0, guard=False)
    if policy is None:
        trainer = imitation.trainer(threads=1)
        policy = trainer.policy()
        trainer.env.close()
    zero, last = torch.zeros(1, dtype=torch.long), int(env.reference.length[0]) - 2
    clock, spent = Clock(), []
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with ExitStack() as stack:
            stack.enter_context(clock.on(env.backend, "step", "physics"))
            stack.enter_context(clock.on(policy, "act", "policy"))
            obs, parts = env.reset_to(zero, zero), []
            for k in range(steps + 50):
                if int(env.frame) >= last:
                    obs = env.reset_to(zero, zero)
                clock.read()
                start = time.perf_counter()
                obs = env.step(policy.act(obs)).obs
                # The first steps make buffers and recordings.
                if k >= 50:
                    spent.append(time.perf_counter() - start)
                    parts.append(clock.read())
    finally:
        torch.set_num_threads(threads)
        env.close()
    ms = sorted(1e3 * s for s in spent)
    split = {name: round(1e3 * statistics.median(p[name] for p in parts), 3) for name in parts[0]}
    median_ms = statistics.median(ms)
    rest = round(median_ms - sum(split.values()), 3)
    return {
        "ms": round(median_ms, 3),
        "ms_95": round(ms[int(0.95 * len(ms))], 3),
        "phases_ms": {**split, "observation": rest},
        "helped": helped,
        "steps": steps,
        "threads": 1,
        "rate_hz": imitation.config.sim.rate_hz,
    }
