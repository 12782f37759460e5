"""Limits of all motion, whatever its format: frame rates, and frames times joints."""

from __future__ import annotations

from pathlib import Path

from poise.errors import PoiseError

MIN_FPS, MAX_FPS = 0.1, 2000.0
"""Frames per second that motion can have; others are damage, and ask for endless frames."""
MAX_POSES = 20_000_000
"""Frames times joints of the longest motion that is read (22 joints at 120 Hz: two hours)."""


def check_rate(fps: float, where: str | Path | None = None) -> None:
    """Refuses a frame rate that no motion has, NaN and 0 too."""
    if not MIN_FPS <= fps <= MAX_FPS:
        raise PoiseError(
            f"the frame rate must be from {MIN_FPS:g} to {MAX_FPS:g} per second, got {fps:.6g}",
            where,
            "State the right one with --fps F" if isinstance(where, Path) else None,
        )


def check_poses(frames: int, joints: int, where: str | Path | None = None) -> None:
    """Refuses motion that is too long to be held in memory several times over."""
    if frames * joints > MAX_POSES:
        raise PoiseError(
            f"it has {frames} frames of {joints} joints, more than the {MAX_POSES} poses that are read",
            where,
            "Cut it shorter, or state a lower rate with --fps F",
        )
