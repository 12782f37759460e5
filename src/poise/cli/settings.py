"""The settings of a recipe as options: derived from its dataclass, so that defaults have one truth.

What trains is put together in this order: the recipe's defaults, or --preset, or --config; then the
options that are given; then --set. The recipe's source is read, not imported, since that takes seconds
and `--help` shall not: a test holds both against each other.
"""

from __future__ import annotations

import ast
import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import field, fields, make_dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar, cast, get_args

import poise
from poise.errors import PoiseError

if TYPE_CHECKING:
    from poise.motion import Clip

T = TypeVar("T")
#: Where the dataclass of each recipe stands, below the package.
SOURCES = {
    "residual-force": ("recipes/residual_force.py", "ResidualForce"),
    "inbetween": ("jobs/inbetween/training.py", "Inbetween"),
    "perpetual": ("recipes/perpetual_settings.py", "Perpetual"),
    "endless": ("jobs/endless/training.py", "Endless"),
    "compliant": ("papers/compliant/training.py", "Compliant"),
}
_TYPES = {"float": float, "int": int, "bool": bool, "str": str}
#: Those with a range, in `poise.settings`.
_TYPES |= {"Share": float, "Positive": float, "NotNegative": float, "Count": int, "Limit": float}
#: Of fields that need no entry in a recipe.
_UNSAID = {
    "num_envs": "environments that are simulated at once.",
    "seed": "seed of everything random.",
    "net": "the network; rtn is that of Harvey et al. 2020.",
}
_METAVARS = {float: "X", int: "N", str: "TEXT"}


def class_of(recipe: str) -> type:
    """The dataclass of a recipe's settings, which takes seconds to import."""
    file, name = SOURCES[recipe]
    return getattr(import_module("poise." + file.removesuffix(".py").replace("/", ".")), name)


def derived(recipe: str, prefix: str, *names: str, **flags: str) -> type:
    """A frozen dataclass of options for the fields `names` of a recipe's settings.

    A field that the command line does not state is None, or for a switch its default, so that
    `given` knows what was stated.

    Args:
        prefix: what every help text begins with.
        flags: field and the name of its option, where they differ: `num_envs="envs"`.
    """
    from tyro.conf import arg

    found = _fields_of(recipe)
    made = []
    for name in (*names, *flags):
        kind, default, text = found[name]
        hint = "" if default is None else f"(default: {default})"
        how: dict[str, Any] = {"name": flags.get(name), "help_behavior_hint": hint}
        if kind is bool:
            off = "" if not default or text.startswith("off,") else "switch off: "
            how |= {"help": _upper(prefix + off + text), "help_behavior_hint": ""}
            made.append((name, Annotated[bool, arg(**how)], field(default=bool(default))))
            continue
        values = [str(v) for v in get_args(kind)]
        how |= {"help": _upper(prefix + text), "metavar": "|".join(values) or _METAVARS[kind]}
        made.append((name, Annotated[kind | None, arg(**how)], field(default=None)))
    return make_dataclass(f"Settings{SOURCES[recipe][1]}", made, frozen=True)


def _upper(text: str) -> str:
    return text if re.match(r"\w+: ", text) else text[:1].upper() + text[1:]


def _fields_of(recipe: str) -> dict[str, tuple[Any, Any, str]]:
    """Type, default and help text of each field of plain values."""
    file, name = SOURCES[recipe]
    tree = ast.parse((Path(poise.__file__).parent / file).read_text("utf-8"))
    known: dict[str, Any] = dict(_TYPES)
    for node in tree.body:
        if isinstance(node, ast.Assign) and (alias := _type_of(node.value, known)) is not None:
            known[ast.unparse(node.targets[0])] = alias
    kind = next(n for n in tree.body if isinstance(n, ast.ClassDef) and n.name == name)
    rows = {str(ast.unparse(n.target)): n for n in kind.body if isinstance(n, ast.AnnAssign)}
    texts = _texts(ast.get_docstring(kind) or "", tuple(rows))
    out: dict[str, tuple[Any, Any, str]] = {}
    for row, node in rows.items():
        read = _type_of(node.annotation, known)
        if isinstance(node.value, ast.Constant) and read is not None:
            out[row] = read, node.value.value, texts.get(row) or _UNSAID.get(row, "")
    return out


def _type_of(node: ast.expr, known: Mapping[str, Any]) -> Any:
    """The plain type that an annotation names, without its None; None for any other."""
    if isinstance(node, ast.BinOp):
        return _type_of(node.left, known)
    if isinstance(node, ast.Subscript) and ast.unparse(node.value) == "Annotated":
        return _type_of(cast("ast.Tuple", node.slice).elts[0], known)
    if isinstance(node, ast.Subscript) and ast.unparse(node.value) == "Literal":
        return Literal[ast.literal_eval(node.slice)]
    return known.get(node.id) if isinstance(node, ast.Name) else None


def _texts(doc: str, names: tuple[str, ...]) -> dict[str, str]:
    """Each entry `name: text` of a docstring, on one line or of several."""
    flat = " ".join(doc.split())
    parts = re.split(rf"(?:(?<=[.:] )|^)((?:{'|'.join(names)})(?:, (?:{'|'.join(names)}))*): ", flat)
    out: dict[str, str] = {}
    for listed, text in zip(parts[1::2], parts[2::2], strict=True):
        out |= dict.fromkeys(listed.split(", "), text.replace("`", "").strip())
    return out


def given(*groups: Any) -> dict[str, Any]:
    """What the command line states, by the name of the setting."""
    pairs = ((f, getattr(group, f.name)) for group in groups for f in fields(group))
    return {f.name: value for f, value in pairs if value != f.default}


def stated(texts: tuple[str, ...], kind: type) -> tuple[dict[str, Any], list[str]]:
    """Settings of `kind` among NAME=VALUE texts such as ppo.policy_lr=1e-4, and the other texts."""
    known, out, other = {f.name for f in fields(kind)}, {}, []
    for text in texts:
        name, equals, value = text.partition("=")
        name = name.strip().replace("-", "_")
        if not equals or name.partition(".")[0] not in known:
            other.append(text)
            continue
        try:
            out[name] = tomllib.loads(f"x = {value}")["x"]
        except tomllib.TOMLDecodeError:
            out[name] = value.strip()
    return out, other


def configured(base: T, values: Mapping[str, Any]) -> T:
    """The settings with `values`, by dotted names.

    Raises:
        PoiseError: no such setting, or a value that it cannot have.
    """
    from poise.settings import from_data, to_data

    if not values:
        return base
    data = to_data(base)
    for name, value in values.items():
        *parts, last = name.split(".")
        here = data
        for part in parts:
            if not isinstance(here.get(part), dict):
                here[part] = {}
            here = here[part]
        here[last] = value
    return from_data(type(base), data, "the command line")


def base_of(
    recipe: str, default: T, preset: str | None, config: Path | None, verb: str, clip: Clip | None
) -> T:
    """The settings that options then change: the recipe's, those of a preset, or of a file.

    clip: what is imitated, by which a preset chooses some of its values.
    """
    from poise.settings import from_toml

    if preset is not None and config is not None:
        raise PoiseError(
            "--preset and --config both state all settings", hint="Leave one out", code="option-conflict"
        )
    if config is not None:
        return from_toml(type(default), config, verb)
    if preset is None:
        return default
    from poise.jobs.presets import preset_of

    return preset_of(recipe, preset, clip)


def dotted(argv: Sequence[str]) -> list[str]:
    """A command line in which --ppo.policy-lr 1e-4 stands as --set ppo.policy-lr=1e-4."""
    out: list[str] = []
    rest: Iterator[str] = iter(argv)
    for word in rest:
        if not re.match(r"--[a-z][\w-]*\.[\w.-]+", word):
            out.append(word)
            continue
        name, equals, value = word[2:].partition("=")
        if not equals and (value := next(rest, "")) == "":
            raise PoiseError(
                f"--{name} needs a value", hint=f"Write --{name} VALUE", code="option-malformed"
            )
        out += ["--set", f"{name}={value}"]
    return out
