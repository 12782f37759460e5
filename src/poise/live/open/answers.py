"""The answer of a job, the JSON of its verb, in sentences for the page."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from poise.live.open.actions import Action
from poise.live.open.job_processes import PageJob

#: Hints for the codes of errors that the page has a control for, in place of the command line's.
REMEDIES = {
    "pickle-refused": "Numbers are taken out of it, and no code in it runs",
    "rate-missing": "State its frames per second",
}


def code_of(job: PageJob) -> str:
    """The code of a job's error; "" where it has none."""
    return str((job.answer().get("error") or {}).get("code") or "")


def problem_of(job: PageJob) -> str:
    """Why a job has no result, in a sentence; "" where it has one."""
    if job.state == "crashed" or (job.state == "done" and not job.answer() and job.code):
        how = f"signal {-job.code}" if job.code and job.code < 0 else f"code {job.code}"
        return f"The work ended without an answer ({how}). Nothing was changed; try it again."
    error = job.answer().get("error")
    if not error:
        return ""
    what = " ".join(str(error.get(k) or "") for k in ("what",)).strip()
    hint = REMEDIES.get(code_of(job)) or str(error.get("hint") or "").strip()
    return f"{what[:1].upper()}{what[1:]}.{f' {hint}.' if hint else ''}"


def motion_of(outputs: Mapping[str, Any]) -> Path | None:
    """The motion among what a verb wrote."""
    for name in ("simulated", "motion", "clip", "filled"):
        if outputs.get(name):
            return Path(outputs[name])
    return None


def sentences(action: Action, answer: Mapping[str, Any]) -> list[str]:
    """Sentences on a result, most important first."""
    result, out = answer.get("result") or {}, list[str]()
    if fixed := result.get("fixed"):
        before, after = len(result.get("faults") or ()), len(fixed.get("faults") or ())
        out.append(f"{before} faults before, {after} after.")
        slide = [(r.get("figures") or {}).get("sole_slide_mm_per_s") for r in (result, fixed)]
        if None not in slide:
            out.append(f"Standing soles slide by {slide[1]:.0f} mm/s; it was {slide[0]:.0f}.")
        moved = fixed.get("root_moved") or {}
        if moved.get("max_mm", 0) >= 5:
            out.append(f"The root moves by up to {moved['max_mm']:.0f} mm (frame {moved['frame']}).")
        if worse := fixed.get("worse"):
            out.append(f"Worse than before: {', '.join(worse)}.")
    if score := result.get("score"):
        out.append(str(result.get("sentence") or ""))
        if push := result.get("push"):
            back = push.get("back_s")
            came = "was not back at the end" if back is None else f"was back {back:.1f} s after the push"
            out.append(f"The body gave way by {push['moved_m']:.2f} m and {came}.")
        aid = score.get("help") or {}
        force = aid.get("force_mean_n") or 0.0
        out.append("Nothing helped the body: 0 N." if not force else f"Help: {force:.0f} N on average.")
        before = (score.get("reference") or {}).get("foot_slide_mm_per_s")
        held = ((score.get("delivered") or [{}])[0].get("delivered") or {}).get("sole_slide_mm_per_s")
        if before is not None and held is not None:
            followed = f"the motion it follows by {before:.0f}"
            out.append(f"Soles slide by {held:.0f} mm/s in what is written, {followed}.")
    return [*[s for s in out if s], *map(str, answer.get("notes") or ())]
