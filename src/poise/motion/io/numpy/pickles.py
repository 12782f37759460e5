"""Pickled data without pickle: a small interpreter that builds plain values and calls nothing.

A pickle is a program for a stack machine that may call any function. The one here knows only the
instructions that build dicts, lists, tuples, strings, numbers and NumPy arrays; a file that names
anything else is refused before it can do harm. Arrays are built from their bytes by us, so not even
NumPy's own reconstruction runs.
"""

from __future__ import annotations

import io
import pickletools
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from poise.errors import PoiseError
from poise.motion.io.numpy.arrays import MAX_ARRAY_BYTES, NPY_MAGIC, npy_header
from poise.motion.io.numpy.pickled_arrays import CALLS, Array, Dtype, array_of, checked, text
from poise.motion.io.text import CUT_OFF, check_file, shown

ASK = "Read it with --allow-pickle (in Python: allow_pickle); no code in it will run"
"""The hint of every refusal of a pickled file."""
_MAX_STEPS = 5_000_000
_CORE = ("numpy.core.", "numpy._core.")


@dataclass(eq=False)
class _Named:
    """A class or function that the file names; never looked up, never called."""

    name: str


@dataclass(eq=False)
class _Machine:
    """The stack, the marks in it and the memo of the pickle machine."""

    path: Path
    stack: list[Any] = field(default_factory=list)
    marks: list[int] = field(default_factory=list)
    memo: dict[int, Any] = field(default_factory=dict)
    made: int = 0

    def since_mark(self) -> list[Any]:
        """Takes everything above the last mark from the stack."""
        at = self.marks.pop()
        items = self.stack[at:]
        del self.stack[at:]
        return items

    def counted(self, value: Any) -> Any:
        """The value, unless the arrays made so far grow beyond all need (a few bytes shared often)."""
        inner = value.value if isinstance(value, Array) else value
        if isinstance(inner, np.ndarray):
            self.made += inner.nbytes
        elif isinstance(inner, bytes):
            self.made += len(inner)
        if self.made > 2 * MAX_ARRAY_BYTES:
            raise PoiseError("the pickle holds more arrays than the limit", self.path)
        return value


def load_restricted(path: str | Path) -> dict[str, Any]:
    """The dict in a pickle (`.pkl`) or in a pickled NumPy file (`.npy` with an object array).

    Values are dicts, lists, tuples, strings, bytes, numbers, None and NumPy arrays of numbers or
    text. The file cannot run code.

    Raises:
        PoiseError: the file names anything but NumPy data, is damaged, or holds no dict.
    """
    path = Path(path)
    check_file(path, MAX_ARRAY_BYTES)
    try:
        data = path.read_bytes()
    except OSError as error:
        raise PoiseError(f"the file cannot be read ({error.strerror})", path) from None
    if data.startswith(NPY_MAGIC):
        file = io.BytesIO(data)
        header = npy_header(file, path)
        if not header.dtype.hasobject:
            raise PoiseError("the file holds one array of numbers, not a dict of arrays", path)
        data = data[file.tell() :]
    value = loads_restricted(data, path)
    if isinstance(value, list) and len(value) == 1:
        value = value[0]
    if not isinstance(value, dict) or not all(isinstance(k, str) for k in value):
        raise PoiseError(f"the pickle holds a {type(value).__name__}, not a dict of named arrays", path)
    return value


def loads_restricted(data: bytes, path: str | Path) -> Any:
    """The plain value in a pickle's bytes; see `load_restricted`."""
    machine = _Machine(Path(path))
    try:
        for count, (code, arg, _) in enumerate(pickletools.genops(data)):
            if count >= _MAX_STEPS:
                raise PoiseError(f"the pickle has more than {_MAX_STEPS} instructions", path)
            if code.name == "STOP":
                return _plain(machine.stack.pop(), {}, 0)
            step = _STEPS.get(code.name)
            if step is None:
                raise PoiseError(f"the pickle uses {code.name}, which plain data does not need", path)
            step(machine, arg)
    except PoiseError:
        raise
    except (ValueError, TypeError, IndexError, KeyError, AttributeError, OverflowError) as error:
        raise PoiseError(f"the pickle is damaged ({shown(error)})", path, CUT_OFF) from None
    except RecursionError:
        raise PoiseError("the pickle is nested too deeply", path) from None
    raise PoiseError("the pickle does not end", path, CUT_OFF)


def _push(machine: _Machine, arg: Any) -> None:
    machine.stack.append(arg)


def _const(value: Any) -> Callable[[_Machine, Any], None]:
    return lambda machine, arg: machine.stack.append(value)


def _fresh(make: Callable[[], Any]) -> Callable[[_Machine, Any], None]:
    return lambda machine, arg: machine.stack.append(make())


def _nothing(machine: _Machine, arg: Any) -> None:
    """PROTO and FRAME tell nothing that matters here."""


def _mark(machine: _Machine, arg: Any) -> None:
    machine.marks.append(len(machine.stack))


def _put(machine: _Machine, arg: Any) -> None:
    machine.memo[len(machine.memo) if arg is None else int(arg)] = machine.stack[-1]


def _get(machine: _Machine, arg: Any) -> None:
    machine.stack.append(machine.memo[int(arg)])


def _append(machine: _Machine, arg: Any) -> None:
    item = machine.stack.pop()
    checked(list, machine.stack[-1]).append(item)


def _appends(machine: _Machine, arg: Any) -> None:
    items = machine.since_mark()
    checked(list, machine.stack[-1]).extend(items)


def _set(target: Any, pairs: list[Any]) -> None:
    if not isinstance(target, dict) or len(pairs) % 2:
        raise ValueError("a dict was expected")
    for key, value in zip(pairs[::2], pairs[1::2], strict=True):
        # Keys of other kinds could take forever to hash.
        if not isinstance(key, str | int | bytes):
            raise ValueError("a key is no text")
        target[key] = value


def _setitem(machine: _Machine, arg: Any) -> None:
    pair = machine.stack[-2:]
    del machine.stack[-2:]
    _set(machine.stack[-1], pair)


def _setitems(machine: _Machine, arg: Any) -> None:
    pairs = machine.since_mark()
    _set(machine.stack[-1], pairs)


def _marked(make: Callable[[list[Any]], Any]) -> Callable[[_Machine, Any], None]:
    return lambda machine, arg: machine.stack.append(make(machine.since_mark()))


def _dict(items: list[Any]) -> dict[Any, Any]:
    out: dict[Any, Any] = {}
    _set(out, items)
    return out


def _tuple(count: int) -> Callable[[_Machine, Any], None]:
    def step(machine: _Machine, arg: Any) -> None:
        items = tuple(machine.stack[len(machine.stack) - count :])
        if len(items) != count:
            raise IndexError("the stack is empty")
        del machine.stack[len(machine.stack) - count :]
        machine.stack.append(items)

    return step


def _global(machine: _Machine, arg: Any) -> None:
    if arg is None:
        name = machine.stack.pop()
        arg = f"{checked(str, machine.stack.pop())} {checked(str, name)}"
    name = str(arg).replace(" ", ".")
    for core in _CORE:
        name = name.replace(core, "numpy.core.", 1) if name.startswith(core) else name
    if name not in CALLS and name not in ("numpy.ndarray", "__builtin__.object", "builtins.object"):
        raise PoiseError(
            f"the pickle names {shown(name)}, which is no plain data, and was not read",
            machine.path,
            "Save the arrays with numpy.savez instead",
        )
    machine.stack.append(_Named(name))


def _reduce(machine: _Machine, arg: Any) -> None:
    args = checked(tuple, machine.stack.pop())
    what = checked(_Named, machine.stack.pop())
    call = CALLS.get(what.name)
    if call is None:
        raise ValueError(f"{what.name} cannot be made")
    machine.stack.append(machine.counted(call(*args)))


def _build(machine: _Machine, arg: Any) -> None:
    state = machine.stack.pop()
    target = machine.stack[-1]
    if isinstance(target, Array):
        # (version, shape, dtype, Fortran order, bytes or list), in old files without the version.
        target.value = machine.counted(array_of(*checked(tuple, state)[-4:]))
    elif isinstance(target, Dtype):
        if any(part is not None for part in checked(tuple, state)[2:5]):
            raise ValueError("structured arrays are no plain data")
        target.order = str(text(state[1]))
    else:
        raise ValueError("an object that is no array has a state")


_PUSHED = (
    *("INT", "BININT", "BININT1", "BININT2", "LONG", "LONG1", "LONG4", "FLOAT", "BINFLOAT"),
    *("STRING", "BINSTRING", "SHORT_BINSTRING", "BINBYTES", "SHORT_BINBYTES", "BINBYTES8"),
    *("BYTEARRAY8", "UNICODE", "BINUNICODE", "SHORT_BINUNICODE", "BINUNICODE8"),
)
_STEPS: dict[str, Callable[[_Machine, Any], None]] = {
    **dict.fromkeys(("PROTO", "FRAME"), _nothing),
    **dict.fromkeys(_PUSHED, _push),
    "NONE": _const(None),
    "NEWTRUE": _const(True),
    "NEWFALSE": _const(False),
    "EMPTY_LIST": _fresh(list),
    "EMPTY_DICT": _fresh(dict),
    "EMPTY_TUPLE": _const(()),
    "MARK": _mark,
    "LIST": _marked(list),
    "TUPLE": _marked(tuple),
    "DICT": _marked(_dict),
    **{f"TUPLE{n}": _tuple(n) for n in (1, 2, 3)},
    "APPEND": _append,
    "APPENDS": _appends,
    "SETITEM": _setitem,
    "SETITEMS": _setitems,
    **dict.fromkeys(("PUT", "BINPUT", "LONG_BINPUT", "MEMOIZE"), _put),
    **dict.fromkeys(("GET", "BINGET", "LONG_BINGET"), _get),
    **dict.fromkeys(("GLOBAL", "STACK_GLOBAL"), _global),
    "REDUCE": _reduce,
    "BUILD": _build,
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
