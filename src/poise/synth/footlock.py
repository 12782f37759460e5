"""Feet that stay where they stand in a transition, where the network says that they stand."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from poise.kin.feet.contact import Sole
from poise.kin.feet.hold import FIRM, Standing, hold
from poise.kin.feet.lead import Lead, led
from poise.motion import Skeleton
from poise.spatial import forward_kinematics
from poise.synth.steps import missing_steps, rises, stepping


def lock_feet(
    skeleton: Skeleton, feet: Sequence[int], root: Tensor, rot: Tensor, contact: Tensor, free: Tensor,
    fps: float,
) -> Tensor:  # fmt: skip
    """Rotations `(T, J, 4)` with the feet held still while they stand; the root's path stays.

    A foot that cannot stand, since the kept frames at both ends have it in other places, takes a step,
    and feet that swing are raised clear of the floor, see `synth.steps`.

    Args:
        feet: joints; ankles with toes among them are held, others left alone.
        root: `(T, 3)` m. rot: `(T, J, 4)` wxyz, local.
        contact: `(T, F)` bool per foot joint. free: `(T)` bool, frames that may change; the others
            (keyframes) say where a foot that stands must be.
    """
    soles = _soles(skeleton, feet)
    if not soles:
        return rot.clone()
    gap = _gap(free)
    if gap is not None:
        contact = _with_steps(skeleton, soles, root, rot, contact, gap, fps)
    bears = (contact[1:] & contact[:-1]).to(rot.dtype) * FIRM

    def standing(pos: Tensor, _: Tensor) -> dict[int, Standing]:
        return {
            s.ankle: Standing(Sole(pos[:, s.ankle], pos[:, [s.ankle, s.toe]]), bears[:, list(s.columns)])
            for s in soles
            if bool(bears[:, list(s.columns)].any())
        }

    rot = hold(skeleton, root, rot, fps, standing, ~free, vertical=True)
    return rot if gap is None else _cleared(skeleton, soles, root, rot, contact, gap)


class _Foot(NamedTuple):
    """An ankle and its toe, and their columns among the contacts."""

    ankle: int
    toe: int
    columns: tuple[int, int]


def _soles(skeleton: Skeleton, feet: Sequence[int]) -> list[_Foot]:
    out = []
    for k, toe in enumerate(feet):
        ankle = skeleton.parents[toe]
        # A leg has a knee and a hip above its ankle.
        if ankle in feet and len(skeleton.ancestors(ankle)) > 2:
            out.append(_Foot(ankle, toe, (list(feet).index(ankle), k)))
    return out


def _positions(skeleton: Skeleton, root: Tensor, rot: Tensor) -> Tensor:
    offsets = torch.tensor(skeleton.offsets, dtype=rot.dtype)
    return forward_kinematics(skeleton.parents, offsets, root, rot)[0]


def _gap(free: Tensor) -> slice | None:
    """The free frames with the last kept frame before and the first one after them, if there are."""
    inside = free.nonzero().squeeze(-1)
    if len(inside) == 0 or inside[0] == 0 or inside[-1] == len(free) - 1:
        return None
    return slice(int(inside[0]) - 1, int(inside[-1]) + 2)


def _ends(skeleton: Skeleton, soles: list[_Foot], root: Tensor, rot: Tensor) -> Tensor:
    """`(T, K, 2, 3)` m, ankles and toes."""
    return _positions(skeleton, root, rot)[:, [[s.ankle, s.toe] for s in soles]]


def _stands(contact: Tensor, soles: list[_Foot]) -> Tensor:
    """`(T, K)` bool, on either end."""
    return torch.stack([contact[:, list(s.columns)].any(1) for s in soles], 1)


def _with_steps(
    skeleton: Skeleton, soles: list[_Foot], root: Tensor, rot: Tensor, contact: Tensor, gap: slice,
    fps: float,
) -> Tensor:  # fmt: skip
    """The contacts with the steps that are missing."""
    ends = _ends(skeleton, soles, root[gap], rot[gap])
    steps = missing_steps(ends, _stands(contact[gap], soles), fps)
    contact = contact.clone()
    contact[gap] = stepping(contact[gap], steps, [s.columns for s in soles])
    return contact


def _cleared(
    skeleton: Skeleton, soles: list[_Foot], root: Tensor, rot: Tensor, contact: Tensor, gap: slice
) -> Tensor:
    """The motion with the feet raised that swing too low."""
    up = rises(_ends(skeleton, soles, root[gap], rot[gap]), _stands(contact[gap], soles))
    nothing = torch.zeros(len(up), dtype=rot.dtype)
    level = torch.tensor([1.0, 0.0, 0.0], dtype=rot.dtype).expand(len(up), 3)
    leads = {
        sole.ankle: Lead(torch.stack((nothing, nothing, up[:, k]), -1), nothing, nothing, level)
        for k, sole in enumerate(soles)
        if bool(up[:, k].any())
    }
    rot = rot.clone()
    if leads:
        rot[gap] = led(skeleton, rot[gap], root[gap], leads)
    return rot
