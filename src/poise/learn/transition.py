"""The interface of every in-betweening network: known frames in, a transition out."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from poise.motion.rotations import (
    axis_heading,
    matrix_kinematics,
    quat_conj,
    quat_mul,
    quat_rotate,
    quat_to_matrix,
)


@dataclass(frozen=True)
class SkeletonLayout:
    """What a network must know of a skeleton.

    Attributes:
        parents: of the joints, -1 for the root.
        feet: foot joints.
        facing: the root's local heading axis.
    """

    parents: tuple[int, ...]
    feet: tuple[int, ...]
    facing: tuple[float, float, float]

    @property
    def joints(self) -> int:
        """The number of joints."""
        return len(self.parents)


class Known(NamedTuple):
    """What a transition may be made from; metres, Z up, rotations wxyz local to the parent.

    Attributes:
        past_root: `(N, P, 3)`, at least one frame that was seen.
        past_rot: `(N, P, J, 4)`, the same frames.
        target_root: `(N, 3)`, the one keyframe after the gap.
        target_rot: `(N, J, 4)`, the same keyframe.
        offsets: `(N, J, 3)`, bones.
    """

    past_root: Tensor
    past_rot: Tensor
    target_root: Tensor
    target_rot: Tensor
    offsets: Tensor


class FilledGap(NamedTuple):
    """A transition.

    Attributes:
        root: `(N, L, 3)` m.
        rot: `(N, L, J, 4)` wxyz, with signs that go on from the last frame that was seen.
        contact: `(N, L, F)`, probability of each foot joint.
        pos: `(N, L, J, 3)` m.
    """

    root: Tensor
    rot: Tensor
    contact: Tensor
    pos: Tensor


class TransitionNet(Protocol):
    """The one interface of both networks; it is blind to where on the ground and in which heading."""

    layout: SkeletonLayout

    def fill(self, known: Known, length: int, noise: torch.Generator | None = None) -> FilledGap:
        """`length` frames between the last known one and the target; gradients flow to the weights.

        noise: draws a variant where the network can; without it the result is the same every time.
        """
        ...

    def parameters(self) -> Iterable[torch.nn.Parameter]:
        """The weights."""
        ...


class WindowPlace(NamedTuple):
    """Where a window stood.

    Attributes:
        xy: `(N, 1, 3)` m, of the last known root.
        heading: `(N, 1, 4)` wxyz.
    """

    xy: Tensor
    heading: Tensor


def place_of(root: Tensor, rot: Tensor, facing: Sequence[float]) -> WindowPlace:
    """The place of one frame: root `(N, 3)`, rot `(N, J, 4)`."""
    axis = torch.tensor(tuple(facing), dtype=root.dtype, device=root.device)
    xy = root * torch.tensor([1.0, 1.0, 0.0], dtype=root.dtype, device=root.device)
    return WindowPlace(xy.unsqueeze(1), axis_heading(rot[:, 0], axis).unsqueeze(1))


def into_place(root: Tensor, rot: Tensor, place: WindowPlace) -> tuple[Tensor, Tensor]:
    """Frames `(N, T, ...)` as seen from a place: its ground point the origin, its heading +X."""
    return _turned(root - place.xy, rot, quat_conj(place.heading))


def out_of_place(root: Tensor, rot: Tensor, place: WindowPlace) -> tuple[Tensor, Tensor]:
    """The inverse of `into_place`."""
    root, rot = _turned(root, rot, place.heading)
    return root + place.xy, rot


def _turned(root: Tensor, rot: Tensor, turn: Tensor) -> tuple[Tensor, Tensor]:
    turn = turn.expand(*root.shape[:-1], 4)
    first = quat_mul(turn, rot[..., 0, :]).unsqueeze(-2)
    return quat_rotate(turn, root), torch.cat((first, rot[..., 1:, :]), -2)


def joint_positions(layout: SkeletonLayout, offsets: Tensor, root: Tensor, rot: Tensor) -> Tensor:
    """Global positions `(N, T, J, 3)` of local quaternions `(N, T, J, 4)`; offsets `(N, J, 3)`."""
    mats = quat_to_matrix(rot)
    return matrix_kinematics(layout.parents, offsets.unsqueeze(1), root, mats)[0]


def continued(rot: Tensor, before: Tensor) -> Tensor:
    """Quaternions `(N, T, J, 4)` with signs such that each goes on from the one before it.

    before: `(N, J, 4)`, the last frame that was seen. L2Q compares signs, so this matters.
    """
    path = torch.cat((before.unsqueeze(1), rot), 1)
    dots = (path[:, 1:] * path[:, :-1]).sum(-1)
    signs = torch.where(dots < 0, -1.0, 1.0).to(rot.dtype).cumprod(1)
    return rot * signs.unsqueeze(-1)
