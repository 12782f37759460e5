"""TRC files: tab-separated 3D points of markers or triangulated keypoints."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from poise.errors import PoiseError
from poise.motion.io.numpy.arrays import rate_in
from poise.motion.io.points.raw import UNITS_M, RawPoints
from poise.motion.io.raw import UNSTATED, ReadOptions
from poise.motion.io.tables import number, row_numbers
from poise.motion.io.text import CUT_OFF, at_line, decode, read_bytes, shown

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
    rows = _rows(lines, header, path)
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
        fps=_rate(header, rows[:, 1], path, notes),
        unit_m=unit,
        notes=tuple(notes),
    )


def _header(lines: list[str], path: Path) -> _Header:
    """The header's fields (lower-case name -> value), the labels, and the index of the first row."""
    if len(lines) <= _LABEL_LINE:
        raise PoiseError("the file ends within its header", path, CUT_OFF)
    keys, values = (line.rstrip("\t ").split("\t") for line in lines[1:3])
    if len(values) < len(keys) or len(keys) < 2:
        keys, values = lines[1].split(), lines[2].split()
    fields = {k.strip().lower(): v.strip() for k, v in zip(keys, values, strict=False)}
    if "datarate" not in fields:
        raise PoiseError("the TRC header has no DataRate", at_line(path, 2), CUT_OFF)
    cells = _cells(lines[_LABEL_LINE].rstrip("\t "))
    labels = [c.strip() for c in cells[2:] if c.strip()]
    if len(cells) < 3 or not cells[0].strip().lower().startswith("frame") or not labels:
        raise PoiseError(
            "the labels of the points were expected: Frame#, Time, then one per point",
            at_line(path, _LABEL_LINE + 1),
        )
    twice = next((name for name, count in Counter(labels).items() if count > 1), None)
    if twice is not None:
        raise PoiseError(f"keypoint {shown(twice)} appears twice", at_line(path, _LABEL_LINE + 1))
    stated = fields.get("nummarkers", "")
    if stated.isdigit() and int(stated) != len(labels):
        raise PoiseError(
            f"the header states {stated} markers and there are {len(labels)} labels",
            at_line(path, _LABEL_LINE + 1),
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


def _rows(lines: list[str], header: _Header, path: Path) -> np.ndarray:
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
            )
        cells += [""] * (width - len(cells))
        out.append(row_numbers(cells, header.column, path, i + 1))
    if not out:
        raise PoiseError("the file has a header and no frames", path, CUT_OFF)
    return np.array(out)


def _rate(header: _Header, times: np.ndarray, path: Path, notes: list[str]) -> float:
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
            )
        notes.append(f"DataRate is {rate:g}: {measured:.5g} frames per second taken from the times")
        return measured
    if measured is not None and abs(measured / rate - 1) > 0.02:
        notes.append(
            f"The times step at {measured:.5g} frames per second and DataRate is {rate:g}, "
            "which was taken"
        )
    return rate
