"""The settings of a recipe as options: derived from its dataclass, so that defaults have one truth.

What trains is put together in this order: the recipe's defaults, or --preset, or --config; then the
options that are given; then --set. Settings with options stand in modules that need neither torch nor
MuJoCo, which take seconds to import.
"""

from __future__ import annotations

import re
import sys
import tomllib
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import field, fields, is_dataclass, make_dataclass
from pathlib import Path
from types import NoneType, SimpleNamespace
from typing import (
    TYPE_CHECKING,
    Annotated,
    Any,
    Literal,
    TypeVar,
    cast,
    get_args,
    get_origin,
    get_type_hints,
)

from poise.errors import PoiseError, did_you_mean
from poise.settings import imported

if TYPE_CHECKING:
    from poise.motion import Clip

T = TypeVar("T")
#: The dataclass of each recipe's settings.
SOURCES = {
    "residual-force": "poise.recipes.residual_force_settings:ResidualForce",
    "inbetween": "poise.jobs.inbetween.inbetween_settings:Inbetween",
    "perpetual": "poise.papers.perpetual.ablations:StagedPerpetual",
    "endless": "poise.jobs.endless.endless_training:Endless",
    "compliant": "poise.papers.compliant.scene_training:Compliant",
    "compliant-imitation": "poise.papers.compliant.imitation_controller:CompliantImitation",
    "dual-policy": "poise.papers.residual_force.dual_policy:DualPolicy",
}
#: The dataclass of how a motion is tracked.
TRACK = "poise.jobs.track_settings:TrackConfig"
_METAVARS = {float: "X", int: "N", str: "TEXT"}


def derived(recipe: str, prefix: str, *names: str, **flags: str) -> type:
    """A frozen dataclass of options for the fields `names` of settings: of a recipe, or at a place.

    A field that the command line does not state is None, or for a switch its default, so that
    `given` knows what was stated.

    Args:
        prefix: what every help text begins with.
        flags: field and the name of its option, where they differ: `num_envs="envs"`.
    """
    from tyro.conf import arg

    kind = imported(SOURCES.get(recipe, recipe))
    texts, made = _texts(kind), []
    for name in (*names, *flags):
        type_, default, text = _plain_type(kind, name), getattr(kind, name), texts[name]
        hint = "" if default is None else f"(default: {default})"
        how: dict[str, Any] = {"name": flags.get(name), "help_behavior_hint": hint}
        if type_ is bool:
            off = "" if not default or text.startswith("off,") else "switch off: "
            how |= {"help": capital(prefix + off + text), "help_behavior_hint": ""}
            made.append((name, Annotated[bool, arg(**how)], field(default=default)))
            continue
        values = [str(v) for v in get_args(type_)]
        how |= {"help": capital(prefix + text), "metavar": "|".join(values) or _METAVARS[type_]}
        made.append((name, Annotated[type_ | None, arg(**how)], field(default=None)))
    return make_dataclass(f"Settings{kind.__name__}", made, frozen=True)


def capital(text: str) -> str:
    """A text that begins with a capital, but for a name before a colon ("perpetual: ...")."""
    return text if re.match(r"\w+: ", text) else text[:1].upper() + text[1:]


def _plain_type(kind: type, name: str) -> Any:
    """The type of a setting without its None; those of other settings may need torch."""
    kind = next(k for k in kind.__mro__ if name in vars(k).get("__annotations__", {}))
    one = SimpleNamespace(__annotations__={name: kind.__annotations__[name]})
    found = get_type_hints(one, vars(sys.modules[kind.__module__]))[name]
    others = [a for a in get_args(found) if a is not NoneType]
    return found if get_origin(found) is Literal or not others else others[0]


def texts_of(doc: str | None, known: Iterable[str]) -> dict[str, str]:
    """Each entry `name: text` of a docstring for the names that are known, on one line or of several."""
    names, flat = "|".join(known), " ".join((doc or "").split())
    parts = re.split(rf"(?:(?<=[.:] )|^)((?:{names})(?:, (?:{names}))*): ", flat)
    out: dict[str, str] = {}
    for listed, text in zip(parts[1::2], parts[2::2], strict=True):
        out |= dict.fromkeys(listed.split(", "), text.replace("`", "").strip())
    return out


def _texts(kind: type) -> dict[str, str]:
    """The texts of a dataclass's fields, from its docstring and from those that it extends."""
    names, out = [f.name for f in fields(kind)], dict[str, str]()
    for owner in kind.__mro__[-2::-1]:
        out |= texts_of(owner.__doc__, names)
    return out


def given(*groups: Any) -> dict[str, Any]:
    """What the command line states, by the name of the setting."""
    pairs = ((f, getattr(group, f.name)) for group in groups for f in fields(group))
    return {f.name: value for f, value in pairs if value != f.default}


#: Units that the name of a setting ends with and that of its option leaves out.
_UNITS = re.compile(r"_(s|hz|kg|m|n)$")


@contextmanager
def named_options(options: Callable[..., Any], argv: Sequence[str]) -> Generator[None]:
    """An error of a setting that the command line states by an option of its own names that option.

    options: of a verb; each is called as the setting that it states, but for the unit. argv: what is
    stated; a value of a file or a default keeps the name of its setting.
    """
    try:
        yield
    except PoiseError as e:
        setting, _, rest = e.what.partition(" ")
        name, flags = setting.rpartition(".")[2], flags_of(options)
        flag = flags.get(name) or flags.get(_UNITS.sub("", name))
        stated = {word.partition("=")[0].replace("_", "-") for word in argv}
        in_file = e.where is not None and Path(e.where).is_file()
        if flag not in stated or in_file or not rest.startswith(("must ", "cannot be ")):
            raise
        raise PoiseError(f"{flag} {rest}", hint=e.hint, code=e.code) from None


def flags_of(options: Callable[..., Any]) -> dict[str, str]:
    """The options of a verb and of its groups, "--from", by what they are called in Python."""
    out: dict[str, str] = {}
    for name, hint in get_type_hints(options, include_extras=True).items():
        kind, marks = getattr(hint, "__origin__", hint), getattr(hint, "__metadata__", ())
        if is_dataclass(kind):
            out |= flags_of(cast("Callable[..., Any]", kind))
        else:
            named = next((n for m in marks if (n := getattr(m, "name", None))), None)
            out[name] = f"--{(named or name).replace('_', '-')}"
    return out


def stated(texts: tuple[str, ...], kind: type) -> tuple[dict[str, Any], list[str]]:
    """Settings of `kind` among NAME=VALUE texts such as ppo.policy_lr=1e-4, and the other texts, which
    are of a body (lfoot.kp=400).

    Raises:
        PoiseError: a name without a dot that is neither.
    """
    known, out, other = {f.name for f in fields(kind)}, {}, []
    for text in texts:
        name, equals, value = text.partition("=")
        name = name.strip().replace("-", "_")
        if not equals or name.partition(".")[0] not in known:
            if equals and "." not in name and name not in ("friction", "soft_s"):
                hint = did_you_mean(name, sorted(known))
                raise PoiseError(f"--set has no '{name}'", hint=hint, code="unknown-setting")
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
