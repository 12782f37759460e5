"""A clip in one humanoid's generalized coordinates, their velocities, and back onto its skeleton."""

from __future__ import annotations

from itertools import accumulate

import numpy as np
import torch

from poise.body import BodyTable
from poise.errors import PoiseError
from poise.kin.hinges import chain_angles, chain_quat
from poise.motion import Clip, Skeleton
from poise.spatial import (
    forward_kinematics,
    normalize,
    quat_between,
    quat_mul,
    quat_rotate,
    quat_to_rotvec,
    unwrap_quats,
)


def clip_to_qpos(clip: Clip, table: BodyTable) -> np.ndarray:
    """`(T, 7 + hinges)`: root position m, root quaternion wxyz, hinge angles rad.

    World rotations of the carried joints are matched exactly where the chain has three hinges; the
    root follows the pelvis. Angles are continuous and may exceed +-pi.
    """
    skeleton, rows = clip.skeleton, table.rows
    if len(skeleton) <= max(r.joint for r in rows) or any(
        skeleton.names[r.joint] != r.name for r in rows
    ):
        raise PoiseError(
            f"its joints ({', '.join(skeleton.names[:6])}, ...) are not those of this character "
            f"({', '.join(r.name for r in rows[:6])}, ...)",
            clip.name,
        )
    pos, quat = forward_kinematics(skeleton.parents, torch.tensor(skeleton.offsets), *clip.tensors())
    pelvis = rows[0].joint
    columns = [pos[:, pelvis], unwrap_quats(quat[:, pelvis])]
    for row in rows[1:]:
        anchor = rows[row.parent].joint
        rel = quat_between(quat[:, anchor], quat[:, row.joint])
        rest = torch.tensor(row.quat, dtype=torch.float64)
        rot = quat_between(rest, rel)
        columns.append(chain_angles(rot, row.order, torch.tensor(row.frame, dtype=torch.float64)))
    return torch.cat(columns, -1).numpy()


def qpos_to_clip(
    qpos: np.ndarray,
    table: BodyTable,
    skeleton: Skeleton,
    fps: float,
    template: Clip | None = None,
    name: str = "simulated",
) -> Clip:
    """The motion `qpos (T, 7 + hinges)` on `skeleton`, every joint of it.

    Joints without a body of their own (toes, fingers, helpers) and turns that a chain cannot make
    take their local rotation from `template` frame by frame (the clip that was imitated, same frame
    count), or identity without one.
    """
    rows, q = table.rows, torch.tensor(np.asarray(qpos), dtype=torch.float64)
    frames = len(q)
    if template is None:
        rot = torch.zeros(frames, len(skeleton), 4, dtype=torch.float64)
        rot[..., 0] = 1.0
    else:
        if template.frames != frames:
            raise PoiseError(f"the template has {template.frames} frames and the motion {frames}", name)
        rot = template.tensors()[1]
    pelvis = rows[0].joint
    # Joints above the pelvis keep their rotation; the pelvis' own takes up the difference.
    above = skeleton.ancestors(pelvis)[::-1]
    world: dict[int, torch.Tensor] = {}
    lead = torch.zeros(frames, 4, dtype=torch.float64)
    lead[:, 0] = 1.0
    shift = torch.zeros(frames, 3, dtype=torch.float64)
    for j in above:
        if skeleton.parents[j] >= 0:
            shift = shift + quat_rotate(lead, torch.tensor(skeleton.offsets[j]).expand(frames, 3))
        lead = quat_mul(lead, rot[:, j])
    if above:
        shift = shift + quat_rotate(lead, torch.tensor(skeleton.offsets[pelvis]).expand(frames, 3))
    root_pos = q[:, :3] - shift
    world[pelvis] = normalize(q[:, 3:7])
    rot[:, pelvis] = quat_between(lead, world[pelvis])
    by_joint = {r.joint: (i, r) for i, r in enumerate(rows)}
    # First column of each row's hinges.
    start = list(accumulate((len(r.order) for r in rows), initial=7))
    for j in range(len(skeleton)):
        parent = skeleton.parents[j]
        if j == pelvis or j in above:
            continue
        if j in by_joint:
            i, row = by_joint[j]
            angles = q[:, start[i] : start[i] + len(row.order)]
            frame = torch.tensor(row.frame, dtype=torch.float64)
            if row.order:
                rest = torch.tensor(row.quat, dtype=torch.float64).expand(frames, 4)
                turn = chain_quat(angles, row.order, frame.expand(frames, 4))
                anchor = world[rows[row.parent].joint]
                full = quat_mul(anchor, quat_mul(rest, turn))
                rot[:, j] = quat_between(world[parent], full)
        world[j] = quat_mul(world.get(parent, lead), rot[:, j])
    return Clip(skeleton, root_pos.numpy(), normalize(rot).numpy(), fps, name)


def qpos_velocity(qpos: np.ndarray, fps: float) -> np.ndarray:
    """`(T, nv)` velocity of `qpos (T, 7 + n)` in MuJoCo's convention.

    Root linear velocity in the world frame (m/s), root angular velocity in the root's own frame
    (rad/s), hinge speeds (rad/s). Central differences; one-sided at both ends.
    """
    q = torch.tensor(qpos, dtype=torch.float64)
    frames = len(q)
    ahead = torch.arange(frames).add(1).clamp(max=frames - 1)
    behind = torch.arange(frames).sub(1).clamp(min=0)
    dt = (ahead - behind).to(q.dtype).unsqueeze(-1) / fps
    linear = (q[ahead, :3] - q[behind, :3]) / dt
    # w_b = log(q_behind^-1 q_ahead) / dt, in the root's frame
    turn = quat_to_rotvec(quat_between(q[behind, 3:7], q[ahead, 3:7])) / dt
    hinges = (q[ahead, 7:] - q[behind, 7:]) / dt
    return torch.cat((linear, turn, hinges), -1).numpy()
