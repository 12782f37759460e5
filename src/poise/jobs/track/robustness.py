"""Noise by name, and how far a tracker stands it: success over the strength of the noise."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from poise.errors import PoiseError, did_you_mean
from poise.jobs.track.tracking import track
from poise.jobs.track_settings import Controller, TrackConfig
from poise.jobs.tracker import Tracker
from poise.motion import Clip
from poise.motion.keypoints import Keypoints
from poise.motion.noise import (
    TRIANGULATED,
    VIDEO,
    Drift,
    Dropouts,
    FrameLoss,
    Jitter,
    Latency,
    Level,
    Noise,
    Outliers,
    SwapSides,
    WrongDepth,
    robustness_levels,
    scaled,
)
from poise.settings import plain

#: What noise may be called; "video" and "triangulated" are everything that goes wrong with one camera,
#: and with several.
KINDS: dict[str, tuple[Noise, ...]] = {
    "jitter": (Jitter(),),
    "outliers": (Outliers(),),
    "drift": (Drift(),),
    "depth": (WrongDepth(),),
    "dropouts": (Dropouts(),),
    "lost-frames": (FrameLoss(),),
    "swapped-sides": (SwapSides(),),
    "latency": (Latency(),),
    "video": VIDEO,
    "triangulated": TRIANGULATED,
}


def noise_of(texts: Sequence[str]) -> tuple[Noise, ...]:
    """The noise that ("jitter:1", "drift:0.5") ask for, in this order; a strength of 1 may be left out.

    Raises:
        PoiseError: an unknown kind, or a strength that is no number of at least 0.
    """
    out: list[Noise] = []
    for text in texts:
        kind, colon, strength = (x.strip() for x in text.partition(":"))
        if kind not in KINDS:
            near = did_you_mean(kind, list(KINDS))
            raise PoiseError(
                f"there is no noise '{kind}'",
                hint=near or f"Known: {', '.join(KINDS)}",
                code="unknown-choice",
            )
        try:
            factor = float(strength) if colon else 1.0
        except ValueError:
            factor = -1.0
        if not 0 <= factor < 1000:
            raise PoiseError(
                f"the strength of noise must be a number of at least 0, got '{text}'",
                hint=f"Write --noise {kind}:0.5",
                code="out-of-range",
            )
        out += scaled(KINDS[kind], factor)
    return tuple(out)


@dataclass(frozen=True)
class Rung:
    """What a tracker comes to at one level of noise, over all motions.

    Attributes:
        name, strength: of the level.
        motions: how many.
        succ: share done to the end of the input with noise.
        succ_clean: share that stayed within 0.5 m of the motion without noise.
        mpjpe_mm: global error against the input, up to the failure, mean over motions.
        off_mm: against the motion without noise.
        noise_mm: how far the noise moved the bodies of the input.
        tracked: share of the seconds before the first failure.
    """

    name: str
    strength: float
    motions: int
    succ: float
    succ_clean: float
    mpjpe_mm: float
    off_mm: float
    noise_mm: float
    tracked: float


@dataclass(frozen=True)
class Robustness:
    """Success and errors over the strength of noise; rungs as the ladder has them.

    refused: motions that no skeleton could be fitted to at some level, with why; they count as failed.
    """

    rungs: tuple[Rung, ...]
    refused: tuple[tuple[str, str, str], ...]

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON; what was not measured is None."""
        refused = [dict(zip(("level", "motion", "why"), r, strict=True)) for r in self.refused]
        return {"rungs": plain(self.rungs), "refused": refused}


def robustness(
    tracker: Tracker,
    motions: Sequence[Clip | Keypoints],
    levels: Sequence[Level] | None = None,
    seed: int = 0,
    tell: Callable[[str], None] = lambda _: None,
    controller: Controller = "policy",
) -> Robustness:
    """Every motion tracked at every level of noise, once; the noise of a motion is that of its name.

    Args:
        levels: a ladder, by default that of `robustness_levels`.
        tell: is told of each level.
        controller: see `TrackConfig`.

    Raises:
        PoiseError: no motion, or one that cannot be tracked without noise either.
    """
    if not motions:
        raise PoiseError("a robustness curve needs at least one motion", code="no-clips")
    rungs: list[Rung] = []
    refused: list[tuple[str, str, str]] = []
    for level in robustness_levels() if levels is None else levels:
        rows: list[tuple[float, ...]] = []
        for motion in motions:
            try:
                rows.append(_row(tracker, motion, TrackConfig(level.noise, seed, controller=controller)))
            except PoiseError as problem:
                if level.strength == 0:
                    raise
                refused.append((level.name, motion.name, problem.what))
                rows.append((0.0, 0.0, math.nan, math.nan, math.nan, 0.0))
        rungs.append(Rung(level.name, level.strength, len(rows), *_means(rows)))
        tell(f"{level.name}: {100 * rungs[-1].succ:.0f} % of {len(rows)} motions succeed")
    return Robustness(tuple(rungs), tuple(refused))


def _row(tracker: Tracker, motion: Clip | Keypoints, config: TrackConfig) -> tuple[float, ...]:
    """Success, success without noise, errors and share of one motion, in the order of `Rung`."""
    done = track(motion, tracker, config)
    card, clean = done.evaluation.card, done.clean
    seconds = (int(done.imitation.reference.length[0]) - 1) / done.imitation.reference.rate_hz
    tracked = done.failed_s[0] / seconds if done.failed_s else 1.0
    if clean is None:
        return card.succ, card.succ, card.mpjpe_global_mm, card.mpjpe_global_mm, 0.0, tracked
    beside = float(clean.succeeded), card.mpjpe_global_mm, clean.off_mm, clean.noise_mm
    return card.succ, *beside, tracked


def _means(rows: Sequence[tuple[float, ...]]) -> list[float]:
    """Means of the columns; what was not measured does not count."""
    table = np.array(rows)
    known = ~np.isnan(table)
    total = np.where(known, table, 0.0).sum(0)
    return [float(t / n) if n else math.nan for t, n in zip(total, known.sum(0), strict=True)]
