"""The policy that comes with Poise, alone and with lookahead, on unseen clips, without help.

    python benchmarks/lookahead.py --data FOLDER --json FILE [--set bandai cmu dances] [--every N]
        [--controllers nothing policy lookahead] [--budgets 192] [--starts 1] [--workers 2]

"nothing" is the null: action 0, which aims at the motion's own joint angles. With --starts N every clip
is begun N times, each from joint angles that are off by 1 mrad, and figures are means over these.
"""

from __future__ import annotations

import argparse
import json
import math
import platform
import statistics
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from poise.env import Acts
from poise.eval import score_rollouts
from poise.eval.episodes import Recorder, simulate
from poise.eval.rolloutset import RolloutSet, judge
from poise.jobs.open import open_run
from poise.jobs.track import imitation_of, look_ahead
from poise.jobs.track.placement import place
from poise.learn.checkpoint import write_atomic
from poise.metrics import foot_contacts, foot_points, mpjpe_global, success_rule
from poise.motion import read_clip
from poise.plan import Lookahead, LookaheadConfig

#: Joint angles of perturbed starts are off by so much, rad.
OFF = 1e-3
#: Clips of each set: a pattern in the folder of data, and words that are left out.
SETS: dict[str, tuple[str, tuple[str, ...]]] = {
    "bandai": ("other/bandai_bvh/*.bvh", ("_old_", "_giant_", "_tired_", "_elderly_")),
    "bandai-test": ("other/bandai_bvh/*.bvh", ()),
    "cmu": ("cmu_amc/*/*.amc", ("/01/", "/02/", "/rfc/", "/usc/")),
    "dances": ("cmu_bvh/acrnn_salsa/*.bvh", tuple(f"/{k:02d}.bvh" for k in (*range(1, 8), 9, 10, 12))),
}
#: Words of the styles that are kept for the last test.
KEPT = SETS["bandai"][1]
#: Figures of which a table has the median of the clips that were done whole.
FIGURES = (
    "error_mm", "root_error_mm", "jerk_ratio", "slide", "source_slide", "stance_ratio",
    "seconds_per_second",
)  # fmt: skip


class Nothing:
    """Action 0."""

    def __init__(self, actions: int):
        self.actions = actions

    def act(self, obs: Tensor) -> Tensor:
        return torch.zeros(len(obs), self.actions)


def clips_of(name: str, data: Path, every: int) -> list[Path]:
    pattern, without = SETS[name]
    files = [f for f in sorted(data.glob(pattern)) if not any(w in f.as_posix() for w in without)]
    if name == "bandai-test":
        files = [f for f in files if any(w in f.as_posix() for w in KEPT)]
    return files[::every]


def stance(rollouts: RolloutSet) -> float:
    """Contacts of sole points with the ground beside those of the reference."""
    counts, shapes = [], rollouts.shapes
    assert shapes is not None
    for pos, quat in ((rollouts.pos, rollouts.quat), (rollouts.ref_pos, rollouts.ref_quat)):
        points = foot_points(pos[0], quat[0], shapes, rollouts.feet)
        counts.append(float(foot_contacts(points, rollouts.fps)[1].sum()))
    return counts[0] / counts[1] if counts[1] else math.nan


def measured(path: Path, controller: str, budget: float, starts: int) -> dict[str, Any]:
    """One clip with one controller, means over its starts."""
    torch.set_num_threads(1)
    tracker = open_run(None).tracker
    task = imitation_of(tracker, [place(read_clip(path), tracker)])
    rows, times = [], list[float]()
    for k in range(starts):
        env = task.env(1, None, False, 1, help_scale=0.0, guard=False)
        acts: Acts = Nothing(env.num_actions) if controller == "nothing" else tracker.policy
        if controller == "lookahead":
            acts = look_ahead(tracker, task, LookaheadConfig().with_budget(budget), 1, k)
        zero = torch.zeros(1, dtype=torch.long)
        obs = env.reset_to(zero, zero)
        if starts > 1:
            qpos, qvel = env.backend.state.qpos.clone(), env.backend.state.qvel.clone()
            rng = torch.Generator().manual_seed(k)
            qpos[:, 7:] += OFF * torch.randn(qpos[:, 7:].shape, generator=rng, dtype=qpos.dtype)
            env.backend.write(None, qpos, qvel)
            obs = env.observe()
        if isinstance(acts, Lookahead):
            acts.watch(env)
        recorder = Recorder(env, zero, zero, 1)
        begun = time.perf_counter()
        simulate(env, acts, obs, recorder.total - 1, recorder)
        spent = time.perf_counter() - begun
        rollouts = recorder.rollouts()
        if isinstance(acts, Lookahead):
            times += acts.seconds
            acts.copies.close()
        env.close()
        card = score_rollouts(rollouts, method=controller, seed=k)
        fail = int(judge(rollouts, success_rule("phc")).failed_at[0])
        length = rollouts.pos.shape[1]
        all_frames = float(mpjpe_global(rollouts.pos, rollouts.ref_pos).mean())
        source = card.reference
        rows.append({
            "whole": card.succ, "tracked": 1.0 if fail < 0 else fail / length,
            "error_mm": card.mpjpe_global_mm, "all_frames_error_mm": all_frames,
            "root_error_mm": card.mpjpe_mm, "acc": card.acc_mm_per_frame2, "vel": card.vel_mm_per_frame,
            "jerk_ratio": card.jerk / source["jerk"], "slide": card.foot_slide_mm_per_s,
            "source_slide": source["foot_slide_mm_per_s"], "stance_ratio": stance(rollouts),
            "penetration": card.penetration_mm, "floating": card.float_mm,
            "seconds_per_second": spent / (length / rollouts.fps),
        })  # fmt: skip
    out: dict[str, Any] = {"clip": path.stem, "controller": controller, "budget": budget}
    out |= {k: round(statistics.fmean(r[k] for r in rows), 3) for k in rows[0]}
    if times:
        order = sorted(times)
        out["decision_ms"] = round(1000 * order[len(order) // 2], 1)
        out["decision_p99_ms"] = round(1000 * order[int(0.99 * (len(order) - 1))], 1)
    return out


def table(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """What a set came to: share of clips done whole, medians of those."""
    whole = [r for r in rows if r["whole"] >= 0.999] or list(rows)
    out = {"clips": len(rows), "succ": statistics.fmean(r["whole"] for r in rows)}
    out["tracked"] = statistics.fmean(r["tracked"] for r in rows)
    out |= {k: statistics.median(r[k] for r in whole) for k in FIGURES}
    clean = [r["slide"] <= max(r["source_slide"], 40.0) for r in whole]
    out["slide_as_source"] = statistics.fmean(clean)
    out["all_frames_error_mm"] = statistics.fmean(r["all_frames_error_mm"] for r in rows)
    return {k: round(v, 3) for k, v in out.items()}


def work(args: argparse.Namespace) -> Iterator[tuple[str, Path, str, float]]:
    for name in args.set:
        for path in clips_of(name, args.data, args.every):
            for controller in args.controllers:
                for budget in args.budgets if controller == "lookahead" else (0.0,):
                    yield name, path, controller, budget


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--set", nargs="+", choices=SETS, default=["bandai", "cmu", "dances"])
    parser.add_argument("--every", type=int, default=1, help="take every N-th clip")
    parser.add_argument("--controllers", nargs="+", default=["nothing", "policy", "lookahead"])
    parser.add_argument("--budgets", nargs="+", type=float, default=[192.0])
    parser.add_argument("--starts", type=int, default=1)
    parser.add_argument("--workers", type=int, default=2)
    args = parser.parse_args()
    jobs = list(work(args))
    rows: dict[str, list[dict[str, Any]]] = {}
    command = f"python benchmarks/lookahead.py --set {' '.join(args.set)} --every {args.every}"
    command += f" --starts {args.starts} --budgets {' '.join(f'{b:g}' for b in args.budgets)}"
    with ProcessPoolExecutor(args.workers) as pool:
        running = [pool.submit(measured, path, c, b, args.starts) for _, path, c, b in jobs]
        for (name, _, c, b), one in zip(jobs, running, strict=True):
            rows.setdefault(f"{name}, {c}" + (f" {b:g}" if b else ""), []).append(one.result())
            found = {key: table(done) for key, done in rows.items()}
            out = {"command": command, "machine": f"{platform.machine()}, {args.workers} processes"}
            data = out | {"tables": found, "clips": rows}
            write_atomic(args.json, json.dumps(data, indent=1).encode())


if __name__ == "__main__":
    main()
