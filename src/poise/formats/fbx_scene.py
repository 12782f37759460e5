"""A process of its own reads an FBX file with ufbx; a script, see `formats.limited`."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from typing import Any, NoReturn

import numpy as np

Refuse = Callable[..., NoReturn]
#: Poses (frames times joints) that can be evaluated one by one within the limits of time.
POSES = 1_000_000
#: Whether a node above the skeleton moves is asked at so many moments.
MOMENTS = 1000
#: A skeleton of so many bones is another person, not a thing.
PERSON = 8


def read(
    path: str, refuse: Refuse, joints: int, poses: int, value: float, fps: float | None,
    take: str | None, rest: bool = False,
) -> dict[str, np.ndarray]:  # fmt: skip
    """The joints' transforms at every frame of a take, in metres with Y up.

    Args:
        joints, poses, value: limits. fps: a rate in place of the file's. take: by name or number.
        rest: a file without a take is read as it rests.
    """
    ufbx: Any = importlib.import_module("ufbx")
    try:
        scene = ufbx.load_file(
            path, ignore_geometry=True, ignore_embedded=True, load_external_files=False,
            inherit_mode_handling=ufbx.InheritModeHandling.COMPENSATE, target_unit_meters=1.0,
            target_axes=ufbx.axes_right_handed_y_up,
        )  # fmt: skip
    except ufbx.UfbxError as error:
        refuse(
            f"ufbx cannot read the file ({error})",
            "It seems cut off or is no FBX file",
            code="file-damaged",
        )
    notes: list[str] = []
    # ufbx's Python objects are asked for once and kept: some fail when they are made again.
    stacks, nodes = list(scene.anim_stacks), list(scene.nodes)
    stack = _take(stacks, take, rest, refuse, notes)
    anim, rate = (stack or scene).anim, fps or float(scene.settings.frames_per_second)
    begin = float(stack.time_begin) if stack else 0.0
    length = float(stack.time_end) - begin if stack else 0.0
    if not (0 < rate <= value and abs(begin) <= value and 0 <= length <= value):
        refuse("its times are no usable numbers", code="times-unusable")
    # A single pose stands for two frames.
    count = max(2, round(length * rate) + 1)
    times = begin + (np.arange(count) / rate if length > 0 else np.zeros(count))
    above = [-1 if n.parent is None else n.parent.typed_id for n in nodes]
    bones = [n.bone is not None for n in nodes]

    def moves(k: int) -> bool:
        m = _matrices(nodes[k], anim, times[:: max(1, count // MOMENTS)])
        return bool(np.abs(m - m[0]).max() > 1e-6)

    names = [n.name for n in nodes]
    order, parents = skeleton(above, bones, moves, refuse, notes, names)
    if len(order) > joints:
        refuse(f"it has {len(order)} joints; 1 to {joints} are read", code="joint-count")
    if count * len(order) > min(poses, POSES):
        refuse(
            f"it has {count} frames of {len(order)} joints, more than the {min(poses, POSES)} poses "
            "that are read",
            "Cut it shorter, or state a lower rate with --fps F",
            code="clip-too-long",
        )
    local = np.stack([_matrices(nodes[k], anim, times) for k in order], axis=1)
    top, base = above[order[0]], np.eye(4)
    while top >= 0:
        base = base @ _matrices(nodes[top], anim, times[:1])[0]
        top = above[top]
    return {
        "names": np.array([names[k].encode("utf-8", "replace").decode() for k in order], dtype=str),
        "parents": np.array(parents),
        "local": local,
        "above": base[None],
        "codes": times,
        "fps": np.array(rate),
        "up": np.array("Y"),
        "unit": np.array(1.0),
        "ends": np.array(""),
        "cyclic": np.array(False),
        "whole": np.array(False),
        "notes": np.array(notes, dtype=str),
    }


def _take(stacks: list[Any], wanted: str | None, rest: bool, refuse: Refuse, notes: list[str]) -> Any:
    """The animation stack that is asked for, by default the first that lasts, or one of a single pose.

    None where the file has none and may be read as it rests.
    """
    stacks = [s for s in stacks if s.time_end > s.time_begin] or [
        s for s in stacks if any(len(layer.anim_props) for layer in s.layers)
    ]
    if not stacks and rest and wanted is None:
        notes.append("The file holds no animation: it is read as it rests, in one pose")
        return None
    if not stacks:
        refuse(
            "the file holds no animation",
            "Export it with its animation baked; as it rests it serves `poise retarget --onto` alone",
            code="no-animation",
        )
    if wanted is None:
        if len(stacks) > 1:
            others = ", ".join(repr(s.name[:40]) for s in stacks[1:6])
            notes.append(
                f"Of {len(stacks)} takes the first was read; choose another with --take: {others}"
            )
        return stacks[0]
    for k, stack in enumerate(stacks):
        if wanted in (stack.name, str(k)):
            return stack
    refuse(
        f"it has no take {wanted[:40]!r}",
        f"It has {', '.join(repr(s.name[:40]) for s in stacks[:6])}",
        code="unknown-take",
    )


def skeleton(
    above: Sequence[int], bones: Sequence[bool], moves: Callable[[int], bool], refuse: Refuse,
    notes: list[str], names: Sequence[str] = (),
) -> tuple[list[int], list[int]]:  # fmt: skip
    """Nodes of the largest tree of bones, parents first, and where each parent is; -1 for a root.

    Nodes between bones belong to it, and what moves above its root does too. Trees with one parent,
    which is not the file's own node, are one body unless each has a head.

    Args:
        above: the parent of each node, -1 without one.
    """
    children: dict[int, list[int]] = {}
    for k, parent in enumerate(above):
        children.setdefault(parent, []).append(k)
    # From the top down; what stands in a circle is not reached.
    down = list(children.get(-1, ()))
    for k in down:
        down += children.get(k, ())
    weight = [0] * len(above)
    for k in reversed(down):
        weight[k] += bones[k]
        if above[k] >= 0:
            weight[above[k]] += weight[k]
    within = [False] * len(above)
    for k in down:
        within[k] = above[k] >= 0 and (within[above[k]] or bones[above[k]])
    roots = [k for k in down if bones[k] and not within[k]]
    if not roots:
        refuse("the file holds no bones", "Export the skeleton too, not only meshes", code="no-joints")
    root = max(roots, key=lambda k: weight[k])
    heads = [False] * len(above)
    for k in reversed(down):
        heads[k] |= k < len(names) and "head" in names[k].lower()
        if above[k] >= 0:
            heads[above[k]] |= heads[k]
    up = above[root]
    # The outermost node of all is the file's own, which stands still.
    own = up >= 0 and above[up] >= 0
    body = [r for r in roots if r == root or (own and above[r] == up and not (heads[r] and heads[root]))]
    others = [r for r in roots if r not in body]
    if len(body) > 1:
        root, weight[up] = up, sum(weight[r] for r in body)
    _tell(names, weight, root, others, len(roots), notes)
    left = set(others)
    higher = [a for a in _up(above, root) if above[a] >= 0]
    moving = next((i for i in reversed(range(len(higher))) if moves(higher[i])), -1)
    # From what moves there is one way down to the root.
    way = higher[moving::-1] if moving >= 0 else []
    order, parents = list(way), [i - 1 for i in range(len(way))]
    todo = [(root, len(way) - 1)]
    while todo:
        k, parent = todo.pop()
        order.append(k)
        parents.append(parent)
        todo += [
            (c, len(order) - 1) for c in reversed(children.get(k, ())) if weight[c] and c not in left
        ]
    return order, parents


def _tell(
    names: Sequence[str], weight: Sequence[int], root: int, others: list[int], roots: int,
    notes: list[str],
) -> None:  # fmt: skip
    """Adds what is said of skeletons that are left out; those of many bones are other people."""
    people = [k for k in others if weight[k] >= PERSON]
    if names and people:
        more = ", ".join(f"'{names[k][:30]}' ({weight[k]} joints)" for k in people[:4])
        more += f" and {len(people) - 4} more" if len(people) > 4 else ""
        left = "the other one was left out" if len(people) == 1 else "the others were left out"
        notes.append(
            f"The file holds {len(people) + 1} bodies: '{names[root][:30]}' ({weight[root]} joints) was "
            f"read, and {left}: {more}; to read another, export it alone"
        )
    elif others:
        notes.append(f"Of {roots} skeletons the largest was taken, of {weight[root]} bones")


def _up(above: Sequence[int], k: int) -> list[int]:
    """The nodes above one, nearest first."""
    out = []
    while (k := above[k]) >= 0:
        out.append(k)
    return out


def _matrices(node: Any, anim: Any, times: np.ndarray) -> np.ndarray:
    """A node's local transform as row-vector matrices `(T, 4, 4)`."""
    parts = (node.evaluate_transform(anim, float(t)) for t in times)
    rows = [(*p.translation, *p.rotation, *p.scale) for p in parts]
    table = np.array(rows, dtype=np.float64)
    x, y, z, w = table[:, 3:7].T
    out = np.zeros((len(times), 4, 4))
    out[:, 3, :3], out[:, 3, 3] = table[:, :3], 1.0
    # Rows are the images of the axes: the transpose of the usual matrix of a quaternion.
    out[:, 0, :3] = np.stack((1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)), -1)
    out[:, 1, :3] = np.stack((2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)), -1)
    out[:, 2, :3] = np.stack((2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)), -1)
    out[:, :3, :3] *= table[:, 7:, None]
    return out
