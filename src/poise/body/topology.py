"""The limbs of a skeleton whose names say nothing: by its tree, its lengths and how it stands."""

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


@dataclass(frozen=True)
class Limbs:
    """Three joints per limb: hip, knee, ankle and shoulder, elbow, wrist, by side.

    pose: `(J, 3)` m, the joint positions by which they were told. evidence: why, one sentence each.
    """

    legs: dict[str, tuple[int, int, int]]
    arms: dict[str, tuple[int, int, int]]
    pose: np.ndarray
    evidence: tuple[str, ...]


def find_limbs(skeleton: Skeleton, clips: Sequence[Clip] = ()) -> Limbs | None:
    """The legs and arms of a human tree, or None where it has no two pairs of equal limbs.

    A pair of limbs are two sibling subtrees of the same length and number of joints. The two longest
    pairs that do not lie in one another are legs and arms; the legs are those whose ends are lower in
    the first frame of the first clip, else in the rest pose. Left and right follow from the toes.
    """
    pose = trim(clips[0], 0, 2).positions()[0] if clips else skeleton.rest_positions()
    lines = {j: _line(skeleton, j) for j in range(len(skeleton))}
    lengths = {j: _length(skeleton, line) for j, line in lines.items()}
    pairs = []
    for parent in range(len(skeleton)):
        for a, b in itertools.combinations(skeleton.children(parent), 2):
            long = max(lengths[a], lengths[b])
            alike = long > 0 and abs(lengths[a] - lengths[b]) <= UNEQUAL * long
            if alike and len(lines[a]) == len(lines[b]) >= 3:
                pairs.append((long, a, b))
    pairs.sort(reverse=True)
    outer = [p for p in pairs if not any(_inside(skeleton, p[1], q[1:]) for q in pairs if q is not p)]
    if len(outer) < 2:
        return None
    # The mean height of each pair's ends.
    low, high = sorted(outer[:2], key=lambda p: pose[[lines[p[1]][-1], lines[p[2]][-1]], 2].mean())
    ends = [float(pose[[lines[p[1]][-1], lines[p[2]][-1]], 2].mean()) for p in (low, high)]
    size = float(np.ptp(pose[:, 2]))
    names = skeleton.names
    if ends[1] - ends[0] < 0.05 * max(size, low[0]):
        # A pose that does not stand: the legs hang nearer to the root.
        low, high = sorted(outer[:2], key=lambda p: _depth(skeleton, p[1]))
        why = "they hang nearest to the root"
    else:
        why = "their ends are the lowest"
    legs = [_leg(lines[j], pose) for j in low[1:]]
    arms = [_arm(skeleton, lines[j]) for j in high[1:]]
    left, side_why = _left_first(skeleton, legs, lines, low[1:], pose)
    order = (0, 1) if left else (1, 0)
    # The arm that is on the left leg's side is the left one.
    across = pose[legs[order[0]][0]] - pose[legs[order[1]][0]]
    arm_left = (pose[arms[0][0]] - pose[arms[1][0]]) @ across > 0
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
    """The joints from above the chest to the head: the central branch whose end is the highest."""
    taken = set(limbs)
    best: list[int] = []
    for child in skeleton.children(chest):
        line = _line(skeleton, child)
        if taken.isdisjoint(_subtree(skeleton, child)):
            top = [j for j in line if pose[j, 2] > pose[chest, 2]]
            if top and (not best or pose[top[-1], 2] > pose[best[-1], 2]):
                best = top
    return best


def _subtree(skeleton: Skeleton, joint: int) -> list[int]:
    out, stack = [], [joint]
    while stack:
        out.append(stack.pop())
        stack += skeleton.children(out[-1])
    return out


def _inside(skeleton: Skeleton, joint: int, tops: Sequence[int]) -> bool:
    """Whether a joint lies properly below one of `tops`."""
    j = skeleton.parents[joint]
    while j >= 0:
        if j in tops:
            return True
        j = skeleton.parents[j]
    return False


def _depth(skeleton: Skeleton, joint: int) -> int:
    out = 0
    while skeleton.parents[joint] >= 0:
        joint, out = skeleton.parents[joint], out + 1
    return out


def _length(skeleton: Skeleton, line: Sequence[int]) -> float:
    return float(sum(np.linalg.norm(skeleton.offsets[j]) for j in line[1:]))


def _line(skeleton: Skeleton, joint: int) -> list[int]:
    """The longest way (m) down from a joint, itself first."""
    below = [_line(skeleton, c) for c in skeleton.children(joint)]
    if not below:
        return [joint]
    offsets = skeleton.offsets
    return [joint, *max(below, key=lambda w: _length(skeleton, w) + np.linalg.norm(offsets[w[0]]))]


def _leg(line: Sequence[int], pose: np.ndarray) -> tuple[int, int, int]:
    """Hip, knee and ankle on a way from the hip to the toes.

    Equal thigh and shin, the longest such pair, and no more behind the ankle than a foot.
    """

    def cost(way: tuple[int, int, int]) -> float:
        thigh, shin = (float(np.linalg.norm(pose[b] - pose[a])) for a, b in itertools.pairwise(way))
        if min(thigh, shin) < 1e-6:
            return np.inf
        whole = float(sum(np.linalg.norm(pose[b] - pose[a]) for a, b in itertools.pairwise(line)))
        # The straight way of both counts, so that a helper on the way to the hip is left out.
        lean = pose[way[0]] - pose[way[2]]
        upright = abs(lean[2]) / max(float(np.linalg.norm(lean)), 1e-9)
        foot = 0.0 if way[2] == line[-1] else -0.3
        return abs(np.log(thigh / shin / LEG_RATIO)) - 2 * (thigh + shin) / whole - upright + foot

    return min(itertools.combinations(line, 3), key=cost)


def _arm(skeleton: Skeleton, line: Sequence[int]) -> tuple[int, int, int]:
    """Shoulder, elbow and wrist on a way from the collar bone to a finger tip.

    The wrist is no later than the first joint that bears several fingers.
    """

    def fingers(joint: int) -> int:
        # A leaf beside the limb is a twist bone or a helper.
        return sum(bool(skeleton.children(c)) for c in skeleton.children(joint))

    forks = [i for i, j in enumerate(line) if i >= 2 and fingers(j) > 1]
    line = line[: forks[0] + 1] if forks else line
    at = np.cumsum([0.0, *(np.linalg.norm(skeleton.offsets[j]) for j in line[1:])])

    def cost(way: tuple[int, int, int]) -> float:
        upper, fore = at[way[1]] - at[way[0]], at[way[2]] - at[way[1]]
        if min(upper, fore) < 1e-6:
            return np.inf
        return 2 * abs(np.log(upper / fore / ARM_RATIO)) - (upper + fore) / max(at[-1], 1e-9)

    a, b, c = min(itertools.combinations(range(len(line)), 3), key=cost)
    return line[a], line[b], line[c]


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
        # No toes: whoever made the skeleton most likely let it look along +x or, from Y up, along -y.
        ahead = np.array([0.0, -1.0]) if abs(across[0]) > abs(across[1]) else np.array([1.0, 0.0])
        reason = "there are no toes, so it was taken to face along the file's usual axis"
    else:
        reason = "the toes point ahead"
    # left = up x ahead
    left = float(across @ np.array([-ahead[1], ahead[0]])) > 0
    return left, f"{names[0 if left else 1]} is the left hip: {reason}."
