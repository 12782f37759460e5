"""Several characters in one world: they stand on one floor, and those that meet collide."""

from __future__ import annotations

import math

import numpy as np

from poise.body import Humanoid
from poise.sim import Character, CharacterRows, Scene, SceneSim, SimConfig

#: Metres between characters that begin side by side.
APART_M = 2.0


def places(count: int) -> np.ndarray:
    """`(N, 2)` m, where each of N characters begins: rows and columns about the first one's place."""
    wide = math.ceil(math.sqrt(count))
    at = np.arange(count)
    return APART_M * np.stack((at // wide, at % wide), 1).astype(float)


def crowd(humanoid: Humanoid, sim: SimConfig, count: int) -> CharacterRows:
    """N copies of a body on one floor, each a row; names of all but the first begin with "2/", ..."""
    names = ("", *(str(k + 1) for k in range(1, count)))
    things = tuple(Character(humanoid, name) for name in names)
    return SceneSim(Scene(things, sim=sim), 1, threads=1).characters()
