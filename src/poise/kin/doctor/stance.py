"""Feet of a motion that trembled, held where they stand: as firmly as noise is left in them, no more.

Height and speed of either end of a sole tell whether it stands: y are its level velocity, its rise and
its height over the floor, each normal with deviations that are larger while it swings,

    log p(y | stands) / p(y | swings) = sum  d ln(S / s) - |y|^2 (1 / s^2 - 1 / S^2) / 2,

and a chain of two states joins the frames. The s are those of the frames that stand, told again with
them: the more noise is left, the faster and the higher may an end be that stands.

Feet roll and pivot where they stand. Beyond what they do, q, the speed s is noise: an end bears by
(s^2 / q^2 - 1) to the power of `STEEP`. A foot rolls over its own length each time it stands, so that q
is larger where that is short, as in a run.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from poise.kin.doctor.support import Support
from poise.kin.feet.contact import Sole
from poise.kin.feet.hold import Standing, hold
from poise.kin.series import find_runs
from poise.motion import Clip

#: What an end of a sole does that stands (deviations): m/s level, by axis, and of its rise; m of height.
LEVEL_SPEED, RISE_SPEED, HEIGHT_M = 0.05, 0.06, 0.012
#: The same of one that swings, at least; and so many times that of one that stands.
SWING = (1.0, 0.5, 0.12)
WIDER = 3.0
#: How long (s) noise lasts, so that frames in it tell one thing, and a foot stands or swings.
ALIKE_S, LASTS_S = 0.1, 0.4
#: How often both are told, and how surely an end stands that bears: the power of its probability.
TOLD_ROUNDS, SURE = 4, 3
#: How long (s) an end stands at least that rolls as slowly as above.
ROLLS_S = 0.3
#: See the module's text: how much an end bears, at most, and how that grows.
BEARS, MOST, STEEP = 0.0012, 1.0, 1.5


def steadied(clip: Clip, support: Support) -> Clip:
    """The clip with its feet held while they stand; see the module's text."""
    stands, level, rise = stance(support)
    firm, upright = (float(_firm(s / q)) for s, q in ((level, LEVEL_SPEED), (rise, RISE_SPEED)))
    rolls = np.maximum(ROLLS_S * support.fps / _lasting(stands), 1.0)
    weight = torch.tensor(_firm(level / (LEVEL_SPEED * rolls)) * stands**SURE)
    if firm <= 0.0 or not bool(weight.any()):
        return clip

    def standing(pos: Tensor, _: Tensor) -> dict[int, Standing]:
        out = dict[int, Standing]()
        for foot in dict.fromkeys(support.feet):
            mine = [k for k, joint in enumerate(support.feet) if joint == foot]
            sole, own = Sole(pos[:, foot], support.soles[:, mine]), weight[:, mine]
            out[foot] = Standing(sole, own, flat=own.amin(-1))
        return out

    root, rot = clip.tensors()
    out = hold(clip.skeleton, root, rot, clip.fps, standing, vertical=upright / firm, rounds=1)
    return clip.replaced(rot=out.numpy())


def stance(support: Support) -> tuple[np.ndarray, float, float]:
    """How likely each end of a sole stands between frames `(T - 1, F)`, and the deviations of its level
    speed (by axis) and of its rise while it does, m/s. Contacts that a file states stay."""
    soles, fps = support.soles.numpy(), support.fps
    velocity = np.diff(soles, axis=0) * fps
    height = np.maximum(soles[1:, :, 2], soles[:-1, :, 2]) + support.fit.lift_m
    stands, level, rise = support.contacts[1].numpy().astype(float), 0.0, 0.0
    if support.labels is None:
        # Where all that is near the floor is fast, a foot swings through; skating is no tremble.
        stands *= support.contacts[0].numpy() <= SWING[0]
    for _ in range(TOLD_ROUNDS):
        total = stands.sum()
        if total < 1.0:
            break
        floor = (stands * height).sum() / total
        # Lower than the floor is on it.
        parts = (velocity[..., :2], velocity[..., 2:], np.maximum(height - floor, 0.0)[..., None])
        ratio, sizes = np.zeros_like(height), list[float]()
        for y, own, least in zip(parts, (LEVEL_SPEED, RISE_SPEED, HEIGHT_M), SWING, strict=True):
            square, count = (y**2).sum(-1), y.shape[-1]
            spread = square if y is not parts[2] else (height - floor) ** 2
            size = float(np.sqrt((stands * spread).sum() / (count * total) + own**2))
            wide = max(least, WIDER * size)
            ratio += count * np.log(wide / size) - 0.5 * square * (size**-2 - wide**-2)
            sizes.append(size)
        level, rise = sizes[:2]
        if support.labels is not None:
            break
        stands = _joined(ratio / max(ALIKE_S * fps, 1.0), min(0.5, 1.0 / (LASTS_S * fps)))
    return stands, level, rise


def _firm(share: float | np.ndarray) -> np.ndarray:
    """How much an end bears that is so many times as fast as those without noise are."""
    return np.minimum(MOST, BEARS * np.maximum(np.square(share) - 1.0, 0.0) ** STEEP)


def _lasting(stands: np.ndarray) -> np.ndarray:
    """`(T, F)` frames, how long each end stands around every frame by `stands (T, F)`; 1 elsewhere."""
    out = np.ones_like(stands)
    for k in range(stands.shape[1]):
        for a, b in find_runs(stands[:, k] > 0.5, 0):
            out[a : b + 1, k] = b - a + 1
    return out


def _joined(ratio: np.ndarray, change: float) -> np.ndarray:
    """Probabilities `(T, F)` of the first of two states from their log ratios `(T, F)`, by the forward
    and the backward pass of a chain that changes state with the probability `change` at every step."""

    def passed(x: np.ndarray) -> np.ndarray:
        out, before = np.empty_like(x), np.zeros(x.shape[1])
        for t in range(len(x)):
            share = change + (1.0 - 2.0 * change) / (1.0 + np.exp(-np.clip(before, -40.0, 40.0)))
            out[t] = np.log(share / (1.0 - share))
            before = out[t] + x[t]
        return out

    both = passed(ratio) + passed(ratio[::-1])[::-1] + ratio
    return 1.0 / (1.0 + np.exp(-np.clip(both, -40.0, 40.0)))
