"""What a library tells of recovery: clips that walk or stand, a frame that stands, recovery clips.

The paper picks walking and running by hand for its recovery primitive (Q^loco), so that the motion prior
knows nothing else; here rules do.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from poise.env import Reference
from poise.env.recovery.clips import QUICK, RecoveryClips, find_recovery_clips
from poise.recipes.perpetual.config import Perpetual

#: Shares of the standing heights, between which the root and above which the body's top stay in a clip
#: that walks or stands.
HEIGHT, TOP = (0.85, 1.15), 0.85
#: Share of a library's frames that are lower than standing; jumps are rarer than crawling.
STANDS = 0.7
#: m/s: in a walk the root is no faster, and limbs move no faster about the root, on average.
ROOT_SPEED, LIMB_SPEED = 2.5, 0.7
#: s: shorter clips are no walk.
SECONDS = 1.0


def walking_clips(reference: Reference) -> Tensor:
    """`(C,)` bool on the CPU: clips that walk or stand, for the recovery primitive.

    In all frames the root is about as high, and the body about as tall, as in standing, the root does
    not move fast, and on average the limbs move about the root no faster than in a walk. All clips if
    there is no such one.
    """
    pos, vel = (getattr(reference.pose, k).cpu() for k in ("pos", "linvel"))
    height, top = pos[:, 0, 2], pos[:, :, 2].amax(-1)
    usual, tall = _standing(height), _standing(top)
    good = (height > HEIGHT[0] * usual) & (height < HEIGHT[1] * usual) & (top > TOP * tall)
    good &= vel[:, 0, :2].norm(dim=-1) < ROOT_SPEED
    limbs = (vel - vel[:, :1]).norm(dim=-1).mean(-1)
    starts, lengths = reference.start.cpu().tolist(), reference.length.cpu().tolist()
    least = SECONDS * reference.rate_hz
    out = torch.tensor(
        [
            n >= least and bool(good[s : s + n].all()) and float(limbs[s : s + n].mean()) < LIMB_SPEED
            for s, n in zip(starts, lengths, strict=True)
        ]
    )
    return out if bool(out.any()) else torch.ones_like(out)


def standing(reference: Reference) -> tuple[int, int]:
    """(clip, frame) of the reference of trials: the last frame of the clip that ends upright most
    quietly, on which it then goes on standing. Clips that go round and round end nowhere, and of several
    bodies it is the first."""
    pos, vel = (getattr(reference.pose, k).cpu() for k in ("pos", "linvel"))
    last = (reference.start + reference.length - 1).cpu()
    upright = pos[last, 0, 2] / _standing(pos[:, 0, 2])
    restless = vel[last].norm(dim=-1).mean(-1)
    unfit = (upright < HEIGHT[0]) | (upright > HEIGHT[1]) | reference.cyclic.cpu()
    unfit |= reference.body.cpu() != 0
    clip = int((restless + 1e3 * unfit).argmin())
    return clip, int(reference.length[clip]) - 1


def _standing(heights: Tensor) -> Tensor:
    """The standing height, m, of the heights `(F,)` in all frames of a library."""
    return heights.kthvalue(1 + int(STANDS * (len(heights) - 1))).values


def known_recovery_clips(
    config: Perpetual, reference: Reference, known: RecoveryClips | None = None
) -> RecoveryClips | None:
    """The recovery clips by which a policy learns to come back, on a library's own body; None where
    recovery is not learned by such.

    known: what a policy that goes on comes back by already; it stands in place of the library's, which
        may hold no clip that gets up from the belly, say.
    """
    if not (config.recovery and config.recovering.demonstrations) or config.shapes.own:
        return None
    found = known or find_recovery_clips(reference, standing(reference), walking_clips(reference))
    return replace(found, pace=QUICK) if found is not None and config.recovering.quick else found
