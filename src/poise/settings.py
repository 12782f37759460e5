"""Settings as data: a frozen dataclass to JSON or TOML and back, every value checked.

    data = to_data(config)                      # for a checkpoint's JSON
    config = from_data(ResidualForce, data)     # or one sentence that names the setting
    text = to_toml(config); config = from_toml(ResidualForce, path)

A setting that was renamed since a run was made is found by `Migration`, so that old runs open for ever.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
import tomllib
from collections.abc import Mapping
from dataclasses import Field, dataclass, field, fields, is_dataclass
from functools import cache
from importlib import import_module
from pathlib import Path
from types import NoneType, UnionType
from typing import (
    Any,
    Literal,
    TypeGuard,
    TypeVar,
    Union,
    cast,
    get_args,
    get_origin,
    get_type_hints,
    is_typeddict,
)

from poise.errors import PoiseError, did_you_mean

T = TypeVar("T")
#: How TOML, which has no null, says that a part is left out.
NONE = "none"


@dataclass(frozen=True)
class Migration:
    """What settings of earlier versions are called now.

    keys: dotted names of then to dotted names of now; a value moves with its key. values: by the new
    dotted name, what a value of then is called now. absent: what a run did that does not name a setting,
    where that is not today's default.
    """

    keys: Mapping[str, str] = field(default_factory=dict[str, str])
    values: Mapping[str, Mapping[Any, Any]] = field(default_factory=dict[str, Mapping[Any, Any]])
    absent: Mapping[str, Any] = field(default_factory=dict[str, Any])

    def __call__(self, data: Mapping[str, Any]) -> dict[str, Any]:
        """The settings under their names of today; `data` stays as it is."""
        out: dict[str, Any] = json.loads(json.dumps(data))
        for old, new in self.keys.items():
            holder, name = _holder(out, old)
            if holder is not None and name in holder:
                value = holder.pop(name)
                *parts, last = new.split(".")
                here = out
                for part in parts:
                    here = cast("dict[str, Any]", here.setdefault(part, {}))
                here[last] = value
        for name, known in self.values.items():
            holder, last = _holder(out, name)
            if holder is not None and isinstance(holder.get(last), str):
                holder[last] = known.get(holder[last], holder[last])
        for name, value in self.absent.items():
            holder, last = _holder(out, name)
            if holder is not None:
                holder.setdefault(last, value)
        return out


def to_data(config: Any) -> dict[str, Any]:
    """The settings as JSON data."""
    return json.loads(json.dumps(dataclasses.asdict(config)))


def plain(value: Any) -> Any:
    """Results as JSON data: dataclasses as tables, tuples as lists, paths as text, and null for a number
    that is not finite."""
    if is_dataclass(value):
        return {f.name: plain(getattr(value, f.name)) for f in fields(value)}
    if _is_table(value):
        return {str(k): plain(v) for k, v in value.items()}
    if _is_list(value):
        return [plain(v) for v in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return str(value) if isinstance(value, Path) else value


def from_data(kind: type[T], data: Any, where: Path | str | None = None) -> T:
    """Settings from JSON data; what is left out is as by default.

    Raises:
        PoiseError: an unknown setting, or a value of another type; `where` says in which file.
    """
    return _made(kind, data, "", where)


def validate(config: Any) -> None:
    """Refuses a settings object with a value that its fields cannot have; for `__post_init__`.

    A `Literal` field must have one of its values, and a `seed` must fit the random generators.

    Raises:
        PoiseError: another value, with the nearest one that there is.
    """
    own = cast("type[Any]", type(config))
    name = own.__name__
    for f in fields(config):
        value, known = getattr(config, f.name), _choices(_types(own)[f.name])
        if known and value not in known:
            texts = [str(k) for k in known]
            raise PoiseError(
                f"{f.name} cannot be {_short(value)}", name, did_you_mean(str(value)[:40], texts)
            )
        if f.name == "seed" and not (isinstance(value, int) and 0 <= value < 2**63):
            raise PoiseError(f"seed must be a whole number from 0 to 2**63 - 1, got {value!r}", name)


def changed(config: T, settings: Mapping[str, Any]) -> T:
    """The settings with some of them changed.

    Raises:
        PoiseError: a setting that there is not, or a value that it cannot have.
    """
    known = [f.name for f in fields(config) if f.init]  # type: ignore[arg-type]
    for name in settings:
        if name not in known:
            what = f"there is no setting '{name}'"
            raise PoiseError(what, type(config).__name__, did_you_mean(name, known))
    return dataclasses.replace(config, **settings)  # type: ignore[type-var]


def _choices(kind: Any) -> tuple[Any, ...]:
    """The values of a `Literal`, or of one that may be None; () where anything goes."""
    origin, args = get_origin(kind), get_args(kind)
    if origin is Literal:
        return args
    if origin in (Union, UnionType):
        own = [_choices(a) if a is not NoneType else (None,) for a in args]
        return () if () in own else tuple(v for part in own for v in part)
    return ()


def check_data(kind: type, data: Any, where: Path | str | None = None, name: str = "") -> None:
    """Refuses JSON data that is not as a `TypedDict` says; keys that it does not name are left alone.

    Raises:
        PoiseError: a key is missing, or a value is of another type.
    """
    if not isinstance(data, Mapping):
        what = name or "what it says of itself"
        raise PoiseError(f"{what} must be a table, got {_short(data)}", where)
    inside = f" in {name}" if name else ""
    missing = sorted(k for k in getattr(kind, "__required_keys__", ()) if k not in data)
    if missing:
        hint = "The file is damaged, or of another kind"
        raise PoiseError(f"'{missing[0]}' is missing{inside}", where, hint)
    for key, one in _types(kind).items():
        if key in data:
            _value(one, data[key], f"{name}.{key}" if name else key, where)


def to_toml(config: Any) -> str:
    """The settings as TOML text, one table a part."""
    import tomli_w

    return tomli_w.dumps(_without_null(to_data(config)))


def from_toml(kind: type[T], path: Path, verb: str = "") -> T:
    """Settings from a TOML file; what is left out is as by default.

    Raises:
        PoiseError: no such file, no TOML, an unknown setting, or a value of another type.
    """
    try:
        data = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as problem:
        raise PoiseError(f"cannot be read ({(problem.strerror or '').lower()})", path) from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as problem:
        hint = f"poise {verb} --print-config shows one that is complete" if verb else ""
        raise PoiseError(f"is no TOML ({problem})", path, hint) from None
    return from_data(kind, data, path)


def part(place: str, /, made: bool = True, **values: Any) -> Any:
    """A field for settings of another module, which is imported when they are first needed: the settings
    around them can be shown without torch or MuJoCo.

    Args:
        place: module and class, "poise.learn:PPOConfig".
        made: by default there are such settings; else None.
        values: of its settings, where they differ from its own defaults.
    """
    where = {"place": place}
    if not made:
        return field(default=None, metadata=where)
    return field(default_factory=lambda: imported(place)(**values), metadata=where)


def imported(place: str) -> Any:
    """What stands in a module, "poise.learn:PPOConfig"."""
    module, _, name = place.partition(":")
    return getattr(import_module(module), name)


@cache
def _types(kind: type) -> dict[str, Any]:
    own: dict[str, Field[Any]] = getattr(kind, "__dataclass_fields__", {})
    places: list[str] = [f.metadata["place"] for f in own.values() if "place" in f.metadata]
    return get_type_hints(kind, localns={p.partition(":")[2]: imported(p) for p in places} or None)


def _made(kind: Any, data: Any, name: str, where: Path | str | None) -> Any:
    if not _is_table(data):
        what = name or "the settings"
        raise PoiseError(f"{what} must be a table of settings, got {_short(data)}", where)
    types = {f.name: _types(kind)[f.name] for f in fields(kind) if f.init}
    unknown = [k for k in data if k not in types]
    if unknown:
        near = did_you_mean(str(unknown[0]), list(types)) or f"Known: {', '.join(types)}"
        whole = f"{name}.{unknown[0]}" if name else str(unknown[0])
        raise PoiseError(f"there is no setting '{whole}' in this version of Poise", where, near)
    values = {k: _value(types[k], v, f"{name}.{k}" if name else k, where) for k, v in data.items()}
    try:
        return kind(**values)
    except PoiseError as problem:
        # What the settings refuse by themselves is told with the file.
        raise PoiseError(problem.what, problem.where if where is None else where, problem.hint) from None


def _value(kind: Any, value: Any, name: str, where: Path | str | None) -> Any:
    """`value` as the annotated type `kind`, lists as tuples."""
    origin, args = get_origin(kind), get_args(kind)
    if kind is Any:
        return value
    if origin in (Union, UnionType):
        if NoneType in args and (value is None or value == NONE):
            return None
        *others, last = [a for a in args if a is not NoneType]
        for one in others:
            with contextlib.suppress(PoiseError):
                return _value(one, value, name, where)
        return _value(last, value, name, where)
    if origin is Literal:
        if value not in args:
            known = ", ".join(f"'{a}'" for a in args)
            raise PoiseError(f"{name} must be one of {known}, got {value!r}", where)
        return value
    if is_dataclass(kind):
        return _made(kind, value, name, where)
    if is_typeddict(kind):
        check_data(kind, value, where, name)
        return value
    if origin is list and isinstance(value, list):
        items = enumerate(cast("list[Any]", value))
        return [_value(args[0], v, f"{name}[{i}]", where) for i, v in items]
    if origin is tuple and _is_list(value):
        kinds = args[:1] * len(value) if len(args) == 2 and args[1] is ... else args
        if len(kinds) != len(value):
            raise PoiseError(f"{name} must have {len(kinds)} values, got {len(value)}", where)
        pairs = enumerate(zip(kinds, value, strict=True))
        return tuple(_value(k, v, f"{name}[{i}]", where) for i, (k, v) in pairs)
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        return value
    plain = origin or kind
    if not isinstance(value, plain) or (isinstance(value, bool) and plain is not bool):
        raise PoiseError(f"{name} must be {_words(kind)}, got {_short(value)}", where)
    return value


def _is_table(value: Any) -> TypeGuard[Mapping[str, Any]]:
    return isinstance(value, Mapping)


def _is_list(value: Any) -> TypeGuard[list[Any] | tuple[Any, ...]]:
    return isinstance(value, list | tuple)


def _short(value: Any) -> str:
    """A value of a file, of which not all is to be printed."""
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:56]} ..."


def _words(kind: Any) -> str:
    names = {float: "a number", int: "a whole number", bool: "true or false", str: "a text"}
    if get_origin(kind) in (tuple, list):
        return "a list"
    if get_origin(kind) is dict:
        return "a table"
    return names.get(kind, f"a {getattr(kind, '__name__', kind)}")


def _holder(data: dict[str, Any], dotted: str) -> tuple[dict[str, Any] | None, str]:
    """The table that holds a dotted name, None where there is none, and the last part of the name."""
    *parts, last = dotted.split(".")
    here: Any = data
    for part in parts:
        here = cast("dict[str, Any]", here).get(part) if isinstance(here, dict) else None
    return (cast("dict[str, Any]", here) if isinstance(here, dict) else None), last


def _without_null(value: Any) -> Any:
    if _is_table(value):
        return {k: NONE if v is None else _without_null(v) for k, v in value.items()}
    return [_without_null(v) for v in value] if _is_list(value) else value
