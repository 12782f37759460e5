"""The verdict in words: grades of a score, with the thresholds that decide them stated beside."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from poise.score.report.data import number
from poise.score.thresholds import THRESHOLDS

LEVELS = ("good", "fair", "poor")


@dataclass(frozen=True)
class Grade:
    """One judged figure.

    Attributes:
        name: what is judged.
        value: the figure in words with its unit.
        level: "good", "fair", "poor" or "unknown".
        rule: the thresholds in words.
        detail: a remark.
        counts: whether it decides the overall verdict.
    """

    name: str
    value: str
    level: str
    rule: str
    detail: str = ""
    counts: bool = True


def _level(value: float | None, key: str) -> str:
    return "unknown" if value is None else THRESHOLDS[key].verdict(value)


def _rule(key: str, unit: str, times: float = 1.0) -> str:
    t = THRESHOLDS[key]
    word = "from" if t.more else "to"
    return f"good {word} {t.good * times:g}, fair {word} {t.fair * times:g} {unit}"


def percent(share: float) -> str:
    """A share in per cent to a tenth, never rounded up to 100 nor down to 0."""
    text = f"{share * 100:.1f}".removesuffix(".0")
    if share < 1 and text == "100":
        text = "99.9"
    if share > 0 and text == "0":
        text = "below 0.1"
    return f"{text} %"


def _part(score: dict[str, Any], name: str) -> dict[str, Any]:
    part = score.get(name)
    return part if isinstance(part, dict) else {}


def tracking(score: dict[str, Any]) -> Grade:
    """How often the whole clip is tracked to its end, upright and on its feet where measured."""
    succ, tracked = number(score.get("succ")), number(score.get("tracked"))
    detail = str(score.get("succ_rule") or "")
    if succ is not None and tracked is not None and tracked < succ:
        detail = f"{percent(succ)} by {detail}, but down or off its feet"
        succ = tracked
    rule = _rule("succ", "%", 100)
    if succ is None:
        return Grade("Tracks the whole clip", "not measured", "unknown", rule)
    word = "yes" if succ >= 1 - 1e-9 else "almost" if succ >= 0.95 else "no"
    return Grade(
        "Tracks the whole clip", f"{word} ({percent(succ)})", _level(succ, "succ"), rule, detail
    )


def joint_error(score: dict[str, Any]) -> Grade:
    """The mean joint error, root-relative."""
    error = number(score.get("mpjpe_mm"))
    rule = _rule("mpjpe_mm", "mm")
    text = "not measured" if error is None else f"{error:.0f} mm"
    detail = "mean distance, root-relative"
    return _before_loss(score, Grade("Joint error", text, _level(error, "mpjpe_mm"), rule, detail))


def help_given(score: dict[str, Any]) -> Grade:
    """The mean residual force as a share of body weight."""
    table = _part(score, "help")
    force, share = number(table.get("force_mean_n")), number(table.get("share_of_body_weight"))
    rules = (_rule("share_of_body_weight", "% of body weight", 100), _rule("torque_mean_nm", "N\u00a0m"))
    rule = "; ".join(rules)
    if force is None and share is None:
        return Grade("Help", "not measured", "unknown", rule)
    torque = number(table.get("torque_mean_nm"))
    if (force or 0.0) == (share or 0.0) == (torque or 0.0) == 0.0:
        return Grade("Help", "none", "good", rule, "no outside force: only the joints' own torques")
    parts = []
    if force is not None:
        parts.append(f"{force:.0f} N" if force >= 1 or force == 0 else f"{force:.1f} N")
    if share is not None:
        parts.append(f"{percent(share)} of body weight")
    beside = "" if torque is None else f", and {torque:.0f}\u00a0N\u00a0m"
    detail = f"mean residual force on the root{beside}"
    levels = [_level(share, "share_of_body_weight"), _level(torque, "torque_mean_nm")]
    level = levels[0] if torque is None else max(levels, key=("unknown", *LEVELS).index)
    if share is None and level != "poor":
        level = "unknown"
    return Grade("Help", " = ".join(parts), level, rule, detail)


def foot_slide(score: dict[str, Any]) -> Grade:
    """Foot slide beside that of the goal; told, but it does not decide the verdict. That of the written
    file is measured on its soles, as `poise doctor` does."""
    slide = number(score.get("foot_slide_mm_per_s"))
    before = number(_part(score, "reference").get("foot_slide_mm_per_s"))
    text = "not measured" if slide is None else f"{slide:.0f} mm/s"
    key = "foot_slide_mm_per_s"
    told = [] if before is None else [f"the motion it follows: {before:.0f} mm/s"]
    for held in (score.get("delivered") or ())[:1]:
        written = number(_part(held, "delivered").get("sole_slide_mm_per_s"))
        if written is not None:
            told.append(f"soles of the written motion, feet held: {written:.0f} mm/s")
    detail = "; ".join(told)
    grade = Grade("Foot slide", text, _level(slide, key), _rule(key, "mm/s"), detail, False)
    return _before_loss(score, grade)


def _before_loss(score: dict[str, Any], grade: Grade) -> Grade:
    """A figure of a motion that is lost is of what comes before it: poor, or not judged."""
    if not cut(score) or grade.level == "unknown":
        return grade
    told = "; ".join(t for t in ("only of what comes before the loss", grade.detail) if t)
    return replace(grade, level="poor" if grade.level == "poor" else "unknown", detail=told)


def grades(score: dict[str, Any]) -> tuple[Grade, ...]:
    """The four figures at the top of the page."""
    return tracking(score), joint_error(score), help_given(score), foot_slide(score)


def overall(score: dict[str, Any]) -> str:
    """The worst level among the figures that count; "unknown" when one of them is missing."""
    levels = [g.level for g in grades(score) if g.counts]
    if "poor" in levels:
        return "poor"
    if "unknown" in levels:
        return "unknown"
    return "fair" if "fair" in levels else "good"


def sentence(score: dict[str, Any]) -> str:
    """The verdict line, e.g. "Tracks the whole clip from every start: yes (100 %) · joint error …"."""
    track, error, aid, _ = grades(score)
    began = "its first frame" if _only_from_the_first(score) else "every start"
    # An endless motion has no starts.
    where = "" if score.get("kind") == "dream" else f" from {began}"
    return f"{track.name}{where}: {track.value} · joint error {error.value} · help {aid.value}"


def cut(score: dict[str, Any]) -> bool:
    """Whether each clip was played once, from its start, and lost."""
    return number(score.get("succ")) == 0.0 and _only_from_the_first(score)


def _only_from_the_first(score: dict[str, Any]) -> bool:
    """Whether there is one episode per clip, as of `poise track`; frame 0 is always among the starts."""
    clips = score.get("per_clip") or ()
    return bool(clips) and all(number(c.get("episodes")) == 1 for c in clips)
