"""Supports that are found: motions that sit, lean and step up with them and without; others get none.

    python benchmarks/supports.py --json benchmarks/supports.json [--data DATA]

The motions are those of `support_motions.py`. DATA is a folder of real clips; every third of
those in which `poise doctor` finds no need is looked at, and none of them should get a support.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

import torch
from support_motions import MOTIONS, motion

from poise.errors import PoiseError
from poise.jobs.open import open_run
from poise.jobs.result import Result, needs_of
from poise.jobs.track import track
from poise.jobs.track.placement import place
from poise.jobs.track.tracking import imitation_of, read_motion
from poise.jobs.tracker import Tracker
from poise.kinematics.find_supports import find_supports
from poise.kinematics.supports import Support
from poise.motion import Clip

SUFFIXES = (".bvh", ".amc", ".npz", ".npy", ".txt", ".glb")


#: A character is where its support bears it if its pelvis is no higher or lower than this, m.
HEIGHT_M = 0.1


def row(done: Result, seconds: float, supports: tuple[Support, ...]) -> dict[str, object]:
    """What became of a motion. borne: the share of the frames in which `supports` bear the reference in
    which the pelvis is as high; done: tracked, and borne in nine of ten."""
    card, r, rate = done.card, done.evaluation.rollouts, done.imitation.reference.rate_hz
    seconds_at = torch.arange(int(r.lengths[0])) / rate
    bears = torch.zeros_like(seconds_at, dtype=torch.bool)
    for s in supports:
        bears |= (seconds_at >= s.start_s) & (seconds_at <= s.stop_s)
    off = (r.pos[0, : len(bears), 0, 2] - r.ref_pos[0, : len(bears), 0, 2]).abs()
    borne = float((off[bears] < HEIGHT_M).double().mean())
    return {
        "done": card.tracked == 1.0 and borne >= 0.9,
        "tracked": card.tracked == 1.0,
        "borne": round(borne, 2),
        "lost_s": done.failures[0][1] if done.failures else None,
        "controller": done.controller,
        "mpjpe_global_mm": round(card.mpjpe_global_mm, 1),
        "jerk": round(card.jerk, 1),
        "seconds": round(seconds, 1),
        "supports": [s.sentence() for s in done.supports],
    }


def twelve(tracker: Tracker) -> list[dict[str, object]]:
    """Every motion with supports and without."""
    out: list[dict[str, object]] = []
    for name, (kind, _) in MOTIONS.items():
        made: dict[str, object] = {"motion": name, "needs": kind}
        supports: tuple[Support, ...] = ()
        for words, wanted in (("with", "auto"), ("without", "none")):
            began = time.monotonic()
            done = track(motion(name, tracker), tracker, supports=wanted)
            supports = done.supports or supports
            made[words] = row(done, time.monotonic() - began, supports)
        print(json.dumps(made), file=sys.stderr, flush=True)
        out.append(made)
    return out


def controls(tracker: Tracker, data: Path, every: int) -> dict[str, object]:
    """How many motions that need none get a support."""
    files = sorted(f for f in data.rglob("*") if f.suffix in SUFFIXES and "malformed" not in f.parts)
    looked, given = 0, list[str]()
    for file in files[::every]:
        try:
            clip = read_motion(file)
            if not isinstance(clip, Clip):
                continue
            imitation = imitation_of(tracker, [place(clip, tracker)])
        except PoiseError:
            continue
        if needs_of(imitation):
            continue
        r = imitation.reference
        looked += 1
        if find_supports(imitation.humanoid.table, r.pose.pos, r.pose.quat, r.rate_hz):
            given.append(file.name)
    return {"motions": looked, "given_a_support": given}


def main() -> None:
    """Runs all and writes the figures."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--data", type=Path)
    parser.add_argument("--every", type=int, default=3)
    args = parser.parse_args()
    tracker = open_run(None).tracker
    rows = twelve(tracker)
    found: dict[str, object] = {
        "command": "python benchmarks/supports.py --json benchmarks/supports.json --data DATA",
        "motions": rows,
        "done_with": sum(r["with"]["done"] for r in rows),  # type: ignore[index]
        "done_without": sum(r["without"]["done"] for r in rows),  # type: ignore[index]
        "tracked_with": sum(r["with"]["tracked"] for r in rows),  # type: ignore[index]
        "tracked_without": sum(r["without"]["tracked"] for r in rows),  # type: ignore[index]
    }
    if args.data:
        found["controls"] = controls(tracker, args.data, args.every)
    args.json.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
