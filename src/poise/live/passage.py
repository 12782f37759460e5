"""Frame by frame from one skeleton onto another, in a fraction of a millisecond."""

from __future__ import annotations

from functools import lru_cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from poise.body import BodyTable
from poise.kinematics.retarget.passage import Retargeter, _places
from poise.live.quats import between, conj, matrix, mul, normalized, rotate, slerp
from poise.motion import Clip, Skeleton
from poise.motion.roles import SHARED, SIDES


class _Chain(NamedTuple):
    """Turns of a target's chain: between two of the source's turns, by their rows, -1 for none."""

    joint: int
    low: int
    high: int
    share: float


class FramePassage:
    """A clip's skeleton onto another one.

    Args:
        clip: shows how the source stands.
        onto: a clip on the target's skeleton, which shows how that stands.
        scale: of the path, by default the ratio of the heights of the hips.
    """

    def __init__(self, clip: Clip, onto: Clip, scale: float | None = None):
        p = Retargeter.between(clip, onto, None, None, scale)
        self.source, self.target = clip.skeleton, onto.skeleton
        self.factor, self.centre = p.scale.factor, np.array(p.scale.centre)
        self._here, self._there = np.array(p.here.rot), np.array(p.there.rot)
        direct, chains = {b: a for a, b in p.joints.direct}, _chains(p)
        self._direct = np.array(list(direct), dtype=int), np.array(list(direct.values()), dtype=int)
        self._bent = np.array([c.joint for c in chains], dtype=int)
        self._low, self._high = (np.array([c[k] for c in chains], dtype=int) for k in (1, 2))
        self._shares = np.array([c.share for c in chains])
        hips = p.joints.target.joint("hips")
        above = set(self.target.ancestors(hips if hips is not None else 0))
        # What hangs on its parent as it does at rest; joints of one level are turned together.
        done = {*direct, *self._bent.tolist()}
        self._hanging = list[tuple[np.ndarray, np.ndarray, np.ndarray]]()
        self._first = None if 0 in done else np.array(p.there.above[0])
        for joints, parents in _levels(tuple(self.target.parents)):
            at = [k for k, j in enumerate(joints.tolist()) if j not in done]
            if at:
                turns = [
                    p.there.above[j] if j in above else between(self._there[parent], self._there[j])
                    for j, parent in zip(joints[at].tolist(), parents[at].tolist(), strict=True)
                ]
                self._hanging.append((joints[at], parents[at], np.stack(turns)))
        pairs = [p.joints.limb_pair(f"{s}_thigh") for s in SIDES]
        thighs = [x for x in pairs if x is not None]
        self._ways = _way(self.source, [a for a, _ in thighs]), _way(self.target, [b for _, b in thighs])

    def __call__(self, root_pos: np.ndarray, rot: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The target's root `(3)` m and world rotations `(J, 4)` for a pose of the source."""
        return self.turned(root_pos, world_of(self.source, rot))

    def turned(self, root_pos: np.ndarray, world: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The same for world rotations `(J, 4)` of the source."""
        turned = mul(world, conj(self._here))
        out = np.empty((len(self.target), 4))
        onto, of = self._direct
        out[onto] = mul(turned[of], self._there[onto])
        if len(self._bent):
            bent = slerp(turned[self._low], turned[self._high], self._shares)
            out[self._bent] = mul(bent, self._there[self._bent])
        if self._first is not None:
            out[0] = self._first
        for joints, parents, turns in self._hanging:
            out[joints] = mul(out[parents], turns)
        out = normalized(out)
        middle = self._middle(0, root_pos, world)
        root = middle + (self.factor - 1.0) * (middle - self.centre) - self._middle(1, np.zeros(3), out)
        return root, out

    def _middle(self, side: int, root: np.ndarray, world: np.ndarray) -> np.ndarray:
        """The middle between the hip joints of the source (0) or target (1)."""
        joints, arms = self._ways[side]
        return root + rotate(world[joints], arms).sum(0)


def _way(skeleton: Skeleton, ends: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """Joints and arms `(n, 3)` m which, turned by them and added up, lead from the root to the middle
    between the ends."""
    arms = dict[int, np.ndarray]()
    for end in ends:
        path = (*skeleton.ancestors(end)[::-1], end)
        for above, joint in pairwise(path):
            arms[above] = arms.get(above, np.zeros(3)) + skeleton.offsets[joint] / len(ends)
    return np.array(list(arms), dtype=int), np.array(list(arms.values())).reshape(-1, 3)


@lru_cache(maxsize=64)
def _levels(parents: tuple[int, ...]) -> list[tuple[np.ndarray, np.ndarray]]:
    """Joints and their parents, those at the same distance from the root together."""
    depth = [0] * len(parents)
    for j, parent in enumerate(parents):
        depth[j] = 0 if parent < 0 else depth[parent] + 1
    levels = ([j for j, d in enumerate(depth) if d == k] for k in range(1, max(depth) + 1))
    return [(np.array(js), np.array([parents[j] for j in js])) for js in levels]


@lru_cache(maxsize=64)
def doublings(parents: tuple[int, ...]) -> list[tuple[np.ndarray, np.ndarray]]:
    """Joints, and those that all of the way up to which they know already hang on: each round doubles
    the way, so that few are enough."""
    above, out = np.array(parents), list[tuple[np.ndarray, np.ndarray]]()
    while (above >= 0).any():
        joints = np.flatnonzero(above >= 0)
        out.append((joints, above[joints]))
        above = np.where(above >= 0, above[np.maximum(above, 0)], -1)
    return out


def world_of(skeleton: Skeleton, rot: np.ndarray) -> np.ndarray:
    """World rotations `(J, 4)` of local ones."""
    out = rot.copy()
    for joints, above in doublings(tuple(skeleton.parents)):
        out[joints] = mul(out[above], out[joints])
    return out


def local_of(skeleton: Skeleton, world: np.ndarray) -> np.ndarray:
    """Local rotations `(J, 4)` of those in the world."""
    parents = np.array(skeleton.parents)
    out = between(world[np.maximum(parents, 0)], world)
    out[0] = world[0]
    return out


def place_of(
    skeleton: Skeleton, path: tuple[int, ...], root: np.ndarray, world: np.ndarray
) -> np.ndarray:
    """m, where the last joint of a path from the root is."""
    if len(path) < 2:
        return root
    return root + rotate(world[list(path[:-1])], skeleton.offsets[list(path[1:])]).sum(0)


def _chains(p: Retargeter) -> list[_Chain]:
    """Spine, neck and head, as `kinematics.retarget.passage` shares their bend out."""
    joints, out = p.joints, list[_Chain]()
    hips = joints.source.joint("hips")
    carrier = chest = hips if hips is not None else 0
    for kinds in (SHARED[:1], SHARED[1:]):
        source = tuple(x for k in kinds for x in joints.source.chain(k))
        target = tuple(x for k in kinds for x in joints.target.chain(k))
        if not source and kinds != SHARED[:1]:
            continue
        knots = [(0.0, carrier), *zip(_places(p.here, source), source, strict=True)]
        for j, at in zip(target, _places(p.there, target), strict=True):
            out.append(_between(j, knots, at))
        chest = knots[-1][1]
        carrier = chest
    return out


def _between(joint: int, knots: list[tuple[float, int]], at: float) -> _Chain:
    for (a, low), (b, high) in pairwise(knots):
        if at <= b + 1e-9:
            share = 1.0 if b - a < 1e-9 else min(max((at - a) / (b - a), 0.0), 1.0)
            return _Chain(joint, low, high, share)
    return _Chain(joint, knots[-1][1], knots[-1][1], 1.0)


class Hinges:
    """A body's coordinates of one frame, its hinges continuous from one frame to the next.

    The naive twin is `kin.clip_to_qpos`, which knows all frames.
    """

    def __init__(self, skeleton: Skeleton, table: BodyTable):
        self.skeleton, self.rows = skeleton, table.rows
        pelvis = self.rows[0].joint
        self._pelvis = (*skeleton.ancestors(pelvis)[::-1], pelvis)
        driven = [r for r in self.rows[1:] if r.order]
        self._joints = np.array([r.joint for r in driven])
        self._anchors = np.array([self.rows[r.parent].joint for r in driven])
        self._rest = np.array([r.quat for r in driven])
        self._frame = np.array([r.frame for r in driven])
        single, euler, column = list[tuple[int, int, int]](), list[tuple[int, ...]](), 0
        for k, row in enumerate(driven):
            n = len(row.order)
            if n == 1:
                single.append((k, "XYZ".index(row.order), column))
            else:
                order = row.order
                if n == 2:
                    order = order[0] + next(c for c in "XYZ" if c not in order) + order[1]
                i, j, l_ = ("XYZ".index(c) for c in order)
                euler.append((k, i, j, l_, column, n))
            column += n
        self._single = np.array(single, dtype=int).reshape(-1, 3).T
        self._two, self._three = (
            np.array([e[:5] for e in euler if e[5] == n], dtype=int).reshape(-1, 5).T for n in (2, 3)
        )
        self.count = column

    def __call__(self, root: np.ndarray, world: np.ndarray, before: np.ndarray | None) -> np.ndarray:
        """`(7 + n)` for the root `(3)` m and the world rotations of all joints.

        before: `(n)` rad, the hinges of the frame before; None takes those nearest to 0.
        """
        out = np.empty(7 + self.count)
        out[:3] = place_of(self.skeleton, self._pelvis, root, world)
        out[3:7] = world[self._pelvis[-1]]
        rel = between(world[self._anchors], world[self._joints])
        local = mul(between(self._frame, between(self._rest, rel)), self._frame)
        m, angles = matrix(local), np.zeros(self.count)
        last = np.zeros(self.count) if before is None else before
        k, axis, at = self._single
        angles[at] = 2.0 * np.arctan2(local[k, 1 + axis], local[k, 0])
        a, _, c = _euler(m, *self._two[:4])
        angles[self._two[4]], angles[self._two[4] + 1] = a, c
        at = self._three[4] + np.arange(3)[:, None]
        first = np.stack(_euler(m, *self._three[:4]))
        second = np.stack((first[0] + np.pi, np.pi - first[1], first[2] + np.pi))
        near, far = (np.square(_wrapped(x - last[at])).sum(0) for x in (first, second))
        angles[at] = np.where(near <= far, first, second)
        out[7:] = last + _wrapped(angles - last)
        return out


def _euler(
    m: np.ndarray, k: np.ndarray, i: np.ndarray, j: np.ndarray, l_: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The angles `(n)` of turns `m[k]` about axes i, then j, then l."""
    e = np.where((j - i) % 3 == 1, 1.0, -1.0)
    b = np.arcsin(np.clip(e * m[k, i, l_], -1.0, 1.0))
    return np.arctan2(-e * m[k, j, l_], m[k, l_, l_]), b, np.arctan2(-e * m[k, i, j], m[k, i, i])


def _wrapped(angle: np.ndarray) -> np.ndarray:
    return np.remainder(angle + np.pi, 2 * np.pi) - np.pi
