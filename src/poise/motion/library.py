"""Several clips of one skeleton as one source of motion; a single clip is a library of one."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from poise.errors import PoiseError
from poise.motion.clip import Clip


@dataclass(frozen=True)
class ClipLibrary:
    """Clips of one hierarchy, sampled by time.

    clips: at least one clip; all share joint names and parents (bone lengths may differ).
    weights: `(C,)` sampling weights; by default each clip counts by its duration.
    """

    clips: tuple[Clip, ...]
    weights: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if not self.clips:
            raise PoiseError("a library needs at least one clip")
        first = self.clips[0].skeleton
        for clip in self.clips[1:]:
            if clip.skeleton.names != first.names or clip.skeleton.parents != first.parents:
                raise PoiseError(
                    f"its joints differ from those of '{self.clips[0].name}'",
                    clip.name,
                    "Give one library clips of one hierarchy",
                )
        if not self.weights:
            object.__setattr__(self, "weights", tuple(c.seconds for c in self.clips))
        if len(self.weights) != len(self.clips) or min(self.weights) < 0 or sum(self.weights) <= 0:
            raise PoiseError(
                f"a library of {len(self.clips)} clips needs as many weights, none negative and not "
                f"all zero, got {self.weights}"
            )

    @classmethod
    def of(cls, clips: Clip | Sequence[Clip]) -> ClipLibrary:
        """A library from one clip or several."""
        return cls((clips,) if isinstance(clips, Clip) else tuple(clips))

    def __len__(self) -> int:
        return len(self.clips)

    def __iter__(self) -> Iterator[Clip]:
        return iter(self.clips)

    @property
    def names(self) -> tuple[str, ...]:
        """The clips' names in order."""
        return tuple(c.name for c in self.clips)

    @property
    def seconds(self) -> float:
        """Total duration in seconds."""
        return sum(c.seconds for c in self.clips)

    def sample(self, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """`count` draws of (clip index, time in s), clips by weight, times uniform in the clip."""
        p = np.asarray(self.weights) / sum(self.weights)
        which = rng.choice(len(self.clips), size=count, p=p)
        lengths = np.array([c.seconds for c in self.clips])
        return which, rng.uniform(0.0, 1.0, count) * lengths[which]
