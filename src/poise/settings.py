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
import sys
import tomllib
from collections.abc import Mapping
from dataclasses import Field, dataclass, field, fields, is_dataclass
from functools import cache, cached_property
from importlib import import_module
from itertools import pairwise
from pathlib import Path
from types import NoneType, UnionType
from typing import (
    Annotated,
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
    """The present names of settings of earlier versions.

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


@dataclass(frozen=True)
class Range:
    """The numbers that a field may have, declared with it: `share: Annotated[float, Range(0, 1)] = 0.5`.

    Each number of a tuple must lie in it; NaN never does.

    Attributes:
        low, high: the limits.
        above, below: `low`, or `high`, itself is none of the numbers.
        rising: no number of a tuple is below the one before it.
        infinite: infinity is one of them, on a side without a limit.
        unit: the word behind the limits, such as "kg".
        hint: what to do about another number.
    """

    low: float = -math.inf
    high: float = math.inf
    above: bool = False
    below: bool = False
    rising: bool = False
    infinite: bool = False
    unit: str = ""
    hint: str = ""

    @cached_property
    def limits(self) -> tuple[float, float]:
        """The least and the largest number of the range, both in it."""
        low = math.nextafter(self.low, math.inf) if self.above else self.low
        high = math.nextafter(self.high, -math.inf) if self.below else self.high
        most = math.inf if self.infinite else sys.float_info.max
        return max(low, -most), min(high, most)

    def holds(self, number: float) -> bool:
        """Whether a number lies in the range."""
        low, high = self.limits
        return low <= number <= high

    def check(self, number: float, name: str, where: str | None = None) -> None:
        """Refuses a number that is called `name`, by a PoiseError."""
        if not self.holds(number):
            raise PoiseError(
                f"{name} must {self}, got {number!r}", where, self.hint or None, code="out-of-range"
            )

    def __str__(self) -> str:
        """The range in words that follow "must"."""
        unit = f" {self.unit}" if self.unit else ""
        low = f"{'above' if self.above else 'at least'} {self.low:g}"
        high = f"{'below' if self.below else 'at most'} {self.high:g}"
        if math.isinf(self.low) and math.isinf(self.high):
            return "be a number" if self.infinite else "be a finite number"
        if math.isinf(self.low) or math.isinf(self.high):
            return f"be {low if math.isinf(self.high) else high}{unit}"
        if self.above or self.below:
            return f"be {low} and {high}{unit}"
        return f"lie in {self.low:g} to {self.high:g}{unit}"


@dataclass(frozen=True)
class Length:
    """How many values a field may have, declared with it: `Annotated[tuple[int, ...], Length(1)]`."""

    low: int = 0
    high: float = math.inf

    def __str__(self) -> str:
        """The length in words that follow "must"."""
        many = self.low if math.isinf(self.high) else self.high
        how = "" if self.low == self.high else "at least " if math.isinf(self.high) else "at most "
        how = f"{self.low} to " if how == "at most " and self.low else how
        return f"have {how}{many:g} value{'' if many == 1 else 's'}"


#: The ranges that most fields have.
Share = Annotated[float, Range(0, 1)]
Positive = Annotated[float, Range(0, above=True)]
NotNegative = Annotated[float, Range(0)]
Count = Annotated[int, Range(1)]
#: Of what is limited, infinite for no limit.
Limit = Annotated[float, Range(0, infinite=True)]


class Checked:
    """Base of dataclasses that need no other check than `validate`."""

    def __post_init__(self) -> None:
        validate(self)


def validate(config: Any, where: str | None = None) -> None:
    """Refuses a dataclass with a value that its fields do not declare; for `__post_init__`.

    A `Literal` field must have one of its values. Numbers must lie in the declared `Range`; floats
    without one must be finite. A tuple must have as many values as its type or `Length` says. A `seed`
    must fit the random generators.

    Args:
        where: what an error calls the object; by default its class and, if it has one, its name.

    Raises:
        PoiseError: another value, with the values that are allowed.
    """
    for one, name, low, high in _declared(cast("type[Any]", type(config))):
        value: object = getattr(config, name)
        if (type(value) is float or type(value) is int) and low <= value <= high:
            continue  # Most fields are done here.
        what = one.refuses(value)
        if what:
            if where is None:
                where, called = type(config).__name__, getattr(config, "name", None)
                where = f"{where} '{called}'" if isinstance(called, str) else where
            raise PoiseError(
                f"{name} {what}",
                where,
                one.hint(value),
                code="unknown-choice" if one.choices else "out-of-range",
            )


@dataclass(frozen=True)
class _Declared:
    """The declaration of one field of a dataclass.

    Attributes:
        choices: of a `Literal`; () where anything goes.
        range, length: of its numbers, and of its tuple; None where anything goes.
        inner: of each tuple in its tuple.
        none: whether it, or a value in it, may be None.
        numeric: whether its type names numbers, and tuples of them, alone.
        listed: whether its type names tuples alone.
    """

    name: str
    choices: tuple[Any, ...]
    range: Range | None
    length: Length | None
    inner: Length | None
    none: bool
    numeric: bool
    listed: bool

    def refuses(self, value: Any) -> str:
        """The fault of a value in words, "" for a right one."""
        if self.choices:
            return "" if value in self.choices else f"cannot be {_short(value)}"
        if self.name == "seed" and not (isinstance(value, int) and 0 <= value < 2**63):
            return f"must be a whole number from 0 to 2**63 - 1, got {value!r}"
        if value is None and self.none:
            return ""
        if self.numeric and type(value) is not tuple:
            # Numbers and arrays of NumPy and of PyTorch are as their plain values.
            value = _plain_number(value)
        if not _is_list(value):
            if self.listed:
                return f"must {self.length or 'be a tuple'}, got {_short(value)}"
            return "" if self._within(value) else f"must {self.range}, got {_short(value)}"
        rising = self.range is not None and self.range.rising
        if not self._within(value):
            each = "" if rising else " in each value"
            return f"must {'rise and ' * rising}{self.range}{each}, got {_short(value)}"
        if rising and any(a > b for a, b in pairwise(value)):
            return f"must rise and {self.range}, got {_short(value)}"
        length, inner = self.length, self.inner
        if length is not None and not length.low <= len(value) <= length.high:
            return f"must {length}, got {_short(value) if len(value) < 9 else len(value)}"
        if inner is not None and not all(_is_list(v) and len(v) == inner.low for v in value):
            return f"must hold tuples that {inner}, got {_short(value)}"
        return ""

    def hint(self, value: Any) -> str | None:
        """The hint for a value that is refused."""
        if self.choices:
            return did_you_mean(str(value)[:40], [str(c) for c in self.choices])
        return (self.range.hint if self.range else "") or None

    def _within(self, value: Any) -> bool:
        """Whether all numbers of a value lie in the range."""
        if self.range is None:
            return True
        if isinstance(value, float | int):
            return self.range.holds(value)
        if _is_list(value):
            low, high = self.range.limits
            return all(low <= v <= high if type(v) is float else self._within(v) for v in value)
        return self.none if value is None else not self.numeric


@cache
def _declared(kind: type) -> tuple[tuple[_Declared, str, float, float], ...]:
    """Declarations of the fields of a dataclass, but for those that may be anything: each with its
    name and the limits of a plain number."""
    # Settings of other modules check themselves; they need not be imported for this.
    others = {place.partition(":")[2]: object for place in _places(kind).values()}
    hints = get_type_hints(kind, localns=others or None, include_extras=True)
    out: list[tuple[_Declared, str, float, float]] = []
    for f in fields(kind):
        hint = hints[f.name]
        leaves, marks = _parts(hint)
        own = leaves - {NoneType}
        range_ = next((m for m in marks if isinstance(m, Range)), Range() if float in own else None)
        length = next((m for m in marks if isinstance(m, Length)), _fixed(hint))
        inner = next((n for n in map(_fixed, _items(hint)) if n is not None), None)
        choices, listed = _choices(hint), _listed(hint)
        if not f.init or not (choices or range_ or length or inner or f.name == "seed"):
            continue
        one = _Declared(
            f.name, choices, range_, length, inner, NoneType in leaves, own <= {float, int}, listed
        )
        # No number lies between the limits of a field that needs more than a plain number.
        plain = range_ is not None and not (listed or choices or f.name == "seed")
        low, high = range_.limits if range_ is not None and plain else (math.inf, -math.inf)
        out.append((one, f.name, low, high))
    return tuple(out)


def _parts(hint: Any) -> tuple[set[Any], list[Any]]:
    """The types of the values in a field, tuples taken apart, and what `Annotated` adds."""
    origin, args = get_origin(hint), get_args(hint)
    if origin is Annotated:
        leaves, marks = _parts(args[0])
        return leaves, [*args[1:], *marks]
    if origin is Literal:
        return {type(a) for a in args}, []
    if origin not in (Union, UnionType, tuple, list):
        return {origin or hint}, []
    parts = [_parts(a) for a in args if a is not ...]
    leaves: set[Any] = set[Any]().union(*(leaf for leaf, _ in parts))
    return leaves, [m for _, marks in parts for m in marks]


def _fixed(hint: Any) -> Length | None:
    """How many values the tuple of a type has, None where that is left open."""
    origin, args = get_origin(hint), get_args(hint)
    if origin is Annotated:
        return _fixed(args[0])
    if origin in (Union, UnionType):
        return next((n for n in map(_fixed, args) if n is not None), None)
    return Length(len(args), len(args)) if origin is tuple and args and ... not in args else None


def _listed(hint: Any) -> bool:
    """Whether a type names tuples alone, or None."""
    origin, args = get_origin(hint), get_args(hint)
    if origin is Annotated:
        return _listed(args[0])
    if origin in (Union, UnionType):
        return all(_listed(a) for a in args if a is not NoneType)
    return origin is tuple


def _items(hint: Any) -> tuple[Any, ...]:
    """The type of the values of a `tuple[..., ...]`."""
    args = get_args(hint)
    if get_origin(hint) is Annotated:
        return _items(args[0])
    return args[:1] if get_origin(hint) is tuple and ... in args else ()


def _plain_number(value: Any) -> Any:
    """Numbers and arrays of NumPy and of PyTorch as plain ones, anything else as it is."""
    return value.tolist() if hasattr(value, "tolist") else value


def changed(config: T, settings: Mapping[str, Any]) -> T:
    """The settings with some of them changed.

    Raises:
        PoiseError: a setting that there is not, or a value that it cannot have.
    """
    known = [f.name for f in fields(config) if f.init]  # type: ignore[arg-type]
    for name in settings:
        if name not in known:
            what = f"there is no setting '{name}'"
            raise PoiseError(
                what, type(config).__name__, did_you_mean(name, known), code="unknown-setting"
            )
    return dataclasses.replace(config, **settings)  # type: ignore[type-var]


def _choices(kind: Any) -> tuple[Any, ...]:
    """The values of a `Literal`, or of one that may be None; () where anything goes."""
    origin, args = get_origin(kind), get_args(kind)
    if origin is Literal:
        return args
    if origin is Annotated:
        return _choices(args[0])
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
        raise PoiseError(f"{what} must be a table, got {_short(data)}", where, code="wrong-type")
    inside = f" in {name}" if name else ""
    missing = sorted(k for k in getattr(kind, "__required_keys__", ()) if k not in data)
    if missing:
        hint = "The file is damaged, or of another kind"
        raise PoiseError(f"'{missing[0]}' is missing{inside}", where, hint, code="key-missing")
    for key, one in types_of(kind).items():
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
        raise PoiseError(
            f"cannot be read ({(problem.strerror or '').lower()})", path, code="file-unreadable"
        ) from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as problem:
        hint = f"poise {verb} --print-config shows one that is complete" if verb else ""
        raise PoiseError(f"is no TOML ({problem})", path, hint, code="bad-toml") from None
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
    """The object at a place in a module, "poise.learn:PPOConfig"."""
    module, _, name = place.partition(":")
    return getattr(import_module(module), name)


@cache
def types_of(kind: type) -> dict[str, Any]:
    """The types of a settings class by field, with those of parts of other modules, see `part`."""
    places = _places(kind)
    hints = get_type_hints(
        kind, localns={p.partition(":")[2]: imported(p) for p in places.values()} or None
    )
    # A module may not name settings of a folder above it: there a part that is made is typed `Any`.
    own = {k: imported(p) for k, p in places.items() if hints[k] is Any and getattr(kind, k, p) == p}
    return hints | own


def _places(kind: type) -> dict[str, str]:
    """The places of settings of other modules in a dataclass, by field, see `part`."""
    own: dict[str, Field[Any]] = getattr(kind, "__dataclass_fields__", {})
    return {f.name: f.metadata["place"] for f in own.values() if "place" in f.metadata}


def _made(kind: Any, data: Any, name: str, where: Path | str | None) -> Any:
    if not _is_table(data):
        what = name or "the settings"
        raise PoiseError(
            f"{what} must be a table of settings, got {_short(data)}", where, code="wrong-type"
        )
    types = {f.name: types_of(kind)[f.name] for f in fields(kind) if f.init}
    unknown = [k for k in data if k not in types]
    if unknown:
        near = did_you_mean(str(unknown[0]), list(types)) or f"Known: {', '.join(types)}"
        whole = f"{name}.{unknown[0]}" if name else str(unknown[0])
        raise PoiseError(
            f"there is no setting '{whole}' in this version of Poise",
            where,
            near,
            code="unknown-setting",
        )
    values = {k: _value(types[k], v, f"{name}.{k}" if name else k, where) for k, v in data.items()}
    try:
        return kind(**values)
    except PoiseError as problem:
        # What the settings refuse by themselves is told with the file.
        raise PoiseError(
            problem.what, problem.where if where is None else where, problem.hint, code=problem.code
        ) from None


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
            raise PoiseError(
                f"{name} must be one of {known}, got {value!r}", where, code="unknown-choice"
            )
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
            raise PoiseError(
                f"{name} must have {len(kinds)} values, got {len(value)}", where, code="count-differs"
            )
        pairs = enumerate(zip(kinds, value, strict=True))
        return tuple(_value(k, v, f"{name}[{i}]", where) for i, (k, v) in pairs)
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        return value
    plain = origin or kind
    if not isinstance(value, plain) or (isinstance(value, bool) and plain is not bool):
        raise PoiseError(f"{name} must be {_words(kind)}, got {_short(value)}", where, code="wrong-type")
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
