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

#: By how much the largest jerk may grow with a foot that is held.
ROUGHER = 1.25


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
    out = clip
    for fault in _new_slides(clip, source):
        held = as_file(out)
        support = support_of(held, anatomy_of(held))
        if support is None:
            break
        mended = mend_slides(held, support, [fault])
        if not _rougher(held, mended):
            out = clip.replaced(rot=mended.rot)
    return out


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


def _rougher(before: Clip, after: Clip) -> bool:
    """Whether a repair jerks the body, or turns a joint faster than joints do."""
    was, now = (float(body_steps(c).max()) * c.fps for c in (before, after))
    if now > max(was, FASTEST):
        return True
    shakes = [jerk(torch.tensor(c.positions()), c.fps) for c in (before, after)]
    return len(shakes[0]) > 0 and float(shakes[1].max()) > ROUGHER * float(shakes[0].max())
