"""The node tree of a glTF file: parents, local transforms, and which nodes are joints."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from poise.errors import PoiseError
from poise.motion.io.gltf.accessor import index_of
from poise.motion.io.gltf.file import GltfFile
from poise.motion.io.nodes import turn_and_scale
from poise.motion.io.text import MAX_JOINTS, MAX_NAME, MAX_VALUE, shown

MAX_DEPTH = 2 * MAX_JOINTS
"""Deeper node trees are refused."""


@dataclass(frozen=True)
class Tree:
    """All nodes of a file in its units: local transforms T R S of the rest pose.

    names: `N` names as written, made up where there is none. parents: -1 for roots.
    children: in file order. tops: the scene root above each node.
    place `(N, 3)`, turn `(N, 4)` wxyz, scale `(N, 3)`. solid: nodes that carry a mesh or a camera.
    """

    names: list[str]
    parents: list[int]
    children: list[list[int]]
    tops: list[int]
    place: np.ndarray
    turn: np.ndarray
    scale: np.ndarray
    solid: list[bool]

    def line(self, node: int) -> list[int]:
        """The node and its ancestors, from the root down."""
        out = [node]
        while self.parents[out[-1]] >= 0:
            out.append(self.parents[out[-1]])
        return out[::-1]

    def below(self, node: int) -> list[int]:
        """The node and everything below it, depth first in file order."""
        out, stack = [], [node]
        while stack:
            out.append(stack.pop())
            stack += reversed(self.children[out[-1]])
        return out


def read_tree(file: GltfFile) -> Tree:
    """The node tree; cycles, nodes with two parents and unusable transforms are refused."""
    nodes = file.doc["nodes"]
    if not nodes:
        raise PoiseError("the file has no nodes, so there is nothing that could move", file.path)
    names = [_name(node.get("name"), i, file) for i, node in enumerate(nodes)]
    parents, children, tops = _links(file, names)
    moves = [
        _transform(node, f"{file.path}, node '{name}'") for node, name in zip(nodes, names, strict=True)
    ]
    place, turn, scale = (np.array(part) for part in zip(*moves, strict=True))
    solid = [node.get("mesh") is not None or node.get("camera") is not None for node in nodes]
    return Tree(names, parents, children, tops, place, turn, scale, solid)


def _name(value: object, index: int, file: GltfFile) -> str:
    if value is None or value == "":
        return f"node_{index}"
    if not isinstance(value, str) or len(value) > MAX_NAME or not value.isprintable():
        raise PoiseError(f"node {index} has the unusable name {shown(value)}", file.path)
    return value


def _links(file: GltfFile, names: list[str]) -> tuple[list[int], list[list[int]], list[int]]:
    """Parents, children and the scene root of each node."""
    nodes = file.doc["nodes"]
    parents = [-1] * len(nodes)
    children: list[list[int]] = []
    for i, node in enumerate(nodes):
        below = node.get("children") or []
        if not isinstance(below, list):
            raise PoiseError(f"the children of node '{names[i]}' are no list", file.path)
        children.append([])
        for value in below:
            child = index_of(value, nodes, f"a child of node '{names[i]}'", file)
            if parents[child] >= 0:
                raise PoiseError(f"node '{names[child]}' has two parents", file.path)
            parents[child] = i
            children[i].append(child)
    # With one parent each, a node that no root reaches lies on a cycle or below one.
    reached = [i for i, parent in enumerate(parents) if parent < 0]
    tops, depth = list(range(len(nodes))), [0] * len(nodes)
    for i in reached:
        reached += children[i]
        for child in children[i]:
            tops[child], depth[child] = tops[i], depth[i] + 1
    if len(reached) < len(nodes):
        lost = next(iter(set(range(len(nodes))) - set(reached)))
        raise PoiseError(f"the nodes around '{names[lost]}' form a cycle", file.path)
    if max(depth) > MAX_DEPTH:
        raise PoiseError(f"its nodes are nested {max(depth)} deep, more than any body's", file.path)
    return parents, children, tops


def _transform(node: dict[str, Any], where: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A node's place `(3,)`, turn `(4,)` wxyz and scale `(3,)` against its parent."""
    matrix = _vector(node, "matrix", 16, where)
    if matrix is not None:
        return _decomposed(matrix, where)
    place, scale = (_vector(node, key, 3, where) for key in ("translation", "scale"))
    turn = _vector(node, "rotation", 4, where)
    turn = np.array([1.0, 0.0, 0.0, 0.0]) if turn is None else turn[[3, 0, 1, 2]]
    norm = np.linalg.norm(turn)
    if norm < 1e-3:
        raise PoiseError("its rotation is a quaternion of no length", where)
    return np.zeros(3) if place is None else place, turn / norm, np.ones(3) if scale is None else scale


def _vector(node: dict[str, Any], key: str, size: int, where: str) -> np.ndarray | None:
    value = node.get(key)
    if value is None:
        return None
    if not isinstance(value, list) or len(value) != size:
        raise PoiseError(f"its {key} must have {size} numbers", where)
    if not all(type(x) in (int, float) and abs(x) <= MAX_VALUE for x in value):
        raise PoiseError(f"its {key} holds something that is no usable number", where)
    return np.array(value, dtype=np.float64)


def _decomposed(m: np.ndarray, where: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Translation, rotation and scale of a column-major 4x4 matrix."""
    matrix = m.reshape(4, 4).T
    turn, scale = turn_and_scale(matrix[:3, :3], "matrix", where, "Apply the transform before exporting")
    return matrix[:3, 3], turn, scale
