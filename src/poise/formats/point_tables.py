"""Keypoints in tables of text: CSV with a header that names the columns, and TRC."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from poise.errors import PoiseError
from poise.formats.arrays import rate_in
from poise.formats.guess import UPS
from poise.formats.point_raw import UNITS_M, RawPoints
from poise.formats.raw import UNSTATED, ReadOptions
from poise.formats.refused import FLAT_HINT
from poise.formats.text import CUT_OFF, at_line, decode, listed, number, read_bytes, row_numbers, shown

_COLUMN = re.compile(r"^(.+?)[_. :]?(?:pos[_.]?)?\(?([xyz])\)?$", re.IGNORECASE)
_SCORE = re.compile(r"^(.+?)[_. :](?:c|confidence|conf|score|likelihood|visibility)$", re.IGNORECASE)
_TIMES = {"time", "t", "times", "timestamp", "seconds", "time_s", "time (s)"}
_FRAMES = {"frame", "frame#", "frames", "index", "frame_index", "fnum", "#", ""}


@dataclass(frozen=True)
class _Columns:
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
    """The points of a table in its own unit and axes: a header that names the columns, a row per frame.

        # unit = m, up = Z, fps = 60
        time,LHip_x,LHip_y,LHip_z,RHip_x,RHip_y,RHip_z,...
        0.0000,0.112,-0.03,0.941,...

    Commas, semicolons or tabs separate the cells. `time` (s) or `frame` may come first; without times,
    the comment or the caller must state `fps`. A column `NAME_confidence` (0 to 1) may follow each
    point. Blank cells and NaN are missing points. Unit and vertical are guessed where the comment does
    not state them.

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
        raise PoiseError("the table has no header", path, CUT_OFF, code="file-cut-off")
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
        raise PoiseError(
            f"the unit {shown(unit)} is not known",
            path,
            f"Known: {', '.join(UNITS_M)}",
            code="unit-unknown",
        )
    if up not in ("", *UPS):
        raise PoiseError(
            f"up must be one of {', '.join(UPS)}, got {shown(up)}", path, code="unknown-axis"
        )
    return RawPoints(
        "csv", path, tuple(layout.points), positions, rate, UNITS_M.get(unit or ""), up or None, scores
    )


def _mark(header: str) -> str:
    return max(",;\t", key=header.count)


def _split(line: str, mark: str) -> list[str]:
    return [cell.strip().strip('"') for cell in line.rstrip("\r\n").split(mark)]


def _layout(header: list[str], path: Path, line: int) -> _Columns:
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
                raise PoiseError(f"the column {shown(cell)} appears twice", where, code="name-repeated")
            axes[name][axis] = k
        elif match := _SCORE.match(cell):
            scores[match.group(1)] = k
        else:
            other.append(cell)
    whole = {n: (a["x"], a["y"], a["z"]) for n, a in axes.items() if len(a) == 3}
    broken = [n for n in axes if n not in whole]
    if axes and all(set(axes[n]) == {"x", "y"} for n in axes):
        raise PoiseError(
            "its keypoints have x and y and no z: they are 2D", where, FLAT_HINT, code="flat-keypoints"
        )
    if broken:
        lacks = ", ".join(a for a in "xyz" if a not in axes[broken[0]])
        raise PoiseError(
            f"keypoint {shown(broken[0])} has no column for {lacks}", where, code="column-missing"
        )
    if not whole:
        raise PoiseError(
            f"the header names no keypoint (columns: {listed(map(shown, other))})",
            where,
            "Name the columns NAME_x, NAME_y, NAME_z",
            code="no-keypoints",
        )
    return _Columns(header, whole, scores, time)


def _rows(lines: list[str], first: int, layout: _Columns, path: Path, mark: str) -> np.ndarray:
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
                f"it has {len(cells)} columns and the header names {width}",
                at_line(path, i + 1),
                code="row-width",
            )
        # Columns that are no points (a subject's name, a label) may hold anything.
        cells = [c if k in used else "" for k, c in enumerate(cells)]
        out.append(row_numbers(cells, lambda k: layout.header[k], path, i + 1))
    if not out:
        raise PoiseError("the table has a header and no frames", path, CUT_OFF, code="no-frames")
    return np.array(out)


def _rate(
    table: np.ndarray, layout: _Columns, stated: dict[str, str], options: ReadOptions, path: Path
) -> float:
    """Frames per second: stated by the caller, by the comment, or measured on the times."""
    if options.fps is not None:
        return options.fps
    if "fps" in stated:
        return number(stated["fps"], path.name)
    if layout.time is None:
        raise PoiseError(
            "the table has neither times nor a frame rate",
            path,
            "State it with --fps FRAMES_PER_SECOND",
            code="rate-missing",
        )
    return measured_rate(table[:, layout.time], path)


def measured_rate(times: np.ndarray, path: Path) -> float:
    """Frames per second of even times (s); uneven ones are refused with the frame."""
    if not np.isfinite(times).all():
        raise PoiseError(
            f"frame {int(np.argwhere(~np.isfinite(times))[0][0])} has no time",
            path,
            code="times-unusable",
        )
    steps = np.diff(times)
    step = float(np.median(steps)) if len(steps) else 0.0
    if not step > 0:
        raise PoiseError(
            "its times do not increase",
            path,
            "State the rate with --fps FRAMES_PER_SECOND",
            code="times-not-rising",
        )
    odd = np.flatnonzero(np.abs(steps / step - 1) > 0.5)
    if len(odd):
        raise PoiseError(
            f"its times are uneven: frame {odd[0] + 1} comes {steps[odd[0]]:.4g} s after the one "
            f"before, the usual step is {step:.4g} s",
            path,
            "Resample the table, or state the rate with --fps FRAMES_PER_SECOND",
            code="times-uneven",
        )
    # The mean step is more exact than the median of rounded times.
    return 1.0 / float(np.mean(steps))


_LABEL_LINE = 3


@dataclass(frozen=True)
class _Header:
    fields: dict[str, str]
    names: tuple[str, ...]
    first: int

    def column(self, k: int) -> str:
        """The name of column `k`, for errors."""
        return ("Frame#", "Time")[k] if k < 2 else f"{self.names[(k - 2) // 3]} {'XYZ'[(k - 2) % 3]}"


def looks_like_trc(head: bytes) -> bool:
    """Whether a file's first bytes are a TRC header."""
    return (
        head[:12].lower() == b"pathfiletype"
        or re.search(rb"\ndatarate[\t ]", head[:2000].lower()) is not None
    )


def trc_points(path: Path, options: ReadOptions = UNSTATED) -> RawPoints:
    """The points of a TRC file in its own unit and axes.

    Rate and unit come from the header; the vertical is guessed. Blank cells are missing points.

    Raises:
        PoiseError: a header, row or cell that cannot be read, with its line and column.
    """
    lines = [decode(line, path, i + 1) for i, line in enumerate(read_bytes(path).splitlines())]
    header = _header(lines, path)
    rows = _rows_trc(lines, header, path)
    notes: list[str] = []
    stated = header.fields.get("numframes", "")
    if stated.isdigit() and int(stated) != len(rows):
        notes.append(f"The header states {stated} frames, the file has {len(rows)}: these were read")
    unit_name = header.fields.get("units", "").lower()
    unit = UNITS_M.get(unit_name)
    if unit is None and unit_name:
        notes.append(f"The unit {shown(unit_name)} is not known (known: {', '.join(UNITS_M)})")
    positions = rows[:, 2:].reshape(len(rows), -1, 3)
    return RawPoints(
        format="trc",
        path=path,
        names=header.names,
        positions=positions,
        fps=_rate_trc(header, rows[:, 1], path, notes),
        unit_m=unit,
        notes=tuple(notes),
    )


def _header(lines: list[str], path: Path) -> _Header:
    """The header's fields (lower-case name -> value), the labels, and the index of the first row."""
    if len(lines) <= _LABEL_LINE:
        raise PoiseError("the file ends within its header", path, CUT_OFF, code="file-cut-off")
    keys, values = (line.rstrip("\t ").split("\t") for line in lines[1:3])
    if len(values) < len(keys) or len(keys) < 2:
        keys, values = lines[1].split(), lines[2].split()
    fields = {k.strip().lower(): v.strip() for k, v in zip(keys, values, strict=False)}
    if "datarate" not in fields:
        raise PoiseError(
            "the TRC header has no DataRate", at_line(path, 2), CUT_OFF, code="rate-missing"
        )
    cells = _cells(lines[_LABEL_LINE].rstrip("\t "))
    labels = [c.strip() for c in cells[2:] if c.strip()]
    if len(cells) < 3 or not cells[0].strip().lower().startswith("frame") or not labels:
        raise PoiseError(
            "the labels of the points were expected: Frame#, Time, then one per point",
            at_line(path, _LABEL_LINE + 1),
            code="keyword-expected",
        )
    twice = next((name for name, count in Counter(labels).items() if count > 1), None)
    if twice is not None:
        raise PoiseError(
            f"keypoint {shown(twice)} appears twice",
            at_line(path, _LABEL_LINE + 1),
            code="name-repeated",
        )
    stated = fields.get("nummarkers", "")
    if stated.isdigit() and int(stated) != len(labels):
        raise PoiseError(
            f"the header states {stated} markers and there are {len(labels)} labels",
            at_line(path, _LABEL_LINE + 1),
            code="count-differs",
        )
    return _Header(fields, tuple(labels), _first_row(lines))


def _cells(line: str) -> list[str]:
    """The cells of a row; files that went through an editor have blanks for tabs."""
    return line.split("\t") if "\t" in line else line.split()


def _first_row(lines: list[str]) -> int:
    """The line after "X1 Y1 Z1 ...", and after a blank one where there is one."""
    at = _LABEL_LINE + 1
    while at < len(lines) and not lines[at].lstrip()[:1].isdigit():
        at += 1
    return at


def _rows_trc(lines: list[str], header: _Header, path: Path) -> np.ndarray:
    """`(T, 2 + 3 K)` frame number, time, coordinates; NaN where a cell is blank."""
    width = 2 + 3 * len(header.names)
    out: list[list[float]] = []
    for i in range(header.first, len(lines)):
        if not lines[i].strip():
            continue
        cells = _cells(lines[i])
        # Trailing tabs are usual, and trailing blank cells may have been trimmed.
        while len(cells) > width and not cells[-1].strip():
            cells.pop()
        if len(cells) != width and not (
            len(cells) < width and (len(cells) - 2) % 3 == 0 and len(cells) > 2
        ):
            raise PoiseError(
                f"it has {len(cells)} columns and needs {width}: frame, time and 3 for each of "
                f"{len(header.names)} points",
                at_line(path, i + 1),
                code="row-width",
            )
        cells += [""] * (width - len(cells))
        out.append(row_numbers(cells, header.column, path, i + 1))
    if not out:
        raise PoiseError("the file has a header and no frames", path, CUT_OFF, code="no-frames")
    return np.array(out)


def _rate_trc(header: _Header, times: np.ndarray, path: Path, notes: list[str]) -> float:
    """Frames per second: the header's DataRate, checked with the times."""
    text = header.fields["datarate"]
    rate = found if (found := rate_in(text)) is not None else number(text, at_line(path, 3))
    steps = np.diff(times[np.isfinite(times)])
    measured = 1.0 / float(np.median(steps)) if len(steps) and np.median(steps) > 0 else None
    if not rate > 0:
        if measured is None:
            raise PoiseError(
                f"DataRate is {rate:g} and must be above 0",
                at_line(path, 3),
                "State the rate with --fps F",
                code="rate-out-of-range",
            )
        notes.append(f"DataRate is {rate:g}: {measured:.5g} frames per second taken from the times")
        return measured
    if measured is not None and abs(measured / rate - 1) > 0.02:
        notes.append(
            f"The times step at {measured:.5g} frames per second and DataRate is {rate:g}, "
            "which was taken"
        )
    return rate
