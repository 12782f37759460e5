"""Stick figures of motions side by side, moment after moment, as an SVG."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

import numpy as np

from poise.errors import PoiseError
from poise.view.svg import COLORS, _write

_STYLE = """<style>
.pf{font:13px system-ui,-apple-system,"Segoe UI",Roboto,"Helvetica Neue",sans-serif}
.pf .bg{fill:#fff}.pf text{fill:#667080}.pf .t{fill:#1d2129;font-size:15px;font-weight:600}
.pf .floor{stroke:#c9ccd2}.pf .key{stroke:#1d2129}.pf path{fill:none;stroke-width:1.7;
stroke-linejoin:round;stroke-linecap:round}.pf .ghost{stroke:#b3b8c1}
@media (prefers-color-scheme:dark){.pf .bg{fill:#171a20}.pf text{fill:#9aa3b0}.pf .t{fill:#eceef2}
.pf .floor{stroke:#2c313a}.pf .key{stroke:#eceef2}.pf .ghost{stroke:#566070}}
</style>"""
_SIZE, _STEP, _LEFT, _TOP, _GAP = 110.0, 74.0, 62.0, 58.0, 34.0


@dataclass(frozen=True)
class PoseRow:
    """One row of poses.

    Attributes:
        name: of the row.
        pos: `(T, J, 3)` m, joints of a motion.
        ghost: `(T, J, 3)` m, joints of another motion, drawn grey beneath it, or None.
    """

    name: str
    pos: np.ndarray
    ghost: np.ndarray | None = None


def pose_rows(
    title: str,
    rows: Sequence[PoseRow],
    parents: Sequence[int],
    frames: Sequence[int],
    fps: float,
    keys: Sequence[int] = (),
    path: Path | str | None = None,
) -> str:
    """Rows of figures seen from beside a walk, Z up; figures of `keys` are drawn in the ink's colour.

    A row's figures stand side by side, each about the ghost's root (or its own), so that what lies apart
    at one moment is seen apart.

    Args:
        frames: the moments shown.
        path: also writes the SVG there.

    Raises:
        PoiseError: motions that lack a frame or differ in their joints.
    """
    for row in rows:
        for pos in (row.pos, row.ghost):
            if pos is not None and (pos.shape[1:] != (len(parents), 3) or max(frames) >= len(pos)):
                raise PoiseError(
                    f"'{row.name}' has not the {len(parents)} joints or {max(frames)} frames"
                )
    side = _busiest(rows[0].pos if rows[0].ghost is None else rows[0].ghost)
    right = np.array([np.cos(side), np.sin(side), 0.0])
    width = 2 * _LEFT + _STEP * (len(frames) - 1)
    height = _TOP + len(rows) * (_SIZE + _GAP) + 14
    out = [
        f'<svg class="pf" xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:g} {height:g}" '
        f'width="{width:g}" height="{height:g}" role="img" aria-label="{escape(title, quote=True)}">',
        _STYLE, '<rect class="bg" width="100%" height="100%" rx="10"/>',
        f'<text class="t" x="16" y="26">{escape(title)}</text>',
    ]  # fmt: skip
    tall = max(float(row.pos[list(frames), :, 2].max()) for row in rows)
    scale = _SIZE / max(tall, 1e-6)
    for r, row in enumerate(rows):
        floor = _TOP + r * (_SIZE + _GAP) + _SIZE
        out.append(f'<text x="16" y="{floor - _SIZE - 8:g}">{escape(row.name)}</text>')
        out.append(f'<path class="floor" d="M16 {floor:g}H{width - 16:g}"/>')
        for k, frame in enumerate(frames):
            about = (row.pos if row.ghost is None else row.ghost)[frame, 0]
            x = _LEFT + k * _STEP

            def drawn(pos: np.ndarray, x: float = x, about: np.ndarray = about, y: float = floor) -> str:
                flat = np.stack((x + (pos - about) @ right * scale, y - pos[:, 2] * scale), -1)
                bones = [(p, j) for j, p in enumerate(parents) if p >= 0]
                return "".join(
                    f"M{flat[a, 0]:.1f} {flat[a, 1]:.1f}L{flat[b, 0]:.1f} {flat[b, 1]:.1f}"
                    for a, b in bones
                )

            if row.ghost is not None:
                out.append(f'<path class="ghost" d="{drawn(row.ghost[frame])}"/>')
            kind = 'class="key"' if frame in keys else f'style="stroke:{COLORS[1]}"'
            out.append(f'<path {kind} d="{drawn(row.pos[frame])}"/>')
            if r == len(rows) - 1:
                seconds = f"{(frame - frames[0]) / fps:.2g} s"
                out.append(f'<text x="{x:g}" y="{floor + 18:g}" text-anchor="middle">{seconds}</text>')
    return _write("".join([*out, "</svg>"]), path)


def _busiest(pos: np.ndarray) -> float:
    """Azimuth, rad, of the level line along which joints `(T, J, 3)` move most about the root."""
    about = (pos - pos[:, :1])[..., :2]
    moved = (about - about.mean(0)).reshape(-1, 2)
    line = np.linalg.eigh(moved.T @ moved)[1][:, -1]
    # Forward motion goes to the right.
    path = pos[-1, 0, :2] - pos[0, 0, :2]
    line = -line if line @ path < 0 else line
    return float(np.arctan2(line[1], line[0]))
