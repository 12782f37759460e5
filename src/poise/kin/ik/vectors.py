"""Frames of two directions and what else inverse kinematics needs beside `spatial`; float64 tensors."""

from __future__ import annotations

import torch
from torch import Tensor

from poise.spatial import across, normalize, quat_to_matrix, rejected, shortest_arc


def square_to(a: Tensor, b: Tensor) -> Tensor:
    """The part of `a (..., 3)` square to unit `b`; some vector across b where nothing remains."""
    rest = rejected(a, b)
    lost = rest.norm(dim=-1, keepdim=True) < 1e-9 * (a.norm(dim=-1, keepdim=True) + 1e-300)
    return torch.where(lost, across(b), rest)


def frame_of(
    hold: str, x: Tensor | None = None, y: Tensor | None = None, z: Tensor | None = None
) -> Tensor:
    """Orthonormal `(..., 3, 3)` of two directions; axis `hold` is kept, the other made square to it."""
    given = {"x": x, "y": y, "z": z}
    kept = given.pop(hold)
    name, other = next((k, v) for k, v in given.items() if v is not None)
    assert kept is not None
    kept = normalize(kept)
    axes = {hold: kept, name: normalize(square_to(other, kept))}
    # The third axis closes the cycle x, y, z.
    last = next(k for k in "xyz" if k not in axes)
    at = "xyz".index(last)
    axes[last] = torch.linalg.cross(axes["xyz"[(at + 1) % 3]], axes["xyz"[(at + 2) % 3]])
    return torch.stack((axes["x"], axes["y"], axes["z"]), -1)


def rotate(m: Tensor, v: Tensor) -> Tensor:
    """m v `(..., 3)`."""
    return (m @ v.unsqueeze(-1)).squeeze(-1)


def arc(a: Tensor, b: Tensor) -> Tensor:
    """Matrices `(..., 3, 3)` of the smallest turn that brings `a (..., 3)` onto `b`."""
    return quat_to_matrix(shortest_arc(a, b))


def prefix_product(m: Tensor) -> Tensor:
    """m_t ... m_1 m_0 for every t `(T, ..., 3, 3)` in log2(T) passes (Hillis and Steele 1986)."""
    out, reach = m.clone(), 1
    while reach < len(out):
        out = torch.cat((out[:reach], out[reach:] @ out[:-reach]))
        reach *= 2
    return out
