"""The field's tracking table: success and errors as Perpetual Humanoid Control and UHC report them.

Per frame and over all bodies, in mm at 30 Hz (see `metrics.tracking_errors`): g-MPJPE in the world,
MPJPE after each root is subtracted, PA-MPJPE after Procrustes, velocity (mm/frame) and acceleration
(mm/frame^2). The published code pools the frames of all clips and prints figures with and without
failed clips; both choices stand side by side here with the mean over clips, since they differ."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from field.card import FIGURES, ClipErrors, Errors, FieldTable, View
from poise.errors import PoiseError
from poise.metrics import (
    SuccessRule,
    acceleration_error,
    mpjpe_global,
    mpjpe_pa,
    mpjpe_root,
    span_mask,
    success_rule,
    velocity_error,
)
from poise.score.rollouts import RolloutSet, Sums, judge


def field_table(
    rollouts: RolloutSet | Iterable[RolloutSet],
    *,
    method: str = "",
    data: str = "",
    rule: str | SuccessRule = "phc",
    bodies: Sequence[int] | None = None,
) -> FieldTable:
    """The field's table of one evaluation; a large one may come in parts, one at a time.

    A failed episode counts up to and including the frame that broke the rule (the published code goes on
    with a restarted run instead), in the "uncut" views to its end. An episode's first frame was set, not
    tracked, so it does not count.
    "By clip" is the mean over clips of each clip's mean over the frames of its episodes.

    Args:
        rollouts: episodes, by the protocol one per clip from frame 0.
        bodies: their errors are averaged, by default all; the rule looks at the rollouts' own.

    Raises:
        PoiseError: no episode, two frame rates, or an unknown rule.
    """
    chosen = success_rule(rule)
    parts = [rollouts] if isinstance(rollouts, RolloutSet) else rollouts
    gathered = [_Part.of(r, chosen, bodies) for r in parts]
    if not gathered:
        raise PoiseError("there is no episode to tabulate", code="no-rollouts")
    if len({p.fps for p in gathered}) > 1:
        raise PoiseError(
            f"the rollouts have several frame rates: {sorted({p.fps for p in gathered})}",
            code="rate-differs",
        )
    names = [n for p in gathered for n in p.names]
    won, count, failed_at, start = (
        torch.cat([getattr(p, k) for p in gathered]) for k in ("won", "frames", "failed_at", "start")
    )
    sums, uncut = (
        {k: Sums.cat([getattr(p, which)[k] for p in gathered]) for k in FIGURES}
        for which in ("sums", "uncut")
    )
    fps = gathered[0].fps
    rows = {n: torch.tensor([m == n for m in names]) for n in dict.fromkeys(names)}
    clips = [_clip(n, r, won, count, failed_at, start, sums, fps) for n, r in rows.items()]
    everyone = torch.ones_like(won)
    views: dict[View, Errors] = {
        "all_frame": _mean(sums, everyone),
        "all_clip": _over_clips(sums, everyone, list(rows.values())),
        "succ_frame": _mean(sums, won),
        "succ_clip": _over_clips(sums, won, list(rows.values())),
        "uncut_frame": _mean(uncut, everyone),
        "uncut_clip": _over_clips(uncut, everyone, list(rows.values())),
    }
    ranked = sorted(clips, key=lambda c: (-c.failed / c.episodes, -_or(c.errors.g_mpjpe, math.inf)))
    return FieldTable(
        method, data, chosen.name, fps, len(won), int(count.sum()), float(won.double().mean()), views,
        tuple(ranked),
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Part:
    """What one set of rollouts adds: per episode `(E,)` and per figure, over frames that count and
    uncut."""

    names: list[str]
    won: Tensor
    frames: Tensor
    failed_at: Tensor
    start: Tensor
    sums: dict[str, Sums]
    uncut: dict[str, Sums]
    fps: float

    @staticmethod
    def of(r: RolloutSet, rule: SuccessRule, bodies: Sequence[int] | None) -> _Part:
        judged = judge(r, rule)
        mask, uncut = judged.mask.clone(), judged.uncut.clone()
        mask[:, 0] = uncut[:, 0] = False
        picked = list(range(r.pos.shape[2]) if bodies is None else bodies)
        if r.root not in picked:
            raise PoiseError(
                f"the bodies of a tracking table must hold the root, body {r.root}", code="joint-missing"
            )
        ref = r.ref_pos[:, :, picked].double()
        # Frames that do not count may hold anything, on which Procrustes would stop.
        pos = torch.where(uncut[..., None, None], r.pos[:, :, picked].double(), ref)
        # Each with how many frames more it takes.
        values = {
            "g_mpjpe": (mpjpe_global(pos, ref), 0),
            "mpjpe": (mpjpe_root(pos, ref, picked.index(r.root)), 0),
            "pa_mpjpe": (mpjpe_pa(pos, ref), 0),
            "acc": (acceleration_error(pos, ref, r.fps), 2),
            "vel": (velocity_error(pos, ref, r.fps), 1),
        }

        def over(frames: Tensor) -> dict[str, Sums]:
            return {
                k: Sums.of(v, span_mask(frames, more) if more else frames)
                for k, (v, more) in values.items()
            }

        return _Part(
            [r.clip_name(int(i)) for i in r.clip],
            judged.won,
            mask.sum(1),
            judged.failed_at,
            r.start,
            over(mask),
            over(uncut),
            r.fps,
        )


def _mean(sums: Mapping[str, Sums], rows: Tensor) -> Errors:
    return Errors(**{k: sums[k].mean(rows, "frame") for k in FIGURES})


def _over_clips(sums: Mapping[str, Sums], rows: Tensor, clips: Sequence[Tensor]) -> Errors:
    """The mean over clips, each with the mean over its frames, of those of `rows`."""
    each = [_mean(sums, rows & c) for c in clips]
    out = {}
    for name in FIGURES:
        told = [v for v in (getattr(e, name) for e in each) if not math.isnan(v)]
        out[name] = sum(told) / len(told) if told else math.nan
    return Errors(**out)


def _clip(
    name: str,
    rows: Tensor,
    won: Tensor,
    count: Tensor,
    failed_at: Tensor,
    start: Tensor,
    sums: Mapping[str, Sums],
    fps: float,
) -> ClipErrors:
    lost = rows & ~won
    first = start[rows][0]
    seconds = math.nan
    if bool(lost.any()):
        at = (start + failed_at)[lost]
        seconds, first = float(at.min()) / fps, start[lost][at.argmin()]
    return ClipErrors(
        name, int(rows.sum()), int(lost.sum()), seconds, int(first), int(count[rows].sum()),
        _mean(sums, rows),
    )  # fmt: skip


def _or(value: float, other: float) -> float:
    return other if math.isnan(value) else value
