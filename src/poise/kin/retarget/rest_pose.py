"""A rest pose that other tools understand: with all rotations at zero the skeleton stands in a T-pose.

Let `R_j` be the world rotations of a pose of the old skeleton, and `p_j` the places of its joints there.
If the new skeleton has the offsets `p_j - p_parent`, it stands in that pose with all rotations at zero.
With `G_j R_j^-1` in place of the world rotations `G_j` of a motion every joint is where it was, since
`G_p R_p^-1 (p_j - p_p)` is `G_p o_j`.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from poise.body.topology import subtree
from poise.kin.retarget.common_pose import common_pose
from poise.motion import Clip, Roles, Skeleton
from poise.motion.roles import SIDES, find_roles
from poise.spatial import (
    axis_angle_to_quat,
    quat_between,
    quat_conj,
    quat_mul,
    quat_rotate,
    shortest_arc,
)

_ARM = ("upper_arm", "forearm", "hand")
_UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)


class Rested(NamedTuple):
    """clip: the same motion on the skeleton with the new rest pose. evidence: from what the pose was
    found, in a sentence without a full stop. turned_deg: how far joints' frames were turned, mean."""

    clip: Clip
    evidence: str
    turned_deg: float


def with_rest_pose(clip: Clip) -> Rested:
    """The same motion on a skeleton that stands in a T-pose with all rotations at zero.

    Every joint stays where it is in every frame; its frame turns. The T-pose faces along -Y, which is
    +Z in files with Y up; its joints' frames are the world's.

    Raises:
        PoiseError: a skeleton that is no human's.
    """
    roles = find_roles(clip.skeleton)
    common = common_pose(roles, clip)
    rot = torch.tensor(common.rot)
    _straighten(roles, rot)
    for side in SIDES:
        _spread(roles, rot, side)
    face = axis_angle_to_quat(_UP, torch.tensor(-math.pi / 2, dtype=torch.float64))
    rot = quat_mul(face.expand_as(rot), rot)
    world = torch.tensor(clip.world()[1])
    turned = quat_mul(world, quat_conj(rot).expand_as(world))
    parents = clip.skeleton.parents
    local = [turned[:, 0]]
    local += [quat_between(turned[:, p], turned[:, j]) for j, p in enumerate(parents) if p >= 0]
    made = replace(clip, skeleton=_skeleton(clip.skeleton, rot), rot=torch.stack(local, 1).numpy())
    angle = 2 * torch.acos(rot[:, 0].abs().clamp(max=1.0))
    return Rested(made, common.evidence, math.degrees(float(angle.mean())))


def _skeleton(skeleton: Skeleton, rot: Tensor) -> Skeleton:
    """The skeleton with a rest pose of world rotations `rot (J, 4)`; what its file's own frames
    say is forgotten."""
    offsets = torch.tensor(skeleton.offsets)
    above = rot[[max(p, 0) for p in skeleton.parents]]
    ends = tuple(
        (j, tuple(quat_rotate(rot[j], torch.tensor(tip, dtype=torch.float64)).tolist()))
        for j, tip in skeleton.ends
    )
    old = skeleton.source
    channels = tuple(replace(c, axis=None, limits=()) for c in old.channels)
    source = replace(
        old,
        format=old.format if old.format in ("bvh", "gltf") else "poise",
        notes=(*old.notes, "Its rest pose was made a T-pose"),
        # What VRM says of its bones stays true, and where a root stands that another joint travels for.
        extra=tuple(entry for entry in old.extra if entry[0] in ("roles", "root_position")),
        channels=channels,
    )
    return replace(skeleton, offsets=quat_rotate(above, offsets).numpy(), ends=ends, source=source)


def _straighten(roles: Roles, rot: Tensor) -> None:
    """Turns the trunk until the neck, or the head, stands over the foot of the spine."""
    spine, tops = roles.chain("spine"), (*roles.chain("neck")[:1], *roles.chain("head"))
    if spine and tops:
        pos = _places(roles.skeleton, rot)
        _swing(roles, rot, spine[0], pos[tops[0]] - pos[spine[0]], _UP)


def _spread(roles: Roles, rot: Tensor, side: str) -> None:
    """Turns an arm until its bones point aside."""
    joints = [j for kind in _ARM if (j := roles.joint(f"{side}_{kind}")) is not None]
    aside = torch.tensor([0.0, 1.0 if side == "left" else -1.0, 0.0], dtype=torch.float64)
    for a, b in itertools.pairwise(joints):
        pos = _places(roles.skeleton, rot)
        _swing(roles, rot, a, pos[b] - pos[a], aside)


def _swing(roles: Roles, rot: Tensor, joint: int, now: Tensor, wanted: Tensor) -> None:
    """Turns a joint and what hangs on it by the smallest turn that brings `now` to `wanted`."""
    if float(now.norm()) < 1e-6:
        return
    below = subtree(roles.skeleton, joint)
    turn = shortest_arc(now / now.norm(), wanted)
    rot[below] = quat_mul(turn.expand(len(below), 4), rot[below])


def _places(skeleton: Skeleton, rot: Tensor) -> Tensor:
    """`(J, 3)` m, of a pose with the world rotations `rot (J, 4)`."""
    out = [torch.zeros(3, dtype=torch.float64)]
    for j, p in enumerate(skeleton.parents):
        if p >= 0:
            out.append(out[p] + quat_rotate(rot[p], torch.tensor(skeleton.offsets[j])))
    return torch.stack(out)
