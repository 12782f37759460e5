"""Motion as packed tensors for learning, and batches of windows drawn from them without a loop."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from poise.errors import PoiseError
from poise.nets.transition import Layout
from poise.spatial import normalize


class Windows(NamedTuple):
    """A batch of N windows of W frames; metres, Z up.

    Attributes:
        root: `(N, W, 3)` m.
        rot: `(N, W, J, 4)` wxyz, local.
        contact: `(N, W, F)`, 0 or 1 of each foot joint.
        offsets: `(N, J, 3)` m, bones.
    """

    root: Tensor
    rot: Tensor
    contact: Tensor
    offsets: Tensor


@dataclass(frozen=True, eq=False)
class FrameData:
    """All frames of a training set, one clip after another, float32; metres, Z up.

    Attributes:
        layout: of the skeleton.
        root: `(F, 3)` m.
        rot: `(F, J, 4)` wxyz, local.
        contact: `(F, K)` of each foot joint.
        offsets: `(C, J, 3)` m, bones of each clip.
        first: `(C + 1)`, rows where clips begin.
        std: `(J, 3)` m, the deviations that L2P divides by.
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

    Args:
        stretch: windows are drawn up to so many times faster and slower than recorded, evenly on a
            logarithmic scale, as far as the clip reaches; 1 leaves them.
    """

    def __init__(self, data: FrameData, stretch: float = 1.0):
        if not 1.0 <= stretch <= 4.0:
            raise PoiseError(f"stretch must lie in 1 to 4, got {stretch:g}")
        self.data, self.stretch = data, stretch
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
        if self.stretch == 1.0:
            return self.at(start, window)
        way = 2 * torch.rand(count, generator=generator) - 1
        return self.at(start, window, self.stretch**way)

    def at(self, start: Tensor, window: int, speed: Tensor | None = None) -> Windows:
        """The windows that begin at frames `start (N)`, at `speed (N)` times that of the recording, or
        as fast as the clip has frames for."""
        d, clip = self.data, self.clip[start]
        if speed is None:
            rows = start[:, None] + torch.arange(window)
            return Windows(d.root[rows], d.rot[rows], d.contact[rows], d.offsets[clip])
        left = (d.first[1:][clip] - 1 - start).float()
        speed = torch.minimum(speed, left / max(1, window - 1))
        way = speed[:, None] * torch.arange(window)
        # The last frame may be missed by a rounding.
        whole = torch.minimum(way.floor(), (left[:, None] - 1).clamp_min(0))
        rows = start[:, None] + whole.long()
        after = torch.minimum(rows + 1, d.first[1:][clip][:, None] - 1)
        share = (way - whole)[..., None]
        root = torch.lerp(d.root[rows], d.root[after], share)
        # Neighbouring frames are so alike that a chord is as good as the arc; their signs agree.
        rot = normalize(torch.lerp(d.rot[rows], d.rot[after], share[..., None]))
        contact = torch.where(share < 0.5, d.contact[rows], d.contact[after])
        return Windows(root, rot, contact, d.offsets[clip])
