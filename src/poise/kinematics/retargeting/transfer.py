"""A motion on another skeleton: the same directions of all bones, the same steps, at its own size."""

# pyright: reportUnknownArgumentType=false, reportUnknownMemberType=false, reportUnknownVariableType=false
from __future__ import annotations

import itertools
import math
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np

from poise.body.topology import subtree
from poise.kinematics.retargeting.common_pose import common_pose
from poise.kinematics.retargeting.hands import HandPlaces
from poise.kinematics.retargeting.passage import Retargeter
from poise.kinematics.retargeting.plant import feet_of, plant, source_contacts
from poise.kinematics.retargeting.retarget_report import RetargetReport, measure
from poise.kinematics.retargeting.standing import ClipWorld
from poise.motion import Clip, Roles, Skeleton
from poise.motion.roles import SIDES, find_roles
from poise.motion.rotations import (
    axis_angle_to_quat,
    normalize,
    quat_between,
    quat_conj,
    quat_mul,
    quat_rotate,
    shortest_arc,
    unwrap_quats,
)
from poise.motion.vectors import norm


@dataclass(frozen=True)
class RetargetConfig:
    """How a motion passes to another skeleton.

    contacts: hold planted feet and hands where the source's are, scaled. clear: lift what would sink
    deeper into the floor than in the source. scale: size of the path, by default the ratio of the
    heights of the hips. share: where the target's spine has more joints than the source's, they share
    its bend out; without, those that lie on a bone of the source move as that bone. rigid: roles that
    keep to what carries them.
    hands: with "direction" arms point where the source's point, and hands end where arms of these
    lengths take them; with "place" wrists are where the source's are, scaled, over the floor and from
    the hips, or from the part of the body that they are near (`HandPlaces`), and elbows bend to it.
    """

    contacts: bool = True
    clear: bool = True
    scale: float | None = None
    share: bool = True
    rigid: tuple[str, ...] = ()
    hands: Literal["direction", "place"] = "direction"


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
    (`plant`), or hands on their places all the time (`RetargetConfig.hands`).

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
    how = config.scale, config.share, config.rigid
    world, passage = ClipWorld.of(clip), Retargeter.between(clip, onto, mapping, example, *how)
    rot, root = passage.transfer(world)
    feet = feet_of(passage)
    contacts = source_contacts(clip, world, feet, passage.scale.ground)
    places = HandPlaces(passage, world, clip.fps, clip.cyclic) if config.hands == "place" else None
    kept: dict[str, np.ndarray] = {}
    if config.contacts or config.clear or places:
        given = clip, world, passage, rot, root, feet, contacts
        rot, root, kept = plant(*given, hold=config.contacts, clear=config.clear, places=places)
    flat = [unwrap_quats(normalize(rot[:, j])) for j in range(len(target))]
    made = Clip(target, root, np.stack(flat, 1), clip.fps, clip.name, clip.cyclic)
    seconds = time.perf_counter() - began
    worlds = world, ClipWorld.of(made)
    return made, measure(worlds, clip.fps, passage, feet, contacts, kept, seconds)


_ARM = ("upper_arm", "forearm", "hand")
_UP = np.array([0.0, 0.0, 1.0], dtype=float)


class RestPoseResult(NamedTuple):
    """clip: the same motion on the skeleton with the new rest pose. evidence: from what the pose was
    found, in a sentence without a full stop. turned_deg: how far joints' frames were turned, mean."""

    clip: Clip
    evidence: str
    turned_deg: float


def with_rest_pose(clip: Clip) -> RestPoseResult:
    """The same motion on a skeleton that stands in a T-pose with all rotations at zero.

    Every joint stays where it is in every frame; its frame turns. The T-pose faces along -Y, which is
    +Z in files with Y up; its joints' frames are the world's.

    Let R_j be the world rotations of a pose of the old skeleton, and p_j the places of its joints there.
    If the new skeleton has the offsets p_j - p_parent, it stands in that pose with all rotations zero.
    With G_j R_j^-1 in place of the world rotations G_j of a motion every joint is where it was, since
    G_p R_p^-1 (p_j - p_p) is G_p o_j.

    Raises:
        PoiseError: a skeleton that is no human's.
    """
    roles = find_roles(clip.skeleton)
    common = common_pose(roles, clip)
    rot = common.rot.copy()
    _straighten(roles, rot)
    for side in SIDES:
        _spread(roles, rot, side)
    face = axis_angle_to_quat(_UP, np.asarray(-math.pi / 2, dtype=float))
    rot = quat_mul(np.broadcast_to(face, rot.shape), rot)
    world = clip.world()[1]
    turned = quat_mul(world, np.broadcast_to(quat_conj(rot), world.shape))
    parents = clip.skeleton.parents
    local = [turned[:, 0]]
    local += [quat_between(turned[:, p], turned[:, j]) for j, p in enumerate(parents) if p >= 0]
    made = replace(clip, skeleton=_skeleton(clip.skeleton, rot), rot=np.stack(local, 1))
    angle = 2 * np.arccos(np.minimum(np.abs(rot[:, 0]), 1.0))
    return RestPoseResult(made, common.evidence, math.degrees(float(angle.mean())))


def _skeleton(skeleton: Skeleton, rot: np.ndarray) -> Skeleton:
    """The skeleton with a rest pose of world rotations `rot (J, 4)`; what its file's own frames
    say is forgotten."""
    offsets = skeleton.offsets.copy()
    above = rot[[max(p, 0) for p in skeleton.parents]]
    ends = tuple(
        (j, tuple(quat_rotate(rot[j], np.asarray(tip, dtype=float)).tolist()))
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
    return replace(skeleton, offsets=quat_rotate(above, offsets), ends=ends, source=source)


def _straighten(roles: Roles, rot: np.ndarray) -> None:
    """Turns the trunk until the neck, or the head, stands over the foot of the spine."""
    spine, tops = roles.chain("spine"), (*roles.chain("neck")[:1], *roles.chain("head"))
    if spine and tops:
        pos = _places(roles.skeleton, rot)
        _swing(roles, rot, spine[0], pos[tops[0]] - pos[spine[0]], _UP)


def _spread(roles: Roles, rot: np.ndarray, side: str) -> None:
    """Turns an arm until its bones point aside."""
    joints = [j for kind in _ARM if (j := roles.joint(f"{side}_{kind}")) is not None]
    aside = np.array([0.0, 1.0 if side == "left" else -1.0, 0.0], dtype=float)
    for a, b in itertools.pairwise(joints):
        pos = _places(roles.skeleton, rot)
        _swing(roles, rot, a, pos[b] - pos[a], aside)


def _swing(roles: Roles, rot: np.ndarray, joint: int, now: np.ndarray, wanted: np.ndarray) -> None:
    """Turns a joint and what hangs on it by the smallest turn that brings `now` to `wanted`."""
    if float(norm(now)) < 1e-6:
        return
    below = subtree(roles.skeleton, joint)
    turn = shortest_arc(now / norm(now), wanted)
    rot[below] = quat_mul(np.broadcast_to(turn, (len(below), 4)), rot[below])


def _places(skeleton: Skeleton, rot: np.ndarray) -> np.ndarray:
    """`(J, 3)` m, of a pose with the world rotations `rot (J, 4)`."""
    out = [np.zeros(3)]
    for j, p in enumerate(skeleton.parents):
        if p >= 0:
            out.append(out[p] + quat_rotate(rot[p], skeleton.offsets[j]))
    return np.stack(out)
