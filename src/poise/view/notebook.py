"""A result in a notebook: its poses over those of the source, its figures, its notes; no script."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

import numpy as np

from poise.motion import Clip
from poise.view.poses import PoseRow, pose_rows

#: Moments that are drawn.
MOMENTS = 13
_CELL = "text-align:{side};padding:2px 14px 2px 0"


def result_html(
    title: str,
    clip: Clip,
    source: Clip | None = None,
    rows: Sequence[tuple[str, float, str, str]] = (),
    notes: Sequence[str] = (),
    keys: Sequence[int] = (),
) -> str:
    """A self-contained piece of HTML, a few tens of kB, all text escaped.

    source: what the motion is of, drawn grey beneath it, on the same skeleton. rows: (label, value,
    unit, verdict), see `eval.table`. keys: frames that are drawn in the ink's colour, such as keyframes.
    """
    frames, ghost = clip.frames, None
    if source is not None and source.skeleton.names == clip.skeleton.names:
        frames, ghost = min(frames, source.frames), source.positions()
    picks = np.unique(np.linspace(0, frames - 1, min(MOMENTS, frames)).round().astype(int)).tolist()
    row = PoseRow(clip.name, clip.positions(), ghost)
    picture = pose_rows(title, [row], clip.skeleton.parents, picks, clip.fps, keys)
    return f'<div style="overflow-x:auto">{picture}{_table(rows)}{_list(notes)}</div>'


def _table(rows: Sequence[tuple[str, float, str, str]]) -> str:
    if not rows:
        return ""
    left, right = (_CELL.format(side=side) for side in ("left", "right"))
    lines = [
        f'<tr><td style="{left}">{escape(label)}</td>'
        f'<td style="{right}">{f"{value:,.4g}" if np.isfinite(value) else "-"}</td>'
        f'<td style="{left}">{escape(unit)}</td><td style="{left}">{escape(verdict)}</td></tr>'
        for label, value, unit, verdict in rows
    ]
    return f"<table>{''.join(lines)}</table>"


def _list(notes: Sequence[str]) -> str:
    return f"<ul>{''.join(f'<li>{escape(n)}</li>' for n in notes)}</ul>" if notes else ""
