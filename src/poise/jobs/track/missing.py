"""Whether a motion was done or only survived, and what it would have needed, in words."""

from __future__ import annotations

import math
from collections.abc import Sequence

from poise.eval import ScoreCard
from poise.kin.doctor.needs import Need, find_needs
from poise.kin.supports import Support
from poise.metrics import LASTING_S
from poise.recipes.imitation import Imitation


def needs_of(imitation: Imitation, supports: Sequence[Support] = ()) -> tuple[Need, ...]:
    """What a task's first motion needs besides a floor and its supports."""
    reference = imitation.reference
    frames = int(reference.length[0])
    pose = reference.pose
    table, rate = imitation.humanoid.table, reference.rate_hz
    needs = find_needs(table, pose.pos[:frames], pose.quat[:frames], rate)
    return tuple(
        n for n in needs if not any(s.start_s < n.stop_s and n.start_s < s.stop_s for s in supports)
    )


def shortfalls(card: ScoreCard) -> tuple[str, ...]:
    """Why a single motion was not tracked, beside its distance, in sentences.

    Since when the character was down or off its feet, and what the motion lacked by then; empty where
    there is nothing to say.
    """
    one = card.per_clip[0]
    down, off = one["fallen_s"], one["off_feet_s"]
    out: list[str] = []
    if math.isfinite(down) and not off < down:
        out.append(f"The character is down from {down:.1f} s on, where the motion is upright.")
    elif math.isfinite(off):
        out.append(f"The character is off its feet from {off:.1f} s on, where the motion is on them.")
    times = [t for t in (one["first_fail_s"], down, off) if math.isfinite(t)]
    by = min(times, default=-math.inf) + LASTING_S
    lacked = "; ".join(n.clause() for n in (Need(**n) for n in card.needs) if n.start_s <= by)
    return (*out, f"{lacked[0].upper()}{lacked[1:]}.") if lacked else tuple(out)
