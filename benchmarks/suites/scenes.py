"""Scenes with forces: how stiff hands are against what is commanded, throws by level, doors, balls,
fights.

All by the policy that ships, alone and without help. Each scene stands beside its twin that does not
give way ("without", the law off), and fights beside the player whom nobody touches: these are the nulls.
The part "learned" measures the same with what runs of `poise train compliant SCENE` learned on top,
which lie in `--work`, compliant/NAME; the rows of the other parts are those of the plain policy.
"""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.stats import spearmanr

from benchmarks.common.clips import WALK, Places, moment
from benchmarks.common.policies import stated
from benchmarks.common.rows import Figure, of, short
from benchmarks.common.runner import Part, Raws
from poise.control import Compliance, Stiffness
from poise.env.pushes import Pushes
from poise.formats import read_clip
from poise.jobs.open import open_run
from poise.jobs.tracker import Tracker
from poise.learn import LATEST, PPOConfig, Until
from poise.motion import Clip
from poise.papers.compliant.figures import measure, slope, throws
from poise.papers.compliant.motions import motion_of, standing
from poise.papers.compliant.scene_play import COUNTS, Played, play
from poise.papers.compliant.scene_training import (
    SHIPPED,
    Compliant,
    LearnedOnTop,
    digest_of,
    open_learned,
    shipped,
    train,
)
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

COMMANDS = (10.0, 20.0, 40.0, 80.0, 160.0, 320.0, 640.0, 1000.0)


LEVELS = (0.0, 0.04, 0.08, 0.12, 0.16, 0.2)


#: Characters, control steps and repetitions of the cost.
ROWS, STEPS, REPEATS = 512, 12, 9


def cost(tracker: Tracker, many: int, steps: int, repeats: int) -> dict[str, Any]:
    """Control steps of environments with a force in every world, with compliance against without: the
    processor's time, of steps that take turns, so that what else the machine does counts little."""
    task = standing(tracker, 5.0)
    push = Pushes((20.0, 20.0), (0.03, 0.03), 100.0, task.humanoid.rows_of("hand"))
    envs = {}
    for name, given in (("without", None), ("eq8", Compliance()), ("stiffness", Stiffness())):
        own = replace(task.task, events=(push,), compliance=given, dones=(), help_by="all")
        envs[name] = replace(task, task=own).env(
            many, auto_reset=False, threads=1, help_scale=0.0, guard=False
        )
    zero, spent = torch.zeros(many, dtype=torch.long), {name: list[float]() for name in envs}
    still = torch.zeros(many, envs["without"].num_actions)
    for repeat in range(repeats + 1):
        for env in envs.values():
            env.reset_to(zero, zero)
        for step in range(steps + 2):
            for name, env in envs.items():
                begun = time.process_time()
                env.step(still)
                # The first ones record, and nothing pushes yet.
                if repeat and step >= 2:
                    spent[name].append(time.process_time() - begun)
    middle = {name: statistics.median(values) for name, values in spent.items()}
    out: dict[str, Any] = {
        "rows": many,
        "steps": len(spent["without"]),
        "goals": len(task.task.window) + 2,
    }
    out["ms_a_step"] = {k: round(1000 * v, 2) for k, v in middle.items()}
    shares = {
        k: [a / b for a, b in zip(spent["without"], v, strict=True)]
        for k, v in spent.items()
        if k != "without"
    }
    out["share_of_without"] = {k: round(statistics.median(v), 3) for k, v in shares.items()}
    out["share_quartiles"] = {
        k: [round(float(np.quantile(v, q)), 3) for q in (0.25, 0.75)] for k, v in shares.items()
    }
    return out


Given = Compliance | Stiffness | None
LAG = "stiffness 500, lag 0.5 s"
#: What gives way, by its name.
WAY: dict[str, Given] = {
    "without": None,
    "level 0": Compliance(0.0),
    "level 0.04": Compliance(0.04),
    "level 0.16": Compliance(0.16),
    "level 0.2": Compliance(0.2),
    LAG: Stiffness(500.0, 0.5),
    "stiffness 200, lag 0.5 s": Stiffness(200.0, 0.5),
}


@cache
def policy(of: str = "") -> Tracker:
    """The policy of a file or run folder, by default that which ships."""
    return open_run(of or None).tracker


# --- stiffness ------------------------------------------------------------------------------------


def stiff_units(places: Places) -> list[str]:
    """A command, and how it is given."""
    if places.smoke:
        return ["law off", "commanded 160 N/m"]
    return ["law off", *(f"commanded {k:g} N/m" for k in COMMANDS), *(f"level {a:g}" for a in LEVELS)]


def stiff(places: Places, unit: str) -> Any:
    """At both hands and in six directions, of a character that stands."""
    how, _, number = unit.partition(" ")
    if how == "commanded":
        made = measure(policy(), Stiffness(), (float(number.split()[0]),), threads=1)
    else:
        given = None if how == "law" else Compliance()
        made = measure(
            policy(),
            given,
            *(() if given is None else ((float(number),),)),
            newtons=lambda _: 10.0,
            threads=1,
        )
    values = [m.stiffness for m in made if math.isfinite(m.stiffness)]
    return {"values": values, "fell": sum(m.fell for m in made)}


def stiff_rows(places: Places, raws: Raws) -> Iterator[Figure]:
    """Medians, and how well what is commanded and what is measured go in the same order."""
    pairs = []
    for unit, raw in raws.items():
        values = raw["values"]
        spread = " to ".join(short(float(np.quantile(values, q))) for q in (0.1, 0.9))
        subject = f"standing, hands, {unit}"
        yield Figure(subject, "stiffness_n_per_m", statistics.median(values), len(values), spread)
        yield Figure(subject, "fell", raw["fell"], len(values))
        if unit.startswith("commanded"):
            pairs += [(float(unit.split()[1]), v) for v in values]
    rank = (
        float(spearmanr(*zip(*pairs, strict=True)).statistic)
        if len({k for k, _ in pairs}) > 1
        else math.nan
    )
    yield from of("standing, hands, all commands", {"rank_correlation": rank}, len(pairs))


# --- throws ---------------------------------------------------------------------------------------

SOFT = (4000.0, 1000.0, 400.0, 200.0, 100.0, 50.0)
THROWS = {
    "eq8, 60 Hz": 200,
    "algorithm1, 60 Hz": 40,
    "eq8, 600 Hz": 200,
    "algorithm1, 600 Hz": 40,
    "stiffness, 60 Hz": 200,
}


def throw_units(places: Places) -> list[str]:
    """Laws and rates."""
    return list(THROWS)[: 1 if places.smoke else None]


def thrown(places: Places, unit: str, top: LearnedOnTop | None = None) -> Any:
    """The same throws at each level; the first is the null. top: on top of the policy."""
    law, _, rate = unit.removesuffix(" Hz").partition(", ")
    given: Any = Stiffness() if law == "stiffness" else Compliance(law=law)  # type: ignore[arg-type]
    levels = SOFT if law == "stiffness" else LEVELS
    count = THROWS[unit]
    if places.smoke:
        count, levels = 2, levels[::5]
    tracker = policy(top.config.policy if top else "")
    found = throws(tracker, given, levels, count, float(rate), threads=1, learned=top)
    out: dict[str, Any] = {"levels": list(levels), "fell": found.fell.sum(1).tolist(), "throws": count}
    out["goal_moved_mm"] = (1000 * np.nanmean(found.moved, 1)).tolist()
    out["before_mm"] = (1000 * np.nanmean(found.off, 1)).tolist()
    out["torque_nm"] = np.nanmean(found.torque, 1).tolist()
    out["torque_before_nm"] = np.nanmean(found.stood, 1).tolist()
    for name in ("impulse", "peak", "torque"):
        values = getattr(found, name)
        ratio = values / values[:1]
        error = 1.96 * np.nanstd(ratio, 1, ddof=1) / np.sqrt(np.isfinite(ratio).sum(1))
        middle = np.nanmean(ratio, 1)
        out[f"{name}_ratio"] = np.stack((middle, middle - error, middle + error), 1).tolist()
        if law != "stiffness" and not places.smoke:
            out[f"{name}_slope"] = list(slope(levels, values))
    return out


#: Figures of throws by level beside the ratios.
MORE = ("fell", "goal_moved_mm", "before_mm", "torque_nm", "torque_before_nm")


def throw_rows(places: Places, raws: Raws) -> Iterator[Figure]:
    """Ratios of each throw to the first level's, and their slope over levels, with intervals of 95 %."""
    for unit, raw in raws.items():
        words = "{:g} N/m" if unit.startswith("stiffness") else "level {:g}"
        for k, level in enumerate(raw["levels"]):
            subject, many = f"throws, {unit}, {words.format(level)}", raw["throws"]
            for name in ("impulse_ratio", "peak_ratio", "torque_ratio"):
                middle, low, high = raw[name][k]
                yield Figure(subject, name, middle, many, f"{short(low)} to {short(high)}")
            values = {n: raw[n][k] for n in MORE if n in raw}
            yield from of(subject, values, many)
        for name in ("impulse", "peak", "torque"):
            if f"{name}_slope" in raw:
                middle, low, high = raw[f"{name}_slope"]
                yield Figure(
                    f"throws, {unit}, all levels",
                    f"{name}_slope",
                    middle,
                    raw["throws"],
                    f"{short(low)} to {short(high)}",
                )


#: Levels of the paper and above, which let hinges leave their ranges (Sec. 5.2).
FAR_LEVELS = (0.04, 0.12, 0.2, 0.3, 0.4)


def ranges(places: Places, unit: str) -> Any:
    """The same throws where nothing keeps the goal's hinges in their ranges."""
    levels, count = (FAR_LEVELS[:1], 2) if places.smoke else (FAR_LEVELS, 100)
    found = throws(policy(), Compliance(), levels, count, threads=1, within=False)
    return {"levels": list(levels), "outside": [row[np.isfinite(row)].tolist() for row in found.outside]}


def range_rows(places: Places, raws: Raws) -> Iterator[Figure]:
    """Shares of the frames after the blow, by level."""
    for unit, raw in raws.items():
        for level, shares in zip(raw["levels"], raw["outside"], strict=True):
            subject, middle = f"{unit}, level {level:g}", statistics.fmean(shares)
            yield Figure(subject, "outside", middle, len(shares), interval(shares, "outside"))


# --- scenes ---------------------------------------------------------------------------------------

Case = tuple[PlayScene, tuple[str, ...], float, int]
CHICKEN = {
    "chicken, heavy and light": (Chicken(against="rival"), ("level 0.16", LAG)),
    "chicken, 60 kg each": (Chicken(60.0, 60.0, against="rival"), ("level 0.16",)),
    "chicken, heavy against a bag of 36 kg": (Chicken(85.0, 36.0), ("level 0.16",)),
    "chicken, light against a bag of 85 kg": (Chicken(36.0, 85.0), ("level 0.16",)),
}
BALL: dict[str, dict[str, Any]] = {
    "ball": {},
    "ball, pushed with 50 N": {"pushes": 50.0},
    "ball, pushed with 100 N": {"pushes": 100.0},
    "ball, pushed with 50 N, another seed": {"pushes": 50.0, "seed": 1},
    **{f"ball, rod of {m:g} m": {"length": m} for m in (0.8, 0.9, 1.1, 1.2)},
}
DOORS = {
    f"door {w:g} m{', motion for 1 m' if m else ''}": DoorScene(w, made_for=m)
    if w > 1
    else DoorScene(1.0)
    for w, m in ((1.0, None), (1.35, None), (1.7, None), (1.35, 1.0), (1.7, 1.0))
}
TWO = ("level 0.16", "level 0.2", LAG)
HOPS = "chicken, hopping alone for 17 s"
RUN = "other/bandai_bvh/dataset-1_run_normal_001.bvh"
#: Scenes, what gives way beside the twin that does not, s, episodes.
SCENES: dict[str, Case] = {
    "hand in hand, walking": (
        HandInHand(),
        ("level 0.16", "level 0.2", LAG, "stiffness 200, lag 0.5 s"),
        8.0,
        32,
    ),
    "hand in hand, running": (
        HandInHand(),
        ("level 0.16", "level 0.2", LAG, "stiffness 200, lag 0.5 s"),
        8.0,
        32,
    ),
    "hand in hand, standing": (
        HandInHand(),
        ("level 0.16", "level 0.2", LAG, "stiffness 200, lag 0.5 s"),
        8.0,
        32,
    ),
    "hand in hand, two people walking": (HandInHand(partner="person"), TWO, 8.0, 32),
    "hand in hand, two people running": (HandInHand(partner="person"), TWO, 8.0, 32),
    **{k: (s, ("level 0.16", LAG, "stiffness 200, lag 0.5 s"), 0.0, 32) for k, s in DOORS.items()},
    "trampoline": (TrampolineScene(), ("level 0.16", "level 0.04"), 8.0, 32),
    **{k: (Balance(**v), ("linear law", "learned"), 20.0, 32) for k, v in BALL.items()},
    **{k: (s, ways, 8.0, 32) for k, (s, ways) in CHICKEN.items()},
    HOPS: (Chicken(against="nobody"), ("level 0.16",), 17.0, 32),
}


def scene_units(places: Places, begins: str) -> list[str]:
    """The scenes whose names begin so."""
    return [n for n in SCENES if n.startswith(begins)][: 1 if places.smoke else None]


def played(places: Places, unit: str, top: LearnedOnTop | None = None) -> Any:
    """A scene by each way beside its twin. top: on top of the policy, by the levels that it learned."""
    scene, ways, seconds, many = SCENES[unit]
    if top is not None:
        ways = TOP_LEVELS if top.config.drawn else ("as learned",)
    if places.smoke:
        ways, seconds, many = ways[:1], 1.0, 1
    tracker = policy(top.config.policy if top else "")
    clip = read_clip(WALK) if unit.endswith("walking") else None
    if unit.endswith("running"):
        clip = moment() if places.smoke else read_clip(places.data / RUN)
    rival = None
    if top is not None and isinstance(scene, Chicken):
        # The opponent acts with what a run of its own mass has learned, where there is one.
        turned = {
            t.config.players[::-1]: t for t in tops(places).values() if t.config.scene == "chicken"
        }
        rival = turned.get(top.config.players)
    out: dict[str, Any] = {"episodes": many}
    for way in ways:
        own = shipped("ball", tracker) if way == "learned" else top
        how = {} if not seconds else {"seconds": seconds}
        made = play(scene, tracker, clip, WAY.get(way), many, threads=1, learned=own, rival=rival, **how)
        out["without"], out[way] = told(made.stiff_episodes), told(made.episodes)
    alone = unit != HOPS and (isinstance(scene, Chicken) or top is None)
    if alone and not isinstance(scene, Balance):
        out["nobody touches"] = nobody(tracker, scene, clip, made, many, seconds, top)
    return out


def told(episodes: Mapping[str, np.ndarray]) -> dict[str, list[float | None]]:
    """Figures of episodes, None where one has none."""
    return {k: [None if math.isnan(x) else float(x) for x in v] for k, v in episodes.items()}


def scene_rows(places: Places, raws: Raws) -> Iterator[Figure]:
    """Each way's figures."""
    for unit, raw in raws.items():
        for way, figures in raw.items():
            if way == "episodes":
                continue
            # Forces on a rod are fictional, so that their size tells nothing.
            fictional = "stays_s" in figures
            for name, every in figures.items():
                known = [x for x in every if x is not None]
                if not known or (fictional and name.startswith(("force_", "impulse_"))):
                    continue
                value = statistics.fmean(known)
                yield Figure(f"{unit}, {way}", name, value, len(known), interval(known, name))
            peaks = figures.get("force_peak_n")
            if peaks and not fictional:
                yield Figure(f"{unit}, {way}", "force_most_n", max(peaks), len(peaks))


#: Levels at which what has learned several is measured in scenes; the words before a run's name.
TOP_LEVELS, BY = ("level 0.04", "level 0.16", "level 0.2"), ", learned by "


@cache
def tops(places: Places) -> dict[str, LearnedOnTop]:
    """What comes along on top of the policy by its scene, but the ball's, and what runs in `--work`,
    compliant/NAME, have learned beside."""
    home, below = places.work / "compliant", policy()
    if places.smoke and not home.exists():
        net = PPOConfig(horizon=2, epochs=1, minibatch=4, policy_hidden=(8,), value_hidden=(8,))
        tiny = Compliant("throws", seconds=0.5, num_envs=2, ppo=net)
        train(tiny, below, home / "smoke", Until(iterations=1), threads=1, tensorboard=False)
    runs = (file.parent for file in sorted(home.glob(f"*/{LATEST}")))
    found = {run.name: open_learned(run, below) for run in runs}
    if places.smoke:
        return found
    along = ((name, shipped(name, below)) for name in SHIPPED if name != "ball")
    return found | {name: top for name, top in along if top is not None}


def fits(top: LearnedOnTop, unit: str) -> bool:
    """Whether a case of the suite is of the scene that was learned, with the same players or motion."""
    scene, own = SCENES[unit][0], top.config.play()
    if isinstance(scene, DoorScene) and isinstance(own, DoorScene):
        return (scene.made_for or scene.width) == (own.made_for or own.width)
    if top.config.suits(scene) is None:
        return False
    if isinstance(scene, Chicken) and isinstance(own, Chicken) and scene.against == "bag":
        return (scene.mass, scene.other) == (own.mass, own.other)
    return type(scene) is type(own)


def top_units(places: Places) -> list[str]:
    """Cases of each run's scene; throws at the rate of the paper."""
    out = list[str]()
    for name, top in tops(places).items():
        cases = [unit for unit in SCENES if fits(top, unit)]
        if top.config.scene == "throws" and top.config.drawn:
            cases.append("throws, eq8, 600 Hz")
        out += [case + BY + name for case in cases]
    return out


def on_top(places: Places, unit: str) -> Any:
    """A case with what a run has learned."""
    case, _, name = unit.partition(BY)
    top = tops(places)[name]
    if case.startswith("throws"):
        raw = thrown(places, case.removeprefix("throws, "), top)
    else:
        raw = played(places, case, top)
    below, on = stated(_SHIPS), top.config.policy
    if on:
        below = f"{Path(on).name} {digest_of(policy(on).policy)}"
    return raw | {
        "policy": stated(("tracker", name))
        if name in SHIPPED
        else f"{below}; {name} {digest_of(top.top)} (learned on top)"
    }


def top_rows(places: Places, raws: Raws) -> Iterator[Figure]:
    """Rows as those of the plain policy, which stand in the other parts; these state the run. The twin
    that does not give way acts with what was learned where that is levels, else by the plain policy."""
    for unit, raw in raws.items():
        plain = ("policy", "without") if "as learned" in raw else ("policy",)
        own = {k: v for k, v in raw.items() if k not in plain}
        if unit.startswith("throws"):
            rows = throw_rows(places, {unit.removeprefix("throws, "): own})
        else:
            rows = scene_rows(places, {unit: own})
        for row in rows:
            yield row._replace(policy=raw["policy"])


def interval(values: list[float], name: str) -> str:
    """The interval of 95 % of a mean, by Wilson of the share of episodes in `COUNTS`, as text."""
    n, z = len(values), 1.96
    if n < 2:
        return ""
    mean = statistics.fmean(values)
    if name not in COUNTS:
        error = z * statistics.stdev(values) / math.sqrt(n)
        return f"{short(mean - error)} to {short(mean + error)}"
    middle = (mean + z * z / (2 * n)) / (1 + z * z / n)
    error = z * math.sqrt(mean * (1 - mean) / n + z * z / (4 * n * n)) / (1 + z * z / n)
    return f"{short(max(middle - error, 0.0))} to {short(min(middle + error, 1.0))}"


def nobody(
    tracker: Tracker,
    scene: PlayScene,
    clip: Clip | None,
    made: Played,
    many: int,
    seconds: float,
    top: LearnedOnTop | None = None,
) -> dict[str, list[float | None]]:
    """The same motion from the same starts on a floor where nobody comes: steps, losses, distance,
    torque. Of a fight also how far the pelvis leaves its way in the half second of the first touch."""
    own = motion_of(scene, tracker, seconds) or clip
    free = Throws(every_s=(100.0, 100.0))
    seconds = seconds or own.seconds if own else seconds
    alone = play(free, tracker, own, None, many, seconds, 1, learned=top)
    every = told(alone.stiff_episodes if top is None else alone.episodes)
    out = {k: every[k] for k in ("steps", "lost", "off_m", "torque_nm")}
    if isinstance(scene, Chicken):
        rolled = alone.evaluation.rollouts
        touch = next((i for i, arrows in enumerate(made.arrows) if len(arrows)), 0)
        off = (rolled.pos - rolled.ref_pos)[:, :, 0, :2]
        first = min(touch, off.shape[1] - 2)
        last = min(first + round(PUSHED_S * rolled.fps), off.shape[1] - 1)
        out["pushed_mm"] = (1000.0 * (off[:, last] - off[:, first]).norm(dim=-1)).tolist()
    return out


# --- cost -----------------------------------------------------------------------------------------


def cost_rows(places: Places, raws: Raws) -> Iterator[Figure]:
    """Shares of the environment without."""
    raw = raws["cost"]
    for name, share in raw["share_of_without"].items():
        yield Figure(
            f"control steps with compliance, {name}",
            "share_of_without",
            share,
            raw["steps"],
            " to ".join(short(q) for q in raw["share_quartiles"][name]),
        )


def costs(places: Places, unit: str) -> Any:
    """The time that compliance costs."""
    return cost(policy(), *((8, 2, 1) if places.smoke else (ROWS, STEPS, REPEATS)))


_SHIPS = ("tracker",)
PARTS = {
    "stiffness": Part(
        "stiffness of hands, commanded and measured",
        stiff_units,
        stiff,
        stiff_rows,
        _SHIPS,
        hours=0.3,
        needs=(),
    ),
    "throws": Part(
        "throws at a standing character", throw_units, thrown, throw_rows, _SHIPS, hours=1.5, needs=()
    ),
    "ranges": Part(
        "throws at levels that the hinges' ranges do not hold back",
        lambda _: ["throws, no range held"],
        ranges,
        range_rows,
        _SHIPS,
        hours=0.1,
        needs=(),
    ),
    **{
        name: Part(
            f"scenes: {name}",
            partial(scene_units, begins=begins),
            played,
            scene_rows,
            kinds,
            hours=hours,
            needs=("data",) if name == "hands" else (),
        )
        for name, begins, kinds, hours in (
            ("hands", "hand in hand", _SHIPS, 0.3),
            ("door", "door", _SHIPS, 0.5),
            ("trampoline", "trampoline", _SHIPS, 0.1),
            ("ball", "ball", ("tracker", "ball"), 0.5),
            ("chicken", "chicken", _SHIPS, 0.5),
        )
    },
    "learned": Part(
        "scenes with what was learned on top",
        top_units,
        on_top,
        top_rows,
        ("tracker", *(name for name in SHIPPED if name != "ball")),
        hours=3.0,
        needs=("data",),
    ),
    "cost": Part(
        "what compliance costs", lambda _: ["cost"], costs, cost_rows, alone=True, hours=0.05, needs=()
    ),
}
