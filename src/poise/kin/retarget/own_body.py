"""A body of one topology with the bones of any skeleton: the joints of a policy, the limbs of a clip."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from poise.body import BodyConfig, BodyTable, Humanoid, generate_table, make_humanoid
from poise.errors import PoiseError
from poise.kin.fk import carried
from poise.kin.retarget.common_pose import CommonPose, common_pose
from poise.kin.retarget.standing import World
from poise.kin.retarget.transfer import RetargetConfig
from poise.motion import Clip, Skeleton
from poise.motion.joint_map import SHARED, map_joints
from poise.motion.roles import ARM, LEG, SIDES
from poise.spatial import quat_rotate, quat_rotate_inv


def onto_own(table: BodyTable) -> RetargetConfig:
    """How a motion passes onto a body with its own bones, and back: nothing is held, lifted or scaled,
    and clavicles that the body holds rigid keep to its chest."""
    rigid = tuple(f"{r.side}_{r.kind}" for r in table.rows if r.kind == "clavicle" and not r.order)
    return RetargetConfig(contacts=False, clear=False, scale=1.0, share=False, rigid=rigid)


def own_body(
    clip: Clip, core: Humanoid, example: Clip, config: BodyConfig | None = None
) -> tuple[Humanoid, Clip]:
    """The core's bodies and hinges with the bones of a clip's skeleton.

    Names, order, axes and ranges of the hinges are the core's. Lengths are those of `own_skeleton`;
    shapes, soles, masses and gains follow from them as in every body that is generated, the mass from
    the height of its own legs where `config` states none.

    Args:
        clip: a motion of the skeleton, which shows how it stands.
        core: the body with the topology.
        example: a clip on it that shows how it stands.
        config: by which the core was generated.

    Returns:
        the body, and the example on its skeleton, onto which the clip can be retargeted; both those of
        the core where the clip is on the core's bones already.

    Raises:
        PoiseError: a skeleton that is no human's, or a core that was read from a file.
    """
    config = config or BodyConfig()
    if config.mjcf is not None:
        raise PoiseError("a body of your own keeps its lengths", config.mjcf, "Leave body='own' out")
    if clip.skeleton.same_bones(core.skeleton):
        return core, example
    skeleton = own_skeleton(clip, example)
    there = example.replaced(skeleton=skeleton)
    made = generate_table(skeleton, config, (there,))
    if [r.name for r in made.rows] != list(core.bodies):
        raise PoiseError("the body was not generated from its skeleton, so its lengths are not known")
    rows = tuple(
        replace(new, order=old.order, frame=old.frame, quat=old.quat, ranges=old.ranges)
        for new, old in zip(made.rows, core.table.rows, strict=True)
    )
    table = replace(core.table, rows=rows, height_m=made.height_m)
    return make_humanoid(skeleton, table), there


def own_skeleton(clip: Clip, example: Clip) -> Skeleton:
    """The joints of `example` where the skeleton of `clip` has them.

    Both stand in their common pose (`common_pose`), in which limbs point the same ways. Hips, knees,
    ankles, toes, shoulders, elbows and wrists then lie where the clip's do, spine and neck on the clip's
    chain; all else is scaled by the length of the legs. A motion that is retargeted onto it keeps the
    places of its limbs.
    """
    joints = map_joints(clip.skeleton, example.skeleton)
    here, there = common_pose(joints.source, clip), common_pose(joints.target, example)
    places = _places(replace(here, pos=_arms_at_ease(here, clip)), there)
    skeleton, rot = example.skeleton, torch.tensor(there.rot)
    scale = _leg(here) / _leg(there)
    pos = np.zeros_like(there.pos)
    for j, parent in enumerate(skeleton.parents):
        if j in places:
            pos[j] = places[j]
        elif parent < 0:
            # The pelvis keeps its place about the hips.
            pos[j] = scale * there.pos[j]
        else:
            pos[j] = pos[parent] + scale * (there.pos[j] - there.pos[parent])
    offsets = skeleton.offsets.copy()
    for j, parent in enumerate(skeleton.parents):
        if parent >= 0:
            offsets[j] = quat_rotate_inv(rot[parent], torch.tensor(pos[j] - pos[parent])).numpy()
    ends = tuple((j, (scale * x, scale * y, scale * z)) for j, (x, y, z) in skeleton.ends)
    return replace(skeleton, offsets=offsets, ends=ends)


def _places(here: CommonPose, there: CommonPose) -> dict[int, np.ndarray]:
    """m, where joints of the target lie in the common pose: where the source has the same roles."""
    out: dict[int, np.ndarray] = {}
    source, target = here.roles, there.roles
    for which, side in enumerate(SIDES):
        for kind in (*LEG, *ARM):
            a, b = source.joint(f"{side}_{kind}"), target.joint(f"{side}_{kind}")
            if a is not None and b is not None:
                out[b] = here.pos[a]
        toes, foot = target.joint(f"{side}_toes"), source.joint(f"{side}_foot") or 0
        if toes is not None:
            # On what the foot treads, the toe joint where there is one.
            quat, tread = torch.tensor(here.rot[foot])[None], here.treads[which]
            out[toes] = carried(torch.tensor(here.pos[foot])[None], quat, tread)[0].numpy()
    hips = _leg(here) / _leg(there) * there.pos[target.joint("hips") or 0]
    for kinds, start in ((SHARED[:1], [hips]), (SHARED[1:], [])):
        a = [here.pos[j] for k in kinds for j in source.chain(k)]
        b = [j for k in kinds for j in target.chain(k)]
        line = a if len(a) > 1 else [*start, *a]
        if len(a) == len(b):
            out |= dict(zip(b, a, strict=True))
        elif len(line) > 1 and len(b) > 1:
            out |= dict(zip(b, _along(line, [there.pos[j] for j in b]), strict=True))
        elif a and b:
            out[b[-1 if start else 0]] = a[-1]
    return out


def _arms_at_ease(pose: CommonPose, clip: Clip) -> np.ndarray:
    """The places in the common pose, the arms where a motion has them on the chest on average.

    A body that holds its clavicles rigid has its shoulders there.
    """
    out, roles = pose.pos.copy(), pose.roles
    chest = (*roles.chain("spine")[-1:], roles.joint("hips") or 0)[0]
    places, quat = World.of(clip)
    turn = torch.tensor(pose.rot[chest])
    for side in SIDES:
        arm = roles.joint(f"{side}_upper_arm")
        if arm is None or roles.joint(f"{side}_clavicle") is None:
            continue
        mean = quat_rotate_inv(quat[:, chest], places[:, arm] - places[:, chest]).mean(0)
        move = pose.pos[chest] + quat_rotate(turn, mean).numpy() - pose.pos[arm]
        for kind in ARM[1:]:
            joint = roles.joint(f"{side}_{kind}")
            if joint is not None:
                out[joint] += move
    return out


def _along(line: Sequence[np.ndarray], chain: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Places on a line of joints, at the shares of its length that `chain` has of its own."""
    far, own = _shares(line), _shares(chain)
    return [np.array([np.interp(s, far, axis) for axis in np.transpose(line)]) for s in own]


def _shares(points: Sequence[np.ndarray]) -> np.ndarray:
    lengths = np.linalg.norm(np.diff(points, axis=0), axis=-1)
    return np.append(0.0, lengths.cumsum()) / max(float(lengths.sum()), 1e-9)


def _leg(pose: CommonPose) -> float:
    """Length of thigh and shin, m, of both legs."""
    total = 0.0
    for side in SIDES:
        line = [pose.pos[pose.roles.joint(f"{side}_{k}") or 0] for k in LEG[:3]]
        total += float(np.linalg.norm(np.diff(line, axis=0), axis=-1).sum())
    return total
