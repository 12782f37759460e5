"""Rotations from directions: shortest arcs, frames of two axes, the best turn of a cluster of points;
and turns about the vertical, also of coordinates that begin with a root's place and rotation.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from poise.spatial.rotations import heading_quat, matrix_to_quat, normalize, quat_mul, quat_rotate


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
