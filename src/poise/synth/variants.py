"""Variants of a transition that can be told apart: their middle is elsewhere and at another time."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from poise.nets.between import Between
from poise.nets.transition import Filled
from poise.spatial import quat_mul, rotvec_to_quat

#: m to the side, radians and share of the gap by which the middle of a variant is elsewhere, turned, and
#: earlier or later, in a gap of a second or more; in shorter ones less, as the square of the time.
ASIDE_M, TURNED, SHIFTED = 0.25, 0.35, 0.2
#: Frames of a gap below which there is no middle to lead through.
_LEAST = 8


class Detour(NamedTuple):
    """What a variant's middle is.

    Attributes:
        frame: of the gap, that it goes through.
        pose: frame of the best guess with the pose that it has there.
        aside: m, across the way.
        turn: radians, about the vertical.
    """

    frame: int
    pose: int
    aside: float
    turn: float


def drawn(length: int, fps: float, noise: torch.Generator) -> Detour | None:
    """A detour for a gap of `length` frames; None where it is too short for one.

    Each is at least half as large as it may be, so that no variant is the best guess again.
    """
    if length < _LEAST:
        return None
    u = torch.rand(4, generator=noise).tolist()
    reach = min(1.0, length / fps) ** 2
    frame = round((0.4 + 0.2 * u[0]) * (length - 1))

    def either(share: float, most: float) -> float:
        """Between half of `most` and all of it, on either side."""
        return math.copysign(most * (0.5 + abs(share - 0.5)), share - 0.5)

    pose = frame + round(either(u[1], SHIFTED * reach) * length)
    return Detour(
        frame,
        min(max(pose, 0), length - 1),
        either(u[2], ASIDE_M * reach),
        either(u[3], TURNED * reach),
    )


def through(
    net: Between, root: Tensor, rot: Tensor, seen: Tensor, offsets: Tensor, guess: Filled,
    detour: Detour, noise: torch.Generator,
) -> Filled:  # fmt: skip
    """The frames of one window `(1, T, ...)` again, led through a detour of the best guess.

    Args:
        root, rot, seen, offsets: as `Between.complete` takes them.
        guess: what it made of all T frames.
    """
    first = int((~seen).nonzero()[0])
    last = int((~seen).nonzero()[-1])
    at, pose = first + detour.frame, first + detour.pose
    way = guess.root[:, last] - guess.root[:, first]
    flat = way * torch.tensor([1.0, 1.0, 0.0]).to(way)
    size = flat.norm(dim=-1, keepdim=True)
    # Where the body stays it is displaced along X.
    ahead = torch.where(size > 0.05, flat / size.clamp_min(1e-6), torch.tensor([0.0, -1.0, 0.0]).to(way))
    across = torch.stack((-ahead[:, 1], ahead[:, 0], torch.zeros_like(ahead[:, 0])), -1)
    turn = rotvec_to_quat(torch.tensor([[0.0, 0.0, detour.turn]]).to(way))
    root, rot, seen = root.clone(), rot.clone(), seen.clone()
    # The pose of another time at the place of this one, aside.
    root[:, at] = guess.root[:, at] + detour.aside * across
    root[:, at, 2] = guess.root[:, pose, 2]
    rot[:, at] = guess.rot[:, pose]
    rot[:, at, 0] = quat_mul(turn, guess.rot[:, pose, 0])
    seen[at] = True
    filled = net.complete(root, rot, seen, offsets, noise)
    # What a network says of the feet in known frames was never learned.
    contact = filled.contact.clone()
    contact[:, at] = 0.5 * (contact[:, at - 1] + contact[:, at + 1])
    return filled._replace(contact=contact)
