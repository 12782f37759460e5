"""A motion on another skeleton: the same directions of all bones, the same steps, at its own size."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch

from poise.kin.retarget.passage import Passage
from poise.kin.retarget.plant import feet_of, plant, source_contacts
from poise.kin.retarget.report import RetargetReport, measure
from poise.kin.retarget.standing import World
from poise.motion import Clip, Skeleton
from poise.spatial import normalize, unwrap_quats


@dataclass(frozen=True)
class RetargetConfig:
    """How a motion passes to another skeleton.

    contacts: hold planted feet and hands where the source's are, scaled. clear: lift what would sink
    deeper into the floor than in the source. scale: size of the path, by default the ratio of the
    heights of the hips. share: where the target's spine has more joints than the source's, they share
    its bend out; without, those that lie on a bone of the source move as that bone. rigid: roles that
    keep to what carries them.
    """

    contacts: bool = True
    clear: bool = True
    scale: float | None = None
    share: bool = True
    rigid: tuple[str, ...] = ()


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
    world, passage = World.of(clip), Passage.between(clip, onto, mapping, example, config.scale)
    if config.rigid:
        passage = replace(passage, joints=passage.joints.without(config.rigid))
    rot, root = passage.transfer(world, config.share)
    feet = feet_of(passage)
    contacts = source_contacts(clip, world, feet, passage.scale.ground)
    if config.contacts or config.clear:
        rot, root = plant(
            *(clip, world, passage, rot, root, feet, contacts), hold=config.contacts, clear=config.clear
        )
    flat = [unwrap_quats(normalize(rot[:, j])) for j in range(len(target))]
    made = Clip(target, root.numpy(), torch.stack(flat, 1).numpy(), clip.fps, clip.name, clip.cyclic)
    seconds = time.perf_counter() - began
    worlds = world, World.of(made)
    return made, measure(worlds, clip.fps, passage, feet, contacts, seconds)
