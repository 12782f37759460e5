"""Bounded reading of text, of tables of numbers and of JSON, with the place of every mistake."""

from __future__ import annotations

import json
import os
import secrets
import stat
from array import array
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from poise.errors import PoiseError, printable

MAX_FILE_BYTES = 512 << 20
"""Larger files are refused before they are read (22 joints at 30 Hz: about seven hours)."""
MAX_SKELETON_BYTES = 16 << 20
"""The same for ASF skeletons, which hold no motion."""
MAX_LINES = 10_000_000
"""Files with more lines are refused while they are read."""
MAX_LINE_BYTES = 4 << 20
"""Longer lines are refused while they are read."""
MAX_HEADER_WORDS = 1_000_000
"""More words than this before the motion starts are refused."""
MAX_JOINTS = 1500
"""Skeletons with more joints are refused: a person with a face of hundreds of bones has some 1200."""
MAX_NAME = 200
"""Joints and keypoints with longer names are refused."""
MAX_VALUE = 1e8
"""Numbers larger than this, in any unit, are taken for damage."""
MAX_JSON_BYTES = 128 << 20
"""Longer JSON is refused before it is read."""
MAX_CONTAINERS = 2_000_000
"""JSON with more objects and lists is refused: a short one takes up to 250 bytes in memory."""
MAX_ITEMS = 20_000_000
"""The same for items in them, at some 40 bytes each (44 numbers at 60 Hz: two hours)."""
NO_ANIMATION = "Export it with its animation; as it rests it serves `poise retarget --onto` alone"
"""The hint of errors about files with a skeleton that does not move."""
REST_POSE = "The file holds no animation: it is read as it rests, in one pose"
"""The note of such files where a rest pose is enough."""
CUT_OFF = "The file seems cut off"
"""The hint of errors about files that end too early."""

_CHUNK = 1 << 20


def at_line(path: Path, line: int) -> str:
    """The place "FILE, line N" of an error."""
    return f"{path}, line {line}"


def check_file(path: Path, limit: int = MAX_FILE_BYTES) -> int:
    """The size in bytes of a regular file that is there, not empty and not too large."""
    try:
        info = path.stat()
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        if isinstance(error, FileNotFoundError):
            raise PoiseError("there is no such file", path, code="file-missing") from None
        raise PoiseError(f"the file cannot be opened ({reason})", path, code="file-unreadable") from None
    if stat.S_ISDIR(info.st_mode):
        raise PoiseError(
            "this is a folder, not a motion file", path, "Name one file in it", code="is-folder"
        )
    if not stat.S_ISREG(info.st_mode):
        raise PoiseError("this is not a regular file", path, code="not-a-file")
    if info.st_size == 0:
        raise PoiseError("the file is empty", path, code="file-empty")
    if info.st_size > limit:
        raise PoiseError(
            f"the file has {info.st_size / 1e9:.2f} GB, more than the limit of {limit / 1e9:.2f} GB",
            path,
            "Cut it into shorter clips",
            code="file-too-big",
        )
    return info.st_size


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    """Says in one sentence that a file cannot be read."""
    try:
        yield
    except OSError as error:
        raise PoiseError(
            f"the file cannot be read ({error.strerror})", path, code="file-unreadable"
        ) from None


def read_head(path: Path) -> bytes:
    """The first bytes of a file, after `check_file`."""
    check_file(path)
    with _reading(path), path.open("rb") as file:
        return file.read(4096)


def below_comments(path: Path, most: int = 4 << 20) -> bytes:
    """The first 4 kB below the lines of a long comment ("# ..."), sought in `most` bytes."""
    with path.open("rb") as file:
        while file.tell() < most and (line := file.readline(_CHUNK)):
            if line.strip() and not line.lstrip().startswith(b"#"):
                return line + file.read(4096)
    return b""


def read_binary(path: Path, limit: int = MAX_FILE_BYTES) -> bytes:
    """All bytes of a file of any kind, after `check_file`."""
    check_file(path, limit)
    with _reading(path):
        return path.read_bytes()


def read_bytes(path: Path, limit: int = MAX_FILE_BYTES) -> bytes:
    """All bytes of a text file; binary data, other encodings and endless lines are refused.

    The file is scanned in pieces of 1 MiB, so that a bad one is refused early and cheaply.
    """
    check_file(path, limit)
    chunks: list[bytes] = []
    run, line, total = 0, 1, 0
    with _reading(path), path.open("rb") as file:
        while chunk := file.read(_CHUNK):
            if total == 0:
                chunk = _without_mark(chunk, path)
            total += len(chunk)
            if total > limit:
                raise PoiseError(
                    "the file grew beyond the limit while it was read", path, code="file-too-big"
                )
            nul = chunk.find(b"\0")
            if nul >= 0:
                place = at_line(path, line + chunk.count(b"\n", 0, nul))
                raise PoiseError("binary data in a text file", place, code="not-text")
            first, last = _breaks(chunk)
            if run + first > MAX_LINE_BYTES:
                raise PoiseError(
                    f"the line is longer than {MAX_LINE_BYTES / 1e6:.1f} MB, which no frame needs",
                    at_line(path, line),
                    code="over-limit",
                )
            run = len(chunk) - last - 1 if last >= 0 else run + len(chunk)
            line += chunk.count(b"\n") + chunk.count(b"\r") - chunk.count(b"\r\n")
            if line > MAX_LINES:
                raise PoiseError(f"the file has more than {MAX_LINES} lines", path, code="over-limit")
            chunks.append(chunk)
    return b"".join(chunks)


def _without_mark(chunk: bytes, path: Path) -> bytes:
    if chunk[:2] in (b"\xff\xfe", b"\xfe\xff"):
        raise PoiseError(
            "the text is encoded as UTF-16", at_line(path, 1), "Save it as UTF-8", code="not-text"
        )
    return chunk.removeprefix(b"\xef\xbb\xbf")


def _breaks(chunk: bytes) -> tuple[int, int]:
    """Places of the first and the last line break, (length, -1) where there is none."""
    found = [i for i in (chunk.find(b"\n"), chunk.find(b"\r")) if i >= 0]
    first = min(found) if found else len(chunk)
    return first, max(chunk.rfind(b"\n"), chunk.rfind(b"\r"))


def decode(line: bytes, path: Path, number: int) -> str:
    """One line as text; bytes that are not UTF-8 are refused with their place."""
    try:
        return line.decode("utf-8")
    except UnicodeDecodeError as error:
        raise PoiseError(
            f"byte 0x{line[error.start]:02x} is not UTF-8 text",
            at_line(path, number),
            "Save it as UTF-8",
            code="not-text",
        ) from None


def json_object(data: bytes, path: Path) -> dict[str, Any]:
    """The JSON object in a file's bytes, see `json_value`."""
    content = json_value(data, path)
    if not isinstance(content, dict):
        raise PoiseError("the JSON is no object", path, code="not-an-object")
    return content


def json_value(data: bytes, path: Path) -> Any:
    """The JSON in a file's bytes; brackets and commas are counted before memory is taken."""
    data = data.removeprefix(b"\xef\xbb\xbf")
    for size, most, what in (
        (len(data), MAX_JSON_BYTES, "bytes"),
        (data.count(b"{") + data.count(b"["), MAX_CONTAINERS, "objects and lists"),
        (data.count(b","), MAX_ITEMS, "items"),
    ):
        if size > most:
            raise PoiseError(
                f"the JSON has {size} {what}, more than the {most} allowed",
                path,
                "Cut it into shorter clips",
                code="over-limit",
            )
    try:
        return json.loads(data.decode("utf-8"))
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise PoiseError(
            "this is not UTF-8 text", at_line(path, line), "Save it as UTF-8", code="not-text"
        ) from None
    except json.JSONDecodeError as error:
        raise PoiseError(
            f"this is not valid JSON ({error.msg})",
            at_line(path, error.lineno),
            CUT_OFF,
            code="bad-json",
        ) from None
    except (RecursionError, ValueError):
        raise PoiseError("this is not valid JSON", path, code="bad-json") from None


def shown(token: object) -> str:
    """A token for an error message: printable and short."""
    text = token.decode("utf-8", "replace") if isinstance(token, bytes) else str(token)
    text = printable(text)
    return f"'{text[:30]}...'" if len(text) > 30 else f"'{text}'"


def listed(items: Iterable[object], limit: int = 8) -> str:
    """Up to `limit` items, comma-separated, then how many more."""
    all_items = [str(i) for i in items]
    more = len(all_items) - limit
    return ", ".join(all_items[:limit]) + (f" and {more} more" if more > 0 else "")


def others_note(name: str, joints: int, others: Sequence[tuple[str, int]]) -> str:
    """The sentence about bodies of a file beside the one that is read: the root and joints of each."""
    more = listed((f"{shown(n)} ({count} joints)" for n, count in others), 4)
    left = "the other one was left out" if len(others) == 1 else "the others were left out"
    return (
        f"The file holds {len(others) + 1} bodies: {shown(name)} ({joints} joints) was read, and "
        f"{left}: {more}; to read another, export it alone"
    )


def write_whole(path: Path, content: str | bytes) -> None:
    """Writes a file, text as UTF-8, whole or not at all: beside its place, then into it."""
    if path.is_dir():
        raise PoiseError("this is a folder; name a file to write", path, code="is-folder")
    beside = path.with_name(f".{path.name}.{secrets.token_hex(4)}.tmp")
    try:
        with beside.open("xb") as file:
            file.write(content if isinstance(content, bytes) else content.encode("utf-8"))
            file.flush()
            os.fsync(file.fileno())
        beside.replace(path)
    except OSError as error:
        beside.unlink(missing_ok=True) if beside.parent.is_dir() else None
        reason = error.strerror or str(error)
        raise PoiseError(
            f"the file cannot be written ({reason})",
            path,
            "Choose a folder you may write to",
            code="cannot-write",
        ) from None


BLANK = b" \t,;"
"""Lines of these alone are passed over."""
MISSING = {"", "nan", "-nan", "nan(ind)", "-nan(ind)", "na", "n/a", "null", "none"}
"""Cells in lower case that stand for a missing value."""


def number(token: str | bytes, where: str) -> float:
    """One finite number; anything else is refused with its place."""
    try:
        if ("_" if isinstance(token, str) else b"_") in token:  # type: ignore[operator]
            raise ValueError
        value = float(token)
    except ValueError:
        raise PoiseError(f"{shown(token)} is not a number", where, code="not-a-number") from None
    if not abs(value) <= MAX_VALUE:
        raise PoiseError(f"{shown(token)} is not a usable number", where, code="number-unusable")
    return value


def append_numbers(values: array[float], tokens: list[bytes], where: str) -> None:
    """Adds the numbers of one row in one go; on a mistake, names the token at fault.

    NaN and inf pass, so that the caller can name the joint and frame.
    """
    size = len(values)
    try:
        # Python reads "1_000" as a number; motion files do not.
        if b"_" in b"".join(tokens):
            raise ValueError
        values.extend(map(float, tokens))
    except ValueError:
        del values[size:]
        for token in tokens:
            try:
                float(token.replace(b"_", b"x"))
            except ValueError:
                raise PoiseError(f"{shown(token)} is not a number", where, code="not-a-number") from None


def first_bad(table: np.ndarray) -> tuple[int, int] | None:
    """(row, column) of the first value that is not finite or is absurdly large, else None."""
    bad = ~(np.abs(table) <= MAX_VALUE)
    if not bad.any():
        return None
    row, column = np.argwhere(bad)[0]
    return int(row), int(column)


def number_table(
    lines: list[bytes], first: int, width: int, path: Path, mark: bytes | None = None
) -> np.ndarray:
    """`(T, width)` the numbers in the lines from index `first` on; blank lines are passed over.

    mark: what stands between the numbers, None for blanks.

    Raises:
        PoiseError: a row of another width, or a word that is no number, with the line.
    """
    values: array[float] = array("d")
    for i in range(first, len(lines)):
        if not lines[i].strip(BLANK if mark else None):
            continue
        tokens = lines[i].split(mark)
        if len(tokens) != width:
            what = f"the row has {len(tokens)} values; there are {width} columns"
            raise PoiseError(what, at_line(path, i + 1), code="row-width")
        append_numbers(values, tokens, at_line(path, i + 1))
    return np.frombuffer(values, dtype=np.float64).reshape(-1, width)


def row_numbers(cells: list[str], column: Callable[[int], str], path: Path, line: int) -> list[float]:
    """The numbers of one row, NaN where a cell is blank or says so.

    column: the name of a column by its index, for the place of a mistake ("line 7, column 4 (RHip Y)").
    """
    try:
        # Python reads "1_000" as a number; tables do not.
        if "_" not in "".join(cells):
            values = [float(c) if c and not c.isspace() else np.nan for c in cells]
            if all(abs(v) <= MAX_VALUE or v != v for v in values):
                return values
    except ValueError:
        pass
    out = []
    for k, cell in enumerate(cells):
        text = cell.strip()
        if text.lower() in MISSING:
            out.append(np.nan)
        else:
            if text.count(",") == 1 and "." not in text:
                # A decimal comma: no table here separates its cells by commas and holds one in a cell.
                text = text.replace(",", ".")
            out.append(number(text, f"{at_line(path, line)}, column {k + 1} ({column(k)})"))
    return out
