"""Ways between disjoint clips: by the network of Skeleton2Humanoid, and planned as `poise track A B` is.

The second clip stands half a metre to two away, turned by up to a quarter turn. The network makes the
way at a walking pace, and the whole is followed as one motion; or the character plans its way there. By
the policy alone. Jerk is of the joints' centres, on the way only.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from benchmarks.common.clips import Places, clip_of, moment, names_of
from benchmarks.common.rows import Figure, median_of, of
from benchmarks.common.runner import Part, Raws
from poise.jobs.inbetween.fill import inbetween
from poise.jobs.result import TRACKED
from poise.jobs.track import track
from poise.kinematics.travel import moved_by
from poise.metrics import jerk
from poise.motion import Clip, resample, trim
from poise.motion.rotations import heading_angle

#: Pairs; s of each clip; frames a second; m between the clips; rad by which the way bends and the second
#: one turns, to either side; m/s of the way, and s to set off and to arrive.
PAIRS, LASTS, FPS = 20, 2.5, 30.0
AWAY, BENDS, TURNS = (0.5, 2.0), math.pi / 3, math.pi / 2
PACE, BESIDE_S = 1.0, 0.5


def units(places: Places) -> list[str]:
    """Pairs by their numbers."""
    return [f"pair {k}" for k in range(1 if places.smoke else PAIRS)]


def pair_of(places: Places, unit: str) -> tuple[Clip, Clip, float]:
    """Two clips, the second one set down on its place, and the m between them."""
    rng = np.random.default_rng(int(unit.split()[1]))
    if places.smoke:
        first, then = moment("a"), moment("b")
    else:
        kept = names_of(places, "bandai")
        picks = rng.choice(len(kept), 2, replace=False)
        both = [resample(clip_of(places, "bandai", kept[k]), FPS) for k in picks]
        first, then = (trim(c, 0, min(c.frames - 1, round(LASTS * FPS))) for c in both)
    away, ahead = float(rng.uniform(*AWAY)), float(heading_angle(first.rot[-1, 0]))
    bend, turn = rng.uniform(-BENDS, BENDS), rng.uniform(-TURNS, TURNS)
    turned = np.full(then.frames, ahead + turn - float(heading_angle(then.rot[0, 0])))
    then = moved_by(then, np.zeros(3), turned)
    way = np.array((math.cos(ahead + bend), math.sin(ahead + bend), 0.0))
    shift = (first.root_pos[-1] - then.root_pos[0]) * (1.0, 1.0, 0.0) + away * way
    return first, moved_by(then, shift, np.zeros(then.frames)).replaced(name="then"), away


def way_jerk(clip: Clip, first: int, last: int) -> float:
    """m/s^3 of the joints, the mean over frames `first` to `last`."""
    return float(jerk(clip.positions()[max(0, first - 2) : last + 2], clip.fps).mean())


def measured(places: Places, unit: str) -> Any:
    """One pair, both ways."""
    first, then, away = pair_of(places, unit)
    gap = round((away / PACE + BESIDE_S) * first.fps)
    between = first.root_pos[-1:].repeat(gap, 0), first.rot[-1:].repeat(gap, 0)
    root = np.concatenate((first.root_pos, between[0], then.root_pos))
    rot = np.concatenate((first.rot, between[1], then.rot))
    keys = (first.frames - 1, first.frames + gap)
    filled = inbetween(first.replaced(root_pos=root, rot=rot), keys).clip
    one = track(filled, controller="policy")
    two = track([first.replaced(name="first"), then], controller="policy")
    made, ends, begins = two.motion(), two.parts[0].ends, two.parts[1].begins
    came = ends is not None and begins is not None and begins > ends
    out: dict[str, Any] = {
        "network": {"done": one.merit.ended == TRACKED, "way_s": gap / first.fps},
        "planned": {"done": all(p.done for p in two.parts), "way_s": two.parts[1].after},
    }
    if one.motion().frames > keys[1]:
        out["network"]["jerk"] = way_jerk(one.motion(), *keys)
    if came:
        assert ends is not None and begins is not None
        out["planned"]["jerk"] = way_jerk(made, round(ends * made.fps), round(begins * made.fps))
    return out


def rows(places: Places, raws: Raws) -> Iterator[Figure]:
    """Shares that are done, medians of how long ways take and how they jerk."""
    for name, title in (("network", "the network"), ("planned", "planned")):
        own = [r[name] for r in raws.values()]
        values: dict[str, float | None] = {
            "done": sum(r["done"] for r in own) / len(own),
            "way_s": median_of(r["way_s"] for r in own),
            "way_jerk_m_per_s3": median_of(r.get("jerk") for r in own),
        }
        yield from of(f"Skeleton2Humanoid, ways between clips; {title}", values, len(own))


PARTS = {
    "skeleton-ways": Part(
        "ways between disjoint clips", units, measured, rows, ("tracker", "inbetween"), hours=0.1
    )
}
