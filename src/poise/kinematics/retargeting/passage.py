"""The one retargeter, of a clip or of one frame: directions of bones, and the path at another size."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from poise.errors import PoiseError
from poise.kinematics.feet import rest_height
from poise.kinematics.forward import carried
from poise.kinematics.retargeting.common_pose import CommonPose, common_pose
from poise.kinematics.retargeting.standing import ClipWorld
from poise.motion import Clip, Skeleton
from poise.motion.roles import SHARED, SIDES, JointMap, map_joints
from poise.motion.rotations import normalize, quat_between, quat_conj, quat_mul, quat_rotate, slerp


@dataclass(frozen=True)
class Scale:
    """The map of the source's space into the target's: x' = c + k (x - c), and its ground."""

    factor: float
    centre: tuple[float, float, float]
    ground: float

    @staticmethod
    def between(
        world: ClipWorld, fps: float, here: CommonPose, there: CommonPose, factor: float | None
    ) -> Scale:
        """Scaled by the heights of the hips over the feet, about where the clip begins on its ground."""
        factor = there.hip_height / here.hip_height if factor is None else factor
        pos, quat = world
        treads = []
        for side, tread in zip(SIDES, here.treads, strict=True):
            foot = here.roles.joint(f"{side}_foot") or 0
            treads.append(carried(pos[:, foot], quat[:, foot], tread))
        ground = rest_height(np.stack(treads, 1), fps)
        hips = [pos[0, here.roles.joint(f"{s}_thigh") or 0] for s in SIDES]
        middle = (hips[0] + hips[1]) / 2
        return Scale(factor, (float(middle[0]), float(middle[1]), ground), ground)

    def place(self, x: np.ndarray) -> np.ndarray:
        """Points `(..., 3)` m of the source's world where the target has them."""
        centre = self.centre
        # Written so that a factor of 1 changes no digit.
        return x + (self.factor - 1.0) * (x - centre)

    def inverse(self) -> Scale:
        """The map back."""
        return Scale(1.0 / self.factor, self.centre, self.ground)


class _Plan(NamedTuple):
    """The source that turns each joint of a target, as rows of arrays.

    Attributes:
        direct: targets, and the joints of the source that move them.
        bent: targets of spine, neck and head, the source's joints that they lie between, and the shares.
        first: `(4)` the root's rotation, None where a joint of the source moves it.
        hanging: joints on their parents as at rest, those of one level together: joints, parents, turns.
        ways: of source and target, see `_way_to`.
        back: `(J, 4)` the inverse of the source's common pose.
    """

    direct: tuple[np.ndarray, np.ndarray]
    bent: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
    first: np.ndarray | None
    hanging: list[tuple[np.ndarray, np.ndarray, np.ndarray]]
    ways: tuple[tuple[np.ndarray, np.ndarray], ...]
    back: np.ndarray


@dataclass(frozen=True, eq=False)
class Retargeter:
    """From one skeleton to another: which joint moves which, how source (`here`) and target (`there`)
    stand in their common pose, and the scale of the path. share: see `RetargetConfig`."""

    joints: JointMap
    here: CommonPose
    there: CommonPose
    scale: Scale
    share: bool = True

    @cached_property
    def _plan(self) -> _Plan:
        return _plan_of(self.joints, self.here, self.there, self.share)

    @staticmethod
    def between(
        clip: Clip,
        onto: Skeleton | Clip,
        mapping: Mapping[str, str] | None = None,
        example: Clip | None = None,
        factor: float | None = None,
        share: bool = True,
        rigid: Sequence[str] = (),
    ) -> Retargeter:
        """The passage of a clip; see `retarget` and `RetargetConfig`.

        factor: of the scale, by default the ratio of the heights of the hips.
        """
        target, shown = (onto, None) if isinstance(onto, Skeleton) else (onto.skeleton, onto)
        source, world = clip.skeleton, ClipWorld.of(clip)
        joints = map_joints(source, target, mapping)
        if example is None:
            here = common_pose(joints.source, clip, world)
        elif source.same_bones(example.skeleton, 0.0):
            here = common_pose(joints.source, example)
        else:
            raise PoiseError(
                "the example is on another skeleton than the source",
                example.name,
                code="skeleton-differs",
            )
        there = here
        if not source.same_bones(target, 0.0):
            if shown is None and (source.names, source.parents) == (target.names, target.parents):
                # The same hierarchy at another size, such as another subject of one data set.
                shown = Clip(target, clip.root_pos, clip.rot, clip.fps, clip.name)
            there = common_pose(joints.target, shown)
        joints = joints.without(rigid) if rigid else joints
        scale = Scale.between(world, clip.fps, here, there, factor)
        return Retargeter(joints, here, there, scale, share)

    @property
    def source(self) -> Skeleton:
        """The skeleton that a motion comes from."""
        return self.joints.source.skeleton

    @property
    def target(self) -> Skeleton:
        """The skeleton that it goes to."""
        return self.joints.target.skeleton

    def __call__(self, root: np.ndarray, world: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The target's root `(..., 3)` m and world rotations `(..., J, 4)`, contacts as they come, for
        those of the source."""
        plan = self._plan
        turned = quat_mul(world, plan.back)
        rest = self.there.rot
        out = np.empty((*world.shape[:-2], len(self.target), 4))
        onto, of = plan.direct
        out[..., onto, :] = quat_mul(turned[..., of, :], rest[onto])
        onto, low, high, shares = plan.bent
        if len(onto):
            bent = slerp(turned[..., low, :], turned[..., high, :], shares)
            out[..., onto, :] = quat_mul(bent, rest[onto])
        if plan.first is not None:
            out[..., 0, :] = plan.first
        for joints, parents, turns in plan.hanging:
            out[..., joints, :] = quat_mul(out[..., parents, :], turns)
        out = normalize(out)
        (joints, arms), (own_joints, own_arms) = plan.ways
        middle = root + quat_rotate(world[..., joints, :], arms).sum(-2)
        moved = middle + (self.scale.factor - 1.0) * (middle - np.array(self.scale.centre))
        return moved - quat_rotate(out[..., own_joints, :], own_arms).sum(-2), out

    def transfer(self, world: ClipWorld) -> tuple[np.ndarray, np.ndarray]:
        """Local rotations `(T, J, 4)` and root path `(T, 3)` of the target for the source's joints."""
        root, there = self(world.pos[:, 0], world.quat)
        return local_of(self.target, there), root


def hip_middle(joints: JointMap, pos: np.ndarray, side: int) -> np.ndarray:
    """`(T, 3)` m, the middle between the hip joints of the source (0) or target (1)."""
    return sum((pos[:, x[side]] for x in _hips(joints)), np.zeros(())) / 2


def _hips(joints: JointMap) -> list[tuple[int, int]]:
    pairs = (joints.limb_pair(f"{s}_thigh") for s in SIDES)
    return [x for x in pairs if x is not None]


def _plan_of(joints: JointMap, here: CommonPose, there: CommonPose, share: bool) -> _Plan:
    target = joints.target.skeleton
    direct, bent = {b: a for a, b in joints.direct}, _bent(joints, here, there, share)
    done = {*direct, *bent}
    hips = joints.target.joint("hips")
    above = set(target.ancestors(hips if hips is not None else 0))
    hanging = list[tuple[np.ndarray, np.ndarray, np.ndarray]]()
    for level in _levels(tuple(target.parents)):
        free = [j for j in level if j not in done]
        parents = [target.parents[j] for j in free]
        if free:
            # What hangs on its parent as it does at rest.
            turns = quat_between(there.rot[parents], there.rot[free])
            turns = np.stack(
                [there.above[j] if j in above else t for j, t in zip(free, turns, strict=True)]
            )
            hanging.append((np.array(free), np.array(parents), turns))
    ways = (
        _way_to(joints.source.skeleton, [a for a, _ in _hips(joints)]),
        _way_to(target, [b for _, b in _hips(joints)]),
    )
    low, high = np.array([b[:2] for b in bent.values()], dtype=int).reshape(-1, 2).T
    return _Plan(
        (np.array(list(direct), dtype=int), np.array(list(direct.values()), dtype=int)),
        (np.array(list(bent), dtype=int), low, high, np.array([s for *_, s in bent.values()])),
        None if 0 in done else there.above[0],
        hanging,
        ways,
        quat_conj(here.rot),
    )


def _way_to(skeleton: Skeleton, ends: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    """Joints and arms `(n, 3)` m that, turned by them and added up, lead from the root to the middle
    between the ends."""
    arms = dict[int, np.ndarray]()
    for end in ends:
        for above, joint in pairwise((*skeleton.ancestors(end)[::-1], end)):
            arms[above] = arms.get(above, np.zeros(3)) + skeleton.offsets[joint] / 2
    return np.array(list(arms), dtype=int), np.array(list(arms.values())).reshape(-1, 3)


def _bent(
    joints: JointMap, here: CommonPose, there: CommonPose, share: bool
) -> dict[int, tuple[int, int, float]]:
    """The target's spine, neck and head: between which joints of the source each lies, and the share.

    A chain's joints have places in [0, 1] from what carries it (0) to its last joint (1); between the
    source's joints the turn is interpolated, or without `share` that of the joint below where the spine
    of the target has more of them.
    """
    out = dict[int, tuple[int, int, float]]()
    hips = joints.source.joint("hips")
    carrier = hips if hips is not None else 0
    for kinds in (SHARED[:1], SHARED[1:]):
        source = tuple(x for k in kinds for x in joints.source.chain(k))
        target = tuple(x for k in kinds for x in joints.target.chain(k))
        if not source and kinds != SHARED[:1]:
            # Neck and head without a source ride on the chest.
            continue
        places, knots = [0.0, *_places(here, source)], [carrier, *source]
        shares = share or kinds != SHARED[:1] or len(source) >= len(target)
        for j, at in zip(target, _places(there, target), strict=True):
            # The first of the source's joints that lies no lower.
            k = next((k for k in range(1, len(places)) if at <= places[k] + 1e-9), len(places) - 1)
            gap = places[k] - places[k - 1] if k else 0.0
            part = 1.0 if gap < 1e-9 else min(max((at - places[k - 1]) / gap, 0.0), 1.0)
            if at > places[-1] + 1e-9 or part > 1.0 - 1e-9:
                part = 1.0
            elif not shares:
                part = 0.0
            out[j] = knots[max(k - 1, 0)], knots[k], part
        carrier = knots[-1]
    return out


def _places(pose: CommonPose, chain: tuple[int, ...]) -> list[float]:
    """Places in (0, 1] of a chain's joints: the middle of the bone above each, by length."""
    if not chain:
        return []
    first = pose.roles.skeleton.parents[chain[0]]
    line = [first, *chain]
    gaps = [float(np.linalg.norm(pose.pos[b] - pose.pos[a])) for a, b in pairwise(line)]
    # The last joint's own bone is taken as long as the one below it.
    gaps.append(gaps[-1])
    ends = np.cumsum([0.0, *gaps])
    middles = (ends[1:] + ends[:-1]) / 2
    if middles[-1] - middles[0] < 1e-6:
        return [(i + 1) / len(chain) for i in range(len(chain))]
    return [float(x) for x in ((middles[1:] - middles[0]) / (middles[-1] - middles[0]))]


@lru_cache(maxsize=64)
def _levels(parents: tuple[int, ...]) -> list[list[int]]:
    """Joints below the root, those at the same distance from it together."""
    depth = [0] * len(parents)
    for j, parent in enumerate(parents):
        depth[j] = 0 if parent < 0 else depth[parent] + 1
    return [[j for j, d in enumerate(depth) if d == k] for k in range(1, max(depth) + 1)]


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
    """World rotations `(..., J, 4)` of local ones."""
    out = rot.copy()
    for joints, above in doublings(tuple(skeleton.parents)):
        out[..., joints, :] = quat_mul(out[..., above, :], out[..., joints, :])
    return out


def local_of(skeleton: Skeleton, world: np.ndarray) -> np.ndarray:
    """Local rotations `(..., J, 4)` of those in the world."""
    out = quat_between(world[..., np.maximum(skeleton.parents, 0), :], world)
    out[..., 0, :] = world[..., 0, :]
    return out
