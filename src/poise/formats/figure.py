"""Figures and boxes to look at in written scenes: one slim octahedron per bone, bound to its joint."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from poise.formats.raw import vectors_from_z_up

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


@dataclass(frozen=True)
class SceneBox:
    """A box that stands still.

    Attributes:
        name: of its node.
        size: m, full extents.
        pos: m, its centre, Z up.
        yaw: rad, turn about Z.
    """

    name: str
    size: tuple[float, float, float]
    pos: tuple[float, float, float]
    yaw: float = 0.0


def box_mesh(box: SceneBox, axis: str, unit_m: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Triangles of a box about its centre in a file's axes and unit: corners and normals `(36, 3)`, each
    face on its own; and the place `(3,)` of its centre."""
    c, s = math.cos(box.yaw), math.sin(box.yaw)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    corners: list[np.ndarray] = []
    normals: list[np.ndarray] = []
    for k, sign in itertools.product(range(3), (-1.0, 1.0)):
        normal = np.zeros(3)
        normal[k] = sign
        one, two = np.eye(3)[(k + 1) % 3], np.eye(3)[(k + 2) % 3] * sign
        quad = [normal + a * one + b * two for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
        corners += [quad[i] for i in (0, 1, 2, 0, 2, 3)]
        normals += [normal] * 6
    points = (np.array(corners) * np.array(box.size) / 2) @ turn.T
    there = vectors_from_z_up(points, axis) / unit_m
    ways = vectors_from_z_up(np.array(normals) @ turn.T, axis)
    return there, ways, vectors_from_z_up(np.array(box.pos), axis) / unit_m
