"""Clips one after another, without a reset and without help: `poise track A B C`.

    python benchmarks/chain.py --data FOLDER --json FILE [--triples 10] [--set mdm cmu] [--seed 0]
        [--controller auto] [--recover] [--save FOLDER]

A triple is three clips of a set, drawn by the seed. The first stands at the origin; each next one begins
0.5 to 5 m from where the one before ends, in any direction, and faces any way. A clip is resumed where
the character begins it and is within 0.5 m of it for half a second, the rule of the figures of recovery.
"""

from __future__ import annotations

import argparse
import json
import math
import platform
import statistics
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

from poise.formats import read_clip
from poise.jobs.open import open_run
from poise.jobs.result import Result
from poise.jobs.track import track
from poise.jobs.tracker import Tracker
from poise.learn.checkpoint import write_atomic
from poise.metrics import mpjpe_global
from poise.motion import Clip, trim
from poise.motion.rotations import quat_mul, yaw_quat

#: Files of each set, and words that are left out.
SETS: dict[str, tuple[str, tuple[str, ...]]] = {
    "cmu": ("cmu_amc/*/*.amc", ("/01/", "/02/", "/11/", "/rfc/", "/usc/")),
    "mdm": ("other/text_to_motion/mdm_results_pred.npy", ()),
}
#: Motions in MDM's file; s of each that are done.
TAKES, LONGEST_S = 30, 4.0
#: m between an end and the next start.
APART = (0.5, 5.0)
#: s within which a clip is to be resumed, and for which it is to be held; m that count as on it.
WITHIN_S, HELD_S, NEAR = 10.0, 0.5, 0.5
#: Of the root's height at ease; a character with its root below has fallen.
DOWN = 0.5


def clips_of(name: str, data: Path) -> list[tuple[str, Path, str | None]]:
    """(name, file, take) of each clip of a set."""
    pattern, without = SETS[name]
    files = [f for f in sorted(data.glob(pattern)) if not any(w in f.as_posix() for w in without)]
    if name != "mdm":
        return [(f.stem, f, None) for f in files]
    return [(f"{f.stem}-{k}", f, str(k)) for f in files for k in range(TAKES)]


def set_down(clip: Clip, place: np.ndarray, yaw: float) -> Clip:
    """The clip turned by `yaw` about its start and moved so that it begins over `place (2)`."""
    turn = yaw_quat(torch.tensor(yaw, dtype=torch.float64))
    rot, pos = clip.rot.copy(), clip.root_pos.copy()
    rot[:, 0] = quat_mul(turn.expand(len(rot), 4), torch.tensor(rot[:, 0])).numpy()
    c, s = math.cos(yaw), math.sin(yaw)
    pos[:, :2] = (pos[:, :2] - pos[0, :2]) @ np.array([[c, s], [-s, c]]) + place
    return clip.replaced(root_pos=pos, rot=rot)


def triple(name: str, data: Path, rng: np.random.Generator) -> tuple[list[Clip], list[float]]:
    """Three clips as they stand, and m from each end to the next start."""
    files, out, away = clips_of(name, data), list[Clip](), list[float]()
    place = np.zeros(2)
    for k in rng.choice(len(files), 3, replace=False):
        own, path, take = files[k]
        clip = read_clip(path, take=take, allow_pickle=True).replaced(name=own)
        clip = trim(clip, 0, min(clip.frames, round(LONGEST_S * clip.fps)))
        if out:
            away.append(float(rng.uniform(*APART)))
            bearing = rng.uniform(0, 2 * math.pi)
            place = out[-1].root_pos[-1, :2] + away[-1] * np.array(
                [math.cos(bearing), math.sin(bearing)]
            )
        out.append(set_down(clip, place, float(rng.uniform(0, 2 * math.pi))))
    return out, away


def measured(tracked: Result, away: list[float], tracker: Tracker) -> dict[str, Any]:
    """What became of a triple."""
    assert tracker.recovery_clips is not None
    qpos, r = tracked.evaluation.recordings[0].qpos, tracked.evaluation.rollouts
    near = (mpjpe_global(r.pos[0], r.ref_pos[0]) <= 1000 * NEAR).numpy()
    low, rate = qpos[:, 2] < DOWN * float(tracker.recovery_clips.ease[2]), r.fps
    rows, end = [], 0
    for k, (p, row) in enumerate(zip(tracked.parts, tracked.card.per_clip, strict=True)):
        out: dict[str, Any] = {"clip": p.clip, "done": p.done, "lost_s": p.lost, "after_s": p.after}
        out["error_mm"] = row["mpjpe_global_mm"] if p.begins is not None else None
        if k:
            begin = len(qpos) if p.begins is None else round(p.begins * rate)
            held = near[begin : begin + round(HELD_S * rate) + 1]
            out["away_m"] = away[k - 1]
            out["held"] = bool(len(held) and held.all())
            out["resumed"] = out["held"] and p.after is not None and p.after <= WITHIN_S
            between = low[end:begin]
            out["falls"] = int((between[1:] & ~between[:-1]).sum())
        end = end if p.ends is None else round(p.ends * rate)
        rows.append(out)
    step = np.linalg.norm(np.diff(qpos[:, :3], axis=0), axis=-1).max()
    return {"parts": rows, "seconds": len(qpos) / rate, "largest_step_m": float(step)}


def table(triples: list[dict[str, Any]]) -> dict[str, Any]:
    """What a set came to."""
    parts = [p for t in triples for p in t["parts"]]
    between = [p for p in parts if "resumed" in p]
    after = [p["after_s"] for p in between if p["resumed"]]
    errors = [p["error_mm"] for p in parts if p["done"]]
    return {
        "triples": len(triples),
        "clips": len(parts),
        "clips_done": sum(p["done"] for p in parts),
        "transitions": len(between),
        "resumed": sum(p["resumed"] for p in between),
        "triples_resumed": sum(all(p.get("resumed", True) for p in t["parts"]) for t in triples),
        "after_s_median": statistics.median(after) if after else None,
        "after_s_most": max(after, default=None),
        "falls_between": sum(p["falls"] for p in between),
        "largest_step_m": max(t["largest_step_m"] for t in triples),
        "error_mm": statistics.median(errors) if errors else None,
        "seconds_per_second": sum(t["spent_s"] for t in triples) / sum(t["seconds"] for t in triples),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--set", nargs="+", choices=SETS, default=["mdm", "cmu"])
    parser.add_argument("--triples", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--controller", default="auto")
    parser.add_argument("--recover", action="store_true")
    parser.add_argument("--save", type=Path, help="the folder of motions and reports")
    args = parser.parse_args()
    torch.set_num_threads(1)
    tracker, found = open_run(None).tracker, dict[str, list[dict[str, Any]]]()
    command = f"python benchmarks/chain.py --set {' '.join(args.set)} --triples {args.triples}"
    command += f" --seed {args.seed} --controller {args.controller}" + " --recover" * args.recover
    for k in range(args.triples):
        for name in args.set:
            clips, away = triple(name, args.data, np.random.default_rng((args.seed, k)))
            begun = time.perf_counter()
            how = {"controller": args.controller, "recover": args.recover, "threads": 1}
            tracked = track(clips, tracker, **how)
            spent = time.perf_counter() - begun
            found.setdefault(name, []).append(measured(tracked, away, tracker) | {"spent_s": spent})
            if args.save is not None:
                tracked.write(args.save / f"{name}-{k}")
            data = {"command": command, "machine": f"{platform.machine()}, 1 thread"}
            data |= {"tables": {n: table(t) for n, t in found.items()}, "triples": found}
            write_atomic(args.json, json.dumps(data, indent=1).encode())


if __name__ == "__main__":
    main()
