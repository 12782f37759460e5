"""Pickled data without running anything of theirs: plain values and NumPy arrays come out, no more."""

from __future__ import annotations

import io
import math
import pickle
import pickletools
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from poise.errors import PoiseError
from poise.formats.arrays import MAX_ARRAY_BYTES, NPY_MAGIC, no_text, npy_header
from poise.formats.text import CUT_OFF, read_binary, shown

_KINDS = "biufcSU?"


@dataclass(eq=False)
class Dtype:
    """An array's element type while it is read."""

    code: str
    order: str = "="


@dataclass(eq=False)
class Array:
    """An array or a scalar while it is read."""

    value: Any = None


def checked(kind: type | tuple[type, ...], value: Any) -> Any:
    """The value if it is of the wanted kind."""
    if not isinstance(value, kind):
        raise ValueError(f"a {type(value).__name__} stands in the wrong place")
    return value


def text(value: Any) -> str:
    """A text that Python 2 wrote as bytes."""
    return value.decode("ascii") if isinstance(value, bytes) else checked(str, value)


def array_of(shape: Any, dtype: Dtype, fortran: Any, data: Any) -> Any:
    """The array of a pickled state; one of objects becomes a list, or its only item."""
    shape = tuple(int(n) for n in checked(tuple, shape))
    count = math.prod(shape)
    if min(shape, default=0) < 0:
        raise ValueError("an array has a negative length")
    if checked(Dtype, dtype).code.startswith("O"):
        items = checked(list, data)
        if len(items) != count:
            raise ValueError("an array has the wrong number of items")
        return items if shape else items[0]
    kind = _numeric(dtype)
    # Python 2 wrote bytes as text.
    raw = data.encode("latin-1") if isinstance(data, str) else bytes(checked((bytes, bytearray), data))
    if len(raw) != count * kind.itemsize:
        raise ValueError(f"an array of shape {shape} has {len(raw)} bytes")
    order = "F" if fortran else "C"
    flat = np.frombuffer(raw, kind)
    if no_text(flat):
        raise ValueError("characters that do not exist")
    return flat.reshape(shape, order=order)


def _numeric(dtype: Dtype) -> np.dtype[Any]:
    code = text(dtype.code)
    if code[:1] not in _KINDS or not (code[1:] == "" or code[1:].isdecimal()) or len(code) > 9:
        raise ValueError(f"arrays of type {code[:12]} are no plain data")
    kind = np.dtype(code)
    return kind if dtype.order == "|" else kind.newbyteorder(dtype.order)  # type: ignore[arg-type]


def _made_dtype(code: Any, *more: Any) -> Dtype:
    return Dtype(text(code))


def _made_array(*args: Any) -> Array:
    return Array()


def _made_scalar(dtype: Any, data: Any = b"") -> Array:
    return Array(array_of((), dtype, False, data)[()])


def _made_from_buffer(data: Any, dtype: Any, shape: Any, order: Any = "C") -> Array:
    return Array(array_of(tuple(shape), dtype, order == "F", data))


def _made_bytes(text: Any, coding: Any = "latin1") -> bytes:
    return checked(str, text).encode("latin-1")


def _made_nothing() -> bytes:
    """What old protocols write for empty bytes."""
    return b""


def _made_dict(pairs: Any = ()) -> dict[Any, Any]:
    return plain_dict([pair[0] for pair in pairs], [pair[1] for pair in pairs])


def plain_dict(keys: list[Any], values: list[Any]) -> dict[Any, Any]:
    """A dict with keys of text, bytes or whole numbers: others could take for ever to hash."""
    if not all(isinstance(key, str | int | bytes) for key in keys):
        raise ValueError("a key is no text")
    return dict(zip(keys, values, strict=True))


CALLS: dict[str, Callable[..., Any]] = {
    "numpy.dtype": _made_dtype,
    "numpy.core.multiarray._reconstruct": _made_array,
    "numpy.core.multiarray.scalar": _made_scalar,
    "numpy.core.numeric._frombuffer": _made_from_buffer,
    "_codecs.encode": _made_bytes,
    "__builtin__.bytes": _made_nothing,
    "collections.OrderedDict": _made_dict,
}
"""What a pickle may name and have made, under the names that NumPy gives."""


_MAX_STEPS = 5_000_000
# The public `pickle.Unpickler` is the machine in C, whose instructions cannot be taken away.
_Library: Any = pickle._Unpickler  # type: ignore[attr-defined]  # noqa: SLF001
_TYPES = ("numpy.ndarray", "__builtin__.object", "builtins.object")
_CORE = ("numpy.core.", "numpy._core.")
_DAMAGE = (
    *(ValueError, TypeError, IndexError, KeyError, AttributeError, OverflowError, EOFError),
    *(pickle.UnpicklingError, struct.error),
)


def load_plain(path: str | Path) -> Any:
    """What a pickle (`.pkl`) or a pickled NumPy file (`.npy` with an object array) holds.

    Values are dicts, lists, tuples, strings, bytes, numbers, None and NumPy arrays of numbers or
    text. The file cannot run code.

    Raises:
        PoiseError: the file names anything but NumPy data, or is damaged.
    """
    path = Path(path)
    data = read_binary(path, MAX_ARRAY_BYTES)
    if data.startswith(NPY_MAGIC):
        file = io.BytesIO(data)
        header = npy_header(file, path)
        if not header.dtype.hasobject:
            raise PoiseError(
                "the file holds one array of numbers, not a dict of arrays", path, code="wrong-type"
            )
        data = data[file.tell() :]
    return loads_restricted(data, path)


def named_arrays(value: Any, path: Path) -> dict[str, Any]:
    """The dict with names, from a value or a list with it alone; anything else is refused."""
    if isinstance(value, list) and len(value) == 1:
        value = value[0]
    if not isinstance(value, dict) or not all(isinstance(k, str) for k in value):
        raise PoiseError(
            f"the pickle holds a {type(value).__name__}, not a dict of named arrays",
            path,
            code="wrong-type",
        )
    return value


def loads_restricted(data: bytes, where: str | Path) -> Any:
    """The plain value in a pickle's bytes; see `load_plain`."""
    return plain_value(RestrictedMachine(data, where), where)


def plain_value(machine: RestrictedMachine, where: str | Path) -> Any:
    """The plain value that a machine makes; see `load_plain`."""
    try:
        return _plain(machine.load(), {}, 0)
    except _DAMAGE as error:
        raise PoiseError(
            f"the pickle is damaged ({shown(error)})", where, CUT_OFF, code="file-damaged"
        ) from None
    except RecursionError:
        raise PoiseError("the pickle is nested too deeply", where, code="nested-too-deep") from None


@dataclass(frozen=True)
class _Named:
    """A class or function that the file names; never looked up, never called."""

    name: str


class RestrictedMachine(_Library):
    """The pickle machine with fewer instructions, a limit on them and on the bytes of arrays.

    A pickle is a program for a stack machine that may call any function. This machine is the standard
    library's in Python with the instructions that plain data need. It never looks names up, and builds
    arrays from their bytes, so that not even NumPy's own reconstruction runs. `find_class` of the fast
    machine in C would not do: that machine hashes any key (one of nested tuples for ever), and takes
    memory for whatever index or length a file states.
    """

    #: Instructions, and names of classes and functions, that a kind of file needs besides.
    extra: frozenset[str] = frozenset()
    types: frozenset[str] = frozenset()

    def __init__(self, data: bytes, where: str | Path):
        # Python 2 wrote bytes as text.
        super().__init__(io.BytesIO(data), encoding="latin-1")
        self.where, self.steps, self.bytes_made = where, 0, 0
        self.dispatch = self

    def __getitem__(self, code: int) -> Callable[[RestrictedMachine], None]:
        """The step of an instruction, where `load` looks for it."""
        self.steps += 1
        if self.steps > _MAX_STEPS:
            raise PoiseError(
                f"the pickle has more than {_MAX_STEPS} instructions", self.where, code="over-limit"
            )
        name = _NAMES.get(code, "an unknown instruction")
        if name in self.extra:
            return _Library.dispatch[code]
        if name not in _STEPS:
            raise PoiseError(
                f"the pickle uses {name}, which plain data does not need",
                self.where,
                code="pickle-refused",
            )
        return _STEPS[name]

    def find_class(self, module: str, name: str) -> _Named:
        named = f"{module}.{name}"
        for core in _CORE:
            named = named.replace(core, "numpy.core.", 1) if named.startswith(core) else named
        if named not in CALLS and named not in _TYPES and named not in self.types:
            raise PoiseError(
                f"the pickle names {shown(named)}, which is no plain data, and was not read",
                self.where,
                "Save the arrays with numpy.savez instead",
                code="pickle-refused",
            )
        return _Named(named)

    def counted(self, value: Any) -> Any:
        """The value, unless the arrays made so far grow beyond all need (a few bytes shared often)."""
        inner = value.value if isinstance(value, Array) else value
        self.bytes_made += inner.nbytes if isinstance(inner, np.ndarray) else 0
        self.bytes_made += len(inner) if isinstance(inner, bytes) else 0
        if self.bytes_made > 2 * MAX_ARRAY_BYTES:
            raise PoiseError(
                "the pickle holds more arrays than the limit", self.where, code="over-limit"
            )
        return value

    def reduce(self) -> None:
        """Makes what the file names, by our own function for it."""
        args = checked(tuple, self.stack.pop())
        self.stack[-1] = self.counted(self.made(self.name_of(self.stack[-1]), args))

    def name_of(self, value: Any) -> str:
        """The name of a class or function that the file names."""
        return checked(_Named, value).name

    def made(self, name: str, args: tuple[Any, ...]) -> Any:
        """The result of a named function, made by our own in its place."""
        if name not in CALLS:
            raise ValueError(f"{name} cannot be made")
        return CALLS[name](*args)

    def build(self) -> None:
        """Fills an array or a type with its state."""
        state, target = checked(tuple, self.stack.pop()), self.stack[-1]
        if isinstance(target, Array):
            # (version, shape, dtype, Fortran order, bytes or list), in old files without the version.
            target.value = self.counted(array_of(*state[-4:]))
        elif isinstance(target, Dtype):
            if any(part is not None for part in state[2:5]):
                raise ValueError("structured arrays are no plain data")
            target.order = text(state[1])
        else:
            raise ValueError("an object that is no array has a state")

    def set_items(self, pairs: list[Any]) -> None:
        checked(dict, self.stack[-1]).update(plain_dict(pairs[::2], pairs[1::2]))

    def set_one(self) -> None:
        value, key = self.stack.pop(), self.stack.pop()
        self.set_items([key, value])

    def byte_array(self) -> None:
        """Bytes that can be written to; the library's step takes the memory before it reads."""
        self.append(self.read(struct.unpack("<Q", self.read(8))[0]))

    def make_dict(self) -> None:
        items = self.pop_mark()
        self.append(plain_dict(items[::2], items[1::2]))


_NAMES = {ord(op.code): op.name for op in pickletools.opcodes}
_TAKEN = (
    *("PROTO", "FRAME", "STOP", "MARK", "NONE", "NEWTRUE", "NEWFALSE", "GLOBAL", "STACK_GLOBAL"),
    *("INT", "BININT", "BININT1", "BININT2", "LONG", "LONG1", "LONG4", "FLOAT", "BINFLOAT"),
    *("STRING", "BINSTRING", "SHORT_BINSTRING", "BINBYTES", "SHORT_BINBYTES", "BINBYTES8"),
    *("UNICODE", "BINUNICODE", "SHORT_BINUNICODE", "BINUNICODE8"),
    *("EMPTY_LIST", "EMPTY_DICT", "EMPTY_TUPLE", "LIST", "TUPLE", "TUPLE1", "TUPLE2", "TUPLE3"),
    *("APPEND", "APPENDS", "PUT", "BINPUT", "LONG_BINPUT", "MEMOIZE", "GET", "BINGET", "LONG_BINGET"),
)
_STEPS: dict[str, Callable[[Any], None]] = {
    **{name: _Library.dispatch[code] for code, name in _NAMES.items() if name in _TAKEN},
    "REDUCE": RestrictedMachine.reduce,
    "BUILD": RestrictedMachine.build,
    "DICT": RestrictedMachine.make_dict,
    "SETITEM": RestrictedMachine.set_one,
    "SETITEMS": lambda machine: machine.set_items(machine.pop_mark()),
    "BYTEARRAY8": RestrictedMachine.byte_array,
}


def _plain(value: Any, seen: dict[int, Any], depth: int) -> Any:
    """The value with arrays in place of what stood for them; shared parts are walked once."""
    if isinstance(value, _Named | Dtype):
        raise ValueError("a type stands where data was expected")
    if isinstance(value, Array) and not isinstance(value.value, list | dict | tuple | Array):
        return value.value
    if not isinstance(value, list | dict | tuple | Array):
        return value
    if depth > 64:
        raise RecursionError
    if id(value) not in seen:
        # A part that contains itself finds None in its own place.
        seen[id(value)] = None
        if isinstance(value, Array):
            out: Any = _plain(value.value, seen, depth + 1)
        elif isinstance(value, dict):
            out = {k: _plain(v, seen, depth + 1) for k, v in value.items()}
        else:
            out = type(value)(_plain(v, seen, depth + 1) for v in value)
        seen[id(value)] = out
    return seen[id(value)]
