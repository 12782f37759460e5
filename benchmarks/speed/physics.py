"""Fidelity: does a policy that was trained on coarse physics keep its score on fine physics?"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from torch import Tensor

from poise.env import ImitationEnv
from poise.jobs.open import open_run
from poise.jobs.runs import help_left, trained_policy
from poise.jobs.warm_start import some_starts
from poise.learn import PolicyBundle
from poise.recipes.imitation import Imitation
from poise.recipes.residual_force import build
from poise.score import run_episodes, score_rollouts
from poise.sim import SimConfig
from speed.engine import Progress
from speed.stable_pd import StablePDBackend

FINE = SimConfig(rate_hz=450.0, integrator="implicitfast")
PAPER = SimConfig(rate_hz=450.0, integrator="euler")


def bench_physics(
    folder: Path, stable_pd: bool = False, starts: int = 64, tell: Progress | None = None
) -> list[dict[str, Any]]:
    """The run's policy, deterministic, from the same start frames on each kind of physics.

    The first row is the physics it was trained on, the second 450 Hz `implicitfast` with MuJoCo's
    position servos, the third, with `stable_pd`, 450 Hz Euler with the paper's explicit stable PD
    (`control.stable_pd_torque`), which takes a linear solve per physics step.
    """
    own = open_run(folder).task
    policy, meta = trained_policy(folder, own)
    limit, scale = help_left(own, meta)
    clip, frame = some_starts(own, starts)
    kinds: list[tuple[str, SimConfig]] = [("trained", own.config.sim), ("fine", FINE)]
    if stable_pd:
        kinds.append(("stable PD", PAPER))
    rows = []
    for name, sim in kinds:
        sim = replace(sim, control_hz=own.config.sim.control_hz)
        if tell is not None:
            tell(f"physics, {name}: {sim.rate_hz:g} Hz {sim.integrator}")
        imitation = build(own.library, replace(own.config, sim=sim))
        make = (_stable if name == "stable PD" else _servos)(imitation, scale)
        rows.append({"physics": name, "rate_hz": sim.rate_hz, "integrator": sim.integrator}
                    | _score(imitation, policy, make, clip, frame, limit))  # fmt: skip
    return rows


def _servos(imitation: Imitation, scale: float) -> Callable[[int], ImitationEnv]:
    return lambda n: imitation.env(n, auto_reset=False, help_scale=scale)


def _stable(imitation: Imitation, scale: float) -> Callable[[int], ImitationEnv]:
    def make(n: int) -> ImitationEnv:
        backend = StablePDBackend(imitation.model, n)
        return imitation.env(None, 0, False, help_scale=scale, guard=False, backend=backend)

    return make


def _score(
    imitation: Imitation,
    policy: PolicyBundle,
    make: Callable[[int], ImitationEnv],
    clip: Tensor,
    frame: Tensor,
    limit: float,
) -> dict[str, Any]:
    config = imitation.config
    rollouts, _ = run_episodes(make, policy, clip, frame, limit)
    card = score_rollouts(rollouts, method=config.method, seed=config.seed)
    return {
        "episodes": card.episodes,
        "succ": round(card.succ, 3),
        "mpjpe_mm": round(card.mpjpe_mm, 1),
        "reward": round(float(rollouts.reward["total"][rollouts.alive].mean()), 3),
    }
