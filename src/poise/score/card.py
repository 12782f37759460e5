"""The score card as a value, as a file, `score.json` with stable keys (docs/python.md), and in words:
labelled rows, each judged good, fair or poor by stated thresholds."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, field, fields
from pathlib import Path
from typing import Any, Literal, NamedTuple

from poise.errors import PoiseError
from poise.score.thresholds import THRESHOLDS, Verdict
from poise.settings import plain
from poise.version import __version__

NAN = float("nan")
Weighting = Literal["frame", "episode"]


@dataclass(frozen=True)
class Help:
    """The residual wrench's budget and use; `limit_*` inf means unlimited (null in JSON).

    Attributes:
        limit_n: the budget of a wrench's force, N: `help.limit_n` of `score.json`, and so on.
        limit_nm: of its torque, N m: `help.limit_nm`.
        force_mean_n: mean of |F|, N: `help.force_mean_n`.
        force_p95_n: its 95th percentile: `help.force_p95_n`.
        torque_mean_nm: mean of |T|, N m: `help.torque_mean_nm`.
        torque_p95_nm: its 95th percentile: `help.torque_p95_nm`.
        work_j_per_s: mean of |F v + T w|, J/s: `help.work_j_per_s`.
        share_of_body_weight: the mean force over the body's weight: `help.share_of_body_weight`.
    """

    limit_n: float
    limit_nm: float
    force_mean_n: float
    force_p95_n: float
    torque_mean_nm: float
    torque_p95_nm: float
    work_j_per_s: float
    share_of_body_weight: float


#: Where nothing can help.
NO_HELP = Help(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class ScoreCard:
    """The figures of one evaluation; every field is a key of `score.json`.

    NaN means "not measured" and becomes null; unlimited help becomes null, too. Errors count up to the
    first frame that breaks the rule. p is where a body is, r where the reference has it; differences are
    those at 30 frames a second.

    Attributes:
        succ: share of episodes, one from every start frame with a second to come, that reach their end
            within the rule.
        succ_rule: the rule; rates under different rules do not compare.
        mpjpe_mm: mean of |(p - p_root) - (r - r_root)| over bodies and frames, mm (PHC's E_mpjpe).
        mpjpe_global_mm: mean of |p - r|, mm (PHC's E_g-mpjpe).
        vel_mm_per_frame: mean of |Dp - Dr|, mm a frame (PHC's E_vel).
        acc_mm_per_frame2: mean of |DDp - DDr|, mm a frame^2 (PHC's E_acc).
        foot_slide_mm_per_s: mean horizontal speed of points of the feet in contact, mm/s.
        penetration_mm: mean depth of the lowest point under the floor, mm.
        float_mm: mean height of the lowest point where contact is due, mm.
        jerk: mean of the third difference of the bodies' places, m/s^3.
        reward: `total` and every term, mean over frames.
        help: the residual wrench, below.
        seconds: time of the training; 0 where nothing was trained.
        samples: control steps of the training.
        seed: of the training.
        version: of Poise.
        clip: the clip; up to three names, else their number.
        method: the recipe.
        episodes: how many.
        frames: how many count.
        mpjpe_succ_mm: `mpjpe_mm` over episodes that succeed.
        tracked: share of episodes that succeed, upright and on their feet where the motion is.
        needs: what a motion lacks besides a floor: `what`, `start_s`, `stop_s`.
        raw: where noise was taken off: the error beside what came in (`mpjpe_mm`, `mpjpe_global_mm`),
            and that noise (`noise_mm`, `noise_hz`, NaN from frame to frame).
        detail: what is left of the reference's movement at each frequency, of one clip that is tracked.
        changed: its spells that physics changed most: `start_s`, `stop_s`, `body`, `most_mm`.
        forces: pushes and things in hands of one clip: `kind`, `part`, `force` or `force_n`, when, the
            body's distance from the motion meanwhile (`error_mm`) and without them (`without_mm`).
        reference: `foot_slide_mm_per_s`, `penetration_mm`, `float_mm`, `jerk` of the reference itself.
        per_clip: each clip's figures, its earliest failure (`first_fail_s`), and of clips one after
            another when each began and ended.
        weighting: how figures are averaged, "frame" or "episode".
        variants: tracking figures by weighting, for successes alone ("succ_frame", "succ_episode"), and
            over all frames, those after a failure among them ("uncut_frame", "uncut_episode").
        nothing: success and tracking figures of action 0 from the same starts.
        starts: how often every episode was begun, a hair apart.
        spread: standard deviations over these starts.
        delivered: of each clip that was written: feet of `source`, `simulated` and `delivered` as `poise
            doctor` says of a file, how far holding led the ankles (`held_mean_mm`, `held_max_mm`), and
            feet that were `left`.
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
    tracked: float = NAN
    needs: tuple[Mapping[str, Any], ...] = ()
    raw: Mapping[str, float] = field(default_factory=dict)
    detail: Mapping[str, float] = field(default_factory=dict)
    changed: tuple[Mapping[str, Any], ...] = ()
    forces: tuple[Mapping[str, Any], ...] = ()
    reference: Mapping[str, float] = field(default_factory=dict)
    per_clip: tuple[Mapping[str, Any], ...] = ()
    weighting: Weighting = "frame"
    variants: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    nothing: Mapping[str, float] = field(default_factory=dict)
    starts: int = 1
    spread: Mapping[str, float] = field(default_factory=dict)
    delivered: tuple[Mapping[str, Any], ...] = ()

    @property
    def survived(self) -> bool:
        """Whether all episodes succeed by the rule, and yet not all are tracked."""
        return self.succ == 1.0 and self.tracked < 1.0

    @property
    def cut(self) -> bool:
        """Whether each clip was played once, from its start, and lost: figures end there."""
        return (
            self.succ == 0.0 and bool(self.per_clip) and all(c["episodes"] == 1 for c in self.per_clip)
        )

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON values with the keys in field order; what is not finite becomes None. `raw`,
        `detail`, `changed` and `forces` are left out where they are empty."""
        bare = ("raw", "detail", "changed", "forces")
        return {k: v for k, v in plain(self).items() if v or k not in bare}


def write_score(card: ScoreCard, path: str | Path) -> Path:
    """Writes `score.json` whole or not at all."""
    # A card is shown without torch, which only runs of a policy need.
    from poise.learn.checkpoint import write_atomic

    path = Path(path)
    write_atomic(path, (json.dumps(card.to_dict(), indent=2, allow_nan=False) + "\n").encode())
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
        raise PoiseError(f"cannot be read: {problem.strerror}", path, code="file-unreadable") from None
    except json.JSONDecodeError as problem:
        raise PoiseError(
            f"is no JSON: {problem.msg}", f"{path}, line {problem.lineno}", code="bad-json"
        ) from None
    if not isinstance(raw, dict):
        raise PoiseError(
            "is no score card: the file must hold one JSON object", path, code="not-a-score-card"
        )
    # A figure that is newer than the file has its default.
    told = [f for f in fields(ScoreCard) if f.name in raw or f.default is MISSING]
    _require(raw, [f.name for f in told if f.default_factory is MISSING], path)
    if not isinstance(raw["help"], dict):
        raise PoiseError("is no score card: 'help' must be an object", path, code="not-a-score-card")
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
            code="key-missing",
        )


class CardRow(NamedTuple):
    """One line of the table; `value` is NaN where nothing was measured."""

    label: str
    value: float
    unit: str
    verdict: Verdict


_ROWS = (
    ("mpjpe_mm", "Joint error, root-relative", "mm"),
    ("mpjpe_global_mm", "Joint error, global", "mm"),
    ("vel_mm_per_frame", "Velocity error", "mm/frame"),
    ("acc_mm_per_frame2", "Acceleration error", "mm/frame²"),
    ("foot_slide_mm_per_s", "Foot slide", "mm/s"),
    ("penetration_mm", "Penetration", "mm"),
    ("float_mm", "Floating", "mm"),
    ("jerk", "Jerk", "m/s³"),
)


def table(card: ScoreCard) -> list[tuple[str, float, str, Verdict]]:
    """Rows (label, value, unit, verdict) for the command line and the report, most important first.

    Each row is followed by what stands beside it, without a verdict: the error over all frames, the
    spread over perturbed starts, what doing nothing comes to, the reference's own figure. Figures of a
    motion that is lost are of what comes before, so that none of them is called good or fair.
    """
    t = THRESHOLDS

    def judged(key: str, value: float) -> Verdict:
        verdict = t[key].verdict(value)
        return "" if card.cut and verdict != "poor" else verdict

    rows: list[tuple[str, float, str, Verdict]] = [
        CardRow(f"Success ({card.succ_rule})", 100.0 * card.succ, "%", t["succ"].verdict(card.succ)),
        *_beside(card, "succ", "Success", "%", 100.0),
    ]
    if math.isfinite(card.tracked):
        rows.append(CardRow("Tracked", 100.0 * card.tracked, "%", t["tracked"].verdict(card.tracked)))
    for key, label, unit in _ROWS:
        value = getattr(card, key)
        reference = card.reference.get(key, math.nan)
        if key == "jerk":
            ratio = value / reference if reference > 0 else math.nan
            rows.append(CardRow(label, value, unit, judged("jerk_ratio", ratio)))
        else:
            rows += [
                CardRow(label, value, unit, judged(key, value)),
                *_beside(card, key, label, unit),
            ]
        if math.isfinite(reference):
            rows.append(CardRow(f"{label}, reference", reference, unit, ""))
    aid = card.help
    share = t["share_of_body_weight"].verdict(aid.share_of_body_weight)
    torque = t["torque_mean_nm"].verdict(aid.torque_mean_nm)
    rows += [
        CardRow("Help, share of body weight", 100.0 * aid.share_of_body_weight, "%", share),
        CardRow("Help, mean force", aid.force_mean_n, "N", ""),
        CardRow("Help, mean torque", aid.torque_mean_nm, "N m", torque),
        CardRow("Help, mean power", aid.work_j_per_s, "J/s", ""),
        CardRow("Reward per step", card.reward.get("total", math.nan), "", ""),
    ]
    return rows


def _beside(card: ScoreCard, key: str, label: str, unit: str, times: float = 1.0) -> list[CardRow]:
    """What stands beside a figure of tracking, as far as it was measured."""
    uncut = card.variants.get(f"uncut_{card.weighting}", {}).get(key, math.nan)
    # Without a failure all frames count anyway.
    uncut = math.nan if card.succ == 1.0 else uncut
    found = (
        ("all frames", uncut),
        (f"spread over {card.starts} starts", card.spread.get(key, math.nan)),
        ("doing nothing", card.nothing.get(key, math.nan)),
    )
    return [CardRow(f"{label}, {w}", times * v, unit, "") for w, v in found if math.isfinite(v)]
