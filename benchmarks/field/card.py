"""The field's tracking table as a value, as JSON and as Markdown beside the paper's rows."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, Literal

from field.paper import PHC_ROWS, PaperRow
from poise.errors import PoiseError
from poise.learn.checkpoint import write_atomic

View = Literal["all_frame", "all_clip", "succ_frame", "succ_clip", "uncut_frame", "uncut_clip"]
VIEWS: Mapping[View, str] = {
    "all_frame": "all clips, by frame",
    "all_clip": "all clips, by clip",
    "succ_frame": "successful clips, by frame",
    "succ_clip": "successful clips, by clip",
    "uncut_frame": "all frames, after failures too, by frame",
    "uncut_clip": "all frames, after failures too, by clip",
}
FIGURES = ("g_mpjpe", "mpjpe", "pa_mpjpe", "acc", "vel")


@dataclass(frozen=True)
class Errors:
    """Mean errors: mm, mm/frame^2 and mm/frame at 30 Hz; NaN where no frame counts."""

    g_mpjpe: float
    mpjpe: float
    pa_mpjpe: float
    acc: float
    vel: float


@dataclass(frozen=True)
class ClipErrors:
    """One clip: its episodes, how many failed, when first (s in the clip, NaN), frames and errors.

    start: the first frame of the episode that failed first, else of the first one.
    """

    clip: str
    episodes: int
    failed: int
    first_fail_s: float
    start: int
    frames: int
    errors: Errors


@dataclass(frozen=True)
class FieldTable:
    """An evaluation as the field reports it.

    method, data: what was evaluated on what. rule: of success. succ: share of episodes that succeed.
    views: errors over all or successful episodes, weighted by frame or by clip; tables of before know no
    uncut ones. clips: worst first.
    fps: of the control; other rates than 30 are rescaled, not resampled.
    """

    method: str
    data: str
    rule: str
    fps: float
    episodes: int
    frames: int
    succ: float
    views: Mapping[View, Errors]
    clips: tuple[ClipErrors, ...]

    @property
    def failed(self) -> tuple[str, ...]:
        """Names of the clips of which some episode failed, in the order of `clips`."""
        return tuple(c.clip for c in self.clips if c.failed)

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON values; NaN becomes None."""
        return _plain(asdict(self))

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> FieldTable:
        """What `to_dict` gave."""
        views: dict[View, Errors] = {k: _errors(data["views"][k]) for k in VIEWS if k in data["views"]}
        clips = tuple(
            ClipErrors(
                **{k: _number(v) for k, v in c.items() if k != "errors"}, errors=_errors(c["errors"])
            )
            for c in data["clips"]
        )
        rest = {f.name: data[f.name] for f in fields(cls) if f.name not in ("views", "clips")}
        return cls(**rest, views=views, clips=clips)


def markdown(
    tables: FieldTable | Sequence[FieldTable],
    paper: Sequence[PaperRow] = PHC_ROWS,
    worst: int = 0,
) -> str:
    """The tables as Markdown, every view a row, with the paper's rows under them.

    worst: this many clips of each table, failed and worst ones first, are listed below.
    """
    tables = [tables] if isinstance(tables, FieldTable) else list(tables)
    head = [
        "method",
        "data",
        "clips",
        "errors over",
        "Succ %",
        "g-MPJPE",
        "MPJPE",
        "PA-MPJPE",
        "acc",
        "vel",
    ]
    lines = [_line(head), _line(["---"] * 4 + ["---:"] * 6)]
    for t in tables:
        for view, e in t.views.items():
            lines.append(
                _line(
                    [
                        t.method,
                        t.data,
                        len(t.clips),
                        VIEWS[view],
                        100 * t.succ,
                        *(getattr(e, n) for n in FIGURES),
                    ]
                )
            )
    for p in paper:
        method = f"{p.method}{', with residual force' if p.help else ''} ({p.source})"
        errors = [p.g_mpjpe, p.mpjpe, math.nan, p.acc, p.vel]
        lines.append(_line([method, p.data, p.clips, p.note or "not stated", p.succ, *errors]))
    rules = " and ".join(sorted({t.rule for t in tables}))
    lines += ["", f"Success by the rule `{rules}`; errors in mm, mm/frame² and mm/frame at 30 Hz."]
    for t in tables:
        if worst and t.clips:
            lines += ["", f"{t.method} on {t.data}: {len(t.failed)} of {len(t.clips)} clips failed", ""]
            lines += [
                _line(["clip", "failed", "at s", "frames", *head[5:]]),
                _line(["---"] + ["---:"] * 8),
            ]
            for c in t.clips[:worst]:
                fate = f"{c.failed} of {c.episodes}"
                errors = [getattr(c.errors, n) for n in FIGURES]
                lines.append(_line([c.clip, fate, c.first_fail_s, c.frames, *errors]))
    return "\n".join(lines) + "\n"


def write_field_table(table: FieldTable, path: str | Path) -> Path:
    """Writes the table as JSON, whole or not at all."""
    path = Path(path)
    write_atomic(path, (json.dumps(table.to_dict(), indent=2, allow_nan=False) + "\n").encode())
    return path


def read_field_table(path: str | Path) -> FieldTable:
    """What `write_field_table` wrote.

    Raises:
        PoiseError: no such file, or no field table.
    """
    try:
        return FieldTable.from_dict(json.loads(Path(path).read_bytes()))
    except OSError as problem:
        raise PoiseError(f"cannot be read: {problem.strerror}", path, code="file-unreadable") from None
    except (ValueError, KeyError, TypeError):
        raise PoiseError(
            "is no field table", path, "Evaluate the policy again", code="wrong-file-kind"
        ) from None


def _line(cells: Sequence[object]) -> str:
    return "| " + " | ".join(_cell(c) for c in cells) + " |"


def _cell(value: object) -> str:
    if isinstance(value, float):
        return "-" if math.isnan(value) else f"{value:.1f}"
    return str(value)


def _number(value: Any) -> Any:
    return math.nan if value is None else value


def _errors(data: Mapping[str, Any]) -> Errors:
    return Errors(**{k: _number(data[k]) for k in FIGURES})


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
