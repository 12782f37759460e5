"""The one exception a user may meet: what was wrong, where, and what to do about it."""

from __future__ import annotations

from pathlib import Path
from typing import Any


class PoiseError(Exception):
    """A mistake that the user can mend, told in one clear sentence.

    Args:
        what: what was wrong, with the value that was got.
        where: file, file and line, joint or frame, as a prefix ("walk.bvh, line 12").
        hint: what to do about it.
        code: the kind of mistake, for programs, such as "file-missing" or "out-of-range". A kind has one
            code wherever it is met, and keeps it when the sentence changes.
    """

    def __init__(
        self, what: str, where: str | Path | None = None, hint: str | None = None, *, code: str
    ):
        self.what, self.where, self.hint = what, None if where is None else str(where), hint
        self.code = code
        text = what if where is None else f"{where}: {what}"
        super().__init__(text if hint is None else f"{text.rstrip('.')}. {hint}")

    def __reduce__(self) -> tuple[Any, ...]:
        """Copies and pickles take the error as it is, since `args` holds its sentence alone."""
        return _again, (type(self), self.args, self.__dict__)


def _again(kind: type[PoiseError], args: tuple[Any, ...], state: dict[str, Any]) -> PoiseError:
    error = kind.__new__(kind, *args)
    error.__dict__.update(state)
    return error


def did_you_mean(name: str, known: list[str] | tuple[str, ...]) -> str:
    """A hint that names the closest known name and lists what exists."""
    import difflib

    close = difflib.get_close_matches(name, known, n=1)
    listed = ", ".join(known[:40]) + (", ..." if len(known) > 40 else "")
    return (f"Did you mean '{close[0]}'? " if close else "") + f"Known: {listed}"


#: Characters of an error behind the file's name, of the place in the file, and of one word.
_MOST, _PLACE, _WORD = 300, 100, 100


def printable(text: str, kept: str = "") -> str:
    """The text with "?" for what a terminal would obey instead of showing it, but for `kept`."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() or c in kept else "?" for c in text)


def brief(error: PoiseError, path: Path) -> PoiseError:
    """An error about a file from a stranger: printable, short, and with the file's name.

    path: the file; where the error names another place, it stands before it or in it.
    """
    where, rest = str(path), error.where or ""
    if rest.startswith((where, str(path.parent))):
        # Another file in the same folder, such as a skeleton, or a place within this one.
        known = where if rest.startswith(where) else str(path.parent)
        where, rest = known, rest.removeprefix(known)
    elif rest and rest != path.stem:
        rest = f", {rest}"
    else:
        rest = ""
    place = _cut(rest, _PLACE)
    most = _MOST - len(place) - 4
    what = _cut(error.what, most - 60 if error.hint else most)
    hint = None if error.hint is None else _cut(error.hint, most - len(what))
    return PoiseError(what, where + place, hint, code=error.code)


def _cut(text: str, most: int) -> str:
    """Printable text on one line, its long words and itself cut."""
    words = (w if len(w) <= _WORD else w[: _WORD - 3] + "..." for w in printable(text).split(" "))
    text = " ".join(words)
    return text if len(text) <= most else text[: most - 3] + "..."
