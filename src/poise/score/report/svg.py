"""Small SVG plots in text: lines with bands, bars, stick figures; and a result in a notebook."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from poise.errors import PoiseError
from poise.formats.text import write_whole
from poise.motion import Clip

COLORS = ("#e0692e", "#3b7ddd", "#7a5cd6", "#1f9d75", "#c2417c", "#8a8f98", "#a88a00")
"""One colour per series, in order; readable on white and on near-black."""

_W, _H = 560, 300
_STYLE = """<style>
.pp{font:13px system-ui,-apple-system,"Segoe UI",Roboto,"Helvetica Neue",sans-serif;
--ink:#1d2129;--soft:#667080;--line:#e4e6ea;--card:#fff}
@media (prefers-color-scheme:dark){.pp{--ink:#eceef2;--soft:#9aa3b0;--line:#2c313a;--card:#171a20}}
.pp text{fill:var(--soft)}.pp .pp-t{fill:var(--ink);font-size:16px;font-weight:600}
.pp .pp-k{fill:var(--ink)}.pp .pp-g{stroke:var(--line);stroke-width:1}
.pp .pp-l{fill:none;stroke-width:2;stroke-linejoin:round;stroke-linecap:round}
</style>"""


def ticks(low: float, high: float, count: int = 5) -> list[float]:
    """About `count` round numbers (1, 2 or 5 times a power of ten) within `[low, high]`."""
    if not (math.isfinite(low) and math.isfinite(high)) or high <= low:
        return [low] if math.isfinite(low) else []
    raw = (high - low) / max(count, 1)
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(m * power for m in (1.0, 2.0, 5.0, 10.0) if m * power >= raw * 0.7)
    first = math.ceil(low / step - 1e-9)
    last = math.floor(high / step + 1e-9)
    return [round(k * step, 12) for k in range(first, last + 1)]


def short(value: float) -> str:
    """A number in few characters: 1234567 becomes 1.2M, 0.25 stays."""
    size = abs(value)
    for limit, letter in ((1e9, "G"), (1e6, "M"), (1e4, "k")):
        if size >= limit:
            return f"{value / (1e3 if letter == 'k' else limit):.3g}{letter}"
    return f"{value:.4g}"


def _numbers(values: Any) -> np.ndarray:
    return np.asarray(values, dtype=np.float64).reshape(-1)


def _path(x: np.ndarray, y: np.ndarray) -> str:
    """Path data with a new stroke after every gap (a value that is not finite)."""
    parts, pen = [], False
    for a, b in zip(x, y, strict=True):
        if math.isfinite(a) and math.isfinite(b):
            parts.append(f"{'L' if pen else 'M'}{a:.1f} {b:.1f}")
            pen = True
        else:
            pen = False
    return "".join(parts)


def _thin(n: int, most: int = 800) -> np.ndarray:
    return np.arange(n) if n <= most else np.unique(np.linspace(0, n - 1, most).round().astype(int))


def _write(text: str, path: Path | str | None) -> str:
    if path is not None:
        write_whole(Path(path), text)
    return text


def _range(values: list[np.ndarray], zero: bool) -> tuple[float, float]:
    flat = np.concatenate([v[np.isfinite(v)] for v in values]) if values else np.zeros(0)
    if flat.size == 0:
        return 0.0, 1.0
    low, high = float(flat.min()), float(flat.max())
    if zero:
        low, high = min(low, 0.0), max(high, 0.0)
    if high - low < 1e-12:
        high = low + max(abs(low), 1.0) * 0.1
    pad = (high - low) * 0.06
    return (low if zero and low == 0 else low - pad), high + pad


def line_plot(
    series: Sequence[Sequence[Any]],
    title: str,
    xlabel: str,
    ylabel: str,
    path: Path | str | None = None,
    *,
    zero: bool = False,
    right: tuple[str, float] | None = None,
    top: tuple[str, Callable[[float], float]] | None = None,
    colors: Sequence[str] = COLORS,
    inline: bool = False,
) -> str:
    """Lines over a shared x axis as one SVG text.

    Args:
        series: `(name, x, y)`, or `(name, x, y, (low, high))` with a shaded band; gaps where NaN.
        path: where to write the file too.
        zero: let the y axis include 0.
        right: label and factor of a second y axis, right value = factor times left value.
        top: label and function of a second x axis.
        inline: for a page that brings style and heading.
    """
    lines = [
        (str(name), _numbers(x), _numbers(y), [_numbers(v) for edges in band for v in edges])
        for name, x, y, *band in series
    ]
    xs = [x for _, x, *_ in lines]
    ys = [v for _, _, y, band in lines for v in (y, *band)]
    flat = np.concatenate([v[np.isfinite(v)] for v in xs]) if xs else np.zeros(0)
    x0, x1 = (float(flat.min()), float(flat.max())) if flat.size else (0.0, 1.0)
    x1 = x1 if x1 > x0 else x0 + 1.0
    y0, y1 = _range(ys, zero)
    left, end = 58.0, _W - (58.0 if right else 16.0)
    # The key has three names a row; from the third row on it pushes the plot down.
    more = 0.0 if inline else 16.0 * max(0, (len(lines) - 1) // 3 - 1)
    up = (12.0 if inline else 62.0) + (34.0 if top else 0.0) + more
    down = _H - 46.0

    def px(v: Any) -> Any:
        return left + (v - x0) / (x1 - x0) * (end - left)

    def py(v: Any) -> Any:
        return down - (v - y0) / (y1 - y0) * (down - up)

    out = [_head(title, inline)]
    for v in ticks(y0, y1):
        y = py(v)
        out.append(f'<line class="pp-g" x1="{left:g}" x2="{end:g}" y1="{y:.1f}" y2="{y:.1f}"/>')
        out.append(f'<text x="{left - 8:g}" y="{y + 4:.1f}" text-anchor="end">{short(v)}</text>')
    for v in ticks(x0, x1, 6):
        out.append(f'<text x="{px(v):.1f}" y="{down + 19:g}" text-anchor="middle">{short(v)}</text>')
        if top:
            text = short(float(f"{top[1](v):.2g}"))
            out.append(f'<text x="{px(v):.1f}" y="{up - 8:g}" text-anchor="middle">{text}</text>')
    if right:
        for v in ticks(y0 * right[1], y1 * right[1]):
            y = py(v / right[1]) + 4
            out.append(f'<text x="{end + 8:g}" y="{y:.1f}">{short(v)}</text>')
    sides = (right[0] if right else "", top[0] if top else "")
    out.append(_labels(xlabel, ylabel, *sides, left, end, up, down))
    plot: dict[str, Any] = {"x": [x0, x1], "px": [left, end], "py": [up, down], "w": _W, "series": []}
    for k, (name, x, y, band) in enumerate(lines):
        color = colors[k % len(colors)]
        keep = _thin(len(x))
        if band:
            low, high = band
            ok = np.isfinite(x) & np.isfinite(low) & np.isfinite(high)
            edge = np.concatenate([px(x[ok]), px(x[ok])[::-1]])
            rim = np.concatenate([py(high[ok]), py(low[ok])[::-1]])
            if edge.size:
                out.append(f'<path d="{_path(edge, rim)}Z" fill="{color}" opacity=".16"/>')
        if np.isfinite(y).sum() == 1:
            one = int(np.argmax(np.isfinite(y)))
            out.append(f'<circle cx="{px(x[one]):.1f}" cy="{py(y[one]):.1f}" r="4" fill="{color}"/>')
        out.append(f'<path class="pp-l" stroke="{color}" d="{_path(px(x[keep]), py(y[keep]))}"/>')
        if not inline:
            out.append(_key(k, name, color))
        plot["series"].append({"name": name, "color": color, "x": _few(x[keep]), "y": _few(y[keep])})
    data = escape(json.dumps(plot, separators=(",", ":")), quote=True)
    carried = f' data-plot="{data}"' if inline else ""
    return _write("".join(out).replace(" data-plot", carried, 1) + "</svg>", path)


def bar_plot(
    items: Sequence[tuple[str, float]],
    title: str,
    xlabel: str,
    *,
    most: float | None = None,
    color: str = COLORS[0],
    inline: bool = False,
) -> str:
    """Horizontal bars, one per `(name, value)`; `most` fixes the full length of the axis."""
    up, row = (8.0 if inline else 44.0), 30.0
    down = up + row * max(len(items), 1)
    height = down + 46.0
    left, end = 150.0, _W - 60.0
    finite = [v for _, v in items if math.isfinite(v)]
    low, high = min([0.0, *finite]), most if most is not None else max([0.0, *finite])
    high = max(high, *finite, low + 1e-9) if finite else 1.0
    out = [_head(title, inline, height)]

    def px(v: float) -> float:
        return left + (v - low) / (high - low) * (end - left)

    for v in ticks(low, high):
        out.append(f'<line class="pp-g" x1="{px(v):.1f}" x2="{px(v):.1f}" y1="{up:g}" y2="{down:g}"/>')
        out.append(f'<text x="{px(v):.1f}" y="{down + 19:g}" text-anchor="middle">{short(v)}</text>')
    for k, (name, value) in enumerate(items):
        y = up + row * k
        shown = name if len(name) <= 20 else name[:19] + "…"
        out.append(
            f'<text class="pp-k" x="{left - 10:g}" y="{y + 20:g}" text-anchor="end">{escape(shown)}'
            f"<title>{escape(name)}</title></text>"
        )
        if math.isfinite(value):
            a, b = sorted((px(0.0), px(value)))
            out.append(
                f'<rect x="{a:.1f}" y="{y + 6:g}" width="{b - a:.1f}" height="18" rx="4" fill="{color}">'
                f"<title>{escape(name)}: {value:.4g}</title></rect>"
            )
        text = f"{value:.3g}" if math.isfinite(value) else "no value"
        x = max(px(value), px(0.0)) if math.isfinite(value) else px(0.0)
        out.append(f'<text class="pp-k" x="{x + 8:.1f}" y="{y + 20:g}">{text}</text>')
    out.append(_labels(xlabel, "", "", "", left, end, up, down))
    return "".join(out).replace(" data-plot", "", 1) + "</svg>"


def _few(values: np.ndarray) -> list[float | None]:
    return [float(f"{v:.5g}") if math.isfinite(v) else None for v in values]


def _head(title: str, inline: bool, height: float = _H) -> str:
    name = escape(title, quote=True)
    if inline:
        return f'<svg class="pp" viewBox="0 0 {_W} {height:g}" role="img" aria-label="{name}" data-plot>'
    return (
        f'<svg class="pp" xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_W} {height:g}" width="{_W}" '
        f'height="{height:g}" role="img" aria-label="{name}" data-plot>{_STYLE}'
        f'<rect width="100%" height="100%" rx="10" style="fill:var(--card)"/>'
        f'<text class="pp-t" x="16" y="27">{escape(title)}</text>'
    )


def _key(k: int, name: str, color: str) -> str:
    x, y = 18 + (k % 3) * 182, 47 + (k // 3) * 16
    return (
        f'<rect x="{x}" y="{y - 6}" width="14" height="4" rx="2" fill="{color}"/>'
        f'<text class="pp-k" x="{x + 20}" y="{y}">{escape(name[:26])}</text>'
    )


def _labels(
    x: str, y: str, right: str, top: str, left: float, end: float, up: float, down: float
) -> str:
    mid, centre = (left + end) / 2, (up + down) / 2
    out = [f'<text x="{mid:g}" y="{down + 38:g}" text-anchor="middle">{escape(x)}</text>']
    if y:
        turn = f"translate(15 {centre:g}) rotate(-90)"
        out.append(f'<text transform="{turn}" text-anchor="middle">{escape(y)}</text>')
    if right:
        out.append(
            f'<text transform="translate({end + 50:g} {centre:g}) rotate(90)" text-anchor="middle">'
            f"{escape(right)}</text>"
        )
    if top:
        out.append(f'<text x="{mid:g}" y="{up - 24:g}" text-anchor="middle">{escape(top)}</text>')
    return "".join(out)


_POSES_STYLE = """<style>
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
                    f"'{row.name}' has not the {len(parents)} joints or {max(frames)} frames",
                    code="count-differs",
                )
    side = _busiest(rows[0].pos if rows[0].ghost is None else rows[0].ghost)
    right = np.array([np.cos(side), np.sin(side), 0.0])
    width = 2 * _LEFT + _STEP * (len(frames) - 1)
    height = _TOP + len(rows) * (_SIZE + _GAP) + 14
    out = [
        f'<svg class="pf" xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:g} {height:g}" '
        f'width="{width:g}" height="{height:g}" role="img" aria-label="{escape(title, quote=True)}">',
        _POSES_STYLE,
        '<rect class="bg" width="100%" height="100%" rx="10"/>',
        f'<text class="t" x="16" y="26">{escape(title)}</text>',
    ]
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
    unit, verdict), see `score.card.table`. keys: frames that are drawn in the ink's colour, such as
    keyframes.
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
