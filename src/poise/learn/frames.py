"""Motion as packed tensors for learning, and batches of windows drawn from them without a loop."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from poise.errors import PoiseError
from poise.nets.transition import Layout


class Windows(NamedTuple):
    """A batch: root `(N, W, 3)`, rot `(N, W, J, 4)`, contact `(N, W, F)` 0 or 1, offsets `(N, J, 3)`."""

    root: Tensor
    rot: Tensor
    contact: Tensor
    offsets: Tensor


@dataclass(frozen=True, eq=False)
class FrameData:
    """All frames of a training set, one clip after another, float32; metres, Z up.

    root `(F, 3)`, rot `(F, J, 4)` wxyz local, contact `(F, K)` of each foot joint, offsets `(C, J, 3)`
    of each clip, first `(C + 1)` where clips begin. std `(J, 3)` m: the deviations that L2P divides by.
    """

    layout: Layout
    root: Tensor
    rot: Tensor
    contact: Tensor
    offsets: Tensor
    first: Tensor
    std: Tensor

    @property
    def frames(self) -> int:
        """The number of frames of all clips."""
        return len(self.root)


class Sampler:
    """Windows at every frame of every clip (dense), drawn uniformly.

    Frames are ordered once by how many follow them in their clip, so that those with room for a window
    of any length are the first so many.
    """

    def __init__(self, data: FrameData):
        self.data = data
        sizes = data.first[1:] - data.first[:-1]
        clip = torch.repeat_interleave(torch.arange(len(sizes)), sizes)
        room = data.first[1:][clip] - torch.arange(data.frames)
        self.order = torch.argsort(room, descending=True, stable=True)
        self.room, self.clip = -room[self.order], clip

    def count(self, window: int) -> int:
        """How many different windows of `window` frames there are."""
        return int(torch.searchsorted(self.room, -window, right=True))

    def draw(self, count: int, window: int, generator: torch.Generator) -> Windows:
        """A batch of `count` windows.

        Raises:
            PoiseError: no clip is long enough.
        """
        most = self.count(window)
        if most == 0:
            raise PoiseError(
                f"no clip of the training set has {window} frames",
                hint="Give longer clips or train shorter transitions",
            )
        start = self.order[torch.randint(most, (count,), generator=generator)]
        return self.at(start, window)

    def at(self, start: Tensor, window: int) -> Windows:
        """The windows that begin at frames `start (N)`."""
        d, rows = self.data, start[:, None] + torch.arange(window)
        return Windows(d.root[rows], d.rot[rows], d.contact[rows], d.offsets[self.clip[start]])
