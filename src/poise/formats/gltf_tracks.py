"""The node tree of a glTF file and its animation: samplers, and all channels at one rate."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from poise.errors import PoiseError
from poise.formats.gltf_file import GltfFile, index_of, read_accessor
from poise.formats.nodes import turn_and_scale
from poise.formats.text import MAX_JOINTS, MAX_NAME, MAX_VALUE, NO_ANIMATION, REST_POSE, listed, shown
from poise.motion.rotations import normalize, slerp

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
        raise PoiseError(
            "the file has no nodes, so there is nothing that could move", file.path, code="no-joints"
        )
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
        raise PoiseError(
            f"node {index} has the unusable name {shown(value)}", file.path, code="not-a-name"
        )
    return value


def _links(file: GltfFile, names: list[str]) -> tuple[list[int], list[list[int]], list[int]]:
    """Parents, children and the scene root of each node."""
    nodes = file.doc["nodes"]
    parents = [-1] * len(nodes)
    children: list[list[int]] = []
    for i, node in enumerate(nodes):
        below = node.get("children") or []
        if not isinstance(below, list):
            raise PoiseError(
                f"the children of node '{names[i]}' are no list", file.path, code="not-a-list"
            )
        children.append([])
        for value in below:
            child = index_of(value, nodes, f"a child of node '{names[i]}'", file)
            if parents[child] >= 0:
                raise PoiseError(
                    f"node '{names[child]}' has two parents", file.path, code="second-parent"
                )
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
        raise PoiseError(
            f"the nodes around '{names[lost]}' form a cycle", file.path, code="hierarchy-cycle"
        )
    if max(depth) > MAX_DEPTH:
        raise PoiseError(
            f"its nodes are nested {max(depth)} deep, more than any body's",
            file.path,
            code="nested-too-deep",
        )
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
        raise PoiseError("its rotation is a quaternion of no length", where, code="not-a-rotation")
    return np.zeros(3) if place is None else place, turn / norm, np.ones(3) if scale is None else scale


def _vector(node: dict[str, Any], key: str, size: int, where: str) -> np.ndarray | None:
    value = node.get(key)
    if value is None:
        return None
    if not isinstance(value, list) or len(value) != size:
        raise PoiseError(f"its {key} must have {size} numbers", where, code="wrong-shape")
    if not all(type(x) in (int, float) and abs(x) <= MAX_VALUE for x in value):
        raise PoiseError(
            f"its {key} holds something that is no usable number", where, code="number-unusable"
        )
    return np.array(value, dtype=np.float64)


def _decomposed(m: np.ndarray, where: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Translation, rotation and scale of a column-major 4x4 matrix."""
    matrix = m.reshape(4, 4).T
    turn, scale = turn_and_scale(matrix[:3, :3], "matrix", where, "Apply the transform before exporting")
    return matrix[:3, 3], turn, scale


_KINDS = {"translation": "VEC3", "rotation": "VEC4", "scale": "VEC3"}
_MODES = ("LINEAR", "STEP", "CUBICSPLINE")
#: Ends of one span differ by less than this share of it.
_ONE_SPAN = 0.02
#: Words for a kind of channel in the names of animations.
_KIND = re.compile(r"(?i)(rotation|translation|location|position|scale|quaternion|rot|loc|pos)")


@dataclass(frozen=True)
class AnimationTrack:
    """One channel: key times `(K,)` s, and values `(K, n)`, or `(3K, n)` for CUBICSPLINE (in-tangent,
    value, out-tangent). Quaternions are wxyz."""

    times: np.ndarray
    values: np.ndarray
    mode: str

    def keys(self) -> np.ndarray:
        """`(K, n)` values at the keys."""
        return self.values[1::3] if self.mode == "CUBICSPLINE" else self.values

    def varies(self) -> bool:
        """Whether the value differs between keys by more than float32 noise."""
        keys = self.values
        if self.mode == "CUBICSPLINE":
            if np.abs(self.values[0::3]).max() + np.abs(self.values[2::3]).max() > 1e-6:
                return True
            keys = self.keys()
        if keys.shape[1] == 4:
            keys = keys * np.where((keys * keys[:1]).sum(-1, keepdims=True) < 0, -1.0, 1.0)
        return bool(np.ptp(keys, axis=0).max() > 1e-6 * max(1.0, float(np.abs(keys).max())))

    def at(self, when: np.ndarray) -> np.ndarray:
        """`(T, n)` values at sorted times, held before the first key and after the last."""
        turn = self.values.shape[1] == 4
        if len(self.times) == 1:
            return np.tile(self.keys()[0], (len(when), 1))
        i = np.clip(np.searchsorted(self.times, when, side="right") - 1, 0, len(self.times) - 2)
        span = self.times[i + 1] - self.times[i]
        u = np.clip((when - self.times[i]) / np.where(span > 0, span, 1.0), 0.0, 1.0)
        if self.mode == "STEP":
            # A time on the last key belongs to it.
            return self.values[np.where(u >= 1.0, i + 1, i)]
        if self.mode == "CUBICSPLINE":
            return self._hermite(i, u[:, None], span[:, None], turn)
        a, b = self.values[i], self.values[i + 1]
        if turn:
            return slerp(a, b, u)
        return a + u[:, None] * (b - a)

    def _hermite(self, i: np.ndarray, u: np.ndarray, span: np.ndarray, turn: bool) -> np.ndarray:
        """glTF 2.0, appendix C: p(u) = (2u3-3u2+1) v0 + d(u3-2u2+u) b0 + (3u2-2u3) v1 + d(u3-u2) a1."""
        v0, b0 = self.values[3 * i + 1], self.values[3 * i + 2]
        a1, v1 = self.values[3 * (i + 1)], self.values[3 * (i + 1) + 1]
        u2, u3 = u * u, u * u * u
        out = (2 * u3 - 3 * u2 + 1) * v0 + span * (u3 - 2 * u2 + u) * b0
        out = out + (3 * u2 - 2 * u3) * v1 + span * (u3 - u2) * a1
        return normalize(out) if turn else out


@dataclass(frozen=True)
class Take:
    """The chosen animation: `(node, path) -> Track`, its name, and Poise's own `extras`."""

    name: str
    tracks: dict[tuple[int, str], AnimationTrack]
    extras: dict[str, Any]

    def nodes(self, *paths: str, varying: bool = False) -> set[int]:
        """Nodes with a channel of one of `paths`."""
        return {
            n for (n, p), track in self.tracks.items() if p in paths and (not varying or track.varies())
        }


def choose_take(file: GltfFile, tree: Tree, wanted: str | None, rest: bool, notes: list[str]) -> Take:
    """The animation of that name or number (from 0), or else the longest that moves nodes.

    Animations that move different nodes over one span are one, see `_parts_of_one`.

    Args:
        rest: a file without animation is taken as it rests, without a track.
    """
    animations = file.doc["animations"]
    names = [str(a.get("name") or f"animation {i}") for i, a in enumerate(animations)]
    numbered = [f"{i} {shown(name)}" for i, name in enumerate(names)]
    if not animations and not (rest and wanted is None):
        raise PoiseError("the file holds no animation", file.path, NO_ANIMATION, code="no-animation")
    if wanted is not None and not (wanted in names or wanted in map(str, range(len(names)))):
        raise PoiseError(
            f"it has no animation {shown(wanted)}",
            file.path,
            f"Known, by number or name: {listed(numbered, 20)}",
            code="unknown-take",
        )
    groups = _parts_of_one(file, tree, names)
    if wanted is not None:
        at = names.index(wanted) if wanted in names else int(wanted)
        best = next(g for g in groups if at in g.members)
    else:
        best = max(groups, key=lambda g: g.seconds, default=_Group([], set(), 0.0, -1.0, "", False))
        if best.seconds < 0 and rest:
            notes.append(REST_POSE)
            return Take("", {}, {})
        if best.seconds < 0:
            raise PoiseError(
                "no animation of the file moves or turns a node", file.path, code="nothing-moves"
            )
    first = best.members[0]
    if len(best.members) > 1:
        notes.append(
            f"{len(best.members)} animations, from {numbered[first]} on, move different nodes over one "
            "span; they were read as one"
        )
    if wanted is None and len(groups) > 1:
        others = listed((numbered[g.members[0]] for g in groups if g is not best), 6)
        notes.append(
            f"Of {len(groups)} animations the longest, {numbered[first]} ({best.seconds:.2f} s), was "
            f"taken; the others are {others}"
        )
    return _take(file, tree, best.members, names[first])


@dataclass
class _Group:
    """Animations that are one: their numbers, what they move, their span in s, a name they share, and
    whether each moves a single node."""

    members: list[int]
    moved: set[tuple[int, str]]
    start: float
    end: float
    tag: str
    alone: bool

    @property
    def seconds(self) -> float:
        """From the first key to the last, negative where nothing moves or turns."""
        return self.end - self.start


def _parts_of_one(file: GltfFile, tree: Tree, names: list[str]) -> list[_Group]:
    """The animations, put together where exporters wrote one for each bone or each kind of channel.

    Those are one that move or turn different nodes over one span: both have the same, or one of them
    moves a single node within that of the other. Where their names hold the names of nodes, what is
    left must be the same.
    """
    times: dict[int, np.ndarray] = {}
    groups: list[_Group] = []
    for i, name in enumerate(names):
        moved, start, end = _span(file, tree, i, times)
        nodes = {n for n, _ in moved}
        node = tree.names[next(iter(nodes))] if len(nodes) == 1 else ""
        tag = _KIND.sub("", name.replace(node, "")).strip(" _.|:-") if node and node in name else ""
        alone = len(nodes) == 1
        found = None
        for group in groups if moved else ():
            slack = _ONE_SPAN * max(group.seconds, end - start)
            same = abs(group.start - start) <= slack and abs(group.end - end) <= slack
            inside = alone and group.start - slack <= start and end <= group.end + slack
            around = group.alone and start - slack <= group.start and group.end <= end + slack
            fits = same or inside or around
            if fits and group.tag == tag and group.moved and not group.moved & moved:
                found = group
                break
        if found is None:
            groups.append(_Group([i], moved, start, end, tag, alone))
        else:
            found.members.append(i)
            found.moved |= moved
            found.start, found.end = min(found.start, start), max(found.end, end)
            found.alone &= alone
    return groups


def _channels(file: GltfFile, tree: Tree, index: int) -> Iterator[tuple[str, int, str, Any]]:
    """What to call it, node, path and sampler of each channel that moves, turns or scales a node."""
    animation = file.doc["animations"][index]
    for c, channel in enumerate(animation["channels"]):
        what = f"channel {c} of animation {shown(animation.get('name') or index)}"
        target = channel.get("target") or {}
        path, node = target.get("path"), target.get("node")
        # Channels without a node belong to extensions; weights move no joint.
        if node is None or not isinstance(path, str) or path not in _KINDS:
            continue
        node = index_of(node, tree.names, f"the target of {what}", file)
        samplers = animation["samplers"]
        yield what, node, path, samplers[index_of(channel.get("sampler"), samplers, what, file)]


def _span(
    file: GltfFile, tree: Tree, index: int, known: dict[int, np.ndarray]
) -> tuple[set[tuple[int, str]], float, float]:
    """What the animation moves and turns, and its first and last key in s; 0 and -1 without one."""
    moved: set[tuple[int, str]] = set()
    first, last = np.inf, -np.inf
    for what, node, path, sampler in _channels(file, tree, index):
        if path != "scale":
            times = _key_times(file, sampler.get("input"), what, known)
            first, last = min(first, float(times[0])), max(last, float(times[-1]))
            moved.add((node, path))
    return moved, *((first, last) if moved else (0.0, -1.0))


def _take(file: GltfFile, tree: Tree, members: list[int], name: str) -> Take:
    tracks: dict[tuple[int, str], AnimationTrack] = {}
    known: dict[int, np.ndarray] = {}
    channels = (c for index in members for c in _channels(file, tree, index))
    for what, node, path, sampler in channels:
        mode = sampler.get("interpolation") or "LINEAR"
        if mode not in _MODES:
            raise PoiseError(
                f"{what} has the unknown interpolation {shown(mode)}", file.path, code="unknown-choice"
            )
        times = _key_times(file, sampler.get("input"), what, known)
        values = read_accessor(file, sampler.get("output"), _KINDS[path], f"the values of {what}")
        _check_values(values, times, mode, path, tree.names[node], file)
        if path == "rotation":
            values = _wxyz(values, mode, times, tree.names[node], file)
        if (node, path) in tracks:
            raise PoiseError(
                f"{what} moves the {path} of node '{tree.names[node]}' again",
                file.path,
                code="channel-repeated",
            )
        tracks[node, path] = AnimationTrack(times, values, mode)
    extras = file.doc["animations"][members[0]].get("extras")
    own = extras.get("poise") if isinstance(extras, dict) else None
    return Take(name, tracks, own if isinstance(own, dict) else {})


def _key_times(file: GltfFile, index: object, what: str, known: dict[int, np.ndarray]) -> np.ndarray:
    """`(K,)` s, read once per accessor."""
    if type(index) is int and index in known:
        return known[index]
    times = read_accessor(file, index, "SCALAR", f"the times of {what}")[:, 0]
    if not (np.abs(times) <= MAX_VALUE).all():
        key = int(np.argmin(np.abs(times) <= MAX_VALUE))
        raise PoiseError(f"{what} has no usable time at key {key}", file.path, code="times-unusable")
    if (np.diff(times) < 0).any():
        key = int(np.argmax(np.diff(times) < 0)) + 1
        raise PoiseError(
            f"{what} goes back in time at key {key} ({times[key]:.4g} s)",
            file.path,
            code="times-not-rising",
        )
    known[int(index)] = times  # type: ignore[call-overload]
    return times


def _check_values(
    values: np.ndarray, times: np.ndarray, mode: str, path: str, name: str, file: GltfFile
) -> None:
    per_key = 3 if mode == "CUBICSPLINE" else 1
    if len(values) != per_key * len(times):
        raise PoiseError(
            f"the {path} of node '{name}' has {len(values)} values for {len(times)} keys",
            file.path,
            code="count-differs",
        )
    bad = ~(np.abs(values) <= MAX_VALUE).all(-1)
    if bad.any():
        key = int(np.argmax(bad)) // per_key
        raise PoiseError(
            f"the {path} of joint '{name}' is no usable number at key {key} ({times[key]:.4g} s)",
            file.path,
            code="number-unusable",
        )


def _wxyz(values: np.ndarray, mode: str, times: np.ndarray, name: str, file: GltfFile) -> np.ndarray:
    """Quaternions from xyzw; keys (but not tangents) are brought to unit length."""
    out = np.ascontiguousarray(values[:, [3, 0, 1, 2]])
    keys = out[1::3] if mode == "CUBICSPLINE" else out
    norm = np.linalg.norm(keys, axis=-1)
    if norm.min() < 1e-3:
        key = int(norm.argmin())
        raise PoiseError(
            f"the rotation of joint '{name}' has no length at key {key} ({times[key]:.4g} s)",
            file.path,
            code="not-a-rotation",
        )
    keys /= norm[:, None]
    return out
