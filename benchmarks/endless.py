"""Motion without end in figures: falls per hour, slide, jerk, dead time, repeats, steering, diversity.

    python benchmarks/endless.py -o endless.json [--parts ...] [--seconds 600] [--rollouts 20]

Nothing helps the character. The policy alone does all rollouts of a part side by side, in as many
worlds, and every half minute its falls are written; other rollouts are written one by one, and a
command that goes on with the same file makes only those that it lacks. A rollout without recovery counts
until the character falls; with it, what is down in the end has 15 s more to get up. What is written says
how many rollouts of which length were made.

parts: kinematic (no physics), lookahead, policy (alone), unrecovered (policy alone, recovery off),
simulated-past (policy alone, which goes on from what was done), steering and steering-policy (points
5 m apart), diversity, library (needs --library, the folder of `tracker/README.md`), hour (memory).
"""

from __future__ import annotations

import argparse
import json
import math
import resource
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from endless_figures import diversity, repeats, visited
from endless_worlds import Rollouts, rollouts
from tracker import HELD_OUT, SIXTY, TWINS

from poise.body import BodyConfig
from poise.jobs.endless.dreaming import dream
from poise.jobs.endless.dreamt import PIECE, Figures
from poise.jobs.endless.model import GeneratorModel, load_generator
from poise.jobs.library.clips import LibraryConfig
from poise.jobs.library.folder import library_of, split
from poise.jobs.open import open_run
from poise.jobs.track.placement import place
from poise.jobs.tracker import Tracker

#: How each part goes about.
HOW: dict[str, dict[str, Any]] = {
    "lookahead": {},
    "policy": {"controller": "policy"},
    "unrecovered": {"controller": "policy", "recover": False},
    "simulated-past": {"controller": "policy", "past": "simulated"},
    "steering": {},
    "steering-policy": {"controller": "policy"},
}
PARTS = ("kinematic", *HOW, "diversity", "library", "hour")
#: m between points, and how many there are.
STEP_M, POINTS = 5.0, 20
NAMES = ("foot_slide_mm_per_s", "penetration_mm", "jerk_m_per_s3", "speed_m_per_s")


def figures_of(motions: list[np.ndarray], tracker: Tracker, fps: float) -> dict[str, Any]:
    """Slide, sinking, jerk, speed, standing still of coordinates."""
    sums = Figures(tracker.humanoid, fps)
    for qpos in motions:
        for k in range(0, len(qpos), PIECE):
            sums.add(qpos[k : k + PIECE])
    return sums.to_dict()


def points_of(seed: int, count: int = POINTS) -> tuple[tuple[float, float], ...]:
    """Points, each `STEP_M` from the one before it, to either side by up to a right angle."""
    rng, at, heading = np.random.default_rng(seed), np.zeros(2), 0.0
    out = list[tuple[float, float]]()
    for _ in range(count):
        heading += float(rng.uniform(-math.pi / 2, math.pi / 2))
        at = at + STEP_M * np.array([math.cos(heading), math.sin(heading)])
        out.append((float(at[0]), float(at[1])))
    return tuple(out)


class Bench:
    """The measurements, and the file into which they go.

    Attributes:
        seen: the most memory, MB, at moments of the last rollout, s.
    """

    def __init__(self, a: argparse.Namespace, model: GeneratorModel, tracker: Tracker):
        self.a, self.model, self.tracker = a, model, tracker
        self.made = model.generator(tracker.humanoid)
        self.out: dict[str, Any] = json.loads(a.o.read_text()) if a.o.exists() else {}
        self.out |= {"command": "python benchmarks/endless.py", "help_n": 0.0}

    def keep(self) -> None:
        """Writes what there is."""
        self.a.o.write_text(json.dumps(self.out, indent=1) + "\n")

    def rollouts(self, name: str, make: Callable[[int], dict[str, Any]], summary: Any) -> None:
        """Those of a part that are not there yet, each written at once."""
        part = self.out.setdefault(name, {})
        rows: list[dict[str, Any]] = part.setdefault("rows", [])
        have = {r["seed"] for r in rows}
        for seed in (s for s in range(self.a.rollouts) if s not in have):
            begun = time.process_time()
            rows.append({"seed": seed, **make(seed), "cpu_s": round(time.process_time() - begun, 1)})
            self.out[name] = {**summary(rows), "rows": rows}
            self.keep()
            print(name, {k: v for k, v in self.out[name].items() if k != "rows"}, flush=True)

    def kinematic(self, seed: int) -> dict[str, Any]:
        """A rollout without physics, the network's own past again and again."""
        made, frames = self.made, round(self.a.seconds * self.made.fps)
        qpos = made.endless(frames, torch.Generator().manual_seed(seed))[made.past :].numpy()
        return {"seconds": self.a.seconds, **self.about(qpos)}

    def about(self, qpos: np.ndarray) -> dict[str, Any]:
        """Figures of a motion."""
        fps, humanoid = self.made.fps, self.tracker.humanoid
        seen = sorted(visited(humanoid, self.model.seeds, qpos, fps))
        kinds = set[int]() if self.model.kinds is None else set(self.model.kinds[seen].tolist())
        return {
            **figures_of([qpos], self.tracker, fps), **repeats(humanoid, qpos, fps), "visited": seen,
            "labels": [name for k, name in enumerate(self.model.labels) if k in kinds],
        }  # fmt: skip

    def simulated(self, seed: int, **how: Any) -> dict[str, Any]:
        """A rollout with a body, which looks ahead."""
        done = dream(self.a.seconds, self.model, self.tracker, seed=seed, threads=1, **how)
        one = Rollouts(
            done.characters[0].done.read()[None], done.characters[0].asked.read()[None],
            done.characters[0].done.count, list(done.lost), list(done.back), [],
        )  # fmt: skip
        return self.went(one, 0, **how)

    def went(self, made: Rollouts, world: int, **how: Any) -> dict[str, Any]:
        """What one rollout is worth."""
        falls, away, down = made.of(world)
        until = falls[0] if falls and not how.get("recover", True) else made.count / self.made.fps
        frames = made.count if until == made.count / self.made.fps else round(until * self.made.fps)
        asked = figures_of([made.asked[world, :frames].astype(float)], self.tracker, self.made.fps)
        return {
            "seconds": self.a.seconds, "counted_s": until, "falls": [round(t, 2) for t in falls],
            "away_s": [round(t, 2) for t in away], "stayed_down": int(down),
            "up_after_end": sum(t + s > self.a.seconds for t, s in zip(falls, away, strict=False)),
            **self.about(made.done[world, :frames].astype(float)),
            **{f"asked_{n}": asked[n] for n in NAMES},
        }  # fmt: skip

    def together(self, name: str, **how: Any) -> None:
        """All rollouts of a part side by side."""
        count, seconds, begun = self.a.rollouts, self.a.seconds, time.process_time()
        have = self.out.get(name, {})
        if have.get("rollouts") == count and have.get("seconds_each") == seconds:
            return

        def look(made: Rollouts) -> None:
            part = {"rollouts": count, "seconds_so_far": made.count / self.made.fps, "bad": made.bad,
                    "falls": len(made.lost), "got_up": len(made.back)}  # fmt: skip
            self.out[name] = part
            self.keep()
            print(name, part, f"{time.process_time() - begun:.0f} s of CPU", flush=True)

        made = rollouts(self.tracker, self.made, count, seconds, look, **how)
        spent = round(time.process_time() - begun, 1)
        rows = [{"seed": k, **self.went(made, k, **how)} for k in range(count)]
        self.out[name] = {**roamed(rows), "went_bad": made.bad, "cpu_s": spent, "rows": rows}
        self.keep()

    def steered(self, seed: int, **how: Any) -> dict[str, Any]:
        """Points reached in turn, and when, against a straight walk at the library's own pace."""
        points = points_of(seed)
        done = dream(
            self.a.steer_seconds, self.model, self.tracker, seed=seed, threads=1, targets=points,
            hold_feet=False, **how,
        )  # fmt: skip
        jerk = done.figures["simulated"]["jerk_m_per_s3"]
        return self.arrived([t for _, t in done.reached], points, len(done.falls), seed, jerk)

    def steered_together(self, name: str) -> None:
        """The same course in several worlds, the policy alone."""
        points, count = points_of(0), self.a.steer_worlds
        made = rollouts(self.tracker, self.made, count, self.a.steer_seconds, targets=points)
        rows = list[dict[str, Any]]()
        for k in range(count):
            times = [t for i, t in made.reached if i == k]
            jerk = figures_of([made.done[k].astype(float)], self.tracker, self.made.fps)["jerk_m_per_s3"]
            falls = len(made.of(k)[0])
            rows.append(self.arrived(times, points, falls, k, jerk))
        self.out[name] = {**reached(rows), "rows": rows}

    def arrived(
        self, times: list[float], points: Any, falls: int, seed: int, jerk: float | None
    ) -> dict[str, Any]:
        """How it went from point to point; a straight walk is at the pace of the library's own walk."""
        clips = self.tracker.recovery_clips
        assert clips is not None
        walk = clips.walks[0]
        pace = float(walk[-1, 0]) * self.made.fps / (len(walk) - 1)
        way = STEP_M * len(times)
        return {
            "seed": seed, "seconds": self.a.steer_seconds, "reached": len(times), "of": len(points),
            "at_s": [round(t, 2) for t in times], "falls": falls,
            "straight_walk_s": round(way / pace, 1),
            "times_straight": round(times[-1] * pace / way, 2) if times else None, "jerk_m_per_s3": jerk,
        }  # fmt: skip

    def hour(self) -> dict[str, Any]:
        """Most memory in use while an hour is made and written, the policy alone."""
        seen, seconds = list[tuple[float, float]](), self.a.hour_minutes * 60
        rate = self.made.fps

        def told(_: str, step: int, steps: int) -> None:
            if step % max(1, steps // 12) == 0:
                most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
                seen.append((round(step / rate, 1), round(most, 1)))

        file = self.a.o.with_suffix(".hour.bvh")
        try:
            dream(seconds, self.model, self.tracker, controller="policy", threads=1, out=file,
                  progress=told)  # fmt: skip
            size = file.stat().st_size / 1e6
        finally:
            file.unlink(missing_ok=True)
        return {"minutes": self.a.hour_minutes, "file_mb": round(size, 1), "most_mb_at_s": seen}


def mean(values: list[float | None]) -> float | None:
    """Of those that could be measured: some rollouts end in a fall at once."""
    found = [v for v in values if v is not None]
    return round(float(np.mean(found)), 2) if found else None


def roamed(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Summary of rollouts that go about."""
    labels = [len(r["labels"]) for r in rows]
    everywhere = set[int]().union(*(r["visited"] for r in rows))
    out: dict[str, Any] = {
        "rollouts": len(rows), "seconds_each": rows[0]["seconds"],
        **{n: mean([r[n] for r in rows]) for n in NAMES},
        "longest_still_s": max(r["longest_still_s"] for r in rows),
        "repeated_share": round(float(np.mean([r["repeated_share"] or 0.0 for r in rows])), 3),
        "visited_a_rollout": round(float(np.mean([len(r["visited"]) for r in rows])), 1),
        "visited_by_all": len(everywhere), "labels_a_rollout": round(float(np.mean(labels)), 1),
        "labels_at_least": min(labels), "labels": sorted(set[str]().union(*(r["labels"] for r in rows))),
    }  # fmt: skip
    if "falls" in rows[0]:
        falls, counted = sum(len(r["falls"]) for r in rows), sum(r["counted_s"] for r in rows)
        away = [t for r in rows for t in r["away_s"]]
        out |= {
            "falls": falls, "falls_per_hour": round(3600 * falls / counted, 1),
            "stayed_down": sum(r["stayed_down"] for r in rows),
            "up_after_end": sum(r["up_after_end"] for r in rows),
            "mean_away_s": round(float(np.mean(away)), 2) if away else None,
            "longest_away_s": max(away, default=None),
            **{f"asked_{n}": mean([r[f"asked_{n}"] for r in rows]) for n in NAMES},
        }  # fmt: skip
    return out


def reached(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Summary of rollouts that go from point to point."""
    slow = [r["times_straight"] for r in rows if r["times_straight"]]
    return {
        "rollouts": len(rows), "points": sum(r["of"] for r in rows),
        "reached": sum(r["reached"] for r in rows), "falls": sum(r["falls"] for r in rows),
        "times_straight": round(float(np.mean(slow)), 2) if slow else None,
    }  # fmt: skip


def main() -> None:
    """Measures the parts that are asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("-o", type=Path, required=True)
    parser.add_argument(
        "--parts", nargs="+", choices=PARTS, default=[p for p in PARTS if p != "library"]
    )
    parser.add_argument("--library", type=Path)
    parser.add_argument("--generator", type=Path)
    parser.add_argument("--seconds", type=float, default=600.0)
    parser.add_argument("--rollouts", type=int, default=20)
    parser.add_argument("--steer-seconds", type=float, default=200.0)
    parser.add_argument("--steer-worlds", type=int, default=4)
    parser.add_argument("--hour-minutes", type=float, default=60.0)
    a = parser.parse_args()
    torch.set_num_threads(1)
    tracker, model = open_run(None).tracker, load_generator(a.generator)
    bench = Bench(a, model, tracker)
    for part in a.parts:
        if part == "kinematic":
            bench.rollouts(part, bench.kinematic, roamed)
        elif part == "steering-policy":
            bench.steered_together(part)
        elif part == "steering":
            bench.rollouts(part, lambda s, p=part: bench.steered(s, **HOW[p]), reached)
        elif HOW.get(part, {}).get("controller") == "policy":
            bench.together(part, **HOW[part])
        elif part in HOW:
            bench.rollouts(part, lambda s, p=part: bench.simulated(s, **HOW[p]), roamed)
        elif part == "diversity":
            bench.out[part] = diversity(bench.made, tracker.humanoid)
        elif part == "hour":
            bench.out[part] = bench.hour()
        elif a.library is None:
            parser.error("--parts library needs --library")
        else:
            how = LibraryConfig(rates=SIXTY, leave_out=TWINS)
            library, _ = library_of(
                a.library, tracker.target, config=how, body=BodyConfig(), tell=lambda _: None
            )
            some = [place(c, tracker).qpos for c in list(split(library, HELD_OUT).train)[::8]]
            bench.out[part] = figures_of(some, tracker, bench.made.fps)
        bench.keep()


if __name__ == "__main__":
    main()
