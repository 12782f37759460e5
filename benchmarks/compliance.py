"""Compliance measured: how stiff hands are against what is commanded, throws by level (Fig. 4), what it
costs.

python benchmarks/compliance.py stiffness --json benchmarks/compliance.json --svg docs/stiffness.svg
python benchmarks/compliance.py throws --json benchmarks/compliance.json
python benchmarks/compliance.py hands --json benchmarks/compliance.json
python benchmarks/compliance.py door --json benchmarks/compliance.json
python benchmarks/compliance.py scenes --json benchmarks/compliance.json
python benchmarks/compliance.py flips --clip humanoid3d_backflip.txt --json benchmarks/compliance.json
python benchmarks/compliance.py cost --json benchmarks/compliance.json

All by the policy that comes with Poise, alone (the flips with lookahead, too) and without help; no
training. Each part writes its section of the same file, and under "policies" which policy it is of.
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.stats import spearmanr

import poise
from poise.control import Compliance, Stiffness
from poise.env.pushes import Pushes
from poise.formats import read_clip
from poise.jobs.open import open_run
from poise.jobs.tracker import Tracker
from poise.papers.compliant.figures import Measured, measure, slope, throws
from poise.papers.compliant.motions import AT_SOMEBODY, WAYS, hopping, standing
from poise.papers.compliant.scene_play import play
from poise.papers.compliant.scene_training import LearnedOnTop, digest_of, shipped
from poise.papers.compliant.scenes import (
    Balance,
    Chicken,
    DoorScene,
    HandInHand,
    PlayScene,
    Throws,
    TrampolineScene,
)
from poise.papers.compliant.watch import PUSHED_S
from poise.plan import LookaheadConfig
from poise.score.report import line_plot
from poise.sim import SimConfig

WALK = Path(poise.__file__).parent / "data/walk.bvh"

COMMANDS = (10.0, 20.0, 40.0, 80.0, 160.0, 320.0, 640.0, 1000.0)
LEVELS = (0.0, 0.04, 0.08, 0.12, 0.16, 0.2)
#: s, when the backflip's feet begin to push off.
PUSH_OFF_S = 0.5
#: Control steps that the farther lookahead of the flips simulates for each that is made.
BUDGET = 640.0
#: Characters, control steps and repetitions of the cost.
ROWS, STEPS, REPEATS = 512, 12, 9


def stiffness(tracker: Tracker, svg: Path | None, threads: int) -> dict[str, Any]:
    """Commanded against measured, at both hands and in six directions."""
    made = measure(tracker, Stiffness(), COMMANDS, threads=threads)
    alone = measure(tracker, None, newtons=lambda _: 10.0, threads=threads)
    level = measure(tracker, Compliance(), LEVELS, lambda _: 10.0, threads)
    harder = measure(tracker, Stiffness(), COMMANDS, lambda k: min(20.0, 0.05 * k), threads)
    kept = [m for m in made if math.isfinite(m.stiffness)]

    def rank(rows: Sequence[Measured]) -> float:
        real = [m for m in rows if math.isfinite(m.stiffness)]
        found = spearmanr([m.commanded for m in real], [m.stiffness for m in real])
        return round(float(found.statistic), 4)

    by = {k: [m.stiffness for m in kept if m.commanded == k] for k in COMMANDS}
    middle = [statistics.median(by[k]) for k in COMMANDS]
    if svg is not None:
        x = np.log10(COMMANDS)
        low, high = (np.log10([np.quantile(by[k], q) for k in COMMANDS]) for q in (0.1, 0.9))
        line_plot(
            [("measured", x, np.log10(middle), (low, high)), ("commanded", x, x)],
            "Stiffness of a standing character's hands", "commanded, log10 of N/m",
            "measured, log10 of N/m", svg,
        )  # fmt: skip
    return {
        "trials": len(made), "measured": len(kept), "fell": sum(m.fell for m in made),
        "rank_correlation": rank(made), "rank_correlation_up_to_20_n": rank(harder),
        "range_factor": round(middle[-1] / middle[0], 1),
        "commanded": {f"{k:g}": _summary([m for m in made if m.commanded == k]) for k in COMMANDS},
        "without": _summary(alone),
        "level": {f"{a:g}": _summary([m for m in level if m.commanded == a]) for a in LEVELS},
    }  # fmt: skip


def _summary(rows: Sequence[Measured]) -> dict[str, Any]:
    values = [m.stiffness for m in rows if math.isfinite(m.stiffness)]
    low, high = (float(np.quantile(values, q)) for q in (0.1, 0.9))
    return {
        "median_n_per_m": round(statistics.median(values), 1), "tenth": round(low, 1),
        "ninetieth": round(high, 1), "measured": len(values), "fell": sum(m.fell for m in rows),
    }  # fmt: skip


def thrown(
    tracker: Tracker,
    counts: dict[float, int],
    threads: int,
    keep: Callable[[dict[str, Any]], None],
    only: str | None = None,
) -> dict[str, Any]:
    """The same throws at each level, by both laws and at two physics rates, and by stiffness; `keep` is
    told what there is after each."""
    out: dict[str, Any] = {}
    for rate, count in counts.items():
        if not count:
            continue
        for law in ("eq8", "algorithm1"):
            if only not in (None, law):
                continue
            # Two tried steps for each force: a fifth of the throws is what the time allows.
            many = count if law == "eq8" else max(20, count // 5)
            out[f"{law}, {rate:g} Hz"] = _thrown(
                tracker, Compliance(law=law), LEVELS, many, rate, threads
            )  # type: ignore[arg-type]
            keep(out)
    soft = (4000.0, 1000.0, 400.0, 200.0, 100.0, 50.0)
    if counts[60.0] and only in (None, "stiffness"):
        out["stiffness, 60 Hz"] = _thrown(tracker, Stiffness(), soft, counts[60.0], 60.0, threads)
    return out


def _thrown(
    tracker: Tracker, given: Compliance | Stiffness, levels: Sequence[float], count: int, rate: float,
    threads: int,
) -> dict[str, Any]:  # fmt: skip
    begun = time.perf_counter()
    found = throws(tracker, given, levels, count, rate, threads=threads)
    out: dict[str, Any] = {"throws": count, "hit": int(np.isfinite(found.impulse[0]).sum())}
    out |= {"levels": list(levels), "fell": found.fell.sum(1).tolist()}
    out["goal_moved_mm"] = np.round(1000 * np.nanmean(found.moved, 1), 2).tolist()
    for name in ("impulse", "peak", "torque"):
        values = getattr(found, name)
        ratio = np.nanmean(values / values[:1], 1)
        out[name] = {
            "at_first": round(float(np.nanmean(values[0])), 3),
            "ratio": np.round(ratio, 4).tolist(),
        }
        if isinstance(given, Compliance):
            middle, low, high = slope(levels, values)
            out[name] |= {"slope": round(middle, 4), "interval_95": [round(low, 4), round(high, 4)]}
    out["seconds"] = round(time.perf_counter() - begun, 1)
    return out


def cost(tracker: Tracker) -> dict[str, Any]:
    """Control steps of environments with a force in every world, with compliance against without: the
    processor's time, of steps that take turns, so that what else the machine does counts little."""
    task = standing(tracker, 5.0)
    push = Pushes((20.0, 20.0), (0.03, 0.03), 100.0, task.humanoid.rows_of("hand"))
    envs = {}
    for name, given in (("without", None), ("eq8", Compliance()), ("stiffness", Stiffness())):
        own = replace(task.task, events=(push,), compliance=given, dones=(), help_by="all")
        envs[name] = replace(task, task=own).env(
            ROWS, auto_reset=False, threads=1, help_scale=0.0, guard=False
        )
    zero, spent = torch.zeros(ROWS, dtype=torch.long), {name: list[float]() for name in envs}
    still = torch.zeros(ROWS, envs["without"].num_actions)
    for repeat in range(REPEATS + 1):
        for env in envs.values():
            env.reset_to(zero, zero)
        for step in range(STEPS + 2):
            for name, env in envs.items():
                begun = time.process_time()
                env.step(still)
                # The first ones record, and nothing pushes yet.
                if repeat and step >= 2:
                    spent[name].append(time.process_time() - begun)
    middle = {name: statistics.median(values) for name, values in spent.items()}
    out: dict[str, Any] = {
        "rows": ROWS,
        "steps": len(spent["without"]),
        "goals": len(task.task.window) + 2,
    }
    out["ms_a_step"] = {k: round(1000 * v, 2) for k, v in middle.items()}
    shares = {
        k: [a / b for a, b in zip(spent["without"], v, strict=True)]
        for k, v in spent.items() if k != "without"
    }  # fmt: skip
    out["share_of_without"] = {k: round(statistics.median(v), 3) for k, v in shares.items()}
    out["share_quartiles"] = {
        k: [round(float(np.quantile(v, q)), 3) for q in (0.25, 0.75)] for k, v in shares.items()
    }
    return out


def hands(tracker: Tracker, threads: int) -> dict[str, Any]:
    """Hand in hand, walking (the embedded walk) and standing: figures by level and by stiffness."""
    walk = read_clip(WALK)
    ways = {
        "level 0.16": Compliance(0.16), "level 0.2": Compliance(0.2),
        "stiffness 500, lag 0.5 s": Stiffness(500.0, 0.5),
        "stiffness 200, lag 0.5 s": Stiffness(200.0, 0.5),
    }  # fmt: skip
    out: dict[str, Any] = {"episodes": 16}
    for name, clip in (("walking", walk), ("standing", None)):
        rows: dict[str, Any] = {}
        for way, given in ways.items():
            made = play(HandInHand(), tracker, clip, given, 16, 8.0, threads)
            rows["without"] = dict(made.stiff)
            rows[way] = dict(made.figures)
        out[name] = rows
    return out


def doors(tracker: Tracker, threads: int) -> dict[str, Any]:
    """Doors of three widths, by level and by stiffness, beside the twin that does not give way, with a
    motion made for the door, and with one made for 1 m."""
    ways = {
        "level 0.16": Compliance(0.16), "stiffness 500, lag 0.5 s": Stiffness(500.0, 0.5),
        "stiffness 200, lag 0.5 s": Stiffness(200.0, 0.5),
    }  # fmt: skip
    out: dict[str, Any] = {"episodes": 8}
    for scene in (DoorScene(1.0), *(DoorScene(w, made_for=m) for m in (None, 1.0) for w in (1.35, 1.7))):
        rows: dict[str, Any] = {}
        for way, given in ways.items():
            made = play(scene, tracker, None, given, 8, threads=threads)
            rows["without"] = dict(made.stiff)
            rows[way] = dict(made.figures)
        out[f"{scene.width:g} m" + (", motion for 1 m" if scene.made_for else "")] = rows
    return out


def at_rate(tracker: Tracker, rate_hz: float) -> Tracker:
    """The same policy with other physics steps."""
    sim = SimConfig(rate_hz=rate_hz, control_hz=tracker.config.sim.control_hz)
    return replace(tracker, config=replace(tracker.config, sim=sim))


def nobody(tracker: Tracker, scene: Chicken, touch_s: float, threads: int) -> dict[str, float]:
    """How far the pelvis leaves its way in the same half second where nobody touches the player."""
    clip = hopping(tracker, ways=AT_SOMEBODY if scene.against == "rival" else WAYS)
    alone = play(Throws(every_s=(100.0, 100.0)), tracker, clip, None, 8, 8.0, threads)
    rolled = alone.evaluation.rollouts
    off = (rolled.pos - rolled.ref_pos)[:, :, 0, :2]
    first, rate = round(touch_s * rolled.fps), rolled.fps
    way = (off[:, first + round(PUSHED_S * rate)] - off[:, first]).norm(dim=-1)
    return {"pushed_mm": 1000.0 * float(way.mean()), "from_s": touch_s, "lost": alone.stiff["lost"]}


def scenes(tracker: Tracker, threads: int, only: str | None = None) -> dict[str, Any]:
    """Trampoline, ball and chicken fight, each beside its twin that does not give way."""
    learned = shipped("ball", tracker)
    assert learned is not None
    ball: dict[str, Compliance | Stiffness | LearnedOnTop | None] = {
        "linear law": None,
        "learned": learned,
    }
    cases: dict[str, tuple[PlayScene, dict[str, Compliance | Stiffness | LearnedOnTop | None]]] = {
        "trampoline": (
            TrampolineScene(), {"level 0.16": Compliance(0.16), "level 0.04": Compliance(0.04)}
        ),
        "ball": (Balance(), ball),
        "ball, pushed with 50 N": (Balance(pushes=50.0), ball),
        "ball, pushed with 100 N": (Balance(pushes=100.0), ball),
        "ball, pushed with 50 N, another seed": (Balance(pushes=50.0, seed=1), ball),
        "ball, rod of 0.9 m": (Balance(length=0.9), ball),
        "ball, rod of 1.1 m": (Balance(length=1.1), ball),
        "chicken, heavy and light": (
            Chicken(against="rival"),
            {"level 0.16": Compliance(0.16), "stiffness 500, lag 0.5 s": Stiffness(500.0, 0.5)},
        ),
        "chicken, heavy and light, 600 Hz": (
            Chicken(against="rival"), {"level 0.16": Compliance(0.16)}
        ),
        "chicken, 60 kg each": (
            Chicken(60.0, 60.0, against="rival"), {"level 0.16": Compliance(0.16)}
        ),
        "chicken, heavy against a bag of 36 kg": (Chicken(85.0, 36.0), {"level 0.16": Compliance(0.16)}),
        "chicken, light against a bag of 85 kg": (Chicken(36.0, 85.0), {"level 0.16": Compliance(0.16)}),
    }  # fmt: skip
    out: dict[str, Any] = {"episodes": 8}
    for name, (scene, ways) in cases.items():
        if not name.startswith(only or ""):
            continue
        rows: dict[str, Any] = {}
        for way, given in ways.items():
            own = given if isinstance(given, LearnedOnTop) else None
            how = None if isinstance(given, LearnedOnTop) else given
            seconds = 20.0 if isinstance(scene, Balance) else 8.0
            by = at_rate(tracker, 600.0) if "600 Hz" in name else tracker
            made = play(scene, by, None, how, 8, seconds, threads, learned=own)
            rows["without"] = dict(made.stiff)
            rows[way] = dict(made.figures)
        if isinstance(scene, Chicken):
            touch = next(i for i, arrows in enumerate(made.arrows) if len(arrows))
            rows["nobody touches"] = nobody(by, scene, touch / made.evaluation.rollouts.fps, threads)
        out[name] = rows
        print(name, json.dumps(rows), flush=True)
    return out


def flips(tracker: Tracker, file: Path, threads: int) -> dict[str, Any]:
    """A clip, such as a backflip, on a trampoline that bounces as its feet push off: alone and with
    lookahead."""
    clip, out = read_clip(file), dict[str, Any]()
    for height in (0.0, 0.05, 0.1, 0.15):
        rows = out[f"bounce of {height:g} m"] = dict[str, Any]()
        scene = TrampolineScene(height, first=PUSH_OFF_S)
        for controller in ("policy", "lookahead"):
            made = play(scene, tracker, clip, None, 8, 8.0, threads, controller=controller)
            rows[controller] = dict(made.figures)
            rows[f"{controller}, without"] = dict(made.stiff)
            print(height, controller, made.sentence(), flush=True)
        if height in (0.05, 0.1):
            much, level = LookaheadConfig().with_budget(BUDGET), Compliance(0.04)
            how: dict[str, Any] = {"controller": "lookahead", "lookahead": much}
            made = play(scene, tracker, clip, level, 8, 8.0, threads, **how)
            rows[f"lookahead, {BUDGET:g}, level 0.04"] = dict(made.figures)
            rows[f"lookahead, {BUDGET:g}, without"] = dict(made.stiff)
    return {"clip": file.name, "episodes": 8, "first_s": PUSH_OFF_S, "rows": out}


def main() -> None:
    """One part of it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "part", choices=("stiffness", "throws", "hands", "door", "scenes", "flips", "cost")
    )
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--svg", type=Path)
    parser.add_argument("--clip", type=Path, help="flips: humanoid3d_backflip.txt")
    parser.add_argument(
        "--only", help="scenes of which the names begin so; throws: eq8, algorithm1, stiffness"
    )
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--throws", type=int, default=200, help="at 60 Hz; 0 leaves what is there")
    parser.add_argument("--fine", type=int, default=200, help="throws at 600 Hz; 0 leaves what is there")
    args = parser.parse_args()
    torch.set_num_threads(1)
    tracker = open_run(None).tracker
    steps = round(1e-6 * tracker.about["samples"], 1)
    policy = {"digest": digest_of(tracker.policy), "million_steps": steps}

    def keep(found: dict[str, Any]) -> None:
        told = json.loads(args.json.read_text()) if args.json.exists() else {}
        told[args.part] = {**told.get(args.part, {}), **found}
        # Scenes and throws are measured one by one; what it costs is measured without a policy.
        parts = found if args.part in ("scenes", "throws") else () if args.part == "cost" else ("",)
        names = [f"{args.part}/{name}".rstrip("/") for name in parts if name != "episodes"]
        told["policies"] = {**told.get("policies", {}), **dict.fromkeys(names, policy)}
        args.json.write_text(json.dumps(told, indent=1) + "\n")

    if args.part == "stiffness":
        found = stiffness(tracker, args.svg, args.threads)
    elif args.part == "throws":
        found = thrown(tracker, {60.0: args.throws, 600.0: args.fine}, args.threads, keep, args.only)
    elif args.part == "hands":
        found = hands(tracker, args.threads)
    elif args.part == "door":
        found = doors(tracker, args.threads)
    elif args.part == "scenes":
        found = scenes(tracker, args.threads, args.only)
    elif args.part == "flips":
        if args.clip is None:
            parser.error("flips needs --clip")
        found = flips(tracker, args.clip, args.threads)
    else:
        found = cost(tracker)
    keep(found)


if __name__ == "__main__":
    main()
