"""Windows of consecutive frames: those that are running, and buffers of past ones."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from poise.errors import PoiseError
from poise.learn.state import State, take


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
            raise PoiseError(f"the features have the shape {tuple(features.shape)}, {want} is expected")
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
                f"{(self.size, self.data.shape[1])}"
            )
        self.data, self.next = data.to(self.data.device, copy=True), int(take(state, "next"))
