"""Pins and touch points: what the delivered motion and the simulation make of them.

python benchmarks/directed.py --data DIR -o benchmarks/directed.json
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np

from poise.body import find_anatomy
from poise.formats import read_clip
from poise.jobs.open import open_run
from poise.jobs.track import track
from poise.jobs.track.direction import Direction
from poise.kinematics.directed import Pin, TouchPoint
from poise.motion import Clip, trim

#: Walks, jumps, dances and everyday motion; six seconds of each at most.
CLIPS = (
    "cmu_amc/02/02_01.amc", "cmu_amc/07/07_01.amc", "cmu_amc/08/08_01.amc", "cmu_amc/35/35_01.amc",
    "cmu_amc/38/38_01.amc", "cmu_amc/39/39_02.amc", "cmu_bvh/ad/dance001.bvh", "cmu_amc/11/11_01.amc",
    "deepmimic_txt/humanoid3d_walk.txt", "lafan1_bvh/walk4_subject1.bvh",
)  # fmt: skip
SECONDS, PIN_S = 6.0, 0.3


def stance(clip: Clip, joint: int) -> tuple[int, int]:
    """The 0.3 s in which a foot moves least, away from the clip's ends."""
    foot, frames = clip.positions()[:, joint], round(PIN_S * clip.fps)
    edge = max(1, min(round(0.4 * clip.fps), (clip.frames - frames) // 2 - 1))
    firsts = range(edge, clip.frames - frames - edge)
    best = min(firsts, key=lambda a: float(np.ptp(foot[a : a + frames], axis=0).max()))
    return best, best + frames - 1


def measure(path: Path) -> dict[str, Any]:
    """One clip with a foot pinned for 0.3 s and a hand led 15 cm up at another moment."""
    clip = read_clip(path)
    clip = trim(clip, 0, min(clip.frames, round(SECONDS * clip.fps)) - 1)
    anatomy = find_anatomy(clip.skeleton)
    foot, hand = anatomy.of("foot", "left")[0], anatomy.of("hand", "right")[0]
    pin = Pin("left_foot", *stance(clip, foot))
    frame = clip.frames // 2
    point = clip.positions()[frame, hand] + np.array([0.0, 0.0, 0.15])
    touch = TouchPoint("right_hand", frame, (float(point[0]), float(point[1]), float(point[2])))
    begun = time.perf_counter()
    made = track(
        clip, open_run(None), direction=Direction((), (pin,), (touch,)), supports="none", threads=1
    )
    took = time.perf_counter() - begun
    raw, out = made.delivered(hold=False).positions(), made.clip.positions()
    span = slice(pin.first, pin.last + 1)

    def moves(pos: np.ndarray) -> float:
        return 1000 * float(
            np.linalg.norm(pos[span, foot] - np.median(pos[span, foot], 0), axis=-1).max()
        )

    few = slice(max(0, frame - 2), frame + 3)
    return {
        "clip": path.stem, "controller": made.controller, "whole": not made.failures,
        "pinned_moves_mm": round(moves(out), 2), "simulated_moves_mm": round(moves(raw), 1),
        "source_moves_mm": round(moves(clip.positions()), 1),
        "touch_mm": round(1000 * float(np.linalg.norm(raw[few, hand] - point, axis=-1).min()), 1),
        "global_mm": round(made.card.mpjpe_global_mm, 1), "seconds": round(took, 1),
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("-o", type=Path, required=True)
    args = parser.parse_args()
    rows = [measure(args.data / name) for name in CLIPS]
    whole = sum(r["whole"] and r["pinned_moves_mm"] <= 5.0 for r in rows)
    args.o.write_text(
        json.dumps({"command": "python benchmarks/directed.py", "done": whole, "rows": rows}, indent=1)
        + "\n"
    )


if __name__ == "__main__":
    main()
