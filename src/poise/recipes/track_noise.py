"""Noise by name, and how far a tracker stands it: success over the strength of the noise."""

from __future__ import annotations

from collections.abc import Sequence

from poise.errors import PoiseError, did_you_mean
from poise.motion.noise import (
    TRIANGULATED,
    VIDEO,
    Drift,
    Dropouts,
    FrameLoss,
    Jitter,
    Latency,
    Noise,
    Outliers,
    SwapSides,
    WrongDepth,
    scaled,
)

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
            raise PoiseError(f"there is no noise '{kind}'", hint=near or f"Known: {', '.join(KINDS)}")
        try:
            factor = float(strength) if colon else 1.0
        except ValueError:
            factor = -1.0
        if not 0 <= factor < 1000:
            raise PoiseError(
                f"the strength of noise must be a number of at least 0, got '{text}'",
                hint=f"Write --noise {kind}:0.5",
            )
        out += scaled(KINDS[kind], factor)
    return tuple(out)
