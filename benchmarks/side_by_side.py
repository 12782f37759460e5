"""Four characters do four clips in one world, where they may collide: falls and throughput.

    python benchmarks/side_by_side.py --data DATA --json benchmarks/side_by_side.json

The clips stand in a row, `--apart` metres from each other; the policy that comes with Poise acts alone,
without help. A character that fails is put back, and all go on to the end of the shortest clip.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from dataclasses import replace
from pathlib import Path

import torch

from poise.env import Reference
from poise.formats import read_clip
from poise.jobs.open import open_run
from poise.jobs.track import ResetOnFail, imitation_of
from poise.jobs.track.placement import place
from poise.jobs.track.supports import crowd
from poise.jobs.tracker import Tracker

CLIPS = tuple(f"cmu_amc/02/02_{k}.amc" for k in ("05", "07", "09", "10"))


def measure(tracker: Tracker, data: Path, apart: float, together: bool) -> dict[str, object]:
    """One run of all clips, up to the end of the shortest; `together` in one world, or each alone."""
    placed = [place(read_clip(data / name), tracker) for name in CLIPS]
    task = imitation_of(tracker, placed)
    rate, body = task.config.sim.control_hz, task.humanoid
    motions = [p.qpos.copy() for p in placed]
    for k, qpos in enumerate(motions):
        qpos[:, :2] += torch.tensor([0.0, apart * k]).numpy() - qpos[0, :2]
    reference = Reference(body, motions, rate, task.reference.names)
    count = len(motions)
    rows = crowd(body, task.config.sim, count) if together else None
    env = replace(task, reference=reference).env(
        None if together else count, None, False, 1, help_scale=0.0, backend=rows
    )
    keeper = ResetOnFail(env, tracker.policy)
    obs = env.reset_to(torch.arange(count), torch.zeros(count, dtype=torch.long))
    lengths = reference.length
    steps = int(lengths.min()) - 1
    began = time.perf_counter()
    for _ in range(steps):
        obs = env.step(keeper.act(obs)).obs
    spent = time.perf_counter() - began
    env.close()
    return {"control_steps": steps, "falls": len(keeper.fallen), "steps_per_s": count * steps / spent}


def main() -> None:
    """Runs all and writes the figures."""
    torch.set_num_threads(1)
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--data", type=Path, required=True)
    args = parser.parse_args()
    tracker = open_run(None).tracker
    out: dict[str, object] = {
        "command": "python benchmarks/side_by_side.py --data DATA --json benchmarks/side_by_side.json",
        "clips": CLIPS,
    }
    for apart in (2.0, 0.6):
        pairs = [
            [measure(tracker, args.data, apart, together) for together in (True, False)]
            for _ in range(3)
        ]
        out[f"{apart:g} m apart"] = {
            "control_steps": pairs[0][0]["control_steps"],
            "falls_in_one_world": pairs[0][0]["falls"],
            "falls_each_alone": pairs[0][1]["falls"],
            "character_steps_per_s": round(statistics.median(float(a["steps_per_s"]) for a, _ in pairs)),  # type: ignore[arg-type]
            "one_world_over_alone": round(
                statistics.median(float(a["steps_per_s"]) / float(b["steps_per_s"]) for a, b in pairs),  # type: ignore[arg-type]
                2,
            ),
        }
    args.json.write_text(json.dumps(out, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
