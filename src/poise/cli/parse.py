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
_FRAME = "│╭╮╰╯"


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
        raise PoiseError(sentence(refused.getvalue(), prog), hint=f"See {prog} --help") from None


def sentence(boxed: str, prog: str) -> str:
    """What tyro's frame says, in one line: the message and, if there is one, the nearest option."""
    plain = re.sub(r"\x1b\[[0-9;]*m", "", boxed)
    lines = [line.strip(_FRAME + " ") for line in plain.splitlines()]
    # The first line of the frame holds its title, rules of dashes part its sections.
    sections: list[list[str]] = [[]]
    for line in lines:
        if line.startswith("─"):
            sections.append([])
        elif line:
            sections[-1].append(line)
    parts = [s for s in sections if s]
    if not parts:
        return "the command line was not understood"
    text = " ".join(parts[0]).rstrip(".")
    text = text.replace(f"Missing from {prog}:", "required, but missing:").replace(" (required)", "")
    near = next((s[1].split()[0] for s in parts[1:] if s[0].startswith("Perhaps") and len(s) > 1), None)
    text = text[:1].lower() + text[1:]
    return text if near is None else f"{text}. Did you mean {near.rstrip(',')}?"
