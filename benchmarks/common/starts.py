"""Starts that differ by a stated spread, and the null that does nothing."""

from __future__ import annotations

import numpy as np
from torch import Tensor

from poise.env import ImitationEnv
from poise.score import Nothing, Spread

__all__ = ["SPREAD", "Nothing", "Spread", "scattered"]


#: What rows "from spread starts" are drawn from.
SPREAD = Spread()


def scattered(env: ImitationEnv, trial: Tensor, spread: Spread = SPREAD) -> Tensor:
    """Moves characters off their starts; observations `(N, O)`.

    trial: `(N,)`, which draw each is; 0 stays where it is.
    """
    state = env.backend.state
    qpos, qvel = state.qpos.clone(), state.qvel.clone()
    for i, seed in enumerate(trial.tolist()):
        if seed:
            spread.move(qpos[i], qvel[i], np.random.default_rng([i, seed]))
    env.backend.write(None, qpos, qvel)
    return env.observe()
