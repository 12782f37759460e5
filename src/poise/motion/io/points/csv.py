"""Keypoints in a table of text: a header that names the columns, then one row per frame.

```
# unit = m, up = Z, fps = 60
time,LHip_x,LHip_y,LHip_z,RHip_x,RHip_y,RHip_z,...
0.0000,0.112,-0.03,0.941,...
```

Separated by commas, semicolons or tabs. `time` (s) or `frame` may come first; without times, `fps` must
stand in the comment or be given. A column `NAME_confidence` (0 to 1) may follow each point. Blank cells
and NaN are missing points. Unit and vertical are guessed where the comment does not state them.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from poise.errors import PoiseError
from poise.motion.io.guess import UPS
from poise.motion.io.points.raw import UNITS_M, RawPoints
from poise.motion.io.raw import UNSTATED, ReadOptions
from poise.motion.io.refused import FLAT_HINT
from poise.motion.io.tables import number, row_numbers
from poise.motion.io.text import CUT_OFF, at_line, decode, listed, read_bytes, shown

_COLUMN = re.compile(r"^(.+?)[_. :]?(?:pos[_.]?)?\(?([xyz])\)?$", re.IGNORECASE)
_SCORE = re.compile(r"^(.+?)[_. :](?:c|confidence|conf|score|likelihood|visibility)$", re.IGNORECASE)
_TIMES = {"time", "t", "times", "timestamp", "seconds", "time_s", "time (s)"}
_FRAMES = {"frame", "frame#", "frames", "index", "frame_index", "fnum", "#", ""}


@dataclass(frozen=True)
class _Layout:
    """Which column is what: label -> columns of x, y, z; label -> column of its confidence."""

    header: list[str]
    points: dict[str, tuple[int, int, int]]
    scores: dict[str, int]
    time: int | None


def looks_like_points_csv(head: bytes) -> bool:
    """Whether a file's first bytes are a header that names at least one point's x, y and z."""
    lines = [
        x for x in head.decode("utf-8", "replace").splitlines() if x.strip() and x.strip()[0] != "#"
    ]
    if not lines or "\0" in lines[0]:
        return False
    columns = [m for cell in _split(lines[0], _mark(lines[0])) if (m := _COLUMN.match(cell.strip()))]
    axes = {(m.group(1).lower(), m.group(2).lower()) for m in columns}
    return sum((name, "y") in axes for name, axis in axes if axis == "x") >= 4


def csv_points(path: Path, options: ReadOptions = UNSTATED) -> RawPoints:
    """The points of a table in its own unit and axes.

    Raises:
        PoiseError: no header, a wrong number of columns, a cell that is no number, no rate; 2D points.
    """
    lines = [decode(line, path, i + 1) for i, line in enumerate(read_bytes(path).splitlines())]
    stated: dict[str, str] = {}
    at = 0
    while at < len(lines) and (not lines[at].strip() or lines[at].lstrip()[0] == "#"):
        stated.update(re.findall(r"\b(\w{1,30})\s*[=:]\s*([^\s,;]+)", lines[at].lower()))
        at += 1
    if at == len(lines):
        raise PoiseError("the table has no header", path, CUT_OFF)
    # The header tells what stands between cells; rows may hold decimal commas as well.
    mark = _mark(lines[at])
    layout = _layout(_split(lines[at], mark), path, at + 1)
    table = _rows(lines, at + 1, layout, path, mark)
    rate = _rate(table, layout, stated, options, path)
    positions = np.stack([table[:, list(columns)] for columns in layout.points.values()], 1)
    scores = None
    if layout.scores:
        scores = np.ones(positions.shape[:2])
        for k, name in enumerate(layout.points):
            if name in layout.scores:
                scores[:, k] = np.nan_to_num(table[:, layout.scores[name]])
    unit, up = stated.get("unit"), stated.get("up", "").upper()
    if unit is not None and unit not in UNITS_M:
        raise PoiseError(f"the unit {shown(unit)} is not known", path, f"Known: {', '.join(UNITS_M)}")
    if up not in ("", *UPS):
        raise PoiseError(f"up must be one of {', '.join(UPS)}, got {shown(up)}", path)
    return RawPoints(
        "csv", path, tuple(layout.points), positions, rate, UNITS_M.get(unit or ""), up or None, scores
    )


def _mark(header: str) -> str:
    return max(",;\t", key=header.count)


def _split(line: str, mark: str) -> list[str]:
    return [cell.strip().strip('"') for cell in line.rstrip("\r\n").split(mark)]


def _layout(header: list[str], path: Path, line: int) -> _Layout:
    where = at_line(path, line)
    axes: dict[str, dict[str, int]] = {}
    scores: dict[str, int] = {}
    time: int | None = None
    other: list[str] = []
    for k, cell in enumerate(header):
        if cell.lower() in _TIMES and time is None:
            time = k
        elif cell.lower() in _FRAMES:
            continue
        elif match := _COLUMN.match(cell):
            name, axis = match.group(1), match.group(2).lower()
            if axis in axes.setdefault(name, {}):
                raise PoiseError(f"the column {shown(cell)} appears twice", where)
            axes[name][axis] = k
        elif match := _SCORE.match(cell):
            scores[match.group(1)] = k
        else:
            other.append(cell)
    whole = {n: (a["x"], a["y"], a["z"]) for n, a in axes.items() if len(a) == 3}
    broken = [n for n in axes if n not in whole]
    if axes and all(set(axes[n]) == {"x", "y"} for n in axes):
        raise PoiseError("its keypoints have x and y and no z: they are 2D", where, FLAT_HINT)
    if broken:
        lacks = ", ".join(a for a in "xyz" if a not in axes[broken[0]])
        raise PoiseError(f"keypoint {shown(broken[0])} has no column for {lacks}", where)
    if not whole:
        raise PoiseError(
            f"the header names no keypoint (columns: {listed(map(shown, other))})",
            where,
            "Name the columns NAME_x, NAME_y, NAME_z",
        )
    return _Layout(header, whole, scores, time)


def _rows(lines: list[str], first: int, layout: _Layout, path: Path, mark: str) -> np.ndarray:
    width = len(layout.header)
    out: list[list[float]] = []
    used = {k for columns in layout.points.values() for k in columns} | set(layout.scores.values())
    used |= set() if layout.time is None else {layout.time}
    for i in range(first, len(lines)):
        if not lines[i].strip():
            continue
        cells = _split(lines[i], mark)
        if len(cells) != width:
            raise PoiseError(
                f"it has {len(cells)} columns and the header names {width}", at_line(path, i + 1)
            )
        # Columns that are no points (a subject's name, a label) may hold anything.
        cells = [c if k in used else "" for k, c in enumerate(cells)]
        out.append(row_numbers(cells, lambda k: layout.header[k], path, i + 1))
    if not out:
        raise PoiseError("the table has a header and no frames", path, CUT_OFF)
    return np.array(out)


def _rate(
    table: np.ndarray, layout: _Layout, stated: dict[str, str], options: ReadOptions, path: Path
) -> float:
    """Frames per second: stated by the caller, by the comment, or measured on the times."""
    if options.fps is not None:
        return options.fps
    if "fps" in stated:
        return number(stated["fps"], path.name)
    if layout.time is None:
        raise PoiseError(
            "the table has neither times nor a frame rate", path, "State it with --fps FRAMES_PER_SECOND"
        )
    return measured_rate(table[:, layout.time], path)


def measured_rate(times: np.ndarray, path: Path) -> float:
    """Frames per second of even times (s); uneven ones are refused with the frame."""
    if not np.isfinite(times).all():
        raise PoiseError(f"frame {int(np.argwhere(~np.isfinite(times))[0][0])} has no time", path)
    steps = np.diff(times)
    step = float(np.median(steps)) if len(steps) else 0.0
    if not step > 0:
        raise PoiseError(
            "its times do not increase", path, "State the rate with --fps FRAMES_PER_SECOND"
        )
    odd = np.flatnonzero(np.abs(steps / step - 1) > 0.5)
    if len(odd):
        raise PoiseError(
            f"its times are uneven: frame {odd[0] + 1} comes {steps[odd[0]]:.4g} s after the one "
            f"before, the usual step is {step:.4g} s",
            path,
            "Resample the table, or state the rate with --fps FRAMES_PER_SECOND",
        )
    # The mean step is more exact than the median of rounded times.
    return 1.0 / float(np.mean(steps))
