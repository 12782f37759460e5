"""The limbs of a skeleton with names that say nothing: by its tree, its lengths and how it stands."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from poise.motion import Clip, Skeleton, trim

#: How far the lengths of a left and a right limb may differ, as a fraction.
UNEQUAL = 0.15
#: Upper arm over forearm, and thigh over shin (Winter 2009, table 4.1): 0.186 / 0.146, 0.245 / 0.246.
ARM_RATIO, LEG_RATIO = 1.27, 1.0
#: Distance of the hips over the leg's length, and of the shoulders over the arm's, at least.
HIP_WIDTH, SHOULDER_WIDTH = 0.1, 0.4
#: A limb is sought among so many joints of a way at most.
_LIMB_JOINTS = 48


@dataclass(frozen=True)
class Limbs:
    """Three joints per limb, by side.

    Attributes:
        legs: hip, knee and ankle.
        arms: shoulder, elbow and wrist.
        pose: `(J, 3)` m, the joint positions by which they were told.
        evidence: why, one sentence each.
    """

    legs: dict[str, tuple[int, int, int]]
    arms: dict[str, tuple[int, int, int]]
    pose: np.ndarray
    evidence: tuple[str, ...]


def find_limbs(skeleton: Skeleton, clips: Sequence[Clip] = ()) -> Limbs | None:
    """The legs and arms of a human tree, or None where it has no two pairs of equal limbs.

    A pair of limbs are two sibling subtrees with equal bones along their longest chains. The two longest
    pairs that do not lie in one another are legs and arms; the legs are the pair with lower ends in
    the first frame of the first clip, else in the rest pose. Left and right follow from the toes.
    """
    pose = trim(clips[0], 0, 2).positions()[0] if clips else skeleton.rest_positions()
    lines = _Lines(skeleton)
    pairs = []
    for parent in range(len(skeleton)):
        long = [j for j in skeleton.children(parent) if lines.joints(j) > 2]
        for a, b in itertools.combinations(long, 2):
            if lines.joints(a) != lines.joints(b):
                continue
            one, two = _bones(skeleton, lines[a]), _bones(skeleton, lines[b])
            if np.abs(one - two).max() <= UNEQUAL * one.sum():
                pairs.append((float(one.sum()), a, b))
    pairs.sort(reverse=True)
    tops = {j for _, *both in pairs for j in both}
    # Pairs that do not lie in one another.
    outer = [p for p in pairs if tops.isdisjoint(skeleton.ancestors(p[1]))]
    if len(outer) < 2:
        return None

    def end(pair: tuple[float, int, int]) -> float:
        """The mean height of a pair's ends."""
        return float(pose[[lines[j][-1] for j in pair[1:]], 2].mean())

    low, high = sorted(outer[:2], key=end)
    size = float(np.ptp(pose[:, 2]))
    names = skeleton.names
    if end(high) - end(low) < 0.05 * max(size, low[0]):
        # A pose that does not stand: the legs hang nearer to the root.
        low, high = sorted(outer[:2], key=lambda p: len(skeleton.ancestors(p[1])))
        why = "they hang nearest to the root"
    else:
        why = "their ends are the lowest"
    legs = _limb([lines[j] for j in low[1:]], pose, LEG_RATIO, HIP_WIDTH, True)
    reach = [_to_wrist(skeleton, lines[j]) for j in high[1:]]
    least = min(map(len, reach))
    arms = _limb([line[:least] for line in reach], pose, ARM_RATIO, SHOULDER_WIDTH, False)
    left, side_why = _left_first(skeleton, legs, lines, low[1:], pose)
    order = (0, 1) if left else (1, 0)
    # The arm that is on the left leg's side is the left one.
    across = pose[legs[order[0]][0]] - pose[legs[order[1]][0]]
    arm_left = (pose[list(arms[0][:2])] - pose[list(arms[1][:2])]).sum(0) @ across > 0
    arm_order = (0, 1) if arm_left else (1, 0)
    evidence = (
        f"No names tell the limbs, so {names[low[1]]} and {names[low[2]]} were taken for the legs, "
        f"since {why} of the two longest pairs, and {names[high[1]]} and {names[high[2]]} for the arms.",
        side_why,
    )
    sides = ("left", "right")
    return Limbs(
        {s: legs[i] for s, i in zip(sides, order, strict=True)},
        {s: arms[i] for s, i in zip(sides, arm_order, strict=True)},
        pose,
        evidence,
    )


def head_line(skeleton: Skeleton, chest: int, limbs: Sequence[int], pose: np.ndarray) -> list[int]:
    """The joints from above the chest to the head: the central branch with the highest end."""
    taken = set(limbs)
    best: list[int] = []
    lines = _Lines(skeleton)
    for child in skeleton.children(chest):
        line = lines[child]
        if taken.isdisjoint(subtree(skeleton, child)):
            top = [j for j in line if pose[j, 2] > pose[chest, 2]]
            if top and (not best or pose[top[-1], 2] > pose[best[-1], 2]):
                best = top
    return best


def subtree(skeleton: Skeleton, joint: int) -> list[int]:
    """`joint` and all that hangs on it, each joint's whole subtree before its next sibling."""
    out, stack = [], [joint]
    while stack:
        out.append(stack.pop())
        stack += reversed(skeleton.children(out[-1]))
    return out


def _bones(skeleton: Skeleton, line: Sequence[int]) -> np.ndarray:
    """Lengths (m) of the bones of a way down, the one above its first joint left out."""
    return np.linalg.norm(skeleton.offsets[list(line[1:])], axis=-1)


class _Lines(dict[int, list[int]]):
    """The longest way (m) down from each joint, itself first, made when it is asked for."""

    def __init__(self, skeleton: Skeleton):
        super().__init__()
        bones = np.linalg.norm(skeleton.offsets, axis=-1).tolist()
        # From the tips up: how long a joint's way is, of how many joints, and the best child. The number
        # of joints counts where skin meshes of no length hang beside the end.
        self._best: list[tuple[float, int, int]] = [(0.0, 0, -1)] * len(skeleton)
        for j in reversed(range(len(skeleton))):
            ways = [(*self._best[c][:2], c) for c in skeleton.children(j)]
            far, count, child = max(ways, key=lambda w: (round(w[0], 6), w[1]), default=(0.0, 0, -1))
            self._best[j] = (far + bones[j], count + 1, child)

    def joints(self, joint: int) -> int:
        """How many joints the way down has."""
        return self._best[joint][1]

    def __missing__(self, joint: int) -> list[int]:
        out = [joint]
        while (below := self._best[out[-1]][2]) >= 0:
            out.append(below)
        self[joint] = out
        return out


def _limb(
    lines: Sequence[Sequence[int]], pose: np.ndarray, ratio: float, width: float, upright: bool
) -> list[tuple[int, int, int]]:
    """The three joints of both limbs of a pair, at the same places of their ways from the trunk.

    Of all triples the one with an upper and a lower bone of the human ratio that make the most of the
    length; triples with first joints that stand closer than `width` of both bones, as those of collar
    bones and hip helpers do, come last.
    """
    at = [
        np.append(0.0, np.linalg.norm(np.diff(pose[list(line)], axis=0), axis=-1).cumsum())
        for line in lines
    ]

    def cost(way: tuple[int, int, int]) -> float:
        out = 0.0
        for line, along in zip(lines, at, strict=True):
            upper, lower = along[way[1]] - along[way[0]], along[way[2]] - along[way[1]]
            if min(upper, lower) < 1e-6:
                return np.inf
            out += 2 * abs(np.log(upper / lower / ratio)) - (upper + lower) / along[-1]
            lean = pose[line[way[0]]] - pose[line[way[2]]]
            out -= abs(lean[2]) / max(float(np.linalg.norm(lean)), 1e-9) if upright else 0.0
            # A leg that stands ends in a foot.
            out -= 0.3 if upright and way[2] < len(line) - 1 else 0.0
            apart = np.linalg.norm(pose[lines[0][way[0]]] - pose[lines[1][way[0]]])
            out += 2.0 if apart < width * (upper + lower) else 0.0
        return out

    # Of ways with more joints than limbs have, joints at even places.
    count = len(lines[0])
    usable = np.unique(np.linspace(0, count - 1, min(count, _LIMB_JOINTS)).round().astype(int)).tolist()
    best = min(itertools.combinations(usable, 3), key=cost)
    return [(line[best[0]], line[best[1]], line[best[2]]) for line in lines]


def _to_wrist(skeleton: Skeleton, line: Sequence[int]) -> list[int]:
    """A way from the collar bone, no farther than the first joint that bears several fingers."""
    for i in range(2, len(line) - 1):
        on = skeleton.offsets[line[i + 1]]
        for c in skeleton.children(line[i]):
            beside = skeleton.offsets[c]
            size = np.linalg.norm(on) * np.linalg.norm(beside)
            # What hangs on the line itself is a twist bone, and what has no length a mesh.
            if c != line[i + 1] and size > 1e-9 and on @ beside < 0.97 * size:
                return list(line[: i + 1])
    return list(line)


def _left_first(
    skeleton: Skeleton,
    legs: Sequence[tuple[int, int, int]],
    lines: dict[int, list[int]],
    tops: Sequence[int],
    pose: np.ndarray,
) -> tuple[bool, str]:
    """Whether the first leg is the left one, and why."""
    toes = [pose[lines[top][-1]] - pose[leg[2]] for top, leg in zip(tops, legs, strict=True)]
    ahead = np.mean(toes, 0)[:2]
    across = (pose[legs[0][0]] - pose[legs[1][0]])[:2]
    names = [skeleton.names[leg[0]] for leg in legs]
    if np.linalg.norm(ahead) < 0.02 * np.linalg.norm(pose[legs[0][0]] - pose[legs[0][2]]):
        # No toes: most skeletons look along +x or, where they come from Y up, along -y.
        ahead = np.array([0.0, -1.0]) if abs(across[0]) > abs(across[1]) else np.array([1.0, 0.0])
        reason = "there are no toes, so it was taken to face along the file's usual axis"
    else:
        reason = "the toes point ahead"
    # left = up x ahead
    left = float(across @ np.array([-ahead[1], ahead[0]])) > 0
    return left, f"{names[0 if left else 1]} is the left hip: {reason}."
