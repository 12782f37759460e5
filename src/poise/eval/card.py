"""The score card as a value and as a file: `score.json` with stable keys (docs/metrics.md)."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, field, fields
from pathlib import Path
from typing import Any, Literal

from poise.errors import PoiseError
from poise.version import __version__

NAN = float("nan")
Weighting = Literal["frame", "episode"]


@dataclass(frozen=True)
class Help:
    """The residual wrench's budget and use; `limit_*` inf means unlimited (null in JSON)."""

    limit_n: float
    limit_nm: float
    force_mean_n: float
    force_p95_n: float
    torque_mean_nm: float
    torque_p95_nm: float
    work_j_per_s: float
    share_of_body_weight: float


@dataclass(frozen=True)
class ScoreCard:
    """The figures of one evaluation; every field is a key of `score.json`, defined in docs/metrics.md.

    NaN means "not measured" and becomes null. `variants` holds the tracking figures under each
    weighting ("frame", "episode") and for successes alone ("succ_frame", "succ_episode").
    """

    succ: float
    succ_rule: str
    mpjpe_mm: float
    mpjpe_global_mm: float
    vel_mm_per_frame: float
    acc_mm_per_frame2: float
    foot_slide_mm_per_s: float
    penetration_mm: float
    float_mm: float
    jerk: float
    reward: Mapping[str, float]
    help: Help
    seconds: float
    samples: int
    seed: int
    version: str = __version__
    clip: str = ""
    method: str = ""
    episodes: int = 0
    frames: int = 0
    mpjpe_succ_mm: float = NAN
    reference: Mapping[str, float] = field(default_factory=dict)
    per_clip: tuple[Mapping[str, Any], ...] = ()
    weighting: Weighting = "frame"
    variants: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    delivered: tuple[Mapping[str, Any], ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON values with the keys in field order; what is not finite becomes None."""
        return {f.name: _plain(getattr(self, f.name)) for f in fields(self)}


def _plain(value: Any) -> Any:
    if isinstance(value, Help):
        return {f.name: _plain(getattr(value, f.name)) for f in fields(value)}
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def write_score(card: ScoreCard, path: str | Path) -> Path:
    """Write `score.json` whole or not at all: a file beside it is filled, then takes its name."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        draft.write_text(json.dumps(card.to_dict(), indent=2, allow_nan=False) + "\n", encoding="utf-8")
        draft.replace(path)
    finally:
        draft.unlink(missing_ok=True)
    return path


def _numbers(value: Any) -> Any:
    """Null back to NaN, inside lists and objects too."""
    if isinstance(value, dict):
        return {k: _numbers(v) for k, v in value.items()}
    if isinstance(value, list):
        return tuple(_numbers(v) for v in value)
    return NAN if value is None else value


def read_score(path: str | Path) -> ScoreCard:
    """Read a `score.json`; null becomes NaN (unlimited help: inf) and keys not known here are left out.

    Raises:
        PoiseError: no such file, no JSON, or a key is missing.
    """
    path = Path(path)
    try:
        raw = json.loads(path.read_text(encoding="utf-8"))
    except OSError as problem:
        raise PoiseError(f"cannot be read: {problem.strerror}", path) from None
    except json.JSONDecodeError as problem:
        raise PoiseError(f"is no JSON: {problem.msg}", f"{path}, line {problem.lineno}") from None
    if not isinstance(raw, dict):
        raise PoiseError("is no score card: the file must hold one JSON object", path)
    # A figure that is newer than the file has its default.
    told = [f for f in fields(ScoreCard) if f.name in raw or f.default is MISSING]
    _require(raw, [f.name for f in told if f.default_factory is MISSING], path)
    if not isinstance(raw["help"], dict):
        raise PoiseError("is no score card: 'help' must be an object", path)
    _require(raw["help"], [f.name for f in fields(Help)], path)
    values: dict[str, Any] = {f.name: _numbers(raw[f.name]) for f in told if f.name in raw}
    aid: dict[str, Any] = {f.name: _numbers(raw["help"][f.name]) for f in fields(Help)}
    for name in ("limit_n", "limit_nm"):
        aid[name] = math.inf if raw["help"][name] is None else aid[name]
    values["help"] = Help(**aid)
    return ScoreCard(**values)


def _require(raw: dict[str, Any], names: list[str], path: Path) -> None:
    missing = [n for n in names if n not in raw]
    if missing:
        raise PoiseError(
            f"the score card lacks the key '{missing[0]}'",
            path,
            "Score the run again with this version.",
        )
