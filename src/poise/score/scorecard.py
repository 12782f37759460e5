"""From padded rollouts to a score card; the definitions stand in docs/results.md."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import fields
from typing import Any, NamedTuple

import torch
from torch import Tensor

from poise.errors import PoiseError
from poise.metrics import (
    HelpAudit,
    Shapes,
    SuccessRule,
    acceleration_error,
    centre_of_mass,
    float_gaps,
    foot_contacts,
    foot_points,
    foot_slide,
    help_audit,
    jerk,
    lowest_points,
    mpjpe_global,
    mpjpe_root,
    penetration,
    span_mask,
    success_rule,
    velocity_error,
)
from poise.motion import Clip
from poise.score.card import NAN, Help, ScoreCard, Weighting
from poise.score.rollouts import Posture, RolloutSet, Sums, judge, posture

TRACKING = (
    "mpjpe_mm",
    "mpjpe_global_mm",
    "vel_mm_per_frame",
    "acc_mm_per_frame2",
)
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


class _Part(NamedTuple):
    """What is left of some rollouts: sums per episode, and the wrenches of the frames that count."""

    figures: dict[str, Sums]
    of_reference: dict[str, Sums]
    reward: dict[str, Sums]
    force: Sums
    posture: Posture
    uncut: dict[str, Sums]
    won: Tensor
    failed_at: Tensor
    clip: Tensor
    start: Tensor
    frames: Tensor
    trial: Tensor
    # Force, torque, and the velocities where they act, `(n, M, 3)`.
    wrench: tuple[Tensor, ...]


def _part(r: RolloutSet, chosen: SuccessRule) -> _Part:
    won, mask, failed_at, uncut = judge(r, chosen)
    return _Part(
        _tracking(r, mask) | _plausibility(r.pos, r.quat, mask, r.fps, r.shapes, r.feet),
        _plausibility(r.ref_pos, r.ref_quat, mask, r.fps, r.shapes, r.feet),
        {n: Sums.of(v, mask) for n, v in r.reward.items()},
        Sums.of(r.force.norm(dim=-1).sum(-1), mask),
        posture(r, won, mask),
        _tracking(r, uncut),
        won,
        failed_at,
        r.clip,
        r.start,
        mask.sum(1),
        torch.full_like(r.clip, -1) if r.trial is None else r.trial,
        tuple(x[mask] for x in (r.force, r.torque, r.point_vel, r.ang_vel)),
    )


def _joined(parts: Sequence[_Part]) -> _Part:
    if len(parts) == 1:
        return parts[0]

    def cat(values: Sequence[Any]) -> Any:
        one = values[0]
        if isinstance(one, Sums):
            return Sums.cat(values)
        if isinstance(one, dict):
            return {k: cat([v[k] for v in values]) for k in one}
        if isinstance(one, Posture):
            return Posture(*(cat(x) for x in zip(*values, strict=True)))
        if isinstance(one, tuple):
            return tuple(cat(x) for x in zip(*values, strict=True))
        return torch.cat(list(values))

    return _Part(*(cat(x) for x in zip(*parts, strict=True)))


def _help(limits: tuple[float, float], audit: HelpAudit) -> Help:
    used = {f.name: getattr(audit, f.name) for f in fields(Help) if not f.name.startswith("limit")}
    return Help(*limits, **used)


def _per_clip(
    p: _Part, name: Callable[[int], str], fps: float, weighting: Weighting
) -> tuple[Mapping[str, Any], ...]:
    """One entry per clip, in order of the clip's index; forces are pooled over the clip's frames."""
    entries = []
    for index in sorted(set(p.clip.tolist())):
        rows = p.clip == index

        def first(at: Tensor, rows: Tensor = rows) -> float:
            """Seconds into the clip of the earliest of the frames `at (E,)`, NaN for -1 in all."""
            lost = rows & (at >= 0)
            return float((p.start[lost] + at[lost]).min()) / fps if bool(lost.any()) else NAN

        entry: dict[str, Any] = {
            "clip": name(int(index)),
            "episodes": int(rows.sum()),
            "frames": int(p.frames[rows].sum()),
            "succ": float(p.won[rows].double().mean()),
            "first_fail_s": first(p.failed_at),
            "tracked": float(p.posture.tracked[rows].mean()),
            "fallen_s": first(p.posture.fallen_at),
            "off_feet_s": first(p.posture.off_feet_at),
        }
        for key in (*TRACKING, *PLAUSIBILITY):
            entry[key] = p.figures[key].mean(rows, weighting) if key in p.figures else NAN
        entry["force_mean_n"] = p.force.mean(rows, "frame")
        entries.append(entry)
    return tuple(entries)


def score_rollouts(
    rollouts: RolloutSet | Iterable[RolloutSet],
    *,
    rule: str | SuccessRule = "phc",
    weighting: Weighting = "frame",
    method: str = "",
    clip: str | None = None,
    seconds: float = 0.0,
    samples: int = 0,
    seed: int = 0,
) -> ScoreCard:
    """Score an evaluation; every definition stands in docs/results.md.

    An episode succeeds when it reached its end and no frame broke `rule`. All figures are over the
    valid frames up to and including the first that broke the rule, failed episodes included: what
    comes after a failure is not tracking. The reference is scored over the same frames. Errors over all
    frames are `variants`' "uncut".

    Args:
        rollouts: all at once, or parts of one evaluation, of which only one is kept at a time.
        weighting: "frame" pools the frames of all episodes (PHC's way, the default); "episode"
            averages episode means. Help is always pooled over frames.
        seconds, samples, seed: wall-clock time, control steps and seed of the training that made it.
    """
    if weighting not in ("frame", "episode"):
        raise PoiseError(
            f"the weighting must be 'frame' or 'episode', got '{weighting}'", code="unknown-choice"
        )
    chosen, parts, first = success_rule(rule), [], None
    for r in [rollouts] if isinstance(rollouts, RolloutSet) else rollouts:
        parts.append(_part(r, chosen))
        # What all parts share, without the frames.
        first = first or (r.clip_names, r.fps, r.mass, (float(r.limit_n), float(r.limit_nm)))
    if first is None:
        raise PoiseError("there are no rollouts to score", code="no-rollouts")
    (names, fps, mass, limits), p = first, _joined(parts)
    everyone = torch.ones_like(p.won)
    force, torque, point_vel, ang_vel = p.wrench
    audit = help_audit(force, torque, point_vel, ang_vel, mass)
    variants = {
        prefix + way: {name: p.figures[name].mean(rows, way) for name in TRACKING}
        for prefix, rows in (("", everyone), ("succ_", p.won))
        for way in ("frame", "episode")
    }
    for way in ("frame", "episode"):
        variants[f"uncut_{way}"] = {name: p.uncut[name].mean(everyone, way) for name in TRACKING}

    def named(index: int) -> str:
        return names[index] if names else str(index)

    def means(sums: Mapping[str, Sums], keys: Iterable[str]) -> dict[str, float]:
        return {n: sums[n].mean(everyone, weighting) if n in sums else NAN for n in keys}

    indices = sorted(set(p.clip.tolist()))
    whole = ", ".join(named(int(i)) for i in indices) if len(indices) <= 3 else f"{len(indices)} clips"
    figures: dict[str, Any] = means(p.figures, (*TRACKING, *PLAUSIBILITY))
    trials = [p.trial == k for k in sorted(set(p.trial.tolist()))]
    return ScoreCard(
        succ=float(p.won.double().mean()),
        succ_rule=chosen.name,
        **figures,
        reward={"total": NAN} | means(p.reward, p.reward),
        help=_help(limits, audit),
        seconds=float(seconds),
        samples=int(samples),
        seed=int(seed),
        clip=whole if clip is None else clip,
        method=method,
        episodes=len(p.won),
        frames=int(p.frames.sum()),
        tracked=float(p.posture.tracked.mean()),
        mpjpe_succ_mm=variants["succ_" + weighting]["mpjpe_mm"],
        reference=means(p.of_reference, PLAUSIBILITY),
        per_clip=_per_clip(p, named, fps, weighting),
        weighting=weighting,
        variants=variants,
        starts=len(trials),
        spread=_spread(p, trials, weighting) if len(trials) > 1 else {},
    )


def _spread(p: _Part, trials: Sequence[Tensor], weighting: Weighting) -> dict[str, float]:
    """Standard deviations over perturbed starts `trials`, each the rows `(E,)` of one."""
    each = {n: [p.figures[n].mean(rows, weighting) for rows in trials] for n in TRACKING}
    each["succ"] = [float(p.won[rows].double().mean()) for rows in trials]
    return {n: statistics.stdev(values) for n, values in each.items()}


def clip_figures(
    clip: Clip, joints: Sequence[int], shapes: Shapes, feet: Sequence[int], ground: float = 0.0
) -> dict[str, float]:
    """`point_slide_mm_per_s` (the score's foot slide, at the clip's own rate) and
    `point_penetration_mm` of a clip with a character's shapes (docs/results.md).

    Args:
        joints: the clip's joint that each body of `shapes` is fixed to. feet: the bodies that are feet.
        ground: height (m) of the floor under the soles, for the slide; penetration is below z = 0.
    """
    pos, quat = (x[:, list(joints)] for x in clip.world())
    slide = foot_slide(foot_points(pos, quat, shapes, feet), clip.fps, ground=ground)
    return {
        "point_slide_mm_per_s": float(slide),
        "point_penetration_mm": float(penetration(lowest_points(pos, quat, shapes)).mean_mm),
    }
