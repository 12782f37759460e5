"""How many pieces of 20 s of joined walks and runs policies do, alone and without help.

    python benchmarks/long_walks.py --clips cmu_amc/35 cmu_amc/07 --json benchmarks/long_walks.json
    python benchmarks/long_walks.py --clips ... --policy smoother=FILE --json benchmarks/long_walks.json

A clip of a few steps ends before a policy is tired of it. Clips of each folder, one person's, are joined
as `lengths.py` does, so that a person walks, turns and runs for minutes, and the pieces are begun at
their first frames. Rows of policies that are not asked for stay as they are in the JSON.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from lengths import RATE, joined
from speed import machine

from poise.formats import read_clip
from poise.jobs.open import open_run
from poise.jobs.perpetual.evaluation import evaluate_clips
from poise.jobs.track import imitation_of
from poise.jobs.track.placement import PlacedMotion, place
from poise.jobs.tracker import Tracker
from poise.learn.checkpoint import write_atomic

#: s of a piece.
PIECE_S = 20.0


def pieces(folder: Path, tracker: Tracker, minutes: float, seed: int) -> list[PlacedMotion]:
    """A motion of so many minutes, cut into pieces on the policy's body."""
    files = sorted(p for p in folder.iterdir() if p.suffix in (".amc", ".bvh"))
    long, out, count = joined([read_clip(p) for p in files], minutes, seed), [], round(PIECE_S * RATE)
    for k in range(long.frames // count):
        rows = slice(k * count, (k + 1) * count)
        name = f"{folder.name} {k}"
        part = long.replaced(root_pos=long.root_pos[rows], rot=long.rot[rows], name=name)
        out.append(place(part, tracker))
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--clips", type=Path, nargs="+", required=True, help="a folder for each person")
    parser.add_argument("--policy", nargs="*", default=[], metavar="NAME=FILE")
    parser.add_argument("--minutes", type=float, default=6.0)
    parser.add_argument("--seed", type=int, default=7)
    parser.add_argument("--json", type=Path, required=True)
    a = parser.parse_args()
    shipped = open_run(None).tracker
    placed = [p for k, f in enumerate(a.clips) for p in pieces(f, shipped, a.minutes, a.seed + k)]
    policies = {"tracker": shipped}
    for given in a.policy:
        name, _, path = given.partition("=")
        policies[name] = open_run(Path(path)).tracker
    said: dict[str, Any] = json.loads(a.json.read_text()) if a.json.exists() else {}
    rows = said.setdefault("rows", {})
    for name, tracker in policies.items():
        # Each by the servos that it was trained with.
        done = evaluate_clips(imitation_of(tracker, placed), tracker.policy, threads=1)
        rows[name] = {
            "samples": tracker.about.get("samples"),
            "pieces": len(placed),
            "done": int(done.succeeded.sum()),
            "tracked_s": round(float(done.tracked.sum()) / RATE, 1),
            "mpjpe_global_mm": round(float(done.global_mm.nanmean()), 1),
        }
        print(name, rows[name], flush=True)
        said |= {"machine": machine(), "seed": a.seed, "clips": [str(f.name) for f in a.clips]}
        write_atomic(a.json, (json.dumps(said, indent=1) + "\n").encode())


if __name__ == "__main__":
    main()
