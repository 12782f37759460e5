"""Clips that a policy is told with an estimator's noise, and that it is judged by as they were.

A pose estimator's stream jitters, jumps, loses frames and swaps sides; a policy that has only been told
clean motion follows all of that. Here each clip of the library is there once more for every strength,
"walk~0.25", with the noise of `motion.noise.VIDEO`: the observation's goal and what additive actions add
to are noisy, while episodes begin on the clean clip, and rewards, failures and evaluations are those of
the clean clip.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from poise.env import Reference
from poise.errors import PoiseError
from poise.kin import place_on_body
from poise.motion import Clip, ClipLibrary
from poise.motion.noise import VIDEO, perturb_clip, scaled
from poise.recipes.imitation import Imitation
from poise.recipes.perpetual.shapes import motions_of


def noisy(imitation: Imitation, strengths: Sequence[float], seed: int = 0) -> Imitation:
    """The same task with each clip once more for every strength; unchanged for none.

    A clip with noise is in no cycle. Its noise is that of `seed` and of its name.

    Args:
        strengths: 1 is one camera's noise, see `motion.noise.VIDEO`.

    Raises:
        PoiseError: a clip with noise does not have as many frames as without.
    """
    if not strengths:
        return imitation
    reference, own = imitation.reference, imitation.library
    clean, clips, weights = motions_of(reference), list(own.clips), list(own.weights)
    motions, told = list(clean), list(clean)
    for strength in strengths:
        for clip, qpos, weight in zip(own.clips, clean, own.weights, strict=True):
            clips.append(clip.replaced(name=f"{clip.name}~{strength:g}", cyclic=False))
            motions.append(qpos)
            told.append(_told(clip, qpos, strength, seed, imitation))
            weights.append(weight)
    library = ClipLibrary(tuple(clips), tuple(weights))
    cyclic = [*reference.cyclic.tolist(), *(False for _ in clips[len(clean) :])]
    rate = reference.rate_hz
    made = Reference(imitation.humanoid, motions, rate, library.names, cyclic).told(told)
    return replace(imitation, library=library, reference=made)


def _told(clip: Clip, qpos: np.ndarray, strength: float, seed: int, on: Imitation) -> np.ndarray:
    """A clip with noise in the body's coordinates, as `poise track --noise` puts it there."""
    seen = perturb_clip(clip.replaced(cyclic=False), scaled(VIDEO, strength), seed)
    body, rate = on.humanoid, on.reference.rate_hz
    out = place_on_body(seen, body.table, rate_hz=rate, near=body).qpos
    if len(out) != len(qpos):
        what = f"it has {len(out)} frames with noise and {len(qpos)} without"
        raise PoiseError(what, clip.name, "Leave noise out, or this clip")
    return out
