"""Poise's own files, npz and CSV, and tensors with JSON: everything that a clip holds, without loss."""

from __future__ import annotations

import csv
import dataclasses
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, is_dataclass, replace
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, get_args, get_origin, get_type_hints

import numpy as np

from poise.errors import PoiseError, did_you_mean
from poise.formats.arrays import npz_bytes, numeric, one_number, refuse_bad, require, text_of
from poise.formats.raw import ReadOptions
from poise.formats.text import (
    BLANK,
    CUT_OFF,
    MAX_JOINTS,
    MAX_VALUE,
    at_line,
    decode,
    number,
    number_table,
    read_bytes,
    shown,
    write_whole,
)
from poise.motion.clip import Clip, check_rate
from poise.motion.skeleton import Skeleton, Source, triple

MAX_RECORD = 16 << 20
"""Longer records are refused, characters."""
MAX_NOTE = 2000
LEAST_BONE_M = 1e-6
"""A skeleton of several joints has one bone at least that is as long."""


def source_to_json(source: Source) -> str:
    """All of a `Source` as one line of JSON."""
    # NumPy's numbers, which readers may leave in a source, become plain ones.
    return json.dumps(asdict(source), separators=(",", ":"), default=lambda value: value.item())


def source_from_json(text: str, path: Path) -> Source:
    """The `Source` that `source_to_json` wrote; a damaged one is refused in one sentence.

    Fields that this version does not know are left out, fields that are not there get defaults. Notes
    longer than Poise writes are cut.
    """
    try:
        source = fitted(loads(text, path, "source"), Source)
        cut = (n if len(n) <= MAX_NOTE else n[: MAX_NOTE - 3] + "..." for n in source.notes)
        # What was taken off its keypoints is no fault of the file that was written then.
        mended = (m for m in source.mended if m[0] != "tremble")
        return replace(source, notes=tuple(cut), mended=tuple(mended))
    except (KeyError, TypeError, ValueError) as error:
        raise PoiseError(
            f"the record of the clip's source is damaged ({shown(error)})",
            path,
            CUT_OFF,
            code="file-damaged",
        ) from None


def fitted(value: Any, kind: Any) -> Any:
    """JSON data as a value of the annotated type `kind`, where tuples are lists; else a ValueError."""
    origin, inner = get_origin(kind), get_args(kind)
    if origin is UnionType:
        return None if value is None and NoneType in inner else fitted(value, inner[0])
    if origin is tuple and isinstance(value, list | tuple):
        kinds = [inner[0]] * len(value) if inner[-1] is ... else inner
        return tuple(fitted(v, k) for v, k in zip(value, kinds, strict=True))
    if is_dataclass(kind) and isinstance(value, dict):
        fields = get_type_hints(kind)
        return kind(**{k: fitted(value[k], fields[k]) for k in fields if k in value})  # type: ignore[operator]
    if kind is float and type(value) in (int, float):
        try:
            return float(value)
        except OverflowError:
            raise ValueError("a number beyond all bounds") from None
    if type(value) is not kind:
        raise ValueError(f"{type(value).__name__} in the wrong place")
    return value


def loads(text: str, path: Path, what: str) -> dict[str, Any]:
    """A JSON object, or one sentence about why there is none."""
    try:
        if len(text) > MAX_RECORD:
            raise ValueError("it is too long")
        record = json.loads(text)
        if not isinstance(record, dict):
            raise ValueError("it is no JSON object")
    except (ValueError, RecursionError) as error:
        raise PoiseError(
            f"the {what} record is damaged ({shown(error)})", path, CUT_OFF, code="file-damaged"
        ) from None
    return record


def make_skeleton(
    names: list[str],
    parents: np.ndarray,
    offsets: np.ndarray,
    end_joints: np.ndarray,
    ends: np.ndarray,
    source: Source,
    path: Path,
) -> Skeleton:
    """A skeleton from arrays of a file; whatever does not fit together is refused.

    parents `(J,)`, offsets `(J, 3)` m, end_joints `(E,)` joint indices, ends `(E, 3)` m.
    """
    count = len(names)
    if not 0 < count <= MAX_JOINTS:
        raise PoiseError(
            f"it has {count} joints; 1 to {MAX_JOINTS} are allowed", path, code="joint-count"
        )
    if len(parents) != count or len(offsets) != count or len(end_joints) != len(ends):
        raise PoiseError(
            f"{count} names, {len(parents)} parents, {len(offsets)} offsets, {len(end_joints)} end "
            f"joints and {len(ends)} ends do not fit together",
            path,
            code="count-differs",
        )
    for what, table in (("offsets", offsets), ("ends", ends)):
        if not (np.abs(table) <= MAX_VALUE).all():
            raise PoiseError(
                f"array '{what}' holds a number that is not usable", path, code="number-unusable"
            )
    if count > 1 and not np.abs(offsets[1:]).max() >= LEAST_BONE_M:
        raise PoiseError("no bone of the skeleton has any length", path, code="skeleton-without-length")
    if not ((end_joints >= 0) & (end_joints < count)).all():
        raise PoiseError(
            "array 'end_joints' names a joint that does not exist", path, code="index-outside"
        )
    tips = tuple((int(j), triple(e)) for j, e in zip(end_joints, ends.tolist(), strict=True))
    if source.travel_joint is not None and source.travel_joint not in names:
        raise PoiseError(
            f"there is no joint '{source.travel_joint}'. {did_you_mean(source.travel_joint, names)}",
            path,
            code="unknown-joint",
        )
    return Skeleton(tuple(names), tuple(int(p) for p in parents), offsets, tips, source)


def refuse_overrides(options: ReadOptions, path: Path) -> None:
    """Unit and vertical are stated in Poise's own files, so nothing may override them."""
    for flag, value in (("--unit", options.unit_m), ("--up", options.up_axis)):
        if value is not None:
            raise PoiseError(
                f"{flag} is not for Poise's own files, which are in metres, Z up",
                path,
                code="option-not-applicable",
            )


CSV_VERSION = 1
CSV_MARK = "# poise motion csv"
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
        f"{CSV_MARK} {CSV_VERSION}",
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
    return head.startswith(CSV_MARK.encode())


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
    if not first.startswith(CSV_MARK):
        raise PoiseError(
            "it is no table of keypoints and no CSV of Poise, which begins with "
            f"'{CSV_MARK} {CSV_VERSION}'",
            path,
            "Name the columns of keypoints NAME_x, NAME_y, NAME_z",
            code="wrong-format",
        )
    version = first.removeprefix(CSV_MARK).strip(" ,\t")
    if version != str(CSV_VERSION):
        raise PoiseError(
            f"the file has version {shown(version)} of Poise's CSV; "
            f"this Poise reads version {CSV_VERSION}",
            at_line(path, 1),
            code="version-unsupported",
        )
    header: dict[str, str] = {}
    for i, line in enumerate(lines):
        if not line.startswith(b"#"):
            missing = [k for k in ("name", "fps", "cyclic", "skeleton", "source") if k not in header]
            if missing:
                raise PoiseError(
                    f"the line '# {missing[0]}:' is missing",
                    path,
                    "Keep the lines with #",
                    code="part-missing",
                )
            return header, i
        key, colon, value = decode(line, path, i + 1)[1:].partition(":")
        if colon:
            header[key.strip()] = value.strip()
    raise PoiseError("the file ends before the column names", path, CUT_OFF, code="file-cut-off")


def _skeleton(header: dict[str, str], path: Path) -> Skeleton:
    record = loads(header["skeleton"], path, "skeleton")
    require(record, ("names", "parents", "offsets", "ends"), path, "the skeleton record")
    try:
        names = [str(n) for n in record["names"]]
        parents = np.array(record["parents"], dtype=np.int64).reshape(-1)
        offsets = np.array(record["offsets"], dtype=np.float64).reshape(-1, 3)
        ends = np.array(record["ends"], dtype=np.float64).reshape(-1, 4)
    except (TypeError, ValueError, OverflowError) as error:
        raise PoiseError(
            f"the skeleton record is damaged ({shown(error)})", path, CUT_OFF, code="file-damaged"
        ) from None
    source = source_from_json(header["source"], path)
    if not (np.isfinite(ends).all() and (np.abs(ends[:, 0]) <= MAX_JOINTS).all()):
        raise PoiseError(
            "the skeleton record holds an end that is not finite or on no joint",
            path,
            code="number-unusable",
        )
    return make_skeleton(names, parents, offsets, ends[:, 0].astype(int), ends[:, 1:], source, path)


def _order(lines: list[bytes], first: int, skeleton: Skeleton, path: Path) -> list[int]:
    """Where in a row each wanted column stands."""
    place = at_line(path, first + 1)
    found = next(csv.reader([decode(lines[first], path, first + 1)]), [])
    at = {name.strip(): i for i, name in enumerate(found)}
    order = []
    for name in columns(skeleton):
        if name.strip() not in at:
            raise PoiseError(
                f"the column '{name}' is missing",
                place,
                did_you_mean(name, found),
                code="column-missing",
            )
        order.append(at[name.strip()])
    return [len(found), *order]


def _table(lines: list[bytes], first: int, order: list[int], path: Path) -> np.ndarray:
    """`(T, 4 + 4 J)` the numbers in the order of `columns`."""
    width, *at = order
    rows = [line for line in lines[first + 1 :] if line.strip(BLANK)]
    if not rows:
        raise PoiseError("the file has no frames", path, CUT_OFF, code="no-frames")
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
            f"{1.0 / fps:.6g} s", path, "Keep one row per frame", code="times-uneven",
        )  # fmt: skip


VERSION = 1
"""The version of the format that is written; newer ones are refused."""
MARK = "poise_clip"
"""The array that names the format; it holds the version."""
_KEYS = (
    *("names", "parents", "offsets", "end_joints", "ends", "source"),
    *("root_pos", "rot", "fps", "name", "cyclic"),
)


def write_poise_npz(clip: Clip, path: str | Path) -> None:
    """Writes a clip as Poise's own npz; reading it gives an equal clip, bit by bit.

    Arrays: `poise_clip` (the format's version), `names (J,)`, `parents (J,)` (-1 for the root),
    `offsets (J, 3)` m, `end_joints (E,)` and `ends (E, 3)` m, `root_pos (T, 3)` m, `rot (T, J, 4)`
    wxyz, `fps`, `name`, `cyclic`, `source` (JSON: what writing back in the old format needs).
    Metres, Z up. The file appears whole or not at all, and the same clip gives the same bytes.

    Raises:
        PoiseError: the folder is missing or cannot be written to.
    """
    skeleton = clip.skeleton
    arrays = {
        MARK: np.array(VERSION),
        "names": np.array(skeleton.names),
        "parents": np.array(skeleton.parents, dtype=np.int64),
        "offsets": skeleton.offsets,
        "end_joints": np.array([j for j, _ in skeleton.ends], dtype=np.int64),
        "ends": np.array([tip for _, tip in skeleton.ends], dtype=np.float64).reshape(-1, 3),
        "root_pos": clip.root_pos,
        "rot": clip.rot,
        "fps": np.array(clip.fps),
        "name": np.array(clip.name),
        "cyclic": np.array(clip.cyclic),
        "source": np.array(source_to_json(skeleton.source)),
    }
    write_whole(Path(path), npz_bytes(arrays))


def read_poise_npz(data: Mapping[str, Any], path: Path, options: ReadOptions) -> Clip:
    """The clip in Poise's own npz, exactly as it was written.

    Raises:
        PoiseError: a newer version, missing arrays, or values that make no clip.
    """
    version = int(one_number(data, MARK, path))
    if not 1 <= version <= VERSION:
        raise PoiseError(
            f"the file has version {version} of Poise's clip format; this Poise reads up to {VERSION}",
            path,
            "Install a newer Poise",
            code="version-unsupported",
        )
    require(data, _KEYS, path, "this file of Poise")
    refuse_overrides(options, path)
    names = np.asarray(data["names"])
    if names.dtype.kind != "U" or names.ndim != 1:
        raise PoiseError("array 'names' must hold one text per joint", path, code="wrong-type")
    labels = [str(n) for n in names]
    root_pos = numeric(data, "root_pos", (None, 3), path)
    rot = numeric(data, "rot", (len(root_pos), len(labels), 4), path)
    refuse_bad(root_pos, "the root position", path)
    refuse_bad(rot, "the rotation", path, labels)
    skeleton = make_skeleton(
        labels,
        _joints(data, "parents", path),
        numeric(data, "offsets", (None, 3), path),
        _joints(data, "end_joints", path),
        numeric(data, "ends", (None, 3), path),
        source_from_json(text_of(data["source"]), path),
        path,
    )
    cyclic = bool(np.all(np.asarray(data["cyclic"])))
    name = text_of(data["name"], path.stem)
    fps = options.fps or one_number(data, "fps", path)
    # What a clip refuses is told with the file, once the clip bears the file's name.
    return Clip(skeleton, root_pos, rot, fps, path.stem, cyclic).replaced(name=name)


def _joints(data: Mapping[str, Any], key: str, path: Path) -> np.ndarray:
    """Indices of joints."""
    value = numeric(data, key, (None,), path)
    if not (np.abs(value) <= MAX_JOINTS).all():
        raise PoiseError(f"array '{key}' holds a number that is no joint's", path, code="index-outside")
    return value.astype(int)


def pack_clips(clips: Sequence[Clip]) -> tuple[dict[str, np.ndarray], list[dict[str, Any]]]:
    """Arrays named `"<i>/root_pos"`, `"<i>/rot"`, `"<i>/offsets"`, and one JSON object per clip."""
    arrays: dict[str, np.ndarray] = {}
    notes: list[dict[str, Any]] = []
    for i, clip in enumerate(clips):
        arrays[f"{i}/root_pos"], arrays[f"{i}/rot"] = clip.arrays()
        arrays[f"{i}/offsets"] = clip.skeleton.offsets.copy()
        notes.append(
            {
                "name": clip.name,
                "fps": clip.fps,
                "cyclic": clip.cyclic,
                "names": list(clip.skeleton.names),
                "parents": list(clip.skeleton.parents),
                "ends": [[j, list(v)] for j, v in clip.skeleton.ends],
                "source": dataclasses.asdict(clip.skeleton.source),
            }
        )
    return arrays, notes


def unpack_clips(arrays: Mapping[str, Any], notes: Sequence[Mapping[str, Any]]) -> list[Clip]:
    """The clips that `pack_clips` packed, as arrays or as tensors.

    Raises:
        PoiseError: a key is missing, or of another kind.
    """
    try:
        return [_clip(arrays, note, i) for i, note in enumerate(notes)]
    except (KeyError, TypeError, ValueError, AttributeError, IndexError) as problem:
        raise PoiseError(f"the packed clips are incomplete: {problem}", code="file-damaged") from None


def _clip(arrays: Mapping[str, Any], note: Mapping[str, Any], i: int) -> Clip:
    def told(key: str, kind: Any) -> Any:
        return fitted(note[key], kind)

    skeleton = Skeleton(
        told("names", tuple[str, ...]),
        told("parents", tuple[int, ...]),
        np.asarray(arrays[f"{i}/offsets"]),
        told("ends", tuple[tuple[int, tuple[float, float, float]], ...]),
        told("source", Source),
    )
    root_pos, rot = np.asarray(arrays[f"{i}/root_pos"]), np.asarray(arrays[f"{i}/rot"])
    return Clip(skeleton, root_pos, rot, told("fps", float), told("name", str), told("cyclic", bool))
