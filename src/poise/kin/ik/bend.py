"""Frames of two directions; the plane in which a limb bends, held where a straight limb shows none."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from poise.kin.hinges import best_path, wrapped
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


def bend_normals(upper: Tensor, lower: Tensor) -> Tensor:
    """u x v made unit length: Eqs. 5, 10 and 13 (up to sign), undefined for a straight limb."""
    return normalize(torch.linalg.cross(upper, lower))


def held_normals(
    upper: Tensor,
    lower: Tensor,
    parent: Tensor,
    rest_upper: Tensor,
    rest_normal: Tensor,
    straight: float,
    reach: float,
) -> Tensor:
    """Unit bend axes `(T, L, 3)`, world, that never jump where a limb is straight.

    The angle theta of the observed axis about the upper bone is stated against an axis that is carried
    along with the bone without turning about it. A frame is trusted by c = s^4 / (s^4 + s_0^4), s the
    sine of its bend and s_0 of `straight`; what c lacks comes from the frames around it, so that what a
    bent limb shows holds through the frames where it is straight. Angles are averaged doubled, since a
    limb that is stretched beyond straight shows the same plane. Which side is forward is then the
    smoothest choice, where bends to the wrong side cost.

    Args:
        upper, lower: `(T, L, 3)` unit bones, world. parent: `(T, L, 3, 3)` what the upper bone hangs on.
        rest_upper, rest_normal: `(L, 3)` the bone and its bend axis at rest, in the parent.
        straight: rad, the bend at which the frames around count as much as the frame itself.
        reach: frames over which they do.
    """
    into = parent.mT
    u, v = rotate(into, upper), rotate(into, lower)
    carried = _carried(u, rest_normal)
    other, normal = torch.linalg.cross(u, carried), torch.linalg.cross(u, v)
    sine = normal.norm(dim=-1).numpy()

    def angle(n: Tensor) -> np.ndarray:
        return torch.atan2((n * other).sum(-1), (n * carried).sum(-1)).numpy()

    theta = angle(normal)
    weight = sine**4 / (sine**4 + np.sin(straight) ** 4)
    # The way of least turning from the rest pose; it is lost where the bone points the other way.
    home = rotate(arc(rest_upper.expand_as(u), u), rest_normal.expand_as(u))
    trust = ((0.5 + 0.5 * (rest_upper * u).sum(-1)) ** 2).numpy()
    line = 0.5 * np.angle(_mean(theta, weight, angle(home), 1e-4 * trust, reach))
    both = np.stack((line, line + np.pi), -1)  # (T, L, 2)
    # The bend about each of the two axes: negative is to the wrong side.
    bend = np.arctan2(sine, (u * v).sum(-1).numpy())[..., None] * np.cos(theta[..., None] - both)
    step = wrapped(both[1:, :, None, :] - both[:-1, :, :, None])
    astray = wrapped(both - angle(home)[..., None])
    pull = np.square(np.minimum(bend, 0.0)) + 1e-4 * trust[..., None] * astray**2
    pick = best_path(step**2, pull)
    turn = torch.tensor(np.take_along_axis(both, pick[..., None], -1))
    return rotate(parent, turn.cos() * carried + turn.sin() * other)


def _carried(u: Tensor, start: Tensor) -> Tensor:
    """Unit vectors `(T, L, 3)` square to `u (T, L, 3)` that never turn about it from frame to frame."""
    none = torch.eye(3, dtype=u.dtype).expand(1, *u.shape[1:], 3)
    begin = square_to(start, u[0])
    begin = torch.where(begin.norm(dim=-1, keepdim=True) < 0.05, across(u[0]), normalize(begin))
    turns = prefix_product(torch.cat((none, arc(u[:-1], u[1:]))))
    return normalize(square_to(rotate(turns, begin.expand_as(u)), u))


def _mean(
    theta: np.ndarray, weight: np.ndarray, home: np.ndarray, trust: np.ndarray, reach: float
) -> np.ndarray:
    """Sums of exp(2 i theta) `(T, L)`: a frame's own by its weight, the rest from those around it.

    Around a frame, others count by their weight and exp(-|dt| / reach), and `home` by `trust`.
    """
    own = np.exp(2j * theta)
    frames = len(own)
    kernel = np.exp(-np.arange(frames) / reach)
    both = np.fft.fft(np.concatenate((kernel, [0.0], kernel[:0:-1])))[:, None]

    def spread(x: np.ndarray) -> np.ndarray:
        return np.fft.ifft(np.fft.fft(x, 2 * frames, axis=0) * both, axis=0)[:frames]

    around = spread(weight * own) + trust * np.exp(2j * home)
    total = np.real(spread(weight)) + trust + 1e-12
    return weight * own + (1 - weight) * around / total
