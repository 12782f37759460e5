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
    soles, gap = _soles(skeleton, feet), _gap(free)
    if not soles:
        return rot.clone()

    def ends(rot: Tensor) -> Tensor:
        """`(T, K, 2, 3)` m, ankles and toes in the gap."""
        offsets = torch.tensor(skeleton.offsets, dtype=rot.dtype)
        pos = forward_kinematics(skeleton.parents, offsets, root[gap], rot[gap])[0]
        return pos[:, [[s.ankle, s.toe] for s in soles]]

    def stands() -> Tensor:
        """`(T, K)` bool, on either end, in the gap."""
        return torch.stack([contact[gap][:, list(s.columns)].any(1) for s in soles], 1)

    if gap is not None:
        contact = contact.clone()
        steps = missing_steps(ends(rot), stands(), fps)
        contact[gap] = stepping(contact[gap], steps, [s.columns for s in soles])
    bears = (contact[1:] & contact[:-1]).to(rot.dtype) * FIRM

    def standing(pos: Tensor, _: Tensor) -> dict[int, Standing]:
        return {
            s.ankle: Standing(Sole(pos[:, s.ankle], pos[:, [s.ankle, s.toe]]), bears[:, list(s.columns)])
            for s in soles
            if bool(bears[:, list(s.columns)].any())
        }

    rot = hold(skeleton, root, rot, fps, standing, ~free, vertical=True)
    return rot if gap is None else _raised(skeleton, soles, root, rot, rises(ends(rot), stands()), gap)


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


def _gap(free: Tensor) -> slice | None:
    """The free frames with the last kept frame before and the first one after them, if there are."""
    inside = free.nonzero().squeeze(-1)
    if len(inside) == 0 or inside[0] == 0 or inside[-1] == len(free) - 1:
        return None
    return slice(int(inside[0]) - 1, int(inside[-1]) + 2)


def _raised(
    skeleton: Skeleton, soles: list[_Foot], root: Tensor, rot: Tensor, up: Tensor, gap: slice
) -> Tensor:
    """The motion with its feet raised by `up (T, K)` m in the gap."""
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
