"""Animated nodes with places, turns and scales (glTF, USD) as rigid bones and one root path."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from poise.errors import PoiseError
from poise.formats.guess import guess_unit, guess_up
from poise.formats.raw import ReadOptions, vectors_from_z_up
from poise.formats.root_joint import Carried, carried, size_of
from poise.formats.text import REST_POSE, shown
from poise.motion.clip_info import body_height, sampled
from poise.motion.rotations import (
    forward_kinematics,
    matrix_to_quat,
    quat_mul,
    quat_rotate,
    quat_rotate_inv,
)
from poise.motion.skeleton import Skeleton

_HUMAN_M = (0.3, 4.0)
_SHEAR = 1e-3
#: So many joints with a name that was taken are told one by one.
_RENAMED = 5


@dataclass(frozen=True)
class Base:
    """What lies above the root joint: p_world = place + R factor (scale * p), R = `turn` (wxyz)."""

    place: np.ndarray
    turn: np.ndarray
    factor: float
    scale: np.ndarray

    def down(self, pos: np.ndarray) -> np.ndarray:
        """World places `(T, 3)` in the frame of the node above the root."""
        q = np.broadcast_to(self.turn, (len(pos), 4))
        return quat_rotate_inv(q, (pos - self.place)) / (self.factor * self.scale)

    def below(self) -> float:
        """The scale that reaches what hangs on the root joint."""
        return self.factor * even(self.scale)


@dataclass(frozen=True)
class Bones:
    """Rigid bones in the file's units: offsets `(J, 3)`, root_pos `(T, 3)`, rot `(T, J, 4)` wxyz.

    carried: which joint carries the body, and what did not stay rigid.
    """

    offsets: np.ndarray
    root_pos: np.ndarray
    rot: np.ndarray
    carried: Carried


def even(scale: np.ndarray) -> float:
    """The one factor nearest to a scale `(3,)`: its geometric mean."""
    return float(np.cbrt(np.prod(scale)))


def base_of(nodes: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> Base:
    """The combined transform of nested nodes `(place, turn, scale)`, outermost first.

    Even scales combine exactly; of an uneven one the mean reaches beyond the node's children.
    """
    out = Base(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]), 1.0, np.ones(3))
    for place, turn, scale in nodes:
        out = Base(
            out.place + _turned(out.turn, out.factor * out.scale * place),
            quat_mul(out.turn, turn),
            out.below(),
            np.array(scale, dtype=np.float64),
        )
    return out


def _turned(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Vectors `v (..., 3)` turned by one rotation."""
    return quat_rotate(np.broadcast_to(q, (*v.shape[:-1], 4)), v)


def turn_and_scale(
    axes: np.ndarray, what: str, where: str, hint: str | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Rotations `(..., 4)` wxyz and scales `(..., 3)` of matrices `(..., 3, 3)`.

    what: how a sentence calls them.

    Raises:
        PoiseError: a matrix that flattens, mirrors or shears space.
    """
    scale = np.linalg.norm(axes, axis=-2)
    if scale.min() < 1e-9:
        raise PoiseError(f"its {what} flattens space", where, code="scale-unusable")
    turn = axes / scale[..., None, :]
    if np.linalg.det(turn).min() < 0:
        raise PoiseError(f"its {what} mirrors space, which a body cannot do", where, code="mirrored")
    if np.abs(np.swapaxes(turn, -1, -2) @ turn - np.eye(3)).max() > _SHEAR:
        raise PoiseError(f"its {what} shears space", where, hint, code="sheared")
    return matrix_to_quat(turn), scale


def rigid_bones(
    names: Sequence[str],
    parents: Sequence[int],
    place: Sequence[np.ndarray],
    turn: Sequence[np.ndarray],
    scale: Sequence[np.ndarray],
    base: Base,
    frames: int,
    notes: list[str],
) -> Bones:
    """Bones of constant length from joints' local transforms.

    Args:
        place, turn: per joint `(T, 3)` and `(T, 4)` wxyz, or one row where it is constant.
        scale: `(3,)` per joint, constant. base: what lies above the root. frames: T.
    """
    factor = [base.below()]
    offsets = np.zeros((len(parents), 3))
    paths: dict[int, np.ndarray] = {}
    for j, up in enumerate(parents[1:], 1):
        factor.append(factor[up] * even(scale[up]))
        paths[j] = factor[up] * scale[up] * place[j]
        offsets[j] = np.median(paths[j], axis=0)
    rot = np.stack([np.broadcast_to(q, (frames, 4)) for q in turn], 1)
    rot[:, 0] = quat_mul(np.broadcast_to(base.turn, (frames, 4)), rot[:, 0])
    root_pos = base.place + _turned(base.turn, base.factor * base.scale * place[0])
    root_pos = np.array(np.broadcast_to(root_pos, (frames, 3)))
    moves = [x for x in (root_pos, *paths.values()) if np.ptp(x, axis=0).max() > 0]
    if not moves and np.abs(rot - rot[:1]).max() < 1e-9 and REST_POSE not in notes:
        notes.append(f"Nothing moves in it: its {frames} frames show one pose")
    body = carried(names, parents, offsets, paths, root_pos, rot, size_of(offsets), notes)
    return Bones(body.offsets, body.root_pos, rot, body)


def unique_names(names: Sequence[str], notes: list[str]) -> tuple[str, ...]:
    """The names, with a number added to those that appear again."""
    taken, seen, out = set(names), set[str](), list[str]()
    nexts: dict[str, int] = {}
    renamed: list[tuple[str, str]] = []
    for name in names:
        made = name
        if name in seen:
            k = nexts.get(name, 2)
            while (made := f"{name}_{k}") in taken:
                k += 1
            nexts[name] = k + 1
            renamed.append((name, made))
        seen.add(made)
        taken.add(made)
        out.append(made)
    for name, made in renamed[:_RENAMED]:
        notes.append(
            f"The joint name {shown(name)} appears twice; the later one is called {shown(made)}"
        )
    if len(renamed) > _RENAMED:
        notes.append(f"{len(renamed) - _RENAMED} more joints got another name, since theirs was taken")
    return tuple(out)


def checked_unit(
    form: str,
    stated: float,
    up_axis: str,
    names: Sequence[str],
    parents: Sequence[int],
    bones: Bones,
    options: ReadOptions,
    path: object,
    notes: list[str],
) -> float:
    """Metres in one unit as the format states it, unless the body would then be no human's size.

    Such a unit is guessed anew from the body's height, and told. So is a vertical against which the
    body stands; it is kept.
    """
    if len(bones.rot) < 2 or not np.abs(bones.offsets).max() > 0:
        return stated
    at = sampled(len(bones.rot))
    pos, _ = forward_kinematics(parents, bones.offsets, bones.root_pos[at], bones.rot[at])
    up = guess_up(names, pos, pos[0])
    if options.up_axis is None and up.value != up_axis and "uncertain" not in up.note:
        notes.append(
            f"The {form} file has {up_axis} up and was read so, but the body stands along {up.value}; "
            f"if it should stand upright, override with --up {up.value}"
        )
    height, how = body_height(names, parents, bones.offsets, pos)
    size = height * stated
    if options.unit_m is not None or not height > 0 or _HUMAN_M[0] <= size <= _HUMAN_M[1]:
        return stated
    unit = float(guess_unit(height, how, None, path).value)  # type: ignore[arg-type]
    notes.append(
        f"In the unit of the {form} file the person would be {size:.4g} m tall: one unit is taken as "
        f"{unit:.6g} m, which makes it {height * unit:.2f} m ({how})"
    )
    return unit


def tips_from_z_up(skeleton: Skeleton, up_axis: str, unit_m: float) -> list[tuple[int, np.ndarray]]:
    """Bone tips `(joint, (3,))` in the joints' frames, in the file's unit and axes."""
    return [(j, vectors_from_z_up(np.array(tip), up_axis) / unit_m) for j, tip in skeleton.ends]
