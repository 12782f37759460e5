"""Command lines become frozen dataclasses; a mistake becomes one sentence.

What tyro refuses comes as an event (`tyro._errors`), which names the option and the value; the module is
private to tyro, so a test names the version with which it was tried. An event that is not known here
becomes a general sentence.
"""

from __future__ import annotations

import contextlib
import inspect
import io
import re
import shutil
import textwrap
from collections.abc import Callable, Iterator, Sequence
from dataclasses import is_dataclass
from types import ModuleType, UnionType
from typing import Any, NoReturn, TypeVar, get_args, get_origin, get_type_hints

import tyro

from poise.cli.recipe_options import capital, dotted, texts_of
from poise.errors import PoiseError, did_you_mean

T = TypeVar("T")
_CONFIG = (tyro.conf.FlagCreatePairsOff,)
#: The version of tyro with the events that were tried.
TRIED = "1.0.17"
#: Columns of the widest line of what a verb does.
WIDEST = 100
_KINDS = {"INT": "a whole number", "FLOAT": "a number"}


def parse(options: Callable[..., T], argv: Sequence[str], prog: str, default: Any = None) -> T:
    """The options of a verb that `argv` states, see `options_of`.

    Args:
        default: what is not stated, where that differs from the class's.

    Raises:
        PoiseError: what tyro refused, in one sentence.
        SystemExit: with code 0, after the help text was printed.
    """

    def refuse(event: Any) -> NoReturn:
        what, hint = sentence(event, options, prog)
        raise PoiseError(what, hint=f"{hint}See {prog} --help", code="command-line")

    try:
        does = about(options)
        quiet = contextlib.redirect_stderr(io.StringIO())
        with _told(refuse), whole_lines(does), plain_types(), quiet:
            how: dict[str, Any] = {"prog": prog, "config": _CONFIG, "default": default}
            if default is None:
                how.pop("default")
            return tyro.cli(options, args=_joined_up(dotted(argv)), description=does, **how)
    except SystemExit as stop:
        if stop.code in (0, None):
            raise
        what = "the command line was not understood"
        raise PoiseError(what, hint=f"See {prog} --help", code="command-line") from None


def options_of(module: ModuleType) -> Callable[..., Any]:
    """The options of a verb: its class of them, or a function with the arguments of its `run` that
    returns these by name, with the text on each as its help."""
    if hasattr(module, "Options"):
        return module.Options
    known, hints = inspect.signature(module.run), get_type_hints(module.run, include_extras=True)

    def stated(*values: Any, **named: Any) -> Any:
        return known.bind(*values, **named).arguments

    typed = [p.replace(annotation=hints[p.name]) for p in known.parameters.values()]
    texts = texts_of(module.run.__doc__, known.parameters)
    lines = [f"    {name}: {capital(text)}" for name, text in texts.items()]
    stated.__doc__ = "\n".join((summary(module.run), "", "Args:", *lines))
    stated.__annotations__ = hints
    vars(stated)["__signature__"] = known.replace(parameters=typed)
    return stated


def _joined_up(argv: Sequence[str]) -> list[str]:
    """The command line with `--up -Y` as `--up=-Y`: a value that begins with - is no option."""
    out: list[str] = []
    for word in argv:
        if out[-1:] == ["--up"] and re.fullmatch(r"-[XYZ]", word):
            out[-1] = f"--up={word}"
        else:
            out.append(word)
    return out


def _told(refuse: Any) -> contextlib.AbstractContextManager[None]:
    """Has tyro call `refuse` with what it refuses."""
    try:
        from tyro._errors import on_parse_error
    except ImportError:
        return contextlib.nullcontext()
    return on_parse_error(refuse)


@contextlib.contextmanager
def whole_lines(kept: str) -> Iterator[None]:
    """Has tyro wrap help at the window's width alone: it breaks docstrings where their source does.
    kept: a text with lines of its own."""
    # Private to tyro: without it help is as tyro wraps it.
    try:
        from tyro import _strings

        theirs = _strings.remove_single_line_breaks
    except (ImportError, AttributeError):
        yield
        return
    _strings.remove_single_line_breaks = lambda text: text if text == kept else joined(text)
    try:
        yield
    finally:
        _strings.remove_single_line_breaks = theirs


@contextlib.contextmanager
def plain_types() -> Iterator[None]:
    """Has tyro check the defaults of unions and tuples without typeguard, which takes as long to import
    as tyro itself."""
    # Private to tyro: without it command lines are the same, and slower.
    try:
        from tyro import _resolver

        theirs = _resolver.is_instance
    except (ImportError, AttributeError):
        yield
        return

    def ours(kind: Any, value: Any) -> bool:
        if isinstance(kind, UnionType):
            return any(ours(one, value) for one in get_args(kind))
        if get_origin(kind) is tuple and get_args(kind)[1:] == (...,):
            return isinstance(value, tuple) and all(ours(get_args(kind)[0], one) for one in value)
        return theirs(kind, value)

    _resolver.is_instance = ours
    try:
        yield
    finally:
        _resolver.is_instance = theirs


def about(options: Callable[..., Any]) -> str:
    """What a verb does, in lines that fit into the window: tyro wraps what it says of options alone."""
    wide = min(shutil.get_terminal_size().columns, WIDEST)
    lines = summary(options).split("\n\n")
    return "\n\n".join(textwrap.fill(line, wide) for line in lines)


def summary(options: Callable[..., Any]) -> str:
    """A docstring without what it says of arguments, each paragraph on a line."""
    return joined(re.split(r"\n *Args:\n", options.__doc__ or "")[0])


def joined(text: str) -> str:
    """Each paragraph of a docstring as one line."""
    return "\n\n".join(" ".join(part.split()) for part in re.split(r"\n[ \t]*\n", text.strip()))


def sentence(event: Any, options: Callable[..., Any], prog: str) -> tuple[str, str]:
    """What tyro's event says, in one line, and a hint on the nearest option or the choices."""
    argument = getattr(event, "argument", None)
    name = _name(argument) if argument is not None else ""
    match type(event).__name__:
        case "MissingArgs":
            named = [_name(a.arg, metavar=True) for a in event.missing_arguments]
            return f"{prog} needs {' and '.join(named)}", ""
        case "UnrecognizedArgs":
            return _unknown(event.tokens, options)
        case "InvalidChoice":
            known = sorted({*event.choices} - {"None"})
            return f"{name} cannot be '{event.value}'", f"{did_you_mean(event.value, known)}. "
        case "BadValue":
            return f"{name} needs a value", ""
        case "InstantiationFailure" if argument is not None:
            kind = str(argument.field.type_stripped)
            kind = next((v for k, v in _KINDS.items() if k.lower() in kind), "another value")
            got = re.search(r"'([^']*)'\]?$", event.message)
            return f"{name} needs {kind}" + (f", got '{got[1]}'" if got else ""), ""
        case "InstantiationFailure":
            return event.message, ""
        case _:
            return "the command line was not understood", ""


def _name(argument: Any, metavar: bool = False) -> str:
    """An argument as it is written: "--fps", with its metavar "-o DIR|FILE", by its place "CLIP"."""
    if argument.is_positional():
        return str(argument.lowered.metavar)
    flags = sorted(argument.lowered.name_or_flags, key=len)
    return f"{flags[0]} {argument.lowered.metavar}" if metavar else flags[-1]


def _unknown(tokens: Sequence[str], options: Callable[..., Any]) -> tuple[str, str]:
    """What is no option, and the option that it is near to."""
    flags = [t.partition("=")[0] for t in tokens if t.startswith("-")]
    if not flags:
        return f"{' '.join(tokens)} is one argument too many", ""
    near = did_you_mean(flags[0], list(_flags(options)))
    near = near.partition("?")[0] + "? " if near.startswith("Did you mean") else ""
    return f"there is no option {', '.join(flags)}", near.replace("'", "")


def _flags(options: Callable[..., Any]) -> Iterator[str]:
    for name, given in inspect.signature(options).parameters.items():
        if is_dataclass(given.default):
            yield from _flags(type(given.default))
        else:
            yield ("--no-" if given.default is True else "--") + name.replace("_", "-")
