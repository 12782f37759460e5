"""What ufbx reads of an FBX file; a script of its own, see `motion.io.limited`."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from typing import Any, NoReturn

import numpy as np

Refuse = Callable[..., NoReturn]
#: Poses (frames times joints) that can be evaluated one by one within the limits of time.
POSES = 1_000_000


def read(
    path: str, refuse: Refuse, joints: int, poses: int, value: float, fps: float | None, take: str | None
) -> dict[str, np.ndarray]:
    """The joints' transforms at every frame of a take, in metres with Y up.

    Args:
        joints, poses, value: limits. fps: a rate in place of the file's. take: by name or number.
    """
    ufbx: Any = importlib.import_module("ufbx")
    try:
        scene = ufbx.load_file(
            path, ignore_geometry=True, ignore_embedded=True, load_external_files=False,
            inherit_mode_handling=ufbx.InheritModeHandling.COMPENSATE, target_unit_meters=1.0,
            target_axes=ufbx.axes_right_handed_y_up,
        )  # fmt: skip
    except ufbx.UfbxError as error:
        refuse(f"ufbx cannot read the file ({error})", "It seems cut off or is no FBX file")
    notes: list[str] = []
    # ufbx's Python objects are asked for once and kept: some fail when they are made again.
    stacks, nodes = list(scene.anim_stacks), list(scene.nodes)
    stack = _take(stacks, take, refuse, notes)
    anim, rate = stack.anim, fps or float(scene.settings.frames_per_second)
    begin, length = float(stack.time_begin), float(stack.time_end) - float(stack.time_begin)
    if not (0 < rate <= value and abs(begin) <= value and 0 < length <= value):
        refuse("its times are no usable numbers")
    count = round(length * rate) + 1
    times = begin + np.arange(count) / rate
    above = [-1 if n.parent is None else n.parent.typed_id for n in nodes]
    bones = [n.bone is not None for n in nodes]

    def moves(k: int) -> bool:
        m = _matrices(nodes[k], anim, times[:: max(1, count // 16)])
        return bool(np.abs(m - m[0]).max() > 1e-6)

    order, parents = skeleton(above, bones, moves, refuse, notes)
    if len(order) > joints:
        refuse(f"it has {len(order)} joints; 1 to {joints} are read")
    if count * len(order) > min(poses, POSES):
        refuse(
            f"it has {count} frames of {len(order)} joints, more than the {min(poses, POSES)} poses "
            "that are read",
            "Cut it shorter, or state a lower rate with --fps F",
        )
    local = np.stack([_matrices(nodes[k], anim, times) for k in order], axis=1)
    top, base = above[order[0]], np.eye(4)
    while top >= 0:
        base = base @ _matrices(nodes[top], anim, times[:1])[0]
        top = above[top]
    return {
        "names": np.array([nodes[k].name.encode("utf-8", "replace").decode() for k in order], dtype=str),
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


def _take(stacks: list[Any], wanted: str | None, refuse: Refuse, notes: list[str]) -> Any:
    """The animation stack that is asked for, by default the first that lasts."""
    stacks = [s for s in stacks if s.time_end > s.time_begin]
    if not stacks:
        refuse("the file holds no animation", "Export it with its animation baked")
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
        f"it has no take {wanted[:40]!r}", f"It has {', '.join(repr(s.name[:40]) for s in stacks[:6])}"
    )


def skeleton(
    above: Sequence[int], bones: Sequence[bool], moves: Callable[[int], bool], refuse: Refuse,
    notes: list[str],
) -> tuple[list[int], list[int]]:  # fmt: skip
    """Nodes of the largest tree of bones, parents first, and where each parent is; -1 for a root.

    Nodes between bones belong to it, and what moves above its root does too.

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
        refuse("the file holds no bones", "Export the skeleton too, not only meshes")
    largest = max(roots, key=lambda k: weight[k])
    if len(roots) > 1:
        notes.append(f"Of {len(roots)} skeletons the largest was taken, of {weight[largest]} bones")
    # The outermost node of all is the file's own, which stands still.
    higher = [a for a in _up(above, largest) if above[a] >= 0]
    moving = next((i for i in reversed(range(len(higher))) if moves(higher[i])), -1)
    # From what moves there is one way down to the root.
    way = higher[moving::-1] if moving >= 0 else []
    order, parents = list(way), [i - 1 for i in range(len(way))]
    todo = [(largest, len(way) - 1)]
    while todo:
        k, parent = todo.pop()
        order.append(k)
        parents.append(parent)
        todo += [(c, len(order) - 1) for c in reversed(children.get(k, ())) if weight[c]]
    return order, parents


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
