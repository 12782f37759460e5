"""Unit quaternions in wxyz order, rotations from directions, forward kinematics of a tree of joints.

A quaternion rotates local vectors into the parent frame. Every function takes NumPy arrays or tensors
with any leading batch dimensions, returns the same kind, and is free of side effects. Angles are
radians. Products read right to left: `quat_mul(a, b)` applies `b` first.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache
from typing import Any, cast, overload

import numpy as np

from poise.motion.vectors import (
    LARGE,
    Array,
    constant_like,
    cross,
    floored,
    limited,
    namespace,
    norm,
    parts,
)


def _bilinear(a: Array, b: Array, rows: tuple[tuple[float, ...], ...]) -> Array:
    """Sums of the 16 products a_i b_j with the columns of `rows (16, k)`: `(..., k)`.

    One outer product and one small matrix product take the place of some thirty passes over short
    columns, see `LARGE`.
    """
    outer = a[..., :, None] * b[..., None, :]
    return outer.reshape(*outer.shape[:-2], 16) @ constant_like(rows, outer)


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


def normalize(q: Array) -> Array:
    """Quaternions or vectors `(..., n)` scaled to unit length (zero stays zero)."""
    return q / floored(norm(q, keepdims=True), 1e-12)


def quat_mul(a: Array, b: Array) -> Array:
    """Hamilton product `(..., 4)`: the rotation `b` followed by `a`."""
    if isinstance(a, np.ndarray) and (a.size >= LARGE or b.size >= LARGE):
        (w, x, y, z), (s, i, j, k), out = parts(a, b)
        out[..., 0] = w * s - x * i - y * j - z * k
        out[..., 1] = w * i + x * s + y * k - z * j
        out[..., 2] = w * j - x * k + y * s + z * i
        out[..., 3] = w * k + x * j - y * i + z * s
        return out
    return _bilinear(a, b, _PRODUCT)


_CONJUGATE = (1, -1, -1, -1)


def quat_conj(q: Array) -> Array:
    """The inverse of unit quaternions `(..., 4)`."""
    return q * constant_like(_CONJUGATE, q)


def quat_between(a: Array, b: Array) -> Array:
    """What turns `a` into `b`, in the frame of `a`: a^-1 b `(..., 4)` of unit quaternions."""
    if isinstance(a, np.ndarray) and (a.size >= LARGE or b.size >= LARGE):
        return quat_mul(quat_conj(a), b)
    return _bilinear(a, b, _BETWEEN)


def quat_rotate(q: Array, v: Array) -> Array:
    """Vectors `v (..., 3)` of the local frame expressed in the parent frame."""
    # v' = v + 2 w (u x v) + 2 u x (u x v)
    if isinstance(q, np.ndarray) and (q.size >= LARGE or v.size >= LARGE):
        (w, x, y, z), (i, j, k), out = parts(q, v)
        a, b, c = 2.0 * (y * k - z * j), 2.0 * (z * i - x * k), 2.0 * (x * j - y * i)
        out[..., 0] = i + w * a + (y * c - z * b)
        out[..., 1] = j + w * b + (z * a - x * c)
        out[..., 2] = k + w * c + (x * b - y * a)
        return out
    u = q[..., 1:]
    t = 2.0 * cross(u, v)
    return v + q[..., :1] * t + cross(u, t)


def quat_rotate_inv(q: Array, v: Array) -> Array:
    """Vectors `v (..., 3)` of the parent frame expressed in the local frame."""
    u = -q[..., 1:]
    t = 2.0 * cross(u, v)
    return v + q[..., :1] * t + cross(u, t)


def quat_angle(q: Array) -> Array:
    """Rotation angle `(...)` of unit quaternions in `[0, pi]`, sign-blind."""
    return 2.0 * namespace(q).atan2(norm(q[..., 1:]), abs(q[..., 0]))


def quat_distance(a: Array, b: Array) -> Array:
    """Angle `(...)` in `[0, pi]` of the rotation between unit quaternions `(..., 4)`, sign-blind."""
    # |a - b| = 2 sin(angle / 4), or |a + b| where b has the other sign: exact at small angles too
    xp, less, more = namespace(a), a - b, a + b
    square = xp.minimum((less * less).sum(-1), (more * more).sum(-1))
    return 4.0 * xp.asin(0.5 * square**0.5)


def axis_angle_to_quat(axis: Array, angle: Array) -> Array:
    """Quaternions for turns by `angle (...)` about unit `axis (..., 3)`."""
    xp, half = namespace(angle), 0.5 * angle[..., None]
    return xp.concat((xp.cos(half), axis * xp.sin(half)), axis=-1)


def rotvec_to_quat(v: Array) -> Array:
    """Exponential map: rotation vectors `(..., 3)` to quaternions."""
    xp, angle = namespace(v), norm(v, keepdims=True)
    # sin(a/2)/a, by its series near zero so that the map stays smooth
    small = angle < 1e-6
    safe = xp.where(small, xp.ones_like(angle), angle)
    s = xp.where(small, 0.5 - angle**2 / 48.0, xp.sin(0.5 * safe) / safe)
    return xp.concat((xp.cos(0.5 * angle), v * s), axis=-1)


def quat_to_rotvec(q: Array) -> Array:
    """Logarithm: the shortest rotation vectors `(..., 3)` of unit quaternions, length in `[0, pi]`."""
    xp = namespace(q)
    q = xp.where(q[..., :1] < 0, -q, q)
    s = norm(q[..., 1:], keepdims=True)
    angle = 2.0 * xp.atan2(s, q[..., :1])
    small, one = s < 1e-9, xp.ones_like(s)
    return q[..., 1:] * xp.where(small, 2.0 * one, angle / xp.where(small, one, s))


def quat_to_matrix(q: Array) -> Array:
    """Rotation matrices `(..., 3, 3)` with the local axes in the parent frame as columns."""
    xp, (w, x, y, z) = namespace(q), (q[..., k] for k in range(4))
    cells = (
        1 - 2 * (y * y + z * z),
        2 * (x * y - w * z),
        2 * (x * z + w * y),
        2 * (x * y + w * z),
        1 - 2 * (x * x + z * z),
        2 * (y * z - w * x),
        2 * (x * z - w * y),
        2 * (y * z + w * x),
        1 - 2 * (x * x + y * y),
    )
    return xp.stack(cells, axis=-1).reshape(*q.shape[:-1], 3, 3)


def matrix_to_quat(m: Array) -> Array:
    """Unit quaternions of rotation matrices `(..., 3, 3)`, by the largest of four pivots."""
    xp = namespace(m)
    m00, m11, m22 = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    # 4 w^2, 4 x^2, 4 y^2, 4 z^2
    sq = floored(
        xp.stack(
            (1 + m00 + m11 + m22, 1 + m00 - m11 - m22, 1 - m00 + m11 - m22, 1 - m00 - m11 + m22),
            axis=-1,
        ),
        0.0,
    )
    a = m[..., 2, 1] - m[..., 1, 2]
    b = m[..., 0, 2] - m[..., 2, 0]
    c = m[..., 1, 0] - m[..., 0, 1]
    d = m[..., 1, 0] + m[..., 0, 1]
    e = m[..., 0, 2] + m[..., 2, 0]
    f = m[..., 2, 1] + m[..., 1, 2]
    w, x, y, z = (sq[..., k] for k in range(4))
    candidates = xp.stack(
        (
            xp.stack((w, a, b, c), axis=-1),
            xp.stack((a, x, d, e), axis=-1),
            xp.stack((b, d, y, f), axis=-1),
            xp.stack((c, e, f, z), axis=-1),
        ),
        axis=-2,
    )
    best = xp.broadcast_to(xp.argmax(sq, axis=-1)[..., None, None], (*sq.shape[:-1], 1, 4))
    return normalize(xp.take_along_axis(candidates, best, axis=-2)[..., 0, :])


def euler_to_quat(angles: Array, order: str) -> Array:
    """Intrinsic Euler angles `(..., len(order))` to quaternions: "ZXY" is `Rz @ Rx @ Ry`."""
    xp, q = namespace(angles), None
    for i, letter in enumerate(order.upper()):
        half = 0.5 * angles[..., i]
        turn = xp.zeros((*half.shape, 4), dtype=angles.dtype, device=angles.device)
        turn[..., 0] = xp.cos(half)
        turn[..., 1 + "XYZ".index(letter)] = xp.sin(half)
        q = turn if q is None else quat_mul(q, turn)
    if q is None:
        q = xp.zeros((*angles.shape[:-1], 4), dtype=angles.dtype, device=angles.device)
        q[..., 0] = 1.0
    return cast("Any", q)


def quat_to_euler(q: Array, order: str) -> Array:
    """Intrinsic Euler angles `(..., 3)` of unit quaternions for an order of three different axes.

    The middle angle lies in `[-pi/2, pi/2]`. At gimbal lock (middle angle +-pi/2) the third
    angle is set to zero and the first takes the whole turn.
    """
    i, j, k = ("XYZ".index(c) for c in order.upper())
    if len({i, j, k}) != 3:
        raise ValueError(f"order must name three different axes, got '{order}'")
    s = 1.0 if (j - i) % 3 == 1 else -1.0
    xp, m = namespace(q), quat_to_matrix(q)
    # R = Ri(a) Rj(b) Rk(c):  R[i,k] = s sin b,  R[i,i] = cos b cos c,  R[j,k] = -s sin a cos b
    sin_b = limited(s * m[..., i, k], -1.0, 1.0)
    cos_b = xp.hypot(m[..., i, i], m[..., i, j])
    locked = cos_b < 1e-7
    b = xp.atan2(sin_b, cos_b)
    a = xp.where(
        locked,
        xp.atan2(s * m[..., k, j], m[..., j, j]),
        xp.atan2(-s * m[..., j, k], m[..., k, k]),
    )
    c = xp.where(locked, xp.zeros_like(a), xp.atan2(-s * m[..., i, j], m[..., i, i]))
    return xp.stack((a, b, c), axis=-1)


def slerp(a: Array, b: Array, t: Array | float) -> Array:
    """Shortest-arc interpolation from `a` to `b (..., 4)` at `t (...)`; beyond `[0, 1]` it goes on."""
    xp = namespace(a)
    dot = (a * b).sum(-1)[..., None]
    b = xp.where(dot < 0, -b, b)
    theta = xp.acos(limited(abs(dot), most=1.0))
    sin = xp.sin(theta)
    part: Any = t if isinstance(t, float | int) else t[..., None]
    near = sin < 1e-6
    safe = xp.where(near, xp.ones_like(sin), sin)
    wa = xp.where(near, 1 - part, xp.sin((1 - part) * theta) / safe)
    wb = xp.where(near, part, xp.sin(part * theta) / safe)
    return normalize(wa * a + wb * b)


def heading_quat(q: Array) -> Array:
    """The turn about +Z that best matches `q`: its twist about Z (swing removed)."""
    # The tiny number is lost beside any twist, and alone where there is none, for the identity.
    twist = q * constant_like((1, 0, 0, 1), q) + constant_like((1e-18, 0, 0, 0), q)
    return twist / norm(twist, keepdims=True)


def axis_heading(q: Array, axis: Array) -> Array:
    """The turn about +Z `(..., 4)` from +X to where the local `axis (3)` of `q` points on the ground."""
    ahead = quat_rotate(q, axis)
    return _about_up(0.5 * namespace(q).atan2(ahead[..., 1], ahead[..., 0]))


def lateral_heading(q: Array, axis: Array) -> Array:
    """The turn about +Z `(..., 4)` by which `q` turns the local `axis (3)` as seen from above.

    With the root's axis from hip to hip it is singular where that axis is vertical alone, while the
    twist of `heading_quat` is for every body upside down.
    """
    xp, there = namespace(q), quat_rotate(q, axis)
    return _about_up(0.5 * (xp.atan2(there[..., 1], there[..., 0]) - xp.atan2(axis[1], axis[0])))


def _about_up(half: Array) -> Array:
    """wxyz `(..., 4)` of turns about +Z by twice `half (...)` rad."""
    xp = namespace(half)
    zero = xp.zeros_like(half)
    return xp.stack((xp.cos(half), zero, zero, xp.sin(half)), axis=-1)


def into_heading(heading: Array, v: Array) -> Array:
    """Vectors `v (N, K, 3)` of the world in the frames of turns about +Z `heading (N, 4)`."""
    # R^T v, written v R for rows v
    return v @ _bilinear(heading, heading, _ABOUT_UP).reshape(-1, 3, 3)


def quat_to_sixd(q: Array) -> Array:
    """The first two columns of the rotation matrix, `(..., 6)` (Zhou et al. 2019)."""
    return _bilinear(q, q, _SIXD)


def sixd_to_matrix(d: Array) -> Array:
    """Rotation matrices `(..., 3, 3)` of two columns `(..., 6)` made orthonormal (Zhou et al. 2019)."""
    x = d[..., :3] / floored(norm(d[..., :3], keepdims=True), 1e-8)
    y = d[..., 3:] - (x * d[..., 3:]).sum(-1)[..., None] * x
    y = y / floored(norm(y, keepdims=True), 1e-8)
    return namespace(d).stack((x, y, cross(x, y)), axis=-1)


def unwrap_quats(q: Array) -> Array:
    """Signs chosen so that consecutive quaternions along dim 0 lie in one hemisphere."""
    xp = namespace(q)
    dots = (q[1:] * q[:-1]).sum(-1)
    one = xp.ones_like(dots)
    flips = xp.cumulative_prod(xp.where(dots < 0, -one, one), axis=0)
    return xp.concat((q[:1], q[1:] * flips[..., None]), axis=0)


def across(v: Array) -> Array:
    """Some unit vector `(..., 3)` square to `v (..., 3)`."""
    # The world axis along which v is smallest is never parallel to it.
    least = namespace(v).argmin(abs(v), axis=-1)
    return normalize(cross(v, constant_like(_AXES, v)[least]))


_AXES = ((1, 0, 0), (0, 1, 0), (0, 0, 1))


def rejected(v: Array, axis: Array) -> Array:
    """The part of `v (..., 3)` square to the unit vectors `axis (..., 3)`."""
    return cast("Any", v - (v * axis).sum(-1)[..., None] * axis)


def shortest_arc(a: Array, b: Array) -> Array:
    """wxyz `(..., 4)` of the smallest turn that brings direction `a (..., 3)` onto `b`.

    Opposite directions turn by half a turn about some axis across; a zero vector gives the identity.
    """
    xp = namespace(a)
    a, b = xp.broadcast_arrays(normalize(a), normalize(b))
    dot = (a * b).sum(-1)[..., None]
    # q = (1 + a . b, a x b) normalised
    turn = xp.concat((1.0 + dot, cross(a, b)), axis=-1)
    half = xp.concat((xp.zeros_like(dot), across(a)), axis=-1)
    known = (norm(a, keepdims=True) > 0.5) & (norm(b, keepdims=True) > 0.5)
    best = xp.where(dot < -1.0 + 1e-12, half, turn)
    return normalize(xp.where(known, best, constant_like((1, 0, 0, 0), turn)))


def frame_quat(axis: Array, normal: Array) -> Array:
    """wxyz of the frame with x along `axis (..., 3)` and z along `normal` made square to it.

    Two such frames of one bone, at rest and now, give its rotation: now * rest^-1. Where `normal` is
    parallel to `axis`, some axis across is taken.
    """
    xp = namespace(axis)
    axis, normal = xp.broadcast_arrays(axis, normal)
    x = normalize(axis)
    z = rejected(normal, x)
    z = xp.where(norm(z, keepdims=True) < 1e-9, across(x), normalize(z))
    return matrix_to_quat(xp.stack((x, cross(z, x), z), axis=-1))


def cluster_quat(template: Array, vectors: Array, weights: Array) -> Array:
    """wxyz `(..., 4)` of the rotation R that brings `template (K, 3)` nearest to `vectors (..., K, 3)`.

    Minimises sum_k w_k |R t_k - v_k|^2 (Wahba 1965) by `best_rotation` of sum_k w_k v_k t_k^T. Needs two
    directions that are not parallel.
    """
    weighed = namespace(vectors).matrix_transpose(vectors * weights[:, None])
    return matrix_to_quat(best_rotation(weighed @ template)[0])


def best_rotation(m: Array) -> tuple[Array, Array]:
    """The rotation R `(..., 3, 3)` of largest tr(R^T M), and the singular values `(..., 3)` of R^T M.

    For M = sum_k v_k t_k^T it brings the points t_k nearest to v_k. With M = U S V^T it is
    R = U diag(1, 1, d) V^T, where d = det(U V^T) leaves mirror images out and takes the sign of the
    last of the values (Kabsch 1976).
    """
    xp = namespace(m)
    u, s, vt = xp.linalg.svd(m)
    flip = xp.ones_like(m[..., 0])
    flip[..., 2] = xp.linalg.det(u @ vt)
    return (u * flip[..., None, :]) @ vt, s * flip


def turned(qpos: Array, angle: float, about: Array, onto: Array) -> Array:
    """Frames turned about Z through the place `about (2)`, which moves to `onto (2)`."""
    xp = namespace(qpos)
    turn = yaw_quat(xp.full((len(qpos),), angle, dtype=xp.float64))
    out = xp.asarray(qpos, copy=True)
    out[:, :2] -= about
    out[:, :3] = quat_rotate(turn, out[:, :3])
    out[:, :2] += onto
    out[:, 3:7] = quat_mul(turn, qpos[:, 3:7])
    return out


def facing(pose: Array, heading: float) -> Array:
    """A pose that stands at the origin and faces so."""
    xp = namespace(pose)
    origin = xp.zeros(2, dtype=xp.float64)
    return cast("Any", turned(pose[None], heading - heading_angle(pose[3:7]), pose[:2], origin)[0])


@overload
def yaw_quat(angle: float) -> np.ndarray: ...
@overload
def yaw_quat(angle: Array) -> Array: ...
def yaw_quat(angle: Any) -> Any:
    """`(..., 4)` wxyz float64, turns about Z by `angle (...)` rad."""
    if isinstance(angle, float | int):
        half = 0.5 * angle
        return np.array((np.cos(half), 0.0, 0.0, np.sin(half)))
    xp = namespace(angle)
    return _about_up(0.5 * xp.astype(angle, xp.float64))


def ahead_angle(quat: Array) -> float:
    """rad about +Z from +X to where a rotation `quat (4)` turns +X."""
    w, x, y, z = (float(c) for c in quat)
    return math.atan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z))


def heading_angle(quat: Array) -> float:
    """rad about Z of a rotation, or the mean one of several."""
    xp, h = namespace(quat), heading_quat(quat.reshape(-1, 4))
    angle = 2 * xp.atan2(h[:, 3], h[:, 0])
    return math.atan2(float(xp.mean(xp.sin(angle))), float(xp.mean(xp.cos(angle))))


#: Joints from which on ancestors are joined in steps that double, not one by one.
_MANY = 300


def forward_kinematics(
    parents: Sequence[int], offsets: Array, root_pos: Array, rot: Array
) -> tuple[Array, Array]:
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
    xp = namespace(rot)
    if isinstance(rot, np.ndarray):
        # Each component in one row of memory, for the products by components.
        rot = np.moveaxis(np.ascontiguousarray(np.moveaxis(rot, (-2, -1), (0, 1))), (0, 1), (-2, -1))
    pos: list[Any] = []
    quat: list[Any] = []
    for j, parent in enumerate(parents):
        if parent < 0:
            pos.append(root_pos)
            quat.append(rot[..., j, :])
        else:
            pos.append(pos[parent] + quat_rotate(quat[parent], offsets[..., j, :]))
            quat.append(quat_mul(quat[parent], rot[..., j, :]))
    return xp.stack(pos, axis=-2), xp.stack(quat, axis=-2)


def _by_doubling(
    parents: Sequence[int], offsets: Array, root_pos: Array, rot: Array
) -> tuple[Array, Array]:
    """As `forward_kinematics`, in log2(depth) steps over all joints: each step joins what lies between a
    joint and its ancestor of 1, 2, 4, ... generations above with what lies above that one."""
    xp = namespace(rot)
    up = xp.asarray(list(parents))
    shape = (*rot.shape[:-1], 3)
    pos = xp.where((up < 0)[:, None], root_pos[..., None, :], xp.broadcast_to(offsets, shape))
    quat = rot
    while len(here := xp.nonzero(up >= 0)[0]):
        above = up[here]
        turn = quat[..., above, :]
        new = pos[..., above, :] + quat_rotate(turn, pos[..., here, :])
        product = quat_mul(turn, quat[..., here, :])
        pos, quat = xp.asarray(pos, copy=True), xp.asarray(quat, copy=True)
        pos[..., here, :], quat[..., here, :] = new, product
        up = xp.where(up >= 0, up[xp.clip(up, min=0)], up)
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
    parents: Sequence[int], offsets: Array, root_pos: Array, rot: Array
) -> tuple[Array, Array]:
    """World positions `(..., J, 3)` and rotation matrices `(..., J, 3, 3)`, one product per level.

    As `forward_kinematics`, but `rot (..., J, 3, 3)` are matrices and joints of one depth are computed
    together, which pays for batches that are learned from.

    Args:
        offsets: `(J, 3)` m, or with leading dimensions that broadcast with those of `rot`.
    """
    xp, levels = namespace(rot), _levels(tuple(parents))
    pos, mats = [root_pos[..., None, :]], [rot[..., :1, :, :]]
    for joints, above in levels[1:]:
        up, down = list(above), list(joints)
        turn = mats[-1][..., up, :, :]
        step = offsets[..., down, :][..., None]
        pos.append(pos[-1][..., up, :] + (turn @ step)[..., 0])
        mats.append(turn @ rot[..., down, :, :])
    order = [j for joints, _ in levels for j in joints]
    back = [order.index(j) for j in range(len(order))]
    return xp.concat(pos, axis=-2)[..., back, :], xp.concat(mats, axis=-3)[..., back, :, :]


GRAVITY = 9.81
"""Standard gravity, m/s^2."""
