"""Data of a motion prior: frames of the clips, seen as it sees the characters."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from poise.env.evaluate import seen_by
from poise.env.frame import Frame, ObsTerm, headed
from poise.env.reference import Reference
from poise.errors import PoiseError

#: Features of all frames are kept up to this size; of larger libraries they are worked out when drawn.
MOST_BYTES = 256 * 2**20
#: Frames that are worked out at once.
AT_ONCE = 4096


class ClipFeatures:
    """What `terms`, which look at `frame.sim` alone, see of the frames of the clips.

    Frames of later cycles are seen as the clip has them, so the terms must not know of the world's x, y
    and heading.

    Args:
        reference: the clips. terms: what is seen of a frame, side by side.
        most_bytes: up to this size the features of all frames are kept.
        left: by which headings are taken, see `TaskConfig.left`.
    """

    def __init__(
        self,
        reference: Reference,
        terms: tuple[ObsTerm, ...],
        most_bytes: int = MOST_BYTES,
        left: Tensor | None = None,
    ):
        self.reference, self.terms, self.most_bytes = reference, terms, most_bytes
        self.left = left
        self._all: Tensor | None = None

    @property
    def kept(self) -> bool:
        """True once the features of all frames are kept."""
        return self._all is not None

    def __call__(self, rows: Tensor) -> Tensor:
        """`(n, F)` float32 of the reference's `rows (n,)`."""
        if self._all is None and self._fits():
            every = torch.arange(self.reference.frames, device=rows.device)
            self._all = torch.cat([self._of(part) for part in every.split(AT_ONCE)])
        return self._of(rows) if self._all is None else self._all.index_select(0, rows)

    def _fits(self) -> bool:
        one = self._of(self.reference.start[:1])
        return one.nbytes * self.reference.frames <= self.most_bytes

    def _of(self, rows: Tensor) -> Tensor:
        packed = self.reference.packed(rows)
        layout = self.reference.layout
        pose, place = headed(layout.unpacked(packed), self.left), layout.place(packed)
        frame = Frame.given(sim=pose, ref=pose, phase=place.phase, min_height=place.low)
        return seen_by(self.terms, frame)

    def past(self, clip: Tensor, frame: Tensor, count: int) -> Tensor | None:
        """`(n, count, F)` of the `count` frames that end with `frame (n,)` of `clip (n,)`.

        NaN where the clip begins later than that; None if it does so for all.
        """
        reference, goes_on = self.reference, self.reference.cyclic[clip]
        frames = frame.unsqueeze(1) + torch.arange(1 - count, 1, device=frame.device)
        known = (frames[:, 0] >= 0) | goes_on
        if not bool(known.any()):
            return None
        # Clips that go on have frames before their first one, too; those of the others are not used.
        frames = torch.where(goes_on.unsqueeze(1), frames, frames.clamp_min(0))
        rows = reference.rows(clip.repeat_interleave(count), frames.flatten())
        seen = self(rows).unflatten(0, (len(clip), count))
        seen[~known] = torch.nan
        return seen


class ClipWindows:
    """Draws windows of the clips for a motion prior; implements the learner's `DemoSampler`.

    Args:
        features: what is seen of the clips' frames.
        frames: W, consecutive frames of a window.
        weights: gives the odds `(C,)` with which clips are drawn now, such as an environment's. Clips
            with fewer frames are left out, unless they go on in cycles; if none remains, all clips that
            have enough are drawn by their length.

    Raises:
        PoiseError: no terms, or no clip with enough frames.
    """

    def __init__(self, features: ClipFeatures, frames: int, weights: Callable[[], Tensor]):
        if not features.terms:
            raise PoiseError(
                "a motion prior needs to know what it sees of a frame",
                hint="Set TaskConfig.style, for instance to observations.style_terms(humanoid)",
                code="settings-conflict",
            )
        self.features, self.frames, self.weights = features, frames, weights
        self.reference = reference = features.reference
        length, cyclic = reference.length.cpu(), reference.cyclic.cpu()
        # From how many frames of each clip a window can begin.
        self._room = torch.where(cyclic, length - 1, (length - frames + 1).clamp_min(0))
        if not bool(self._room.any()):
            raise PoiseError(
                f"no clip has the {frames} frames of a window, the longest has {int(length.max())}",
                hint="Give longer clips, or fewer AmpConfig.frames",
                code="clip-too-short",
            )

    def __call__(self, count: int, generator: torch.Generator) -> Tensor:
        """`(count, W F)` float32, oldest frame first."""
        odds = torch.where(self._room > 0, self.weights(), 0.0)
        if not float(odds.sum()) > 0:
            odds = self._room.double()
        clip = torch.multinomial(odds, count, replacement=True, generator=generator)
        room = self._room[clip]
        u = torch.rand(count, dtype=torch.float64, generator=generator)
        first = torch.minimum((u * room).long(), room - 1)
        return self.at(clip, first)

    def at(self, clip: Tensor, first: Tensor) -> Tensor:
        """The windows that begin with frame `first (n,)` of `clip (n,)`, `(n, W F)`."""
        device = self.reference.length.device
        frames = first.unsqueeze(1) + torch.arange(self.frames)
        clips = clip.repeat_interleave(self.frames)
        rows = self.reference.rows(clips.to(device), frames.flatten().to(device))
        return self.features(rows).view(len(clip), -1)
