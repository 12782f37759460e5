"""Unit quaternions in wxyz order, rotations from directions, forward kinematics of a tree of joints.

A quaternion rotates local vectors into the parent frame. Every function takes tensors with any leading
batch dimensions and is free of side effects. Angles are radians. Products read right to left:
`quat_mul(a, b)` applies `b` first.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache

import torch
from torch import Tensor


@cache
def _table(rows: tuple[tuple[float, ...], ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    return torch.tensor(rows, dtype=dtype, device=device)


def _bilinear(a: Tensor, b: Tensor, rows: tuple[tuple[float, ...], ...]) -> Tensor:
    """Sums of the 16 products a_i b_j with the columns of `rows (16, k)`: `(..., k)`.

    One outer product and one small matrix product take the place of some thirty passes over short
    strided columns, which cost more than their arithmetic.
    """
    outer = (a.unsqueeze(-1) * b.unsqueeze(-2)).flatten(-2)
    return outer @ _table(rows, outer.dtype, outer.device)


#: Row 4 i + j holds what a_i b_j adds to (w, x, y, z) of the Hamilton product.
_PRODUCT = (
    (1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1),
    (0, 1, 0, 0), (-1, 0, 0, 0), (0, 0, 0, 1), (0, 0, -1, 0),
    (0, 0, 1, 0), (0, 0, 0, -1), (-1, 0, 0, 0), (0, 1, 0, 0),
    (0, 0, 0, 1), (0, 0, 1, 0), (0, -1, 0, 0), (-1, 0, 0, 0),
)  # fmt: skip
#: The same for the product with a's conjugate: its x, y and z are the other way round.
_BETWEEN = _PRODUCT[:4] + tuple(tuple(-x for x in row) for row in _PRODUCT[4:])
#: Row 4 i + j holds what q_i q_j adds to the first two columns of the rotation matrix.
_SIXD = (
    (1, 0, 0, 0, 1, 0), (0, 0, 0, 0, 0, 1), (0, 0, -1, 0, 0, 0), (0, 1, 0, -1, 0, 0),
    (0, 0, 0, 0, 0, 1), (1, 0, 0, 0, -1, 0), (0, 1, 0, 1, 0, 0), (0, 0, 1, 0, 0, 0),
    (0, 0, -1, 0, 0, 0), (0, 1, 0, 1, 0, 0), (-1, 0, 0, 0, 1, 0), (0, 0, 0, 0, 0, 1),
    (0, 1, 0, -1, 0, 0), (0, 0, 1, 0, 0, 0), (0, 0, 0, 0, 0, 1), (-1, 0, 0, 0, -1, 0),
)  # fmt: skip
_NONE = (0,) * 9
_WW, _WZ, _ZZ = (1, 0, 0, 0, 1, 0, 0, 0, 1), (0, -1, 0, 1, 0, 0, 0, 0, 0), (-1, 0, 0, 0, -1, 0, 0, 0, 1)
#: Row 4 i + j holds what q_i q_j of a turn about +Z adds to its rotation matrix, row by row.
_ABOUT_UP = (_WW, _NONE, _NONE, _WZ, *(_NONE,) * 8, _WZ, _NONE, _NONE, _ZZ)


def normalize(q: Tensor) -> Tensor:
    """Quaternions or vectors `(..., n)` scaled to unit length (zero stays zero)."""
    return q / q.norm(dim=-1, keepdim=True).clamp_min(1e-12)


def quat_mul(a: Tensor, b: Tensor) -> Tensor:
    """Hamilton product `(..., 4)`: the rotation `b` followed by `a`."""
    return _bilinear(a, b, _PRODUCT)


def quat_conj(q: Tensor) -> Tensor:
    """The inverse of unit quaternions `(..., 4)`."""
    return torch.cat((q[..., :1], -q[..., 1:]), -1)


def quat_between(a: Tensor, b: Tensor) -> Tensor:
    """What turns `a` into `b`, in the frame of `a`: a^-1 b `(..., 4)` of unit quaternions."""
    return _bilinear(a, b, _BETWEEN)


def quat_rotate(q: Tensor, v: Tensor) -> Tensor:
    """Vectors `v (..., 3)` of the local frame expressed in the parent frame."""
    # v' = v + 2 w (u x v) + 2 u x (u x v)
    u = q[..., 1:]
    t = 2.0 * torch.linalg.cross(u, v)
    return v + q[..., :1] * t + torch.linalg.cross(u, t)


def quat_rotate_inv(q: Tensor, v: Tensor) -> Tensor:
    """Vectors `v (..., 3)` of the parent frame expressed in the local frame."""
    u = -q[..., 1:]
    t = 2.0 * torch.linalg.cross(u, v)
    return v + q[..., :1] * t + torch.linalg.cross(u, t)


def quat_angle(q: Tensor) -> Tensor:
    """Rotation angle `(...)` of unit quaternions in `[0, pi]`, sign-blind."""
    return 2.0 * torch.atan2(q[..., 1:].norm(dim=-1), q[..., 0].abs())


def quat_distance(a: Tensor, b: Tensor) -> Tensor:
    """Angle `(...)` in `[0, pi]` of the rotation between unit quaternions `(..., 4)`, sign-blind."""
    # |a - b| = 2 sin(angle / 4), or |a + b| where b has the other sign: exact at small angles too
    square = torch.minimum((a - b).square().sum(-1), (a + b).square().sum(-1))
    return 4.0 * torch.asin(0.5 * square.sqrt())


def axis_angle_to_quat(axis: Tensor, angle: Tensor) -> Tensor:
    """Quaternions for turns by `angle (...)` about unit `axis (..., 3)`."""
    half = 0.5 * angle.unsqueeze(-1)
    return torch.cat((half.cos(), axis * half.sin()), -1)


def rotvec_to_quat(v: Tensor) -> Tensor:
    """Exponential map: rotation vectors `(..., 3)` to quaternions."""
    angle = v.norm(dim=-1, keepdim=True)
    # sin(a/2)/a, by its series near zero so that the map stays smooth
    small = angle < 1e-6
    safe = torch.where(small, torch.ones_like(angle), angle)
    s = torch.where(small, 0.5 - angle**2 / 48.0, (0.5 * safe).sin() / safe)
    return torch.cat(((0.5 * angle).cos(), v * s), -1)


def quat_to_rotvec(q: Tensor) -> Tensor:
    """Logarithm: the shortest rotation vectors `(..., 3)` of unit quaternions, length in `[0, pi]`."""
    q = torch.where(q[..., :1] < 0, -q, q)
    s = q[..., 1:].norm(dim=-1, keepdim=True)
    angle = 2.0 * torch.atan2(s, q[..., :1])
    small = s < 1e-9
    k = torch.where(small, torch.full_like(s, 2.0), angle / torch.where(small, torch.ones_like(s), s))
    return q[..., 1:] * k


def quat_to_matrix(q: Tensor) -> Tensor:
    """Rotation matrices `(..., 3, 3)` with the local axes in the parent frame as columns."""
    w, x, y, z = q.unbind(-1)
    rows = (
        torch.stack((1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)), -1),
        torch.stack((2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)), -1),
        torch.stack((2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)), -1),
    )
    return torch.stack(rows, -2)


def matrix_to_quat(m: Tensor) -> Tensor:
    """Unit quaternions of rotation matrices `(..., 3, 3)`, by the largest of four pivots."""
    m00, m11, m22 = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    # 4 w^2, 4 x^2, 4 y^2, 4 z^2
    sq = torch.stack(
        (1 + m00 + m11 + m22, 1 + m00 - m11 - m22, 1 - m00 + m11 - m22, 1 - m00 - m11 + m22), -1
    ).clamp_min(0)
    a = m[..., 2, 1] - m[..., 1, 2]
    b = m[..., 0, 2] - m[..., 2, 0]
    c = m[..., 1, 0] - m[..., 0, 1]
    d = m[..., 1, 0] + m[..., 0, 1]
    e = m[..., 0, 2] + m[..., 2, 0]
    f = m[..., 2, 1] + m[..., 1, 2]
    w, x, y, z = sq.unbind(-1)
    candidates = torch.stack(
        (
            torch.stack((w, a, b, c), -1),
            torch.stack((a, x, d, e), -1),
            torch.stack((b, d, y, f), -1),
            torch.stack((c, e, f, z), -1),
        ),
        -2,
    )
    best = sq.argmax(-1)[..., None, None].expand(*sq.shape[:-1], 1, 4)
    return normalize(candidates.gather(-2, best).squeeze(-2))


def euler_to_quat(angles: Tensor, order: str) -> Tensor:
    """Intrinsic Euler angles `(..., len(order))` to quaternions: "ZXY" is `Rz @ Rx @ Ry`."""
    q = None
    for i, letter in enumerate(order.upper()):
        half = 0.5 * angles[..., i]
        turn = torch.zeros(*half.shape, 4, dtype=angles.dtype, device=angles.device)
        turn[..., 0] = half.cos()
        turn[..., 1 + "XYZ".index(letter)] = half.sin()
        q = turn if q is None else quat_mul(q, turn)
    if q is None:
        q = torch.zeros(*angles.shape[:-1], 4, dtype=angles.dtype, device=angles.device)
        q[..., 0] = 1.0
    return q


def quat_to_euler(q: Tensor, order: str) -> Tensor:
    """Intrinsic Euler angles `(..., 3)` of unit quaternions for an order of three different axes.

    The middle angle lies in `[-pi/2, pi/2]`. At gimbal lock (middle angle +-pi/2) the third
    angle is set to zero and the first takes the whole turn.
    """
    i, j, k = ("XYZ".index(c) for c in order.upper())
    if len({i, j, k}) != 3:
        raise ValueError(f"order must name three different axes, got '{order}'")
    s = 1.0 if (j - i) % 3 == 1 else -1.0
    m = quat_to_matrix(q)
    # R = Ri(a) Rj(b) Rk(c):  R[i,k] = s sin b,  R[i,i] = cos b cos c,  R[j,k] = -s sin a cos b
    sin_b = (s * m[..., i, k]).clamp(-1.0, 1.0)
    cos_b = torch.hypot(m[..., i, i], m[..., i, j])
    locked = cos_b < 1e-7
    b = torch.atan2(sin_b, cos_b)
    a = torch.where(
        locked,
        torch.atan2(s * m[..., k, j], m[..., j, j]),
        torch.atan2(-s * m[..., j, k], m[..., k, k]),
    )
    c = torch.where(locked, torch.zeros_like(a), torch.atan2(-s * m[..., i, j], m[..., i, i]))
    return torch.stack((a, b, c), -1)


def slerp(a: Tensor, b: Tensor, t: Tensor) -> Tensor:
    """Shortest-arc interpolation from `a` to `b (..., 4)` at `t (...)` in `[0, 1]`."""
    dot = (a * b).sum(-1, keepdim=True)
    b = torch.where(dot < 0, -b, b)
    dot = dot.abs().clamp(max=1.0)
    theta = torch.acos(dot)
    sin = theta.sin()
    t = t.unsqueeze(-1)
    near = sin < 1e-6
    safe = torch.where(near, torch.ones_like(sin), sin)
    wa = torch.where(near, 1 - t, ((1 - t) * theta).sin() / safe)
    wb = torch.where(near, t, (t * theta).sin() / safe)
    return normalize(wa * a + wb * b)


def heading_quat(q: Tensor) -> Tensor:
    """The turn about +Z that best matches `q`: its twist about Z (swing removed)."""
    # The tiny number is lost beside any twist, and alone where there is none, for the identity.
    tiny, about_up = _table(((1e-18, 0, 0, 0), (1, 0, 0, 1)), q.dtype, q.device).unbind(0)
    twist = torch.addcmul(tiny, q, about_up)
    return twist / twist.norm(dim=-1, keepdim=True)


def axis_heading(q: Tensor, axis: Tensor) -> Tensor:
    """The turn about +Z `(..., 4)` from +X to where the local `axis (3)` of `q` points on the ground."""
    ahead = quat_rotate(q, axis.expand(*q.shape[:-1], 3))
    half = 0.5 * torch.atan2(ahead[..., 1], ahead[..., 0])
    zero = torch.zeros_like(half)
    return torch.stack((half.cos(), zero, zero, half.sin()), -1)


def lateral_heading(q: Tensor, axis: Tensor) -> Tensor:
    """The turn about +Z `(..., 4)` by which `q` turns the local `axis (3)` as seen from above.

    With the root's axis from hip to hip it is singular where that axis is vertical alone, while the
    twist of `heading_quat` is for every body upside down.
    """
    there = quat_rotate(q, axis.expand(*q.shape[:-1], 3))
    half = 0.5 * (torch.atan2(there[..., 1], there[..., 0]) - torch.atan2(axis[1], axis[0]))
    zero = torch.zeros_like(half)
    return torch.stack((half.cos(), zero, zero, half.sin()), -1)


def into_heading(heading: Tensor, v: Tensor) -> Tensor:
    """Vectors `v (N, K, 3)` of the world in the frames of turns about +Z `heading (N, 4)`."""
    # R^T v, written v R for rows v
    return torch.bmm(v, _bilinear(heading, heading, _ABOUT_UP).unflatten(-1, (3, 3)))


def quat_to_sixd(q: Tensor) -> Tensor:
    """The first two columns of the rotation matrix, `(..., 6)` (Zhou et al. 2019)."""
    return _bilinear(q, q, _SIXD)


def sixd_to_matrix(d: Tensor) -> Tensor:
    """Rotation matrices `(..., 3, 3)` of two columns `(..., 6)` made orthonormal (Zhou et al. 2019)."""
    x = torch.nn.functional.normalize(d[..., :3], dim=-1, eps=1e-8)
    y = d[..., 3:] - (x * d[..., 3:]).sum(-1, keepdim=True) * x
    y = torch.nn.functional.normalize(y, dim=-1, eps=1e-8)
    return torch.stack((x, y, torch.linalg.cross(x, y)), -1)


def unwrap_quats(q: Tensor) -> Tensor:
    """Signs chosen so that consecutive quaternions along dim 0 lie in one hemisphere."""
    dots = (q[1:] * q[:-1]).sum(-1)
    flips = torch.where(dots < 0, -1.0, 1.0).to(q.dtype).cumprod(0)
    return torch.cat((q[:1], q[1:] * flips.unsqueeze(-1)), 0)


def across(v: Tensor) -> Tensor:
    """Some unit vector `(..., 3)` square to `v (..., 3)`."""
    # The world axis along which v is smallest is never parallel to it.
    least = v.abs().argmin(-1)
    return normalize(torch.linalg.cross(v, torch.eye(3, dtype=v.dtype, device=v.device)[least]))


def rejected(v: Tensor, axis: Tensor) -> Tensor:
    """The part of `v (..., 3)` square to the unit vectors `axis (..., 3)`."""
    return v - (v * axis).sum(-1, keepdim=True) * axis


def shortest_arc(a: Tensor, b: Tensor) -> Tensor:
    """wxyz `(..., 4)` of the smallest turn that brings direction `a (..., 3)` onto `b`.

    Opposite directions turn by half a turn about some axis across; a zero vector gives the identity.
    """
    a, b = torch.broadcast_tensors(normalize(a), normalize(b))
    dot = (a * b).sum(-1, keepdim=True)
    # q = (1 + a . b, a x b) normalised
    turn = torch.cat((1.0 + dot, torch.linalg.cross(a, b)), -1)
    half = torch.cat((torch.zeros_like(dot), across(a)), -1)
    one = torch.zeros_like(turn)
    one[..., 0] = 1.0
    known = (a.norm(dim=-1, keepdim=True) > 0.5) & (b.norm(dim=-1, keepdim=True) > 0.5)
    return normalize(torch.where(known, torch.where(dot < -1.0 + 1e-12, half, turn), one))


def frame_quat(axis: Tensor, normal: Tensor) -> Tensor:
    """wxyz of the frame with x along `axis (..., 3)` and z along `normal` made square to it.

    Two such frames of one bone, at rest and now, give its rotation: now * rest^-1. Where `normal` is
    parallel to `axis`, some axis across is taken.
    """
    axis, normal = torch.broadcast_tensors(axis, normal)
    x = normalize(axis)
    z = rejected(normal, x)
    lost = z.norm(dim=-1, keepdim=True) < 1e-9
    z = torch.where(lost, across(x), normalize(z))
    return matrix_to_quat(torch.stack((x, torch.linalg.cross(z, x), z), -1))


def cluster_quat(template: Tensor, vectors: Tensor, weights: Tensor) -> Tensor:
    """wxyz `(..., 4)` of the rotation R that brings `template (K, 3)` nearest to `vectors (..., K, 3)`.

    Minimises sum_k w_k |R t_k - v_k|^2 (Wahba 1965) by `best_rotation` of sum_k w_k v_k t_k^T. Needs two
    directions that are not parallel.
    """
    return matrix_to_quat(
        best_rotation(torch.einsum("...ki,kj,k->...ij", vectors, template, weights))[0]
    )


def best_rotation(m: Tensor) -> tuple[Tensor, Tensor]:
    """The rotation R `(..., 3, 3)` of largest tr(R^T M), and the singular values `(..., 3)` of R^T M.

    For M = sum_k v_k t_k^T it brings the points t_k nearest to v_k. With M = U S V^T it is
    R = U diag(1, 1, d) V^T, where d = det(U V^T) leaves mirror images out and takes the sign of the
    last of the values (Kabsch 1976).
    """
    u, s, vt = torch.linalg.svd(m)
    flip = torch.ones_like(m[..., 0])
    flip[..., 2] = torch.linalg.det(u @ vt)
    return (u * flip.unsqueeze(-2)) @ vt, s * flip


def turned(qpos: Tensor, angle: float, about: Tensor, onto: Tensor) -> Tensor:
    """Frames turned about Z through the place `about (2)`, which moves to `onto (2)`."""
    turn, out = yaw_quat(torch.full((len(qpos),), angle, dtype=torch.float64)), qpos.clone()
    out[:, :2] -= about
    out[:, :3] = quat_rotate(turn, out[:, :3])
    out[:, :2] += onto
    out[:, 3:7] = quat_mul(turn, qpos[:, 3:7])
    return out


def facing(pose: Tensor, heading: float) -> Tensor:
    """A pose that stands at the origin and faces so."""
    origin = torch.zeros(2, dtype=torch.float64)
    return turned(pose[None], heading - heading_angle(pose[3:7]), pose[:2], origin)[0]


def yaw_quat(angle: Tensor) -> Tensor:
    """`(..., 4)` wxyz float64, turns about Z by `angle (...)` rad."""
    half, none = 0.5 * angle.double(), torch.zeros_like(angle, dtype=torch.float64)
    return torch.stack((half.cos(), none, none, half.sin()), -1)


def heading_angle(quat: Tensor) -> float:
    """rad about Z of a rotation, or the mean one of several."""
    h = heading_quat(quat.reshape(-1, 4))
    angle = 2 * torch.atan2(h[:, 3], h[:, 0])
    return math.atan2(float(angle.sin().mean()), float(angle.cos().mean()))


#: Joints from which on ancestors are joined in steps that double, not one by one.
_MANY = 300


def forward_kinematics(
    parents: Sequence[int], offsets: Tensor, root_pos: Tensor, rot: Tensor
) -> tuple[Tensor, Tensor]:
    """World positions and rotations of every joint.

    Args:
        parents: parent index per joint, -1 for the root; parents come before children.
        offsets: `(J, 3)` m, the joint's place in its parent's frame (the root's is ignored); it
            may have leading dimensions that broadcast with those of `root_pos`.
        root_pos: `(..., 3)` m, world.
        rot: `(..., J, 4)` wxyz, local to the parent; the root's is the world rotation.

    Returns:
        positions `(..., J, 3)` m and rotations `(..., J, 4)` wxyz, both world.
    """
    if len(parents) > _MANY:
        return _by_doubling(parents, offsets, root_pos, rot)
    pos: list[Tensor] = []
    quat: list[Tensor] = []
    for j, parent in enumerate(parents):
        if parent < 0:
            pos.append(root_pos)
            quat.append(rot[..., j, :])
        else:
            pos.append(pos[parent] + quat_rotate(quat[parent], offsets[..., j, :].expand_as(root_pos)))
            quat.append(quat_mul(quat[parent], rot[..., j, :]))
    return torch.stack(pos, -2), torch.stack(quat, -2)


def _by_doubling(
    parents: Sequence[int], offsets: Tensor, root_pos: Tensor, rot: Tensor
) -> tuple[Tensor, Tensor]:
    """As `forward_kinematics`, in log2(depth) steps over all joints: each step joins what lies between a
    joint and its ancestor of 1, 2, 4, ... generations above with what lies above that one."""
    up = torch.tensor(list(parents))
    first = (up < 0).unsqueeze(-1)
    pos = torch.where(first, root_pos.unsqueeze(-2), offsets.expand(*rot.shape[:-1], 3))
    quat = rot
    while (here := (up >= 0).nonzero().squeeze(-1)).numel():
        above = up[here]
        turn = quat[..., above, :]
        new = pos[..., above, :] + quat_rotate(turn, pos[..., here, :])
        pos, quat = (
            pos.index_copy(-2, here, new),
            quat.index_copy(-2, here, quat_mul(turn, quat[..., here, :])),
        )
        up = torch.where(up >= 0, up[up.clamp(min=0)], up)
    return pos, quat


@cache
def _levels(parents: tuple[int, ...]) -> tuple[tuple[tuple[int, ...], tuple[int, ...]], ...]:
    """Joints by depth, with the place of each one's parent in the level above; then the way back."""
    depth = [0] * len(parents)
    for j, parent in enumerate(parents):
        depth[j] = 0 if parent < 0 else depth[parent] + 1
    rows = [tuple(j for j, d in enumerate(depth) if d == k) for k in range(max(depth) + 1)]
    return tuple(
        (row, tuple(rows[k - 1].index(parents[j]) if k else 0 for j in row))
        for k, row in enumerate(rows)
    )


def matrix_kinematics(
    parents: Sequence[int], offsets: Tensor, root_pos: Tensor, rot: Tensor
) -> tuple[Tensor, Tensor]:
    """World positions `(..., J, 3)` and rotation matrices `(..., J, 3, 3)`, one product per level.

    As `forward_kinematics`, but `rot (..., J, 3, 3)` are matrices and joints of one depth are computed
    together, which pays for batches that are learned from.

    Args:
        offsets: `(J, 3)` m, or with leading dimensions that broadcast with those of `rot`.
    """
    levels = _levels(tuple(parents))
    pos, mats = [root_pos.unsqueeze(-2)], [rot[..., :1, :, :]]
    for joints, above in levels[1:]:
        up, down = list(above), list(joints)
        turn = mats[-1][..., up, :, :]
        step = offsets[..., down, :].unsqueeze(-1)
        pos.append(pos[-1][..., up, :] + (turn @ step).squeeze(-1))
        mats.append(turn @ rot[..., down, :, :])
    order = [j for joints, _ in levels for j in joints]
    back = [order.index(j) for j in range(len(order))]
    return torch.cat(pos, -2)[..., back, :], torch.cat(mats, -3)[..., back, :, :]


GRAVITY = 9.81
"""Standard gravity, m/s^2."""
