"""The joint near the root that carries a body: its path as the clip's root path, and the way back."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from poise.motion.clip_info import landmarks
from poise.motion.rotations import forward_kinematics, quat_rotate, quat_rotate_inv
from poise.motion.skeleton import Skeleton, line_to_root

RIGID_SHARE = 6e-4
"""A joint is rigid if its place stays within this share of the skeleton's size: about 1 mm on a person,
whatever the unit."""
_LOOSE_SHARE = 20 * RIGID_SHARE
#: Bones of a limb are longer than this share of the size, and turn by more than so many radians.
_BONE_SHARE, _TURNS = 0.05, 0.03


@dataclass(frozen=True)
class Carried:
    """Rigid bones and one root path, file units.

    offsets `(J, 3)`, root_pos `(T, 3)`. joint: the one that carries the body instead of the root, or
    with it; None where the root does. strays: `(joint, largest distance)` of bones that did not stay
    rigid; beside: the same of joints that the body does not hang on. extra: what `restored` needs.
    """

    offsets: np.ndarray
    root_pos: np.ndarray
    joint: int | None
    strays: tuple[tuple[str, float], ...]
    beside: tuple[tuple[str, float], ...]
    extra: tuple[tuple[str, str], ...]


def size_of(offsets: np.ndarray) -> float:
    """A length by which tolerances are measured: a quarter of all bones, in their unit."""
    return float(np.linalg.norm(offsets[1:], axis=-1).sum()) / 4 + 1e-12


def carried(
    names: Sequence[str],
    parents: Sequence[int],
    offsets: np.ndarray,
    paths: Mapping[int, np.ndarray],
    root_pos: np.ndarray,
    rot: np.ndarray,
    size: float,
    notes: list[str],
) -> Carried:
    """Turns places that move against their parents into rigid offsets and the path of one root.

    With D the joint that carries the body and p_k(t) the path of each joint k between the root and D,
    x_root = root_pos + sum_k R_parent(k) (p_k - o_k) and o_D = 0, so that D and all below it stand
    where the file has them. What hangs beside the way down to D keeps its median place.

    Args:
        offsets: `(J, 3)` medians. paths: `(T or 1, 3)` places of joints in their parents' frames, of
            those at least that move. rot: `(T, J, 4)` local, wxyz. size: see `size_of`.
    """
    stray = {j: float(np.linalg.norm(p - offsets[j], axis=-1).max()) for j, p in paths.items()}
    loose = {j for j, far in stray.items() if far > RIGID_SHARE * size}
    joint = _carrier(names, parents, offsets, stray, rot, size) if loose else None
    if joint is None:
        told = tuple((names[j], stray[j]) for j in sorted(loose))
        return Carried(offsets, root_pos, None, told, (), ())
    offsets, own = offsets.copy(), offsets
    way = line_to_root(parents, joint)[::-1]
    moves = bool(np.abs(root_pos - root_pos[0]).max() > RIGID_SHARE * size)
    notes.append(travel_note(names[0], names[joint], moves))
    offsets[joint] = 0.0
    turned = forward_kinematics(parents, offsets, root_pos, rot)[1]
    # How far each joint on the way stands from where rigid bones alone would put it.
    off = {0: np.zeros_like(root_pos)}
    for k in way[1:]:
        step = paths.get(k, own[k][None]) - offsets[k]
        off[k] = off[parents[k]] + _rotate(turned[:, parents[k]], step)
    made = root_pos + off[joint]
    below = _below(parents, joint)
    beside, places = dict[int, float](), dict[int, np.ndarray]()
    for j, up in enumerate(parents):
        if j in below or j in way:
            continue
        if up in off:
            # Its own place, seen from where its parent now stands.
            shift = quat_rotate_inv(turned[:, up], (off[up] - off[joint]))
            path = paths.get(j, own[j][None]) + shift
            offsets[j] = np.median(path, axis=0)
            beside[j] = float(np.linalg.norm(path - offsets[j], axis=-1).max())
            places[j] = own[j]
        else:
            beside[j] = stray.get(j, 0.0)
    places |= {k: own[k] for k in way[1:]}
    still = np.ptp(root_pos, axis=0) <= RIGID_SHARE * size
    extra = (
        ("root_position", text_of(np.where(still, root_pos[0], np.nan))),
        ("beside", " ".join(f"{j} {text_of(p)}" for j, p in sorted(places.items()))),
    )
    return Carried(
        offsets,
        made,
        joint,
        tuple((names[j], stray[j]) for j in sorted(loose & below - {joint})),
        tuple((names[j], far) for j, far in beside.items() if far > RIGID_SHARE * size),
        extra,
    )


def text_of(v: np.ndarray) -> str:
    """Numbers as `Source.extra` holds them."""
    return " ".join(repr(float(x)) for x in v)


def _rotate(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    return quat_rotate(q, np.broadcast_to(v, (len(q), 3)))


def _below(parents: Sequence[int], joint: int) -> set[int]:
    """The joint and all that hang on it."""
    out = {joint}
    for j, up in enumerate(parents):
        if up in out:
            out.add(j)
    return out


def _carrier(
    names: Sequence[str], parents: Sequence[int], offsets: np.ndarray, stray: Mapping[int, float],
    rot: np.ndarray, size: float,
) -> int | None:  # fmt: skip
    """The innermost joint that moves against its parent and carries the body with both its legs.

    It is sought from the root down, in the branch that holds more than half of all rigid bones: controls
    and targets, which move freely, weigh less. Branches that stay beside it may be props, cameras and
    targets, and no legs: a spine that stretches above a moving hip carries no body.
    """
    length = np.linalg.norm(offsets, axis=-1)
    rigid = [
        length[j] > RIGID_SHARE * size and stray.get(j, 0.0) <= _LOOSE_SHARE * size
        for j in range(len(parents))
    ]
    weight = [1.0 if r else 0.25 for r in rigid]
    named = set(landmarks(names)[2])
    feet = [int(j in named) for j in range(len(parents))]
    children: list[list[int]] = [[] for _ in parents]
    for j in range(len(parents) - 1, 0, -1):
        weight[parents[j]] += weight[j]
        feet[parents[j]] += feet[j]
        children[parents[j]].append(j)
    limbs = _limbs(children, length > _BONE_SHARE * size, rigid, rot)
    joint, found, beside = 0, None, 0
    while True:
        heavy = next((j for j in children[joint] if 2 * weight[j] > weight[0]), None)
        if heavy is None or not children[heavy]:
            return found
        beside += sum(limbs[j] for j in children[joint] if j != heavy)
        all_feet = len(named) > 1 and feet[heavy] == len(named)
        no_feet = len(named) > 1 and not feet[heavy]
        if no_feet or (beside > 1 and not all_feet):
            return found
        joint = heavy
        if stray.get(joint, 0.0) > (_LOOSE_SHARE if beside else RIGID_SHARE) * size:
            found = joint


def _limbs(
    children: Sequence[Sequence[int]], long: np.ndarray, rigid: Sequence[bool], rot: np.ndarray
) -> list[int]:
    """Per joint, how many limbs begin at it or below: two long rigid bones that turn one by one."""
    out = [0] * len(children)
    turns = np.abs((rot * rot[:1]).sum(-1)).min(0) < np.cos(_TURNS / 2)
    for j in range(len(children) - 1, -1, -1):
        out[j] = sum(out[c] for c in children[j])
        knees = [c for c in children[j] if long[c] and rigid[c] and turns[c]]
        whole = any(long[d] and rigid[d] for c in knees for d in children[c])
        out[j] = max(out[j], int(whole and bool(turns[j])))
    return out


def travel_note(root: str, joint: str, both: bool) -> str:
    """The sentence about the joint that carries the travel instead of the root, or together with it."""
    if both:
        return f"Both the root '{root}' and '{joint}' travel; the path of both became the root's"
    return f"The root '{root}' stands still: the travel of '{joint}' became the root's path"


def beside_note(joint: str, beside: Sequence[tuple[str, float]], unit_m: float) -> str:
    """The sentence about joints that the body does not hang on; distances in file units."""
    name, far = max(beside, key=lambda pair: pair[1])
    away = f"up to {far * unit_m * 1e3:.1f} mm from where the file has"
    which = f"hang on '{joint}', which travels, and"
    if len(beside) == 1:
        return f"'{name}' does not {which} keeps one place beside it, {away} it"
    more = f"{len(beside) - 1} more joint{'s' if len(beside) > 2 else ''}"
    return f"'{name}' and {more} do not {which} keep one place beside it, {away} them"


@dataclass(frozen=True)
class Restored:
    """Local places to write, file units: `(T, 3)` paths of the root and of the joint that travels,
    and `(J, 3)` offsets of all others."""

    paths: dict[int, np.ndarray]
    offsets: np.ndarray


def restored(skeleton: Skeleton, offsets: np.ndarray, root_pos: np.ndarray, rot: np.ndarray) -> Restored:
    """The way back from `carried`: the root stands where it stood, and the joint travels again.

    On axes along which the file's root moved, it moves again, as far below the joint as it was. Any
    skeleton without such a joint keeps its root's path.
    """
    own = Restored({0: root_pos}, offsets)
    texts, name = dict(skeleton.source.extra), skeleton.source.travel_joint
    if name is None or name not in skeleton.names or "root_position" not in texts:
        return own
    joint, parents = skeleton.names.index(name), skeleton.parents
    stood = np.array([float(x) for x in texts["root_position"].split()])
    kept = [float(x) for x in texts.get("beside", "").split()]
    rows = np.array(kept).reshape(-1, 4) if len(kept) % 4 == 0 else np.zeros((0, 4))
    places = {int(j): p for j, *p in rows.tolist() if 0 < j < len(parents)}
    way = set(line_to_root(parents, joint))
    made = offsets.copy()
    for j, place in places.items():
        made[j] = place
    pos, quat = forward_kinematics(parents, offsets, root_pos, rot)
    zero, _ = forward_kinematics(parents, made, np.zeros((len(rot), 3)), rot)
    # zero[:, D] is how far D stands from the root on rigid bones.
    root = np.where(np.isfinite(stood), stood, pos[:, joint] - zero[:, joint])
    up = parents[joint]
    path = quat_rotate_inv(quat[:, up], pos[:, joint] - (root + zero[:, up]))
    if not places:
        for j in set(range(1, len(parents))) - _below(parents, joint) - way:
            if parents[j] in way:
                at = root + zero[:, parents[j]]
                made[j] = np.median(quat_rotate_inv(quat[:, parents[j]], pos[:, j] - at), axis=0)
    return Restored({0: root, joint: path}, made)
