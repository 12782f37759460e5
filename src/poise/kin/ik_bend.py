"""In which plane an elbow or knee bends, held where the limb is straight and the plane is unknown."""

from __future__ import annotations

import numpy as np

from poise.kin.branches import best_path, wrapped
from poise.kin.ik_math import across, arc, cross, dot, norm, prefix_product, rotate, square_to, unit


def bend_normals(upper: np.ndarray, lower: np.ndarray) -> np.ndarray:
    """u x v made unit length: Eqs. 5, 10 and 13 (up to sign), undefined for a straight limb."""
    return unit(cross(upper, lower))


def held_normals(
    upper: np.ndarray,
    lower: np.ndarray,
    parent: np.ndarray,
    rest_upper: np.ndarray,
    rest_normal: np.ndarray,
    straight: float,
    reach: float,
) -> np.ndarray:
    """Unit bend axes `(T, L, 3)`, world, that never jump where a limb is straight.

    The angle theta of the observed axis about the upper bone is stated against an axis that is carried
    along with the bone without turning about it. It is averaged over time with weights sin^4 of the
    bend, so that what a bent limb shows holds through the frames where it is straight; as a doubled
    angle, since a limb that is stretched beyond straight shows the same plane. Which side is forward is
    then the smoothest choice, where bends to the wrong side cost.

    Args:
        upper, lower: `(T, L, 3)` unit bones, world. parent: `(T, L, 3, 3)` what the upper bone hangs on.
        rest_upper, rest_normal: `(L, 3)` the bone and its bend axis at rest, in the parent.
        straight: rad, the bend below which the neighbours in time count as much as the frame.
        reach: frames over which they do.
    """
    into = np.swapaxes(parent, -1, -2)
    u, v = rotate(into, upper), rotate(into, lower)
    carried = _carried(u, rest_normal)
    other = cross(u, carried)
    normal = cross(u, v)
    sine = norm(normal)[..., 0]

    def angle(n: np.ndarray) -> np.ndarray:
        return np.arctan2(dot(n, other)[..., 0], dot(n, carried)[..., 0])

    theta = angle(normal)
    weight = sine**4
    # The way of least turning from the rest pose; it is lost where the bone points the other way.
    home = rotate(arc(np.broadcast_to(rest_upper, u.shape), u), np.broadcast_to(rest_normal, u.shape))
    trust = (0.5 + 0.5 * dot(rest_upper, u)[..., 0]) ** 2
    line = _mean(theta, weight, np.sin(straight) ** 4, reach) + 1e-12 * trust * np.exp(2j * angle(home))
    line = 0.5 * np.angle(line)
    both = np.stack((line, line + np.pi), -1)  # (T, L, 2)
    # The bend about each of the two axes: negative is to the wrong side.
    bend = np.arctan2(sine, dot(u, v)[..., 0])[..., None] * np.cos(theta[..., None] - both)
    step = wrapped(both[1:, :, None, :] - both[:-1, :, :, None])
    astray = wrapped(both - angle(home)[..., None])
    pull = np.square(np.minimum(bend, 0.0)) + 1e-4 * trust[..., None] * astray**2
    pick = best_path(step**2, pull)
    turn = np.take_along_axis(both, pick[..., None], -1)
    return rotate(parent, np.cos(turn) * carried + np.sin(turn) * other)


def _carried(u: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Unit vectors `(T, L, 3)` square to `u (T, L, 3)` that never turn about it from frame to frame."""
    steps = np.concatenate((np.broadcast_to(np.eye(3), (1, *u.shape[1:], 3)), arc(u[:-1], u[1:])))
    begin = square_to(start, u[0])
    begin = np.where(norm(begin) < 0.05, across(u[0]), unit(begin))
    return unit(square_to(rotate(prefix_product(steps), np.broadcast_to(begin, u.shape)), u))


def _mean(theta: np.ndarray, weight: np.ndarray, share: float, reach: float) -> np.ndarray:
    """Sums of w exp(2 i theta) `(T, L)`: the frame's own and `share` of those around it.

    The neighbours' part falls off as exp(-|dt| / reach).
    """
    own = weight * np.exp(2j * theta)
    frames = len(own)
    lag = np.arange(frames)
    kernel = np.exp(-lag / reach)
    size = 2 * frames
    both = np.concatenate((kernel, [0.0], kernel[:0:-1]))
    around = np.fft.ifft(np.fft.fft(own, size, axis=0) * np.fft.fft(both)[:, None], axis=0)[:frames]
    return own + share * around
