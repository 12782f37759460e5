"""The report: one self-contained `report.html` that opens offline and shows how good a result is."""

from __future__ import annotations

import os
import re
import tempfile
from html import escape
from importlib.resources import files
from pathlib import Path

from poise.errors import PoiseError
from poise.view.data import Report, Shape, Track, payload, safe_json
from poise.view.sections import facts, notes, plots, tiles
from poise.view.table import score_table
from poise.view.verdict import overall, sentence

__all__ = ["Report", "Shape", "Track", "render", "write_report"]

_WORDS = {"good": "Good", "fair": "Fair", "poor": "Poor", "unknown": "Not fully judged"}
_SCRIPTS = ("motion.js", "stage_gl.js", "stage_2d.js", "replay.js", "plots.js")


def _asset(name: str) -> str:
    return (files("poise.view") / "assets" / name).read_text(encoding="utf-8").strip()


def render(report: Report) -> str:
    """The whole page as text; everything from outside is escaped and nothing is fetched."""
    level = overall(report.score)
    data = payload(report)
    parts = {
        "title": escape(report.title),
        "subtitle": escape(report.subtitle),
        "style": _asset("report.css"),
        "level": level,
        "word": _WORDS[level],
        "sentence": escape(sentence(report.score)),
        "tiles": tiles(report),
        "reference_name": escape(report.reference.name),
        "simulated_name": escape(report.simulated.name),
        "plots": plots(report),
        "table": score_table(report.score),
        "notes": notes(report, data["reference"]["held"], data["simulated"]["held"]),
        "facts": facts(report),
        "motion": safe_json(data),
        "licence": "three.js. " + _asset("three.LICENSE.txt").replace("*/", "* /"),
        "three": _asset("three.min.js"),
        "script": "\n".join(_asset(name) for name in _SCRIPTS),
    }
    # One pass over the template, so that what is put in is never searched for placeholders.
    return re.sub(r"\{\{(\w+)\}\}", lambda m: parts[m[1]], _asset("report.html")) + "\n"


def _refused(error: OSError, path: Path) -> PoiseError:
    return PoiseError(f"the report cannot be written ({error.strerror})", path, "Choose another folder.")


def write_report(report: Report, path: Path) -> None:
    """Writes the page; a reader sees the old file or the whole new one, never a part.

    Raises:
        PoiseError: the folder cannot be written.
    """
    path = Path(path)
    text = render(report)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=".part")
    except OSError as error:
        raise _refused(error, path) from error
    part = Path(name)
    try:
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            file.write(text)
        # The temporary file is private to its owner; the report gets the usual rights of a new file.
        mask = os.umask(0)
        os.umask(mask)
        part.chmod(0o666 & ~mask)
        part.replace(path)
    except OSError as error:
        raise _refused(error, path) from error
    finally:
        part.unlink(missing_ok=True)
