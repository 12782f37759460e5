"""Command lines become frozen dataclasses; a mistake becomes one sentence."""

from __future__ import annotations

import contextlib
import io
import re
from collections.abc import Sequence
from typing import TypeVar

import tyro

from poise.errors import PoiseError

T = TypeVar("T")
_CONFIG = (tyro.conf.FlagCreatePairsOff,)


def parse(options: type[T], argv: Sequence[str], prog: str) -> T:
    """The options that `argv` states.

    Raises:
        PoiseError: what tyro refused, in one sentence.
        SystemExit: with code 0, after the help text was printed.
    """
    refused = io.StringIO()
    try:
        with contextlib.redirect_stderr(refused):
            return tyro.cli(options, prog=prog, args=list(argv), config=_CONFIG)
    except SystemExit as stop:
        if stop.code in (0, None):
            raise
        what, near = sentence(refused.getvalue(), prog)
        hint = f"Did you mean {near}? " if near else ""
        raise PoiseError(what, hint=f"{hint}See {prog} --help") from None


def sentence(boxed: str, prog: str) -> tuple[str, str]:
    """What tyro's frame says, in one line, and the nearest option if it names one."""
    plain = re.sub(r"\x1b\[[0-9;]*m", "", boxed)
    # The frame is drawn with lines, and its title stands in them; where the terminal's encoding is
    # not UTF-8 there are only rules, and the title is a section of its own.
    sections: list[list[str]] = [[]]
    for row in plain.splitlines():
        line = row.rstrip().strip("│").rstrip()
        if line.startswith(("╭", "╰")) or not line.strip("─- "):
            sections.append([])
        else:
            sections[-1].append(line)
    parts = [s for s in sections if s]
    if "╭" not in plain:
        parts = parts[1:]
    if not parts:
        return "the command line was not understood", ""
    text = " ".join(line.strip() for line in parts[0]).rstrip(".")
    if text.startswith("Missing from"):
        # Names stand at one depth, their descriptions deeper.
        depths = [len(line) - len(line.lstrip()) for line in parts[0][1:]]
        named = [x.strip() for x, d in zip(parts[0][1:], depths, strict=True) if d == min(depths)]
        text = f"{prog} needs {' and '.join(named)}"
    text = re.sub(r"Expected one of \((.*)\)", _choices, text)
    near = next((s[1].split()[0] for s in parts[1:] if "Perhaps" in s[0] and len(s) > 1), "")
    return text[:1].lower() + text[1:], near.rstrip(",")


def _choices(found: re.Match[str]) -> str:
    """The choices in a fixed order, without the None that only Python knows."""
    names = sorted({x.strip(" '") for x in found[1].split(",")} - {"None", ""})
    return f"Known: {', '.join(names)}"
