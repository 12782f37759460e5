"""Keyframes at other times: gaps that get longer, poses that stay."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch

from poise.motion import Clip
from poise.synth.seams import sampled


@dataclass(frozen=True)
class Retiming:
    """What was done to the times of keyframes.

    Attributes:
        keys: frames of the clip that came in.
        at: frames at which they are now.
        fps: frames a second of both.
        factors: by which each gap is longer.
        called: frames of the file that they are, where times were stated; otherwise `keys`.
    """

    keys: tuple[int, ...]
    at: tuple[int, ...]
    fps: float
    factors: tuple[float, ...]
    called: tuple[int, ...] = ()

    def sentence(self) -> str:
        """The new times in words."""
        changed = [
            f"frame {name} is at {a / self.fps:.2f} s instead of {k / self.fps:.2f} s"
            for name, k, a in zip(self.called or self.keys, self.keys, self.at, strict=True)
            if a != k
        ]
        more = f", and {len(changed) - 6} more" if len(changed) > 6 else ""
        return f"Times were stretched where no body is that fast: {', '.join(changed[:6])}{more}."


def retimed(
    clip: Clip, keys: Sequence[int], factors: Sequence[float] | np.ndarray
) -> tuple[Clip, tuple[int, ...]]:
    """The clip with each gap between keyframes `factors[i]` as long, and where the keyframes are then.

    Keyframes and frames outside of them stay what they are; what is between is sampled.
    """
    if all(f == 1.0 for f in factors):
        return clip, tuple(keys)
    at = [keys[0]]
    for a, b, factor in zip(keys[:-1], keys[1:], factors, strict=True):
        at.append(at[-1] + max(1, round((b - a) * float(factor))))
    places = [np.arange(keys[0], dtype=float)]
    for (a, b), (x, y) in zip(pairwise(keys), pairwise(at), strict=True):
        places.append(a + (b - a) * np.arange(y - x) / (y - x))
    places.append(np.arange(keys[-1], clip.frames, dtype=float))
    root, rot = clip.tensors()
    new = sampled(root, rot, torch.tensor(np.concatenate(places)))
    return clip.replaced(root_pos=new[0].numpy(), rot=new[1].numpy(), cyclic=False, contacts=()), tuple(
        at
    )
