"""From padded rollouts to a score card; the definitions stand in docs/metrics.md."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import torch
from torch import Tensor

from poise.errors import PoiseError
from poise.eval.card import NAN, Help, ScoreCard, Weighting, read_score, write_score
from poise.eval.judged import Sums, judge
from poise.eval.rolloutset import RolloutSet
from poise.eval.verdicts import table
from poise.metrics import (
    HelpAudit,
    Shapes,
    SuccessRule,
    acceleration_error,
    centre_of_mass,
    float_gaps,
    foot_contacts,
    foot_points,
    help_audit,
    jerk,
    lowest_points,
    mpjpe_global,
    mpjpe_root,
    span_mask,
    success_rule,
    velocity_error,
)

__all__ = [
    "Help",
    "RolloutSet",
    "ScoreCard",
    "read_score",
    "score_rollouts",
    "table",
    "write_score",
]

TRACKING = ("mpjpe_mm", "mpjpe_global_mm", "vel_mm_per_frame", "acc_mm_per_frame2")
PLAUSIBILITY = ("foot_slide_mm_per_s", "penetration_mm", "float_mm", "jerk")


def _plausibility(
    pos: Tensor, quat: Tensor, mask: Tensor, fps: float, shapes: Shapes | None, feet: tuple[int, ...]
) -> dict[str, Sums]:
    """The plausibility figures of one side (simulation or reference); the same code serves both."""
    out = {"jerk": Sums.of(jerk(pos, fps), span_mask(mask, 3))}
    if shapes is None:
        return out
    lowest = lowest_points(pos, quat, shapes)
    out["penetration_mm"] = Sums.of((-lowest).clamp_min(0) * 1000.0, mask)
    height = centre_of_mass(pos, quat, shapes)[..., 2]
    out["float_mm"] = Sums.of(*float_gaps(lowest, height, fps, mask=mask))
    if feet:
        points = foot_points(pos, quat, shapes, feet)
        out["foot_slide_mm_per_s"] = Sums.of(*foot_contacts(points, fps, mask=mask))
    return out


def _tracking(r: RolloutSet, mask: Tensor) -> dict[str, Sums]:
    return {
        "mpjpe_mm": Sums.of(mpjpe_root(r.pos, r.ref_pos, r.root), mask),
        "mpjpe_global_mm": Sums.of(mpjpe_global(r.pos, r.ref_pos), mask),
        "vel_mm_per_frame": Sums.of(velocity_error(r.pos, r.ref_pos, r.fps), span_mask(mask, 1)),
        "acc_mm_per_frame2": Sums.of(acceleration_error(r.pos, r.ref_pos, r.fps), span_mask(mask, 2)),
    }


def _help(r: RolloutSet, audit: HelpAudit) -> Help:
    used = {f.name: getattr(audit, f.name) for f in fields(Help) if not f.name.startswith("limit")}
    return Help(float(r.limit_n), float(r.limit_nm), **used)


def _per_clip(
    r: RolloutSet,
    sums: Mapping[str, Sums],
    mask: Tensor,
    won: Tensor,
    failed_at: Tensor,
    weighting: Weighting,
) -> tuple[Mapping[str, Any], ...]:
    """One entry per clip, in order of the clip's index; forces are pooled over the clip's frames."""
    force = Sums.of(r.force.norm(dim=-1).sum(-1), mask)
    entries = []
    for index in sorted(set(r.clip.tolist())):
        rows = r.clip == index
        lost = rows & (failed_at >= 0)
        seconds = float((r.start[lost] + failed_at[lost]).min()) / r.fps if bool(lost.any()) else NAN
        entry: dict[str, Any] = {
            "clip": r.clip_name(int(index)),
            "episodes": int(rows.sum()),
            "frames": int(mask[rows].sum()),
            "succ": float(won[rows].double().mean()),
            "first_fail_s": seconds,
        }
        for name in (*TRACKING, *PLAUSIBILITY):
            entry[name] = sums[name].mean(rows, weighting) if name in sums else NAN
        entry["force_mean_n"] = force.mean(rows, "frame")
        entries.append(entry)
    return tuple(entries)


def score_rollouts(
    rollouts: RolloutSet,
    *,
    rule: str | SuccessRule = "phc",
    weighting: Weighting = "frame",
    method: str = "",
    clip: str | None = None,
    seconds: float = 0.0,
    samples: int = 0,
    seed: int = 0,
) -> ScoreCard:
    """Score an evaluation; every definition stands in docs/metrics.md.

    An episode succeeds when it reached its end and no frame broke `rule`. All figures are over the
    valid frames up to and including the first that broke the rule, failed episodes included: what
    comes after a failure is not tracking. The reference is scored over the same frames.

    Args:
        weighting: "frame" pools the frames of all episodes (PHC's way, the default); "episode"
            averages episode means. Help is always pooled over frames.
        seconds, samples, seed: wall-clock time, control steps and seed of the training that made it.
    """
    r = rollouts
    if weighting not in ("frame", "episode"):
        raise PoiseError(f"the weighting must be 'frame' or 'episode', got '{weighting}'")
    chosen = success_rule(rule)
    won, mask, failed_at = judge(r, chosen)
    sums = _tracking(r, mask) | _plausibility(r.pos, r.quat, mask, r.fps, r.shapes, r.feet)
    of_reference = _plausibility(r.ref_pos, r.ref_quat, mask, r.fps, r.shapes, r.feet)
    everyone = torch.ones_like(won)
    audit = help_audit(r.force, r.torque, r.point_vel, r.ang_vel, r.mass, mask=mask)
    variants = {
        prefix + way: {name: sums[name].mean(rows, way) for name in TRACKING}
        for prefix, rows in (("", everyone), ("succ_", won))
        for way in ("frame", "episode")
    }
    figures: dict[str, Any] = {
        n: sums[n].mean(everyone, weighting) if n in sums else NAN for n in (*TRACKING, *PLAUSIBILITY)
    }
    indices = sorted(set(r.clip.tolist()))
    named = (
        ", ".join(r.clip_name(int(i)) for i in indices) if len(indices) <= 3 else f"{len(indices)} clips"
    )
    return ScoreCard(
        succ=float(won.double().mean()),
        succ_rule=chosen.name,
        **figures,
        reward={"total": NAN}
        | {n: Sums.of(v, mask).mean(everyone, weighting) for n, v in r.reward.items()},
        help=_help(r, audit),
        seconds=float(seconds),
        samples=int(samples),
        seed=int(seed),
        clip=named if clip is None else clip,
        method=method,
        episodes=len(won),
        frames=int(mask.sum()),
        mpjpe_succ_mm=variants["succ_" + weighting]["mpjpe_mm"],
        reference={
            n: of_reference[n].mean(everyone, weighting) if n in of_reference else NAN
            for n in PLAUSIBILITY
        },
        per_clip=_per_clip(r, sums, mask, won, failed_at, weighting),
        weighting=weighting,
        variants=variants,
    )
