"""The passage from one skeleton to another: directions of bones, and the path at another size."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from poise.errors import PoiseError
from poise.kinematics.feet import rest_height
from poise.kinematics.forward import carried
from poise.kinematics.retarget.common_pose import CommonPose, common_pose
from poise.kinematics.retarget.standing import ClipWorld
from poise.motion import Clip, Skeleton
from poise.motion.roles import SHARED, SIDES, JointMap, map_joints
from poise.motion.rotations import (
    forward_kinematics,
    normalize,
    quat_between,
    quat_conj,
    quat_mul,
    slerp,
)


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
        ground = rest_height(torch.stack(treads, 1), fps)
        hips = [pos[0, here.roles.joint(f"{s}_thigh") or 0] for s in SIDES]
        middle = (hips[0] + hips[1]) / 2
        return Scale(factor, (float(middle[0]), float(middle[1]), ground), ground)

    def place(self, x: Tensor) -> Tensor:
        """Points `(..., 3)` m of the source's world where the target has them."""
        centre = torch.tensor(self.centre, dtype=x.dtype)
        # Written so that a factor of 1 changes no digit.
        return x + (self.factor - 1.0) * (x - centre)

    def inverse(self) -> Scale:
        """The map back."""
        return Scale(1.0 / self.factor, self.centre, self.ground)


@dataclass(frozen=True, eq=False)
class Retargeter:
    """From one skeleton to another: which joint moves which, how source (`here`) and target (`there`)
    stand in their common pose, and the scale of the path."""

    joints: JointMap
    here: CommonPose
    there: CommonPose
    scale: Scale

    @staticmethod
    def between(
        clip: Clip,
        onto: Skeleton | Clip,
        mapping: Mapping[str, str] | None = None,
        example: Clip | None = None,
        factor: float | None = None,
    ) -> Retargeter:
        """The passage of a clip; see `retarget`. factor: of the scale."""
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
        return Retargeter(joints, here, there, Scale.between(world, clip.fps, here, there, factor))

    def transfer(self, world_in: ClipWorld, share: bool = True) -> tuple[Tensor, Tensor]:
        """Local rotations `(T, J, 4)` and root path `(T, 3)` of the target, contacts as they come.

        share: see `RetargetConfig`.
        """
        joints, here, there = self.joints, self.here, self.there
        target = joints.target.skeleton
        source_pos, source_quat = world_in
        frames = len(source_pos)
        turned = quat_mul(source_quat, quat_conj(torch.tensor(here.rot)))
        rest = torch.tensor(there.rot)
        moves = dict((b, a) for a, b in joints.direct)
        shared = _shared(self, turned, share)
        hips = joints.target.joint("hips")
        above = target.ancestors(hips if hips is not None else 0)
        world: list[Tensor] = []
        for j, parent in enumerate(target.parents):
            if j in moves:
                q = quat_mul(turned[:, moves[j]], rest[j])
            elif j in shared:
                q = quat_mul(shared[j], rest[j])
            elif j in above:
                own = torch.tensor(there.above[j]).expand(frames, 4)
                q = own if parent < 0 else quat_mul(world[parent], own)
            else:
                q = quat_mul(world[parent], quat_between(rest[parent], rest[j]))
            world.append(normalize(q))
        both = zip(world, target.parents, strict=True)
        rot = torch.stack([q if p < 0 else quat_between(world[p], q) for q, p in both], 1)
        zero = torch.zeros(frames, 3, dtype=torch.float64)
        pos, _ = forward_kinematics(target.parents, torch.tensor(target.offsets), zero, rot)
        root = self.scale.place(hip_middle(joints, source_pos, 0)) - hip_middle(joints, pos, 1)
        return rot, root


def hip_middle(joints: JointMap, pos: Tensor, side: int) -> Tensor:
    """`(T, 3)` m, the middle between the hip joints of the source (0) or target (1)."""
    pairs = [joints.limb_pair(f"{s}_thigh") for s in SIDES]
    return sum((pos[:, p[side]] for p in pairs if p is not None), torch.zeros(())) / 2


def _shared(passage: Retargeter, turned: Tensor, share: bool) -> dict[int, Tensor]:
    """World turns `(T, 4)` from the common pose of the target's spine, neck and head.

    A chain's joints have places in [0, 1] from what carries it (0) to its last joint (1); between the
    source's joints the turn is interpolated, or without `share` that of the joint below where the spine
    of the target has more of them.
    """
    out: dict[int, Tensor] = {}
    joints = passage.joints
    hips = joints.source.joint("hips")
    carrier = turned[:, hips if hips is not None else 0]
    chest = carrier
    for kinds in (SHARED[:1], SHARED[1:]):
        source = tuple(x for k in kinds for x in joints.source.chain(k))
        target = tuple(x for k in kinds for x in joints.target.chain(k))
        if not source and kinds != SHARED[:1]:
            # Neck and head without a source ride on the chest.
            continue
        knots = [
            (0.0, carrier),
            *zip(_places(passage.here, source), [turned[:, j] for j in source], strict=True),
        ]
        shares = share or kinds != SHARED[:1] or len(source) >= len(target)
        for j, at in zip(target, _places(passage.there, target), strict=True):
            out[j] = (_between if shares else _below)(knots, at)
        chest = knots[-1][1]
        carrier = chest
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


def _between(knots: list[tuple[float, Tensor]], at: float) -> Tensor:
    for (a, low), (b, high) in pairwise(knots):
        if at <= b + 1e-9:
            share = 1.0 if b - a < 1e-9 else min(max((at - a) / (b - a), 0.0), 1.0)
            if share > 1.0 - 1e-9:
                return high
            return slerp(low, high, torch.full((len(low),), share, dtype=low.dtype))
    return knots[-1][1]


def _below(knots: list[tuple[float, Tensor]], at: float) -> Tensor:
    """The turn of the bone that carries a place: that of the last joint at or below it."""
    return [turn for place, turn in knots if place <= at + 1e-9][-1]
