"""Motion as packed tensors for learning: frames, running windows, buffers of past ones."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from poise.errors import PoiseError
from poise.learn.checkpoint import State, take
from poise.learn.transition import SkeletonLayout
from poise.motion.rotations import normalize


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

    layout: SkeletonLayout
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
            raise PoiseError(f"stretch must lie in 1 to 4, got {stretch:g}", code="out-of-range")
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
                code="clip-too-short",
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


class History:
    """The last W frames of N environments, of the running episode only.

    `frames (N, W, F)` oldest first; `seen (N,)` how many of them are of the running episode.
    """

    def __init__(self, num_envs: int, frames: int, features: int, device: torch.device):
        self.frames = torch.zeros(num_envs, frames, features, device=device)
        self.seen = torch.zeros(num_envs, dtype=torch.int64, device=device)

    def add(self, features: Tensor) -> None:
        """One more frame `(N, F)` of every environment."""
        if features.shape != self.frames[:, 0].shape:
            want = tuple(self.frames[:, 0].shape)
            raise PoiseError(
                f"the features have the shape {tuple(features.shape)}, {want} is expected",
                code="wrong-shape",
            )
        self.frames = torch.cat((self.frames[:, 1:], features.unsqueeze(1)), 1)
        self.seen = (self.seen + 1).clamp_max(self.frames.shape[1])

    def full(self) -> Tensor:
        """The rows `(n,)` with an episode of at least W frames."""
        return (self.seen == self.frames.shape[1]).nonzero().squeeze(-1)

    def windows(self, rows: Tensor) -> Tensor:
        """The last W frames of some rows, `(n, W F)`."""
        return self.frames[rows].flatten(1)

    def restart(self, rows: Tensor, past: Tensor | None) -> None:
        """Forgets the episodes of `rows (n,)`; new ones begin with `past (n, W, F)`, or with nothing
        where that is None or, for single rows, not a number."""
        self.seen[rows] = 0
        if past is not None:
            known = ~past.flatten(1).isnan().any(1)
            self.frames[rows[known]] = past[known]
            self.seen[rows[known]] = self.frames.shape[1]

    def state(self) -> State:
        """Copies of all tensors."""
        return {"frames": self.frames.clone(), "seen": self.seen.clone()}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Goes on from what `state` returned."""
        self.frames.copy_(take(state, "frames"))
        self.seen.copy_(take(state, "seen"))


class WindowBuffer:
    """At most `size` windows; while there is room all are kept, afterwards the oldest are replaced.

    Args:
        size: how many it holds; 0 keeps none.
        width: of a window.
    """

    def __init__(self, size: int, width: int, device: torch.device):
        self.size, self.data = size, torch.empty(0, width, device=device)
        self.next = 0

    def __len__(self) -> int:
        return len(self.data)

    def add(self, windows: Tensor, keep: float, generator: torch.Generator) -> None:
        """Adds `windows (n, width)`: until it is full all of them, and of the rest each with the
        probability `keep`, in the place of the oldest."""
        room = min(self.size - len(self.data), len(windows))
        if room:
            self.data = torch.cat((self.data, windows[:room]))
        rest = windows[room:]
        if not self.size or not len(rest):
            return
        chosen = torch.rand(len(rest), generator=generator) < keep
        # More than it holds would only replace each other.
        rest = rest[chosen.to(rest.device)][-self.size :]
        place = (self.next + torch.arange(len(rest), device=rest.device)) % self.size
        self.data[place] = rest
        self.next = (self.next + len(rest)) % self.size

    def sample(self, count: int, generator: torch.Generator) -> Tensor:
        """`(count, width)` drawn with replacement; it must not be empty."""
        index = torch.randint(len(self.data), (count,), generator=generator)
        return self.data[index.to(self.data.device)]

    def state(self) -> State:
        """Copies of all tensors."""
        return {"data": self.data.clone(), "next": torch.tensor(self.next)}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Goes on from what `state` returned."""
        data = take(state, "data")
        if len(data) > self.size or data.shape[1:] != self.data.shape[1:]:
            raise PoiseError(
                f"the saved buffer holds {tuple(data.shape)}, this one at most "
                f"{(self.size, self.data.shape[1])}",
                code="state-differs",
            )
        self.data, self.next = data.to(self.data.device, copy=True), int(take(state, "next"))
