"""What scenes cost: stepping and whole environments beside raw stepping of the same model and states.

python benchmarks/scene_stepping.py --json benchmarks/scene_stepping.json
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import mujoco
import torch
from mujoco.batch import Batch

from poise.env import ImitationEnv
from poise.env.events import Event
from poise.jobs.open import open_run
from poise.jobs.track.placement import place
from poise.jobs.track.tracking import imitation_of
from poise.jobs.tracker import Tracker
from poise.sim import STANDARD_FIELDS, Backend, Character, Drive, Scene, SceneSim

ROWS, STEPS, REPEATS = 64, 40, 15
_VEL = int(mujoco.mjtStage.mjSTAGE_VEL)


class Force(Event):
    """30 N on the root of every character, added anew before each physics step."""

    def before_step(self, drive: Drive) -> bool:
        return True

    def before_substep(self, drive: Drive) -> None:
        drive.xfrc_applied[:, 1, 1] += 30.0


class Raw:
    """Steps of a model alone, from the states of a backend."""

    def __init__(self, backend: Backend, substeps: int):
        self.backend, self.substeps = backend, substeps
        self.batch = Batch(backend.model, backend.num_envs, 1)
        for name in STANDARD_FIELDS:
            self.batch.bind(name)

    def seconds(self, advance: Callable[[], object]) -> float:
        """Time of `STEPS` control steps; `advance` makes the same ones in the backend."""
        spent = 0.0
        for _ in range(STEPS):
            self.batch.state[:] = self.backend.snapshot(derived=False).numpy()
            begun = time.perf_counter()
            self.batch.step(None, self.substeps, _VEL)
            spent += time.perf_counter() - begun
            advance()
        return spent


def ratios(raw: Callable[[], float], own: Callable[[], float]) -> dict[str, float]:
    """The speed of `own` as a share of raw stepping: median, least and most of interleaved pairs."""
    raw(), own()
    found = [raw() / own() for _ in range(REPEATS)]
    return {"median": round(statistics.median(found), 3), "least": round(min(found), 3),
            "most": round(max(found), 3)}  # fmt: skip


def in_scenes(tracker: Tracker, many: int) -> dict[str, float]:
    """`ROWS` characters, so many in a world."""
    names = tuple(Character(tracker.humanoid, name=f"character {k}") for k in range(many))
    sim = SceneSim(Scene(names, sim=tracker.config.sim), ROWS // many, "cpu", 1)
    rows, substeps = sim.characters(), tracker.config.sim.substeps
    assert tracker.recovery_clips is not None
    qpos = tracker.recovery_clips.ease.repeat(ROWS, 1).to(rows.state.qpos)
    qpos[:, 0] += 1.5 * (torch.arange(ROWS) % many).to(qpos)
    still = torch.zeros(ROWS, tracker.humanoid.model.nv).to(qpos)
    raw = Raw(sim.backend, substeps)

    def alone() -> float:
        rows.write(None, qpos, still)
        return raw.seconds(lambda: rows.step(substeps))

    def own() -> float:
        rows.write(None, qpos, still)
        begun = time.perf_counter()
        for _ in range(STEPS):
            rows.step(substeps)
        return time.perf_counter() - begun

    return ratios(alone, own)


def environments(tracker: Tracker) -> dict[str, dict[str, float]]:
    """Stepping and whole control steps of environments, without and with a force in every world."""
    task = imitation_of(tracker, [place(tracker.example, tracker)])
    found: dict[str, dict[str, float]] = {}
    for name, events in (("", ()), (", force each physics step", (lambda goal, backend: Force(),))):
        own = replace(task, task=replace(task.task, events=events, help_by="all"))
        env = own.env(ROWS, auto_reset=False, threads=1, help_scale=0.0)
        raw, still = Raw(env.backend, env.substeps), torch.zeros(ROWS, env.num_actions)
        zero = torch.zeros(ROWS, dtype=torch.long)

        def begun(go: Callable[[], float], env: ImitationEnv = env, zero: torch.Tensor = zero) -> float:
            env.reset_to(zero, zero)
            return go()

        def stepping(env: ImitationEnv = env, still: torch.Tensor = still) -> float:
            spent = 0.0
            for _ in range(STEPS):
                env.drive(still)
                at = time.perf_counter()
                env.controls.step(env.backend, env.substeps)
                spent += time.perf_counter() - at
                env.renew(env.judge())
            return spent

        def whole(env: ImitationEnv = env, still: torch.Tensor = still) -> float:
            at = time.perf_counter()
            for _ in range(STEPS):
                env.step(still)
            return time.perf_counter() - at

        def alone(
            raw: Raw = raw, env: ImitationEnv = env, still: torch.Tensor = still
        ) -> float:  # fmt: skip
            return raw.seconds(lambda: env.step(still))

        for what, run in (("stepping", stepping), ("environment", whole)):
            found[what + name] = ratios(lambda a=alone: begun(a), lambda r=run: begun(r))
        env.close()
    return found


def main() -> None:
    """All of it, on one thread."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=Path, required=True)
    args = parser.parse_args()
    torch.set_num_threads(1)
    tracker = open_run(None).tracker
    found = {
        "command": "python benchmarks/scene_stepping.py --json benchmarks/scene_stepping.json",
        "rows": ROWS, "one in a world": in_scenes(tracker, 1), "four in a world": in_scenes(tracker, 4),
        **environments(tracker),
    }  # fmt: skip
    args.json.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
