"""The one exception a user may meet: what was wrong, where, and what to do about it."""

from __future__ import annotations

from pathlib import Path


class PoiseError(Exception):
    """A mistake that the user can mend, told in one clear sentence.

    Args:
        what: what was wrong, with the value that was got.
        where: file, file and line, joint or frame, as a prefix ("walk.bvh, line 12").
        hint: what to do about it.
    """

    def __init__(self, what: str, where: str | Path | None = None, hint: str | None = None):
        self.what, self.where, self.hint = what, None if where is None else str(where), hint
        text = what if where is None else f"{where}: {what}"
        super().__init__(text if hint is None else f"{text.rstrip('.')}. {hint}")


def did_you_mean(name: str, known: list[str] | tuple[str, ...]) -> str:
    """A hint that names the closest known name and lists what exists."""
    import difflib

    close = difflib.get_close_matches(name, known, n=1)
    listed = ", ".join(known[:40]) + (", ..." if len(known) > 40 else "")
    return (f"Did you mean '{close[0]}'? " if close else "") + f"Known: {listed}"
