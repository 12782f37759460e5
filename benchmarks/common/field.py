"""The field's tracking errors, as Perpetual Humanoid Control and UHC report them, episode by episode.

Per frame and over all bodies, in mm at 30 Hz (see `metrics.tracking_errors`): g-MPJPE in the world,
MPJPE after each root is subtracted, velocity (mm/frame) and acceleration (mm/frame^2). A failed episode
counts up to and including the frame that broke PHC's rule; its first frame was set, not tracked, and
does not count. The published code pools the frames of all clips, and so does `pooled`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import torch

from benchmarks.common.rows import Figure, between, of
from benchmarks.common.starts import SPREAD, Nothing, scattered
from benchmarks.common.success import RULES, under_rules
from poise.env import Acts
from poise.metrics import (
    acceleration_error,
    mpjpe_global,
    mpjpe_root,
    span_mask,
    success_rule,
    velocity_error,
)
from poise.recipes.imitation import Imitation
from poise.score import Recorder, simulate
from poise.score.rollouts import RolloutSet, Sums, judge
from poise.sim.guard import UnstableError

#: Figures, their names in rows, and how many frames more each takes than one.
FIGURES = {"g_mpjpe_mm": 0, "mpjpe_mm": 0, "acc_mm_per_frame2": 2, "vel_mm_per_frame": 1}
#: Seeds of starts that are drawn; 0 is the exact one.
TRIALS = (0, 1, 2, 3)
Episode = dict[str, Any]


def episodes(r: RolloutSet, trial: int = 0) -> list[Episode]:
    """The end of each episode: success by rule, frames until PHC's rule broke, sums of the errors."""
    judged = judge(r, success_rule("phc"))
    mask, uncut = judged.mask.clone(), judged.uncut.clone()
    mask[:, 0] = uncut[:, 0] = False
    ref = r.ref_pos.double()
    # Frames that do not count may hold anything.
    pos = torch.where(uncut[..., None, None], r.pos.double(), ref)
    values = {
        "g_mpjpe_mm": mpjpe_global(pos, ref),
        "mpjpe_mm": mpjpe_root(pos, ref, r.root),
        "acc_mm_per_frame2": acceleration_error(pos, ref, r.fps),
        "vel_mm_per_frame": velocity_error(pos, ref, r.fps),
    }
    sums = {k: Sums.of(v, span_mask(mask, n) if (n := FIGURES[k]) else mask) for k, v in values.items()}
    won, lengths = under_rules(r), r.lengths.tolist()
    return [
        {
            "clip": r.clip_name(int(r.clip[e])),
            "trial": trial,
            "frames": lengths[e],
            "tracked": int(mask[e].sum()),
            "won": {rule: bool(w[e]) for rule, w in won.items()},
            "sums": {k: [float(s.total[e]), int(s.count[e])] for k, s in sums.items()},
        }
        for e in range(len(r.clip))
    ]


def pooled(rows: Iterable[Episode], figure: str) -> float:
    """The mean over all frames of all episodes; NaN for none."""
    told = [r["sums"][figure] for r in rows]
    count = sum(n for _, n in told)
    return sum(total for total, _ in told) / count if count else math.nan


def done(rows: Sequence[Episode], rule: str = "phc") -> float:
    """The share of the episodes that succeed by a rule."""
    return sum(r["won"][rule] for r in rows) / len(rows)


def figures(subject: str, rows: Sequence[Episode]) -> list[Figure]:
    """Success under the three rules and the errors, of exact starts and of starts that are drawn.

    The spread of a drawn figure is from the least to the most of a draw.
    """
    out = list[Figure]()
    exact = [r for r in rows if r["trial"] == 0]
    out += of(subject, _of(exact), len(exact))
    trials = sorted({r["trial"] for r in rows} - {0})
    if trials:
        each = [_of([r for r in rows if r["trial"] == t]) for t in trials]
        drawn = [r for r in rows if r["trial"]]
        for name, value in _of(drawn).items():
            values = [e[name] for e in each if math.isfinite(e[name])]
            if values:
                out.append(
                    Figure(f"{subject}, {SPREAD}", name, value, len(drawn), between(values), len(trials))
                )
    return out


def _of(rows: Sequence[Episode]) -> dict[str, float]:
    shares = {"done" if rule == "phc" else f"done_{rule}": done(rows, rule) for rule in RULES}
    return shares | {k: pooled(rows, k) for k in FIGURES}


def tracked(
    task: Imitation, policy: Acts | None, trials: Sequence[int] = TRIALS, help_scale: float = 0.0
) -> Iterator[RolloutSet]:
    """All clips of a task from their first frames, once for each trial.

    policy: None does nothing (action 0). help_scale: of the task's help, by default without any.
    """
    every = torch.arange(len(task.reference.length))
    for trial in trials:
        # A world that goes bad after its character was lost is no reason to stop.
        env = task.bare().env(len(every), None, False, 1, help_scale=help_scale, guard=False)
        try:
            zero = torch.zeros_like(every)
            obs = env.reset_to(every, zero)
            if trial:
                obs = scattered(env, torch.full_like(every, trial))
            recorder = Recorder(env, every, zero, 1)
            try:
                simulate(env, policy or Nothing(env.num_actions), obs, recorder.total - 1, recorder)
            except UnstableError:
                if len(every) > 1:
                    raise
            yield recorder.rollouts()
        finally:
            env.close()


def measured(
    task: Imitation, policy: Acts | None, trials: Sequence[int] = TRIALS, help_scale: float = 0.0
) -> list[Episode]:
    """The episodes of `tracked`."""
    found = tracked(task, policy, trials, help_scale)
    return [e for t, r in zip(trials, found, strict=True) for e in episodes(r, t)]


def chunks(names: Sequence[str], size: int) -> dict[str, list[str]]:
    """Names in groups of `size`, by the first and the last of each."""
    groups = [list(names[k : k + size]) for k in range(0, len(names), size)]
    return {g[0] if len(g) == 1 else f"{g[0]} to {g[-1]}": g for g in groups}
