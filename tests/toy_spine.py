"""The toy human with a spine of many joints."""

from __future__ import annotations

import numpy as np

from poise.motion import Skeleton
from toy_human import human


def long_spine(count: int) -> Skeleton:
    """The toy's trunk in `count` joints, Spine0 to the chest; 0, 3 and 7 carry the longest bones."""
    toy = human()
    names, parents, offsets = ["Hips"], [-1], [np.zeros(3)]
    for i in range(count):
        names.append(f"Spine{i}")
        parents.append(i)
        offsets.append(np.array([0.0, 0.0, 0.06 if i in (0, 3, 7, count - 1) else 0.01]))
    for j, name in enumerate(toy.names):
        if name in ("Hips", "Spine", "Chest"):
            continue
        above = toy.names[toy.parents[j]]
        parents.append(count if above == "Chest" else names.index(above))
        names.append(name)
        offsets.append(toy.offsets[j])
    return Skeleton(tuple(names), tuple(parents), np.array(offsets))
