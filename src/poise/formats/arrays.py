"""NumPy files from strangers: archives by their directory and headers first, then bounded reading."""

from __future__ import annotations

import io
import math
import re
import struct
import sys
import tokenize
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.lib import format as npy

from poise.errors import PoiseError, did_you_mean
from poise.formats.text import CUT_OFF, MAX_VALUE, check_file, listed, shown

#: Bytes of the record that ends an archive, of what points to its 64-bit form, of that form, and of a
#: comment behind it at most.
_END, _POINTS, _END_64, _COMMENT = 22, 20, 56, (1 << 16) - 1


def directory_bytes(path: str | Path) -> int:
    """Bytes of the directory as the end of the file states them; 0 where no archive ends there.

    Python's own reader makes objects of all entries at once, which takes ten times their bytes.

    Raises:
        OSError: the file cannot be read.
    """
    with Path(path).open("rb") as file:
        size = file.seek(0, 2)
        file.seek(max(0, size - _END - _COMMENT - _POINTS - _END_64))
        tail = file.read()
    at = len(tail) - _END
    if not (tail.startswith(b"PK\x05\x06", at) and tail.endswith(b"\0\0")):
        at = tail.rfind(b"PK\x05\x06")
    if at < 0 or at + _END > len(tail):
        return 0
    (stated,) = struct.unpack_from("<L", tail, at + 12)
    if tail.startswith(b"PK\x06\x07", at - _POINTS) and at >= _POINTS + _END_64:
        (wide,) = struct.unpack_from("<Q", tail, at - _POINTS - _END_64 + 40)
        stated = wide if stated == 0xFFFFFFFF else max(stated, wide)
    return min(stated, size)


MAX_ARRAY_BYTES = 512 << 20
"""Larger arrays are refused by what their header states, before memory is taken."""
MAX_KEYS = 4096
"""NumPy archives with more arrays are refused."""
MAX_DIRECTORY = MAX_KEYS << 10
"""Bytes of an archive's directory; a larger one is refused before it is read."""
NPY_MAGIC = b"\x93NUMPY"
ASK = "Read it with --allow-pickle (in Python: allow_pickle); no code in it will run"
"""The hint of every refusal of a pickled file."""
ZIP_MAGIC = b"PK\x03\x04"
Unpickle = Callable[[bytes, str | Path], Any]
"""Makes the value in a pickle's bytes; the second argument is the place that errors name."""

_HEADER_BYTES = 1 << 16
_DAMAGE = (
    *(zipfile.BadZipFile, zlib.error, EOFError, struct.error, RuntimeError),
    # Names of members that are no text.
    UnicodeDecodeError,
)

# NumPy reads headers as Python literals, hence the odd company.
_BAD_HEADER = (
    *(ValueError, TypeError, SyntaxError, RecursionError, MemoryError, EOFError, IndexError),
    tokenize.TokenError,
)


@dataclass(frozen=True)
class Header:
    """What the header of a `.npy` states about its array."""

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    fortran: bool


def npy_header(file: IO[bytes], where: str | Path) -> Header:
    """The header of a `.npy` stream, which is left at the first byte of its data."""
    try:
        version = npy.read_magic(file)
        read = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
        shape, fortran, dtype = read(file, _HEADER_BYTES)
    except _BAD_HEADER as error:
        raise PoiseError(
            f"its NumPy header is damaged ({shown(error)})", where, CUT_OFF, code="file-damaged"
        ) from None
    if min(shape, default=0) < 0:
        raise PoiseError(
            f"its NumPy header states the shape {shape}", where, CUT_OFF, code="file-damaged"
        )
    return Header(shape, dtype, fortran)


def is_statistics(path: Path) -> bool:
    """Whether a `.npy` holds a number or one row of numbers, as `Mean.npy` and `Std.npy` of HumanML3D
    do: no motion, and nothing that anyone would miss."""
    try:
        with path.open("rb") as file:
            header = npy_header(file, path)
    except (OSError, PoiseError):
        return False
    return len(header.shape) < 2 and not header.dtype.hasobject


@contextmanager
def _opened(path: Path) -> Iterator[zipfile.ZipFile]:
    """The archive; whatever is wrong with it becomes one sentence."""
    check_file(path, 2 * MAX_ARRAY_BYTES)
    try:
        crowded = PoiseError(f"the archive holds more than {MAX_KEYS} arrays", path, code="over-limit")
        if directory_bytes(path) > MAX_DIRECTORY:
            raise crowded
        with zipfile.ZipFile(path) as archive:
            if len(archive.infolist()) > MAX_KEYS:
                raise crowded
            yield archive
    except _DAMAGE as error:
        raise PoiseError(
            f"the NumPy archive is damaged ({shown(error)})", path, CUT_OFF, code="file-damaged"
        ) from None
    except OSError as error:
        raise PoiseError(
            f"the file cannot be read ({error.strerror or error})", path, code="file-unreadable"
        ) from None


class Archive(Mapping[str, Any]):
    """The arrays of a `.npz`; each is read when it is asked for, within bounds.

    Only the directory is read at first. Pickled members are refused unless `unpickle` is given, such as
    `loads_restricted`.

    Raises:
        PoiseError: naming the file and the array, for whatever is damaged, too large or pickled.
    """

    def __init__(self, path: str | Path, unpickle: Unpickle | None = None):
        self.path, self._unpickle = Path(path), unpickle
        with _opened(self.path) as archive:
            names = [n.removesuffix(".npy") for n in archive.namelist() if n.endswith(".npy")]
        self._keys = tuple(dict.fromkeys(names))

    def __iter__(self) -> Iterator[str]:
        return iter(self._keys)

    def __len__(self) -> int:
        return len(self._keys)

    def __contains__(self, key: object) -> bool:
        return key in self._keys

    def header(self, key: str) -> Header:
        """Shape and type of one array, read from its first bytes."""
        with _opened(self.path) as archive, archive.open(f"{key}.npy") as file:
            return npy_header(file, self._place(key))

    def __getitem__(self, key: str) -> Any:
        if key not in self._keys:
            raise KeyError(key)
        with _opened(self.path) as archive, archive.open(f"{key}.npy") as file:
            return read_npy(file, self._place(key), self._unpickle)

    def _place(self, key: str) -> str:
        return f"{self.path}, array {shown(key)}"


def read_npy(file: IO[bytes], where: str | Path, unpickle: Unpickle | None = None) -> Any:
    """The array in a `.npy` stream; a pickled one is what `unpickle` makes of it, if it is given."""
    header = npy_header(file, where)
    if header.dtype.hasobject:
        if unpickle is None:
            raise PoiseError("it holds pickled objects", where, ASK, code="pickle-refused")
        data = file.read(MAX_ARRAY_BYTES + 1)
        if len(data) > MAX_ARRAY_BYTES:
            raise PoiseError("it holds more pickled data than the limit", where, code="over-limit")
        return unpickle(data, where)
    size = math.prod(header.shape) * header.dtype.itemsize
    if size > MAX_ARRAY_BYTES:
        raise PoiseError(
            f"it states the shape {header.shape}, which is {min(size, 10**18) / 1e9:.3g} GB and more "
            f"than the limit of {MAX_ARRAY_BYTES / 1e9:.2f} GB",
            where,
            "Cut it into shorter clips",
            code="file-too-big",
        )
    # One byte more than needed, so that the checksum at the end is looked at.
    data = file.read(size + 1)
    if len(data) != size:
        there = f"only {len(data)}" if len(data) < size else "more"
        raise PoiseError(
            f"it states the shape {header.shape} of {size} bytes, but {there} are there",
            where,
            CUT_OFF,
            code="file-cut-off",
        )
    try:
        flat = np.frombuffer(data, header.dtype) if size else np.zeros(0, header.dtype)
        if no_text(flat):
            raise PoiseError(
                "it holds characters that do not exist", where, CUT_OFF, code="file-damaged"
            )
        return flat.reshape(header.shape, order="F" if header.fortran else "C")
    except ValueError:
        raise PoiseError(
            f"its shape {header.shape} makes no array", where, CUT_OFF, code="file-damaged"
        ) from None


def no_text(flat: np.ndarray) -> bool:
    """Whether an array `(N,)` of text holds characters above the last of Unicode, which break Python."""
    if flat.dtype.kind != "U" or not flat.nbytes:
        return False
    return bool(flat.view(np.dtype("u4").newbyteorder(flat.dtype.byteorder)).max() > sys.maxunicode)  # type: ignore[arg-type]


def first_member(head: bytes) -> bytes:
    """The name of the first file in a zip that begins with `head`, empty if it is no zip."""
    if not head.startswith(ZIP_MAGIC) or len(head) < 30:
        return b""
    return head[30 : 30 + int.from_bytes(head[26:28], "little")]


def require(data: Mapping[str, Any], keys: Sequence[str], path: Path, what: str) -> None:
    """Refuses data that lack some of `keys`, with what is there and what was perhaps meant."""
    missing = [k for k in keys if k not in data]
    if missing:
        hint = did_you_mean(missing[0], tuple(data)) if len(data) else "It is empty"
        raise PoiseError(f"{what} lacks {listed(missing)}", path, hint, code="key-missing")


def numeric(data: Mapping[str, Any], key: str, shape: tuple[int | None, ...], path: Path) -> np.ndarray:
    """An array as float64 of the given shape; None allows any length."""
    where = f"{path}, array {shown(key)}"
    value = np.asarray(data[key])
    if value.dtype.kind not in "fiu":
        raise PoiseError(f"it holds {value.dtype.name} values, not numbers", where, code="wrong-type")
    fits = value.ndim == len(shape) and all(
        b in (None, a) for a, b in zip(value.shape, shape, strict=False)
    )
    if not fits:
        wanted = " x ".join("any" if n is None else str(n) for n in shape)
        found = " x ".join(map(str, value.shape)) or "()"
        raise PoiseError(f"it has the shape {found}, not {wanted}", where, code="wrong-shape")
    # Numbers that double precision lacks become infinite, which is refused where they are used.
    with np.errstate(over="ignore", invalid="ignore"):
        return value.astype(np.float64)


def one_number(data: Mapping[str, Any], key: str, path: Path) -> float:
    """A finite number that stands alone, in an array of any number of axes or as text ("30 fps")."""
    if (text := text_of(data[key])) and (rate := rate_in(text)) is not None:
        return rate
    value = float(numeric({key: np.ravel(np.asarray(data[key]))}, key, (1,), path)[0])
    if not np.isfinite(value):
        raise PoiseError(
            f"it holds {value}, not a finite number", f"{path}, array {shown(key)}", code="not-finite"
        )
    return value


def rate_in(text: str) -> float | None:
    """The number in "30", "29.97 Hz" or "30 fps", None where that is not all."""
    match = re.fullmatch(r"\s*(\d{1,6}(?:\.\d{0,12})?)\s*(?:fps|hz|frames.*)?\s*", text, re.IGNORECASE)
    return float(match[1]) if match else None


def text_of(value: Any, default: str = "") -> str:
    """A string that NumPy files hold as text, as bytes or in an array of one item."""
    while isinstance(value, np.ndarray | list | tuple) and np.size(value) == 1:  # type: ignore[arg-type]
        value = value.item() if isinstance(value, np.ndarray) else value[0]
    if isinstance(value, bytes):
        value = value.decode("utf-8", "replace")
    return value if isinstance(value, str) else default


def refuse_bad(table: np.ndarray, what: str, where: str | Path, names: Sequence[str] = ()) -> None:
    """Refuses values that are not finite or absurdly large, with the frame and the joint.

    table: `(T, ...)`, or `(T, J, ...)` if the joints' `names` are given.
    """
    bad = ~(np.abs(table) <= MAX_VALUE)
    if not bad.any():
        return
    at = np.argwhere(bad)[0]
    joint = f" of joint '{names[at[1]]}'" if names else ""
    raise PoiseError(
        f"{what}{joint} at frame {at[0]} is {table[tuple(at)]:.4g}, not a usable number",
        where,
        code="number-unusable",
    )


def npz_bytes(arrays: Mapping[str, np.ndarray]) -> bytes:
    """The bytes of a `.npz`; the same arrays give the same bytes."""
    out = io.BytesIO()
    np.savez(out, allow_pickle=False, **arrays)  # type: ignore[arg-type]
    return out.getvalue()
