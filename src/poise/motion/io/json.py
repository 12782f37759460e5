"""JSON from strangers: bounded by what it would take in memory, with the line of every mistake."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from poise.errors import PoiseError
from poise.motion.io.text import CUT_OFF, at_line

MAX_JSON_BYTES = 128 << 20
"""Longer JSON is refused before it is read."""
MAX_CONTAINERS = 2_000_000
"""JSON with more objects and lists is refused: a short one takes up to 250 bytes in memory."""
MAX_ITEMS = 20_000_000
"""The same for items in them, at some 40 bytes each (44 numbers at 60 Hz: two hours)."""


def json_object(data: bytes, path: Path) -> dict[str, Any]:
    """The JSON object in a file's bytes; brackets and commas are counted before memory is taken."""
    data = data.removeprefix(b"\xef\xbb\xbf")
    for size, most, what in (
        (len(data), MAX_JSON_BYTES, "bytes"),
        (data.count(b"{") + data.count(b"["), MAX_CONTAINERS, "objects and lists"),
        (data.count(b","), MAX_ITEMS, "items"),
    ):
        if size > most:
            raise PoiseError(
                f"the JSON has {size} {what}, more than the {most} allowed",
                path,
                "Cut it into shorter clips",
            )
    try:
        content = json.loads(data.decode("utf-8"))
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise PoiseError("this is not UTF-8 text", at_line(path, line), "Save it as UTF-8") from None
    except json.JSONDecodeError as error:
        raise PoiseError(
            f"this is not valid JSON ({error.msg})", at_line(path, error.lineno), CUT_OFF
        ) from None
    except (RecursionError, ValueError):
        raise PoiseError("this is not valid JSON", path) from None
    if not isinstance(content, dict):
        raise PoiseError("the JSON is no object", path)
    return content
