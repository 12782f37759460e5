"""Clips cut into motion bins of about a second, and how often episodes fail in each.

A long clip is rarely hard all over: where it fails it mostly fails within the same second. The failure
rates of the bins say where episodes are to begin (`Starts`), and which bins still need help
(`HelpBudget`).
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import NamedTuple

import torch
from torch import Tensor

#: How long a motion bin lasts, nearly, s.
BIN_S = 1.0


class Outcomes(NamedTuple):
    """What one control step says of motion bins: `bin (K,)`, and float64 `ended`, `failed (K,)`, 1 where
    a character has come through it or failed, and 1 where it failed."""

    bin: Tensor
    ended: Tensor
    failed: Tensor

    def of(self, worlds: Tensor) -> Outcomes:
        """Those of `worlds (N,)` bool alone; K is 2 N."""
        kept = worlds.repeat(2).double()
        return Outcomes(self.bin, self.ended * kept, self.failed * kept)


@dataclass(frozen=True, eq=False)
class MotionBins:
    """The motion bins of all clips, one after another: G of them, in a reference of R rows.

    Attributes:
        clip: `(G,)`, the clip of each bin.
        begin: `(G,)`, the frame of its clip that it begins on.
        size: `(G,)`, its number of frames.
        offset: `(C,)`, the first bin of each clip.
        count: `(C,)`, the number of bins of each clip.
        of: `(R,)`, the bin of each row.
        into: `(R,)`, frames from the begin of the bin to the row.
        last: `(R,)` bool, rows that are the last frame of their bin.
        before: `(G,)`, the bin before it; for the first bin of a clip, the clip's last.
    """

    clip: Tensor
    begin: Tensor
    size: Tensor
    offset: Tensor
    count: Tensor
    of: Tensor
    into: Tensor
    last: Tensor
    before: Tensor

    @classmethod
    def cut(cls, length: Tensor, cyclic: Tensor, rate_hz: float, seconds: float = BIN_S) -> MotionBins:
        """Motion bins of equal length, as near `seconds` as goes.

        Args:
            length: `(C,)` frames at `rate_hz`, at least 3.
            cyclic: `(C,)` bool, cyclic clips: their last frame is their first, one cycle later.
        """
        frames = length - cyclic.long()
        count = (frames.double() / (seconds * rate_hz)).round().long().clamp(min=1)
        offset, start = count.cumsum(0) - count, length.cumsum(0) - length
        clip = torch.arange(len(length)).repeat_interleave(count)
        number = torch.arange(len(clip)) - offset[clip]
        # Frame f is in bin f * count // frames.
        ends = [-(-(k * frames[clip]) // count[clip]) for k in (number, number + 1)]
        begin, size = ends[0], ends[1] - ends[0]
        row_clip = torch.arange(len(length)).repeat_interleave(length)
        frame = torch.arange(len(row_clip)) - start[row_clip]
        frame = torch.minimum(frame, frames[row_clip] - 1)
        of = offset[row_clip] + frame * count[row_clip] // frames[row_clip]
        into = frame - begin[of]
        before = torch.where(number > 0, torch.arange(len(clip)) - 1, (offset + count - 1)[clip])
        return cls(clip, begin, size, offset, count, of, into, into == size[of] - 1, before)

    def __len__(self) -> int:
        return len(self.clip)

    def to(self, device: torch.device) -> MotionBins:
        """The same on another device."""
        return MotionBins(*(getattr(self, f.name).to(device) for f in fields(self)))

    def outcomes(self, row: Tensor, age: Tensor, failed: Tensor, done: Tensor) -> Outcomes:
        """What a step says that brought N worlds to `row (N,)`.

        A bin has been done when the one after it has, or the clip: a character that fails has mostly
        lost balance before. So a failure counts in its own bin and in the one before, if the episode has
        been there; that one is done, if the episode has seen half of it, when its successor is left.

        Args:
            age: `(N,)` control steps since the episodes began.
            failed, done: `(N,)` bool, which failed, and which came to the end of their clips.
        """
        now, into = self.of[row], self.into[row]
        before = self.before[now]
        there = age - into
        passed = self.last[row] & (2 * there >= self.size[before]) & (there > 0)
        earlier = torch.where(failed, there > 0, passed)
        ended = torch.cat((failed | done, earlier)).double()
        fell = torch.cat((failed, failed & earlier)).double()
        return Outcomes(torch.cat((now, before)), ended, fell)

    def by_clip(self, values: Tensor, most: bool = False) -> Tensor:
        """The mean, or the most, of the values `(G,)` of each clip's bins: `(C,)`."""
        out = values.new_zeros(len(self.count))
        how = "amax" if most else "mean"
        return out.scatter_reduce(0, self.clip.to(values.device), values, how, include_self=False)
