"""Motion without end in figures: falls per hour, slide, jerk, standing still, diversity, prediction.

    python benchmarks/endless.py --library FOLDER -o endless.json [--minutes 10] [--rollouts 20]

FOLDER is that of `tracker/README.md`; predictions are made after windows of the subjects of CMU that no
part of Poise has learned from. Nothing helps the character. A rollout without recovery counts until the
character falls. What is written says how many rollouts of which length were made.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tracker import HELD_OUT, SIXTY, TWINS

from poise.body import BodyConfig
from poise.jobs.endless.config import Dream
from poise.jobs.endless.dreaming import dream
from poise.jobs.endless.figures import Figures
from poise.jobs.endless.frames import PIECE
from poise.jobs.endless.model import load_generator
from poise.jobs.library.clips import LibraryConfig
from poise.jobs.library.folder import library_of, split
from poise.jobs.open import open_run
from poise.jobs.track.placement import place
from poise.kin.fk import Kinematics
from poise.synth.generator import Kinematic

#: Samples after each window, windows, and s that are predicted.
SAMPLES, WINDOWS, AHEAD_S = 10, 40, 2.0


def figures_of(motions: list[np.ndarray], humanoid: Any, fps: float) -> dict[str, Any]:
    """Slide, sinking, jerk, speed, standing still of coordinates."""
    sums = Figures(humanoid, fps)
    for qpos in motions:
        for k in range(0, len(qpos), PIECE):
            sums.add(qpos[k : k + PIECE])
    return sums.to_dict()


def kinematic(made: Kinematic, humanoid: Any, minutes: float, rollouts: int) -> dict[str, Any]:
    """Rollouts without physics, the network's own past again and again."""
    frames = round(60 * minutes * made.fps)
    motions = [
        made.endless(frames, torch.Generator().manual_seed(s))[made.past :].numpy()
        for s in range(rollouts)
    ]
    last = [figures_of([m[-round(60 * made.fps) :]], humanoid, made.fps) for m in motions]
    return {
        "rollouts": rollouts, "minutes": minutes, **figures_of(motions, humanoid, made.fps),
        "last_minute_jerk_m_per_s3": [r["jerk_m_per_s3"] for r in last],
        "last_minute_speed_m_per_s": [r["speed_m_per_s"] for r in last],
    }  # fmt: skip


def simulated(seconds: float, rollouts: int, **how: Any) -> dict[str, Any]:
    """Rollouts with a body."""
    rows = list[dict[str, Any]]()
    for seed in range(rollouts):
        done = dream(seconds, config=Dream(seed=seed, threads=1, **how)).to_dict()
        until = (
            done["falls"][0]["seconds"] if done["falls"] and not how.get("recover", True) else seconds
        )
        rows.append({**done, "counted_s": until})
        print(done["sentence"], flush=True)
    falls, counted = sum(len(r["falls"]) for r in rows), sum(r["counted_s"] for r in rows)
    names = ("foot_slide_mm_per_s", "penetration_mm", "jerk_m_per_s3", "speed_m_per_s")
    return {
        "rollouts": rollouts, "seconds_each": seconds, "falls": falls,
        "falls_per_hour": round(3600 * falls / counted, 1),
        "stayed_down": sum(r["stayed_down"] for r in rows),
        "longest_still_s": max(r["simulated"]["longest_still_s"] for r in rows),
        **{n: round(float(np.mean([r["simulated"][n] for r in rows])), 2) for n in names},
        **{f"asked_{n}": round(float(np.mean([r["asked"][n] for r in rows])), 2) for n in names},
    }  # fmt: skip


def predicted(made: Kinematic, humanoid: Any, test: list[np.ndarray]) -> dict[str, Any]:
    """Errors of the hinges over 2 s as the paper has them (rad, Euclidean), and diversity.

    MAE is the mean over the frames, FAE that of the last one. APD is the mean distance between
    samples, of all bodies' places over the two seconds, root-relative, m.
    """
    frames, p = round(AHEAD_S * made.fps), made.past
    starts = [(q, i) for q in test for i in range(0, len(q) - p - frames + 1, p)]
    picks = np.linspace(0, len(starts) - 1, min(WINDOWS, len(starts))).round().astype(int)
    kin, rng = Kinematics(humanoid.table), torch.Generator().manual_seed(0)
    errors, still, apart = list[np.ndarray](), list[np.ndarray](), list[float]()
    for k in picks:
        q, i = starts[k]
        past, true = torch.tensor(q[i : i + p])[None], q[i + p : i + p + frames, 7:]
        out = made.propose(past.expand(SAMPLES, -1, -1), rng, 1)[:, 0, :frames]
        off = np.linalg.norm(out[..., 7:].numpy() - true, axis=-1)
        errors.append(off)
        still.append(np.linalg.norm(q[i + p - 1, 7:] - true, axis=-1))
        pos = kin(out).pos
        flat = (pos - pos[:, :, :1]).flatten(1)
        apart.append(float(torch.pdist(flat).mean()))
    e, s = np.stack(errors), np.stack(still)
    return {
        "windows": len(picks), "samples": SAMPLES, "seconds": AHEAD_S,
        "mae": round(float(e.mean()), 3), "fae": round(float(e[..., -1].mean()), 3),
        "best_mae": round(float(e.mean(-1).min(-1).mean()), 3),
        "best_fae": round(float(e[..., -1].min(-1).mean()), 3),
        "zero_velocity_mae": round(float(s.mean()), 3),
        "zero_velocity_fae": round(float(s[..., -1].mean()), 3),
        "apd_m": round(float(np.mean(apart)), 3),
    }  # fmt: skip


def main() -> None:
    """Measures and writes after each part."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--library", type=Path, required=True)
    parser.add_argument("-o", type=Path, required=True)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--rollouts", type=int, default=20)
    parser.add_argument("--policy-seconds", type=float, default=600.0)
    parser.add_argument("--policy-rollouts", type=int, default=20)
    parser.add_argument("--ahead-seconds", type=float, default=600.0)
    parser.add_argument("--ahead-rollouts", type=int, default=20)
    a = parser.parse_args()
    torch.set_num_threads(1)
    tracker, model = open_run(None).tracker, load_generator()
    humanoid, made = tracker.humanoid, model.generator(tracker.humanoid)
    out: dict[str, Any] = {"command": "python benchmarks/endless.py", "options": {
        k: v for k, v in vars(a).items() if k not in ("o", "library")}}  # fmt: skip

    def keep(name: str, value: Any) -> None:
        out[name] = value
        a.o.write_text(json.dumps(out, indent=1) + "\n")
        print(name, value, flush=True)

    keep("kinematic", kinematic(made, humanoid, a.minutes, a.rollouts))
    keep("lookahead", simulated(a.ahead_seconds, a.ahead_rollouts))
    keep("policy", simulated(a.policy_seconds, a.policy_rollouts, controller="policy"))
    alone = {"controller": "policy", "recover": False}
    keep("policy, recovery off", simulated(a.policy_seconds, a.policy_rollouts, **alone))
    how = LibraryConfig(rates=SIXTY, leave_out=TWINS)
    library, _ = library_of(
        a.library, tracker.target, config=how, body=BodyConfig(), tell=lambda _: None
    )
    parts = split(library, HELD_OUT)
    test = [place(c, tracker).qpos for c in parts.test]
    keep("prediction, held out", predicted(made, humanoid, test))
    some = [place(c, tracker).qpos for c in list(parts.train)[::8]]
    keep("library", figures_of(some, humanoid, made.fps))


if __name__ == "__main__":
    main()
