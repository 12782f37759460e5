"""Repairs of captured motion that need no body."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from poise.motion.clip import Clip
from poise.spatial import normalize, quat_angle, quat_conj, quat_mul, slerp

#: Joint speed (rad/s) that no human joint reaches; a pitcher's shoulder, the fastest, stays near it
#: only about its long axis, and mocap solvers exceed it when a bone's twist is ambiguous.
IMPOSSIBLE_SPEED = 40.0


@dataclass(frozen=True)
class Spike:
    """Frames `start` to `stop` (inclusive) of one joint that were replaced. peak: rad/s."""

    joint: str
    start: int
    stop: int
    peak: float


def spike_sentence(spikes: Sequence[Spike]) -> str:
    """The repair of one clip in words."""
    joints = ", ".join(dict.fromkeys(s.joint for s in spikes))
    first, worst = min(s.start for s in spikes), max(s.peak for s in spikes)
    return (
        f"{len(spikes)} brief turns faster than a human joint (up to {worst:.0f} rad/s; the first at "
        f"frame {first}) were interpolated: {joints}."
    )


def remove_spikes(
    clip: Clip, speed: float = IMPOSSIBLE_SPEED, longest_s: float = 0.2, margin_s: float = 0.017
) -> tuple[Clip, tuple[Spike, ...]]:
    """The clip with brief impossible turns of single joints interpolated away.

    Steps of more than `speed` rad/s are gathered into spells (gaps of up to 0.05 s belong to one);
    a spell of up to `longest_s` s whose two ends can be joined at an ordinary speed is replaced by a
    slerp between them. Longer damage, and flips that stay, are left as they are.
    """
    rot = torch.tensor(clip.rot)
    steps = quat_angle(quat_mul(quat_conj(rot[:-1]), rot[1:])).numpy() * clip.fps
    gap, longest = max(1, round(0.05 * clip.fps)), max(2, round(longest_s * clip.fps))
    margin = round(margin_s * clip.fps)
    found: list[Spike] = []
    for j, name in enumerate(clip.skeleton.names):
        fast = np.flatnonzero(steps[:, j] > speed)
        if not len(fast):
            continue
        for spell in np.split(fast, np.flatnonzero(np.diff(fast) > gap) + 1):
            a, b = max(int(spell[0]) - margin, 0), min(int(spell[-1]) + 1 + margin, clip.frames - 1)
            turn = float(quat_angle(quat_mul(quat_conj(rot[a, j]), rot[b, j])))
            if (
                b - a > longest
                or turn / ((b - a) / clip.fps) > speed / 2
                or a == 0
                or b == clip.frames - 1
            ):
                continue
            t = torch.linspace(0.0, 1.0, b - a + 1, dtype=rot.dtype)
            ends = rot[a, j].expand(len(t), 4), rot[b, j].expand(len(t), 4)
            rot[a : b + 1, j] = slerp(*ends, t)
            found.append(Spike(name, a + 1, b - 1, float(steps[spell, j].max())))
    if not found:
        return clip, ()
    return clip.replaced(rot=normalize(rot).numpy()), tuple(found)
