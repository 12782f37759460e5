"""Clips as CSV: one row per frame for spreadsheets and scripts, and back without loss."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np

from poise.errors import PoiseError, did_you_mean
from poise.motion.clip import Clip, check_rate
from poise.motion.io.numpy.arrays import refuse_bad, require
from poise.motion.io.own.record import (
    loads,
    make_skeleton,
    refuse_overrides,
    source_from_json,
    source_to_json,
)
from poise.motion.io.raw import ReadOptions
from poise.motion.io.tables import BLANK, number, number_table
from poise.motion.io.text import (
    CUT_OFF,
    MAX_JOINTS,
    at_line,
    decode,
    read_bytes,
    shown,
    write_whole,
)
from poise.motion.skeleton import Skeleton

VERSION = 1
MARK = "# poise motion csv"
"""The first line of the format, before its version."""
_TIME_SLACK = 0.01


def write_csv(clip: Clip, path: str | Path) -> None:
    """Writes a clip as CSV; reading it gives an equal clip, bit by bit.

    Lines that start with `#` come first: format and version, name, fps, cyclic, the skeleton and
    its source as JSON. Then one line of column names and one row per frame: `time` s, `root_x`,
    `root_y`, `root_z` m in the world (Z up), and for each joint `NAME_qw, NAME_qx, NAME_qy,
    NAME_qz`, its rotation in its parent's frame (the root's in the world). Columns may be reordered.

    Raises:
        PoiseError: the folder is missing or cannot be written to.
    """
    write_whole(Path(path), csv_text(clip))


def csv_text(clip: Clip, first: int = 0, header: bool = True) -> str:
    """What `write_csv` writes; a recording is written in parts, from frame `first` on and without the
    header, each of them a clip."""
    skeleton = clip.skeleton
    record = {
        "names": skeleton.names,
        "parents": skeleton.parents,
        "offsets": skeleton.offsets.tolist(),
        "ends": [[j, *tip] for j, tip in skeleton.ends],
    }
    lines = [
        f"{MARK} {VERSION}",
        f"# name: {json.dumps(clip.name)}",
        f"# fps: {clip.fps!r}",
        f"# cyclic: {json.dumps(clip.cyclic)}",
        f"# skeleton: {json.dumps(record, separators=(',', ':'))}",
        f"# source: {source_to_json(skeleton.source)}",
        ",".join(_quoted(name) for name in columns(skeleton)),
    ]
    lines = lines if header else []
    time = (first + np.arange(clip.frames))[:, None] / clip.fps
    table = np.concatenate((time, clip.root_pos, clip.rot.reshape(clip.frames, -1)), 1)
    # The text of a list of floats holds each in the shortest form that reads back to the same bits.
    lines += [repr(row)[1:-1].replace(" ", "") for row in table.tolist()]
    return "\n".join(lines) + "\n"


def columns(skeleton: Skeleton) -> list[str]:
    """The names of the columns."""
    turns = [f"{' '.join(name.split())}_q{axis}" for name in skeleton.names for axis in "wxyz"]
    return ["time", "root_x", "root_y", "root_z", *turns]


def looks_like_csv(head: bytes) -> bool:
    """Whether a file's first bytes are those of this format."""
    return head.startswith(MARK.encode())


def read_csv(path: Path, options: ReadOptions) -> Clip:
    """The clip in a CSV of Poise, exactly as it was written.

    Raises:
        PoiseError: one sentence with the line, the column, and what to do.
    """
    lines = read_bytes(path).splitlines()
    header, first = _header(lines, path)
    refuse_overrides(options, path)
    skeleton = _skeleton(header, path)
    order = _order(lines, first, skeleton, path)
    rate = number(header["fps"], _place(path, "fps"))
    check_rate(rate, path)
    table = _table(lines, first, order, path)
    _check_times(table[:, 0], rate, path)
    root_pos = table[:, 1:4]
    rot = table[:, 4:].reshape(len(table), len(skeleton), 4)
    refuse_bad(root_pos, "the root position", path)
    refuse_bad(rot, "the rotation", path, skeleton.names)
    name = loads(f'{{"name":{header["name"]}}}', path, "name")["name"]
    cyclic = header["cyclic"] == "true"
    # What a clip refuses is told with the file, once the clip bears the file's name.
    clip = Clip(skeleton, root_pos, rot, options.fps or rate, path.stem, cyclic)
    return clip.replaced(name=str(name))


def _place(path: Path, key: str) -> str:
    """The place of a header line."""
    return f"{path}, '# {key}:'"


def _quoted(name: str) -> str:
    if not any(c in name for c in ',"\r\n'):
        return name
    return '"' + name.replace('"', '""') + '"'


def _header(lines: list[bytes], path: Path) -> tuple[dict[str, str], int]:
    """The `# key: value` lines, and the index of the line with the column names."""
    first = decode(lines[0] if lines else b"", path, 1)
    if not first.startswith(MARK):
        raise PoiseError(
            f"it is no table of keypoints and no CSV of Poise, which begins with '{MARK} {VERSION}'",
            path,
            "Name the columns of keypoints NAME_x, NAME_y, NAME_z",
        )
    version = first.removeprefix(MARK).strip(" ,\t")
    if version != str(VERSION):
        raise PoiseError(
            f"the file has version {shown(version)} of Poise's CSV; this Poise reads version {VERSION}",
            at_line(path, 1),
        )
    header: dict[str, str] = {}
    for i, line in enumerate(lines):
        if not line.startswith(b"#"):
            missing = [k for k in ("name", "fps", "cyclic", "skeleton", "source") if k not in header]
            if missing:
                raise PoiseError(f"the line '# {missing[0]}:' is missing", path, "Keep the lines with #")
            return header, i
        key, colon, value = decode(line, path, i + 1)[1:].partition(":")
        if colon:
            header[key.strip()] = value.strip()
    raise PoiseError("the file ends before the column names", path, CUT_OFF)


def _skeleton(header: dict[str, str], path: Path) -> Skeleton:
    record = loads(header["skeleton"], path, "skeleton")
    require(record, ("names", "parents", "offsets", "ends"), path, "the skeleton record")
    try:
        names = [str(n) for n in record["names"]]
        parents = np.array(record["parents"], dtype=np.int64).reshape(-1)
        offsets = np.array(record["offsets"], dtype=np.float64).reshape(-1, 3)
        ends = np.array(record["ends"], dtype=np.float64).reshape(-1, 4)
    except (TypeError, ValueError, OverflowError) as error:
        raise PoiseError(f"the skeleton record is damaged ({shown(error)})", path, CUT_OFF) from None
    source = source_from_json(header["source"], path)
    if not (np.isfinite(ends).all() and (np.abs(ends[:, 0]) <= MAX_JOINTS).all()):
        raise PoiseError("the skeleton record holds an end that is not finite or on no joint", path)
    return make_skeleton(names, parents, offsets, ends[:, 0].astype(int), ends[:, 1:], source, path)


def _order(lines: list[bytes], first: int, skeleton: Skeleton, path: Path) -> list[int]:
    """Where in a row each wanted column stands."""
    place = at_line(path, first + 1)
    found = next(csv.reader([decode(lines[first], path, first + 1)]), [])
    at = {name.strip(): i for i, name in enumerate(found)}
    order = []
    for name in columns(skeleton):
        if name.strip() not in at:
            raise PoiseError(f"the column '{name}' is missing", place, did_you_mean(name, found))
        order.append(at[name.strip()])
    return [len(found), *order]


def _table(lines: list[bytes], first: int, order: list[int], path: Path) -> np.ndarray:
    """`(T, 4 + 4 J)` the numbers in the order of `columns`."""
    width, *at = order
    rows = [line for line in lines[first + 1 :] if line.strip(BLANK)]
    if not rows:
        raise PoiseError("the file has no frames", path, CUT_OFF)
    try:
        table = np.loadtxt(rows, delimiter=",", comments=None, ndmin=2)
    except ValueError:
        table = np.zeros((0, 0))
    if table.shape != (len(rows), width):
        # Line by line is slower, but finds the place of the mistake.
        table = number_table(lines, first + 1, width, path, b",")
    return table[:, at]


def _check_times(times: np.ndarray, fps: float, path: Path) -> None:
    """Refuses rows that are missing, doubled or out of order."""
    with np.errstate(over="ignore"):
        off = ~(np.abs(np.diff(times) * fps - 1.0) < _TIME_SLACK)
    if off.any():
        frame = int(np.flatnonzero(off)[0]) + 1
        raise PoiseError(
            f"frame {frame} is {times[frame] - times[frame - 1]:.6g} s after the one before it, not "
            f"{1.0 / fps:.6g} s", path, "Keep one row per frame",
        )  # fmt: skip
