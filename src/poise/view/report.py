"""The report: one self-contained `report.html` that opens offline and shows how good a result is."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

from poise.errors import PoiseError
from poise.motion.io.text import write_whole
from poise.view.data import Report, Shape, Track, payload, safe_json
from poise.view.sections import facts, figures, notes
from poise.view.table import score_rows
from poise.view.verdict import grades, overall, sentence

__all__ = ["Report", "Shape", "Track", "render", "write_report"]

#: Losses that are named one by one.
NAMED = 8
_WORDS = {"good": "Good", "fair": "Fair", "poor": "Poor", "unknown": "Not fully judged"}


def _asset(name: str) -> str:
    return (files("poise.view") / "assets" / name).read_text(encoding="utf-8").strip()


def render(report: Report) -> str:
    """The whole page as text; everything from outside is escaped and nothing is fetched."""
    from jinja2 import Environment, StrictUndefined

    page = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    data, level = payload(report), overall(report.score)
    return page.from_string(_asset("report.html")).render(
        asset=_asset,
        report=report,
        level=level,
        word=_WORDS[level],
        sentence=sentence(report.score),
        grades=grades(report.score),
        lost=", ".join(f"{t:.1f} s" for t in data["lost"][:NAMED]),
        more=max(0, len(data["lost"]) - NAMED),
        figures=figures(report),
        score=score_rows(report.score),
        notes=notes(report, data["reference"]["held"], data["simulated"]["held"]),
        facts=facts(report),
        motion=safe_json(data),
    )


def write_report(report: Report, path: Path) -> None:
    """Writes the page; a reader sees the old file or the whole new one, never a part.

    Raises:
        PoiseError: the folder cannot be made or written.
    """
    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        what = f"its folder cannot be made ({error.strerror})"
        raise PoiseError(what, path, "Choose another folder") from error
    write_whole(path, render(report) + "\n")
