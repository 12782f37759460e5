"""Boxes that stand beside a motion in a glTF scene, such as what it sits on."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np

from poise.motion.io.raw import vectors_from_z_up


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
