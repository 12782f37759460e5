"""A figure to look at: one slim octahedron per bone, bound to its joint."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

_WAIST = 0.18
_THICK_M = (0.022, 0.05)
_TIP_M = 0.12


def bone_figure(
    parents: Sequence[int], rest: np.ndarray, tips: Sequence[tuple[int, np.ndarray]], metre: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Flat-shaded triangles of all bones in the rest pose.

    A bone runs from its joint to each child or tip; a joint with neither gets one that goes on in
    its parent's direction, so that heads, hands and feet show.

    Args:
        rest: `(J, 3)` joint places. tips: `(joint, (3,))` places of tips. metre: units in one metre.

    Returns:
        positions `(V, 3)`, unit normals `(V, 3)`, the joint of each vertex `(V,)`; three per triangle.
    """
    bones = [(p, rest[p], rest[j]) for j, p in enumerate(parents) if p >= 0]
    bones += [(j, rest[j], tip) for j, tip in tips]
    carrying = {b[0] for b in bones}
    for j, p in enumerate(parents):
        if j not in carrying and p >= 0:
            way = 0.5 * (rest[j] - rest[p])
            length = np.linalg.norm(way)
            short = min(1.0, _TIP_M * metre / length) if length > 0 else 0.0
            bones.append((j, rest[j], rest[j] + short * way))
    points, normals, joints = [], [], []
    for joint, start, end in bones:
        if np.linalg.norm(end - start) < 1e-3 * metre:
            continue
        triangles = _octahedron(start, end, metre)
        n = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
        n /= np.linalg.norm(n, axis=-1, keepdims=True)
        points.append(triangles.reshape(-1, 3))
        normals.append(np.repeat(n, 3, axis=0))
        joints.append(np.full(3 * len(triangles), joint))
    return np.concatenate(points), np.concatenate(normals), np.concatenate(joints)


def _octahedron(start: np.ndarray, end: np.ndarray, metre: float) -> np.ndarray:
    """`(8, 3, 3)` triangles, counterclockwise from outside, widest near the start."""
    way = end - start
    length = float(np.linalg.norm(way))
    z = way / length
    x = np.cross(z, np.eye(3)[int(np.abs(z).argmin())])
    x /= np.linalg.norm(x)
    y = np.cross(z, x)
    half = min(float(np.clip(0.13 * length, _THICK_M[0] * metre, _THICK_M[1] * metre)), 0.45 * length)
    middle = start + _WAIST * way
    ring = [middle + half * v for v in (x, y, -x, -y)]
    out = []
    for a, b in zip(ring, ring[1:] + ring[:1], strict=True):
        out += [(a, b, end), (b, a, start)]
    return np.array(out)
