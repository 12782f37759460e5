"""Analytic inverse kinematics: from joint positions to a humanoid's hinge angles.

Skeleton2Humanoid, section 3.3 and appendix A, Eqs. 5 to 24, for every humanoid that can be generated:
each body part gets a frame from positions (`ik_frames`), the frames' relative rotations become hinge
angles (Eq. 6), and angles are made continuous (Eq. 7). `IkConfig` says which errors are corrected.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from poise.body import Humanoid
from poise.errors import PoiseError, did_you_mean
from poise.kin.ik.angles import continuous_euler, pointing_angles, unwrapped, zyx_angles, zyx_matrix
from poise.kin.ik.bend import arc, rotate
from poise.kin.ik.body import IkBody
from poise.kin.ik.frames import Frames, IkConfig, rest_frames
from poise.motion import Clip
from poise.spatial import euler_to_quat, matrix_to_quat, normalize, quat_to_matrix, unwrap_quats


def analytic_ik(
    positions: np.ndarray,
    body: Humanoid | IkBody,
    config: IkConfig | None = None,
    names: Sequence[str] | None = None,
    rotations: np.ndarray | None = None,
) -> np.ndarray:
    """Generalized coordinates `(T, 7 + hinges)` of a humanoid with joints where they are asked to lie.

    Args:
        positions: `(T, N, 3)` m, world, of the joints in `names`.
        body: the humanoid; an `IkBody` made beforehand saves milliseconds.
        config: which errors of the paper are corrected; all by default.
        names: `N` joint names; all of the humanoid's bodies must be among them. Toes are used where
            they are given. By default `IkBody.points`, with or without the toes.
        rotations: `(T, N, 4)` wxyz, world, of the same joints on the humanoid's own skeleton. Turns that
            positions do not show (about a bone) follow them; by default they follow the neighbours.

    Raises:
        PoiseError: a joint that is missing, positions that are not finite or of the wrong shape.
    """
    body = IkBody.of(body) if isinstance(body, Humanoid) else body
    config = config or IkConfig()
    points, turns = _gather(np.asarray(positions, dtype=np.float64), body, names, rotations)
    wanted = _rotations(points, body, config, turns)
    return _coordinates(points, wanted, body, config)


def clip_ik(clip: Clip, body: Humanoid | IkBody, config: IkConfig | None = None) -> np.ndarray:
    """`analytic_ik` of a clip's joint positions on the humanoid of its own skeleton."""
    return analytic_ik(clip.positions(), body, config, clip.skeleton.names)


def _gather(
    positions: np.ndarray, body: IkBody, names: Sequence[str] | None, rotations: np.ndarray | None
) -> tuple[Tensor, Tensor | None]:
    """Positions `(T, P, 3)` in the body's order (NaN for toes that are not given), rotations alike."""
    rows = len(body.table.rows)
    if positions.ndim != 3 or positions.shape[-1] != 3 or not len(positions):
        raise PoiseError(f"positions must be (T, joints, 3), got {positions.shape}")
    names = tuple(names) if names is not None else body.points[: positions.shape[1]]
    if len(names) != positions.shape[1] or (
        rotations is not None and rotations.shape != (*positions.shape[:2], 4)
    ):
        raise PoiseError(
            f"there are {len(names)} joint names for positions of shape {positions.shape}"
            + ("" if rotations is None else f" and rotations of shape {rotations.shape}")
        )
    for name in body.points[:rows]:
        if name not in names:
            raise PoiseError(f"the position of '{name}' is missing. {did_you_mean(name, names)}")
    at = [names.index(n) if n in names else -1 for n in body.points]
    points = positions[:, at]
    points[:, [i for i, a in enumerate(at) if a < 0]] = np.nan
    bad = ~np.isfinite(points[:, [i for i, a in enumerate(at) if a >= 0]])
    if bad.any():
        frame = int(np.argwhere(bad)[0][0])
        raise PoiseError(f"a joint position is not finite at frame {frame}")
    if rotations is None:
        return torch.tensor(points), None
    turns = torch.tensor(np.asarray(rotations, dtype=np.float64)[:, at[:rows]])
    return torch.tensor(points), quat_to_matrix(turns)


def _rotations(
    points: Tensor, body: IkBody, config: IkConfig, turns: Tensor | None
) -> dict[int, Tensor]:
    """World rotations `(T, 3, 3)` of the rows that positions tell something about."""
    frames, rest = Frames(points, body, config), rest_frames(body, config)
    if not config.square:
        return _paper_rotations(frames, rest, body)
    out: dict[int, Tensor] = {}
    for row, frame in frames.frames.items():
        # F = B A with A fixed in the body: B = F F_rest^T B_rest
        fixed = rest.frames[row][0].T @ body.rest_rot[row]
        out[row] = frame @ fixed
        if turns is not None and row not in body.clusters:
            tip = _tip(body, row)
            bone = body.rest_rot[row].T @ normalize(body.rest_pos[tip] - body.rest_pos[row])
            along = normalize(points[:, tip] - points[:, row])
            out[row] = arc(rotate(turns[:, row], bone), along) @ turns[:, row]
    return out


def _paper_rotations(frames: Frames, rest: Frames, body: IkBody) -> dict[int, Tensor]:
    """The same through Eq. 6 from parent to child, whatever it makes of frames that are not square."""
    rows = body.table.rows
    out = {0: frames.frames[0] @ rest.frames[0][0].T @ body.rest_rot[0]}
    fixed = {0: body.rest_rot[0].T @ rest.frames[0][0]}
    for row in sorted(frames.frames):
        if row == 0:
            continue
        p = rows[row].parent
        while p not in out:
            p = rows[p].parent
        both = [(f.knee_parent.get(row, f.frames[p]), f.frames[row]) for f in (frames, rest)]
        turn, still = (torch.tensor(zyx_matrix(zyx_angles(a.numpy(), b.numpy()))) for a, b in both)
        # B_c = B_p A_p M A_c^T, with A_c such that the rest pose comes out at rest.
        fixed[row] = body.rest_rot[row].T @ body.rest_rot[p] @ fixed[p] @ still[0]
        out[row] = out[p] @ fixed[p] @ turn @ fixed[row].T
    return out


def _tip(body: IkBody, row: int) -> int:
    """The point at the far end of a row's bone, -1 where there is none."""
    for arm in body.arms:
        if row in (arm.upper, arm.lower):
            return arm.lower if row == arm.upper else arm.end
    if row in body.toes:
        return body.toes[row]
    return next((i for i, r in enumerate(body.table.rows) if r.parent == row), -1)


def _coordinates(
    points: Tensor, wanted: dict[int, Tensor], body: IkBody, config: IkConfig
) -> np.ndarray:
    """qpos from world rotations: three hinges make any rotation, fewer point their bone."""
    rows = body.table.rows
    angles: dict[int, np.ndarray] = {}
    world: list[Tensor] = [wanted[0]]
    free: list[int] = []
    for i, row in enumerate(rows[1:], 1):
        if len(row.order) == 3 and i in wanted:
            free.append(i)
            world.append(wanted[i])
            continue
        zero = world[row.parent] @ body.links[i]
        tip = _tip(body, i)
        if not row.order or tip < 0 or bool(points[0, tip, 0].isnan()):
            angles[i] = np.zeros((len(points), len(row.order)))
            world.append(zero)
            continue
        bone = body.rest_rot[i].T @ normalize(body.rest_pos[tip] - body.rest_pos[i])
        along = normalize(points[:, tip] - points[:, i])
        if len(row.order) == 3:
            # The bone is seen and its twist is not (necks): the smallest turn from the parent.
            free.append(i)
            world.append(arc(rotate(zero, bone), along) @ zero)
        else:
            seen, axes = rotate(zero.mT, along), body.axes[i]
            angles[i] = pointing_angles(bone.numpy(), seen.numpy(), row.order, axes.numpy())
            turn = quat_to_matrix(euler_to_quat(torch.tensor(angles[i]), row.order))
            world.append(zero @ axes @ turn @ axes.T)
    angles.update(_free_angles(free, torch.stack(world, 1), body, config))
    hinges = np.concatenate([angles[i] for i in sorted(angles)], -1)
    hinges = unwrapped(hinges) if config.on("branches") else hinges
    root = unwrap_quats(matrix_to_quat(world[0])).numpy()
    return np.concatenate((points[:, 0].numpy(), root, hinges), -1)


def _free_angles(
    free: list[int], world: Tensor, body: IkBody, config: IkConfig
) -> dict[int, np.ndarray]:
    """Angles `(T, 3)` of rows with three hinges from all world rotations `(T, R, 3, 3)`."""
    parents = [body.table.rows[i].parent for i in free]
    zero = world[:, parents] @ body.links[free]
    axes = body.axes[free]
    # The chain's rotation (B_parent link)^T B, stated in the hinges' own frame.
    local = (axes.mT @ (zero.mT @ world[:, free]) @ axes).numpy()
    out: dict[int, np.ndarray] = {}
    orders = [body.table.rows[i].order for i in free]
    for order in dict.fromkeys(orders):
        group = [k for k, o in enumerate(orders) if o == order]
        found = continuous_euler(local[:, group], order, config.on("branches"))
        out.update({free[g]: found[:, k] for k, g in enumerate(group)})
    return out
