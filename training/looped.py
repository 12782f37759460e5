"""Runs and other gaits that are too short for the kinematic policy, repeated, as more clips of it.

    python training/looped.py FOLDER -o FOLDER/looped

Of each take the frames that are most alike, a period apart, are looked for; what lies between is closed
and repeated on its way for some seconds, on the body that comes with Poise.
"""

from __future__ import annotations

import argparse
import re
from pathlib import Path

import numpy as np

from poise.errors import PoiseError
from poise.formats import read_clip, write_clip
from poise.jobs.open import open_run
from poise.jobs.track.placement import place
from poise.kinematics import qpos_to_clip
from poise.kinematics.loops import close_cycle, cycle_step
from poise.motion.rotations import quat_mul, quat_rotate

#: Takes of gaits of which a library holds seconds at once, by their names.
GAITS = re.compile(
    r"amc/(09/09_(?!12)|16/16_(3[5-9]|4[0-4]|5[1-6])|127/127_(0[69]|1[1-6]|30|38)|02/02_03)|running"
    r"|_(run|jog|crawl|stealthy_walk)\.txt"
)
#: Shortest period, s; the farthest that a hinge may be from itself a period later, rad.
PERIOD, APART = 0.6, 0.35
#: Written s of each.
SECONDS = 10.0


def ends_of(qpos: np.ndarray, fps: float) -> tuple[int, int] | None:
    """The two frames of coordinates `(T, 7 + n)` that are most alike in pose and speed, at least
    `PERIOD` apart; None where there are none."""
    pose = np.concatenate((qpos[:, 2:3], qpos[:, 7:]), 1)
    speed = np.gradient(pose, axis=0) * fps
    here = np.concatenate((pose, 0.1 * speed), 1)
    far = np.linalg.norm(here[:, None] - here[None], axis=-1)
    steps = np.arange(len(qpos))
    far[steps[None] - steps[:, None] < PERIOD * fps] = np.inf
    i, j = np.unravel_index(int(far.argmin()), far.shape)
    if not np.isfinite(far[i, j]) or np.abs(pose[i] - pose[j]).max() > APART:
        return None
    return int(i), int(j)


def looped(qpos: np.ndarray, frames: int) -> np.ndarray:
    """A cycle `(T, 7 + n)`, closed and repeated on its way for so many frames."""
    closed, _ = close_cycle(qpos)
    turn, travel = cycle_step(closed)
    parts, now = list[np.ndarray](), closed[:-1]
    while sum(map(len, parts)) < frames:
        parts.append(now)
        now = now.copy()
        now[:, :3] = quat_rotate(turn, now[:, :3]) + travel
        now[:, 3:7] = quat_mul(turn, now[:, 3:7])
    return np.concatenate(parts)[:frames]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("-o", "--out", type=Path, required=True)
    a = parser.parse_args()
    a.out.mkdir(parents=True, exist_ok=True)
    tracker = open_run(None).tracker
    fps = tracker.config.sim.control_hz
    for path in sorted(p for p in a.folder.rglob("*") if GAITS.search(p.as_posix())):
        if a.out in path.parents or "retimed" in path.parts:
            continue
        try:
            qpos = place(read_clip(path), tracker).qpos
        except PoiseError as problem:
            print(problem)
            continue
        found = ends_of(qpos, fps)
        if found is None:
            print(f"{path.name}: no period")
            continue
        i, j = found
        name = f"{path.stem}-looped"
        made = looped(qpos[i : j + 1], round(SECONDS * fps))
        clip = qpos_to_clip(made, tracker.humanoid.table, tracker.example.skeleton, fps, name=name)
        write_clip(clip, a.out / f"{name}.bvh")
        pace = float(np.linalg.norm(np.diff(made[:, :2], axis=0), axis=-1).mean() * fps)
        print(f"{path.name}: {(j - i) / fps:.2f} s, {pace:.1f} m/s")


if __name__ == "__main__":
    main()
