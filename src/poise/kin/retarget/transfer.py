"""A motion on another skeleton: the same directions of all bones, the same steps, at its own size."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from poise.errors import PoiseError
from poise.kin.retarget.common_pose import CommonPose, common_pose
from poise.kin.retarget.plant import Scale, feet_of, plant, source_contacts
from poise.kin.retarget.report import RetargetReport, measure
from poise.kin.retarget.standing import World
from poise.motion import Clip, Roles, Skeleton
from poise.motion.joint_map import SHARED, JointMap, map_joints
from poise.spatial import (
    forward_kinematics,
    normalize,
    quat_conj,
    quat_mul,
    slerp,
    unwrap_quats,
)


@dataclass(frozen=True)
class RetargetConfig:
    """How a motion passes to another skeleton.

    contacts: hold planted feet and hands where the source's are, scaled. clear: lift what would sink
    deeper into the floor than in the source. scale: size of the path, by default the ratio of the
    heights of the hips.
    """

    contacts: bool = True
    clear: bool = True
    scale: float | None = None


def retarget(
    clip: Clip,
    onto: Skeleton | Clip,
    mapping: Mapping[str, str] | None = None,
    config: RetargetConfig | None = None,
    example: Clip | None = None,
) -> tuple[Clip, RetargetReport]:
    """The motion of `clip` on another human skeleton.

    Every joint's world rotation passes through the pose that both skeletons share (`common_pose`):
    W_target = W_source C_source^-1 C_target, so that bones of arms and legs point where they pointed.
    Spine and neck share their bend out along however many joints there are. The hips follow the source's
    path scaled by leg length about its start; then feet and hands are put back on the scaled contacts
    (`plant`).

    Args:
        onto: the skeleton to move, or a clip on it, which also tells how it stands where its rest pose
            does not.
        mapping: joints of the source with the joint that each moves; the others are guessed.
        example: another clip on the source's skeleton, by default `clip` itself, that tells how the
            source stands; hand in the same one for all clips that must come out alike.

    Returns:
        the clip on the other skeleton, same name, rate and length, and what was mapped and measured.

    Raises:
        PoiseError: a joint that does not exist, a mapping that turns the hierarchy round, a skeleton
            without pelvis or legs, or one that lies folded at rest and no clip shows how it stands.
    """
    began = time.perf_counter()
    config = config or RetargetConfig()
    target = onto if isinstance(onto, Skeleton) else onto.skeleton
    world = World.of(clip)
    joints, here, there = passage(clip, onto, mapping, example, world)
    scale = Scale.between(world, clip.fps, joints, here, there, config.scale)
    rot, root = transfer(world, joints, here, there, scale)
    feet = feet_of(joints, here, there)
    contacts = source_contacts(world, clip.fps, feet, scale.ground)
    if config.contacts or config.clear:
        rot, root = plant(
            *(clip, world, joints, (here, there), rot, root, feet, contacts, scale),
            hold=config.contacts,
            clear=config.clear,
        )
    flat = [unwrap_quats(normalize(rot[:, j])) for j in range(len(target))]
    made = Clip(target, root.numpy(), torch.stack(flat, 1).numpy(), clip.fps, clip.name, clip.cyclic)
    seconds = time.perf_counter() - began
    return made, measure(
        (world, World.of(made)), clip.fps, joints, (here, there), feet, contacts, scale, seconds
    )


def passage(
    clip: Clip,
    onto: Skeleton | Clip,
    mapping: Mapping[str, str] | None = None,
    example: Clip | None = None,
    world: World | None = None,
) -> tuple[JointMap, CommonPose, CommonPose]:
    """Which joint moves which, and how source and target stand in their common pose; see `retarget`."""
    target, shown = (onto, None) if isinstance(onto, Skeleton) else (onto.skeleton, onto)
    joints = map_joints(clip.skeleton, target, mapping)
    world = World.of(clip) if world is None else world
    here = common_pose(joints.source, clip, world) if example is None else _pose(joints.source, example)
    there = here if _same(clip.skeleton, target) else _other_pose(joints, clip, shown)
    return joints, here, there


def _same(a: Skeleton, b: Skeleton) -> bool:
    return a.names == b.names and a.parents == b.parents and np.array_equal(a.offsets, b.offsets)


def _pose(roles: Roles, example: Clip) -> CommonPose:
    if not _same(roles.skeleton, example.skeleton):
        raise PoiseError("the example is on another skeleton than the source", example.name)
    return common_pose(roles, example)


def _other_pose(joints: JointMap, clip: Clip, example: Clip | None) -> CommonPose:
    """How the target stands: by itself, by its own motion, or as the source where the names agree."""
    source, target = clip.skeleton, joints.target.skeleton
    if example is None and (source.names, source.parents) == (target.names, target.parents):
        # The same hierarchy at another size, such as another subject of one data set.
        example = Clip(target, clip.root_pos, clip.rot, clip.fps, clip.name)
    return common_pose(joints.target, example)


def transfer(
    world_in: World, joints: JointMap, here: CommonPose, there: CommonPose, scale: Scale
) -> tuple[Tensor, Tensor]:
    """Local rotations `(T, J, 4)` and root path `(T, 3)` of the target, contacts not yet corrected."""
    target = joints.target.skeleton
    source_pos, source_quat = world_in
    frames = len(source_pos)
    turned = quat_mul(source_quat, quat_conj(torch.tensor(here.rot)).expand_as(source_quat))
    rest = torch.tensor(there.rot)
    moves = dict((b, a) for a, b in joints.direct)
    shared = _shared(joints, here, there, turned)
    hips = joints.target.joint("hips")
    above = target.ancestors(hips if hips is not None else 0)
    world: list[Tensor] = []
    for j, parent in enumerate(target.parents):
        if j in moves:
            q = quat_mul(turned[:, moves[j]], rest[j].expand(frames, 4))
        elif j in shared:
            q = quat_mul(shared[j], rest[j].expand(frames, 4))
        elif j in above:
            own = torch.tensor(there.above[j]).expand(frames, 4)
            q = own if parent < 0 else quat_mul(world[parent], own)
        else:
            local = quat_mul(quat_conj(rest[parent]), rest[j])
            q = quat_mul(world[parent], local.expand(frames, 4))
        world.append(normalize(q))
    rot = torch.stack(
        [
            q if p < 0 else quat_mul(quat_conj(world[p]), q)
            for q, p in zip(world, target.parents, strict=True)
        ],
        1,
    )
    zero = torch.zeros(frames, 3, dtype=torch.float64)
    pos, _ = forward_kinematics(target.parents, torch.tensor(target.offsets), zero, rot)
    root = scale.place(_middle(source_pos, joints, 0)) - _middle(pos, joints, 1)
    return rot, root


def _middle(pos: Tensor, joints: JointMap, side: int) -> Tensor:
    """`(T, 3)` m, the middle between the hip joints of the source (0) or target (1)."""
    pairs = [joints.limb_pair(f"{s}_thigh") for s in ("left", "right")]
    return sum((pos[:, p[side]] for p in pairs if p is not None), torch.zeros(())) / 2


def _shared(joints: JointMap, here: CommonPose, there: CommonPose, turned: Tensor) -> dict[int, Tensor]:
    """World turns `(T, 4)` from the common pose of the target's spine, neck and head.

    A chain's joints have places in [0, 1] from what carries it (0) to its last joint (1); between the
    source's joints the turn is interpolated.
    """
    out: dict[int, Tensor] = {}
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
            *zip(_places(joints.source, source, here), [turned[:, j] for j in source], strict=True),
        ]
        for j, at in zip(target, _places(joints.target, target, there), strict=True):
            out[j] = _between(knots, at)
        chest = knots[-1][1]
        carrier = chest
    return out


def _places(roles: Roles, chain: tuple[int, ...], pose: CommonPose) -> list[float]:
    """Places in (0, 1] of a chain's joints: the middle of the bone above each, by length."""
    if not chain:
        return []
    first = roles.skeleton.parents[chain[0]]
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
