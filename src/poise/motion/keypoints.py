"""Points on a body without rotations: what pose estimators and marker systems give."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from poise.errors import PoiseError
from poise.motion.clip import check_rate
from poise.motion.skeleton import Source


@dataclass(frozen=True, eq=False)
class Keypoints:
    """A frozen recording of named points; metres, Z up, right-handed.

    names: `K` unique labels as the file writes them. positions: `(T, K, 3)` m, NaN where a point is
    missing (a point with one missing coordinate is missing). fps: frames per second.
    confidence: `(T, K)` in [0, 1], or None where the file states none; 0 means missing.
    source: format, unit, vertical, and in `notes` what was guessed or repaired.
    """

    names: tuple[str, ...]
    positions: np.ndarray
    fps: float
    name: str = "keypoints"
    confidence: np.ndarray | None = None
    source: Source = field(default_factory=Source)

    def __post_init__(self) -> None:
        positions = np.array(self.positions, dtype=np.float64)
        count = len(self.names)
        if positions.ndim != 3 or positions.shape[1:] != (count, 3):
            raise PoiseError(
                f"positions must be (T, {count}, 3) for {count} names, got {positions.shape}",
                self.name,
                code="wrong-shape",
            )
        if count == 0:
            raise PoiseError("there is no keypoint", self.name, code="no-keypoints")
        seen: set[str] = set()
        for name in self.names:
            if name in seen:
                raise PoiseError(f"keypoint '{name}' appears twice", self.name, code="name-repeated")
            seen.add(name)
        check_rate(self.fps, self.name)
        if np.isinf(positions).any():
            t, k, _ = np.argwhere(np.isinf(positions))[0]
            raise PoiseError(
                f"keypoint '{self.names[k]}' is infinite at frame {t}", self.name, code="not-finite"
            )
        if self.confidence is not None:
            confidence = np.array(self.confidence, dtype=np.float64)
            if confidence.shape != positions.shape[:2]:
                raise PoiseError(
                    f"confidence must be {positions.shape[:2]}, got {confidence.shape}",
                    self.name,
                    code="wrong-shape",
                )
            positions[~(confidence > 0)] = np.nan
            confidence.flags.writeable = False
            object.__setattr__(self, "confidence", confidence)
        positions[np.isnan(positions).any(-1)] = np.nan
        positions.flags.writeable = False
        object.__setattr__(self, "positions", positions)

    @property
    def frames(self) -> int:
        """The number of frames T."""
        return len(self.positions)

    @property
    def missing(self) -> np.ndarray:
        """`(T, K)`, where a keypoint is missing."""
        return np.isnan(self.positions[..., 0])

    def replaced(self, **changes: object) -> Keypoints:
        """A copy with fields replaced."""
        return replace(self, **changes)  # type: ignore[arg-type]
