"""Hinge angles from rotations and directions, continuous in time: Eqs. 6 and 7, generalised."""

from __future__ import annotations

import math

import numpy as np
import torch

from poise.kin.hinges import best_path, euler_path, through_lock, wrapped

#: lambda of Eq. 7 (rad).
JUMP = 5.0
_AXIS = {"X": 0, "Y": 1, "Z": 2}


def zyx_angles(parent: np.ndarray, child: np.ndarray) -> np.ndarray:
    """Eq. 6: angles `(..., 3)` (E_z, E_y, E_x) of a child frame in its parent's, columns x, y, z.

    N, O and A are the child's axes in the parent's. Exact for square frames; E_y lies in +-90 degrees.
    """
    m = np.swapaxes(parent, -1, -2) @ child
    (n0, o0, a0), (n1, o1, a1), (n2, _, _) = np.moveaxis(m, (-2, -1), (0, 1))
    ez = np.arctan2(n1, n0)
    c, s = np.cos(ez), np.sin(ez)
    return np.stack(
        (ez, np.arctan2(-n2, n0 * c + n1 * s), np.arctan2(a0 * s - a1 * c, o1 * c - o0 * s)), -1
    )


def zyx_matrix(angles: np.ndarray) -> np.ndarray:
    """R_z R_y R_x `(..., 3, 3)` of angles (E_z, E_y, E_x)."""
    (cz, cy, cx), (sz, sy, sx) = (np.moveaxis(f(angles), -1, 0) for f in (np.cos, np.sin))
    x = np.stack((cz * cy, sz * cy, -sy), -1)
    y = np.stack((cz * sy * sx - sz * cx, sz * sy * sx + cz * cx, cy * sx), -1)
    z = np.stack((cz * sy * cx + sz * sx, sz * sy * cx - cz * sx, cy * cx), -1)
    return np.stack((x, y, z), -1)


def euler_angles(m: np.ndarray, order: str) -> np.ndarray:
    """Intrinsic angles `(..., 3)` of matrices, three different axes, the middle one in +-90 degrees."""
    i, j, k = (_AXIS[c] for c in order)
    s = 1.0 if (j - i) % 3 == 1 else -1.0
    # R = Ri(a) Rj(b) Rk(c):  R[i,k] = s sin b,  R[i,i] = cos b cos c,  R[j,k] = -s sin a cos b
    cos_b = np.hypot(m[..., i, i], m[..., i, j])
    locked = cos_b < 1e-7
    b = np.arctan2(s * m[..., i, k], cos_b)
    a = np.where(
        locked, np.arctan2(s * m[..., k, j], m[..., j, j]), np.arctan2(-s * m[..., j, k], m[..., k, k])
    )
    c = np.where(locked, 0.0, np.arctan2(-s * m[..., i, j], m[..., i, i]))
    return np.stack((a, b, c), -1)


def continuous_euler(m: np.ndarray, order: str, branches: bool = True) -> np.ndarray:
    """Angles `(T, R, 3)` of rotations `m (T, R, 3, 3)` for one hinge order, without jumps.

    With `branches` the smoothest sequence through both Euler branches and through gimbal lock, up to
    whole turns (`unwrapped`); without, Eq. 7 as it is printed.
    """
    angles = euler_angles(m, order)
    if not branches:
        return one_turn_check(angles)
    for r in np.flatnonzero((np.abs(angles[..., 1]) > math.pi / 2 - 1e-6).any(0)):
        angles[:, r] = through_lock(torch.tensor(angles[:, r]), order).numpy()
    return euler_path(angles)


def unwrapped(angles: np.ndarray) -> np.ndarray:
    """Angles `(T, ...)` without jumps of whole turns, the sequence shifted to lie nearest zero."""
    out = np.unwrap(angles, axis=0)
    return out - 2 * math.pi * np.round(np.median(out, axis=0) / (2 * math.pi))


def one_turn_check(angles: np.ndarray) -> np.ndarray:
    """Eq. 7: E_t+1 + 2 pi where E_t > 0, else E_t+1 - 2 pi, where they differ by more than lambda.

    Each frame is compared with the corrected one before it, so this goes frame by frame.
    """
    out = angles.copy()
    for t in range(len(out) - 1):
        jump = np.abs(out[t + 1] - out[t]) > JUMP
        out[t + 1] += np.where(jump, np.where(out[t] > 0, 2 * math.pi, -2 * math.pi), 0.0)
    return out


def pointing_angles(at_rest: np.ndarray, wanted: np.ndarray, order: str, axes: np.ndarray) -> np.ndarray:
    """Angles `(T, n)` of one or two hinges that turn direction `at_rest (3)` nearest to `wanted (T, 3)`.

    Both are unit and stated in the body at zero angles; `axes (3, 3)` holds the hinges' frame. One hinge
    turns the part across its axis onto that of the wanted direction. Two hinges reach any direction
    within their cone, in two ways of which the smoother one is taken; with i the first axis and k the
    second, e_i . R_k(c) v = e_i . w gives c, and a turns the rest about e_i. Up to whole turns
    (`unwrapped`).
    """
    v, w = axes.T @ at_rest, wanted @ axes
    i = _AXIS[order[0]]
    if len(order) == 1:
        return _about(np.broadcast_to(v, w.shape), w, i)[:, None]
    k = _AXIS[order[1]]
    m = 3 - i - k
    sign = 1.0 if (i + 1) % 3 == m else -1.0
    # R_k(c) carries e_i towards e_k x e_i = sign e_m.
    x, y = v[i], sign * v[m]
    size = max(math.hypot(x, y), 1e-9)
    half = np.arccos(np.clip(w[:, i] / size, -1.0, 1.0))
    phase = math.atan2(y, x)
    both = []
    for c in (half - phase, -half - phase):
        turned = np.empty_like(w)
        turned[:, k] = v[k]
        turned[:, i] = x * np.cos(c) - y * np.sin(c)
        turned[:, m] = sign * (x * np.sin(c) + y * np.cos(c))
        both.append(np.stack((_about(turned, w, i), c), -1))
    pair = wrapped(np.stack(both, 1))[:, None]  # (T, 1, 2, 2)
    step = wrapped(pair[1:, :, None, :] - pair[:-1, :, :, None])
    pick = best_path((step**2).sum(-1), 1e-2 * (pair**2).sum(-1))
    return np.take_along_axis(pair, pick[..., None, None], -2)[:, 0, 0]


def _about(v: np.ndarray, w: np.ndarray, axis: int) -> np.ndarray:
    """Angles `(T)` about one axis that bring `v (T, 3)` nearest to `w`; 0 where either lies on it."""
    a, b = (axis + 1) % 3, (axis + 2) % 3
    return np.arctan2(v[:, a] * w[:, b] - v[:, b] * w[:, a], v[:, a] * w[:, a] + v[:, b] * w[:, b])
