"""Feet of a written motion that still slide, where those of the clip that it follows do not."""

from __future__ import annotations

import torch

from poise.kin import anatomy_of, support_of
from poise.kin.doctor.faults import Fault
from poise.kin.doctor.slides import mend_slides
from poise.kin.doctor.support import slide_faults
from poise.kin.doctor.timing import body_steps
from poise.kin.feet.hold import FASTEST
from poise.metrics import jerk
from poise.motion import Clip
from poise.motion.io import home_suffix

#: By how much the largest jerk may grow with a foot that is held; s around where it slides that are
#: looked at; how often what is rougher is left out.
ROUGHER, AROUND_S, ROUNDS = 1.25, 0.5, 3


def as_file(clip: Clip) -> Clip:
    """A motion as it is read from its file: what tells the soles of some formats is lost in BVH."""
    if home_suffix(clip) != ".bvh":
        return clip
    return clip.replaced(skeleton=clip.skeleton.with_source(format="bvh"))


def settled(clip: Clip, source: Clip) -> Clip:
    """The clip with its feet held where `poise doctor` says that they slide and the source's do not.

    Some of what stands by the doctor's rules, which know no physics, does not bear by those of
    `kin.hold_feet`. A foot is held only where the leg follows without a jerk.

    Args:
        source: what the clip follows, frame by frame.
    """
    faults, held = _new_slides(clip, source), as_file(clip)
    support = support_of(held, anatomy_of(held)) if faults else None
    for _ in range(ROUNDS):
        if support is None or not faults:
            break
        mended = mend_slides(held, support, faults)
        kept = _smooth(held, mended, faults)
        if len(kept) == len(faults):
            return clip.replaced(rot=mended.rot)
        faults = kept
    return clip


def _new_slides(clip: Clip, source: Clip) -> list[Fault]:
    """Slides of the clip in which that foot of the source does not slide."""
    found = list[list[Fault]]()
    for one in (as_file(clip), source):
        support = support_of(one, anatomy_of(one))
        found.append([] if support is None else slide_faults(one, support))
    mine, theirs = found
    return [
        f
        for f in mine
        if not any(f.joint == g.joint and f.start <= g.stop and g.start <= f.stop for g in theirs)
    ]


def _smooth(before: Clip, after: Clip, faults: list[Fault]) -> list[Fault]:
    """Those faults around which a repair neither jerks the body nor turns a joint too fast."""
    was, now = (body_steps(c).max(-1) * c.fps for c in (before, after))
    shook, shakes = (jerk(torch.tensor(c.positions()), c.fps).numpy() for c in (before, after))
    most, around, out = (
        ROUGHER * float(shook.max(initial=0.0)),
        round(AROUND_S * before.fps),
        list[Fault](),
    )
    for f in faults:
        here = slice(max(0, f.start - around), f.stop + around)
        fast = float(now[here].max(initial=0.0)) > max(FASTEST, float(was[here].max(initial=0.0)))
        if not fast and float(shakes[here].max(initial=0.0)) <= most:
            out.append(f)
    return out
