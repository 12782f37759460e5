"""In which plane an elbow or knee bends, held where the limb is straight and the plane is unknown."""

from __future__ import annotations

import numpy as np

from poise.kin.branches import best_path, wrapped
from poise.kin.ik.vectors import across, arc, cross, dot, norm, prefix_product, rotate, square_to, unit


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
    into = np.swapaxes(parent, -1, -2)
    u, v = rotate(into, upper), rotate(into, lower)
    carried = _carried(u, rest_normal)
    other = cross(u, carried)
    normal = cross(u, v)
    sine = norm(normal)[..., 0]

    def angle(n: np.ndarray) -> np.ndarray:
        return np.arctan2(dot(n, other)[..., 0], dot(n, carried)[..., 0])

    theta = angle(normal)
    weight = sine**4 / (sine**4 + np.sin(straight) ** 4)
    # The way of least turning from the rest pose; it is lost where the bone points the other way.
    home = rotate(arc(np.broadcast_to(rest_upper, u.shape), u), np.broadcast_to(rest_normal, u.shape))
    trust = (0.5 + 0.5 * dot(rest_upper, u)[..., 0]) ** 2
    line = 0.5 * np.angle(_mean(theta, weight, angle(home), 1e-4 * trust, reach))
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
