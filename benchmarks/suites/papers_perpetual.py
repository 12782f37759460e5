"""Table 3 of Perpetual Humanoid Control, and what else its paper claims of the parts of its controller.

Each training on a small library is one switch away from the one that it is compared with, with the same
samples, the cloning of the expert counted, and without any help (but for "uhc-helped"). All clips from
their first frames, beside "nothing" (action 0); ranges are those of the seeds. A training that was
stopped goes on. Not measured: a top-1 mixture of experts (no setting; `means` is the code's
mixture).
"""

from __future__ import annotations

import statistics
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from typing import Any

from benchmarks.common.clips import SIXTY, Places, moment
from benchmarks.common.field import figures, measured
from benchmarks.common.rows import Figure, between
from benchmarks.common.runner import Part, Raws
from poise.body import BodyConfig
from poise.jobs import runs
from poise.jobs.library.clips import LibraryConfig
from poise.jobs.open import open_run
from poise.jobs.perpetual.perpetual_run import RESULT, begin, clips_of, resume, train
from poise.jobs.run_file import RUN_FILE
from poise.learn import AmpConfig, CloneConfig, PPOConfig, Until
from poise.motion import ClipLibrary
from poise.papers.perpetual.ablations import StagedPerpetual
from poise.recipes.perpetual import build
from poise.recipes.residual_force_settings import ResidualForce

SAMPLES, SEEDS = 1_000_000, (0, 1)
#: Walks, runs, jumps and blows, few enough that the samples tell rows apart.
FOLDERS = ("cmu_amc/02", "cmu_amc/35", "cmu_amc/39", "deepmimic_txt")
CLIPS = (
    *("02_01", "02_03", "02_04", "02_05", "35_01", "35_28", "39_01", "39_05"),
    *("humanoid3d_jump", "humanoid3d_kick", "humanoid3d_punch", "humanoid3d_spin"),
)


#: Every row adds what its name says to the one before; the last three stand for themselves.
LADDER = {
    "plain": {"termination": "all", "multiplicative": False, "recovery": False},
    "relaxed": {"multiplicative": False, "recovery": False},
    "multiplicative": {"progressive": False, "recovery": False},
    "progressive": {"recovery": False},
    "recovery": {},
    "one-large-network": {"single": True, "recovery": False},
    "absolute-rotations": {"action": "absolute", "recovery": False},
    "absolute-keypoints": {"action": "absolute", "goal": "keypoints", "recovery": False},
}


#: One switch away from a row of the ladder each.
MORE = {
    "no-energy": LADDER["relaxed"] | {"energy": 0.0},
    "style": LADDER["relaxed"] | {"style": AmpConfig()},
    "means": LADDER["progressive"] | {"combine": "means"},
    "primitives-1": LADDER["progressive"] | {"max_primitives": 1},
    "primitives-3": LADDER["progressive"] | {"max_primitives": 3},
    "primitives-4": LADDER["progressive"] | {"max_primitives": 4},
}


#: In the manner of UHC: one network, additive actions, its reward, a root force up to 100 N or none.
UHC = ("uhc", "uhc-helped")


def settings(name: str, seed: int) -> StagedPerpetual:
    """One run's."""
    additive = StagedPerpetual.additive(
        help_start=0.0, max_primitives=2, single_hidden=(1024, 512), seed=seed
    )
    # A small library has fewer hard moments, and the budget is small.
    additive = replace(additive, num_envs=512)
    ppo = replace(additive.ppo, minibatch=2048)
    if name.startswith("absolute"):
        # Noise in shares of a joint's range.
        ppo = replace(ppo, std=0.02)
    return replace(additive, ppo=ppo, **(LADDER | MORE).get(name, {}))


def uhc(name: str, seed: int) -> ResidualForce:
    """The settings of one of `UHC`, with the learner of the others."""
    ppo = settings("relaxed", seed).ppo
    method = "rfc-implicit" if name == "uhc-helped" else "deepmimic"
    return ResidualForce(method=method, help_limit=100.0, help_start=None, ppo=ppo, seed=seed)


#: Which row each is compared with.
AGAINST = {
    "relaxed": "plain",
    "multiplicative": "relaxed",
    "progressive": "multiplicative",
    "recovery": "progressive",
    "absolute-keypoints": "absolute-rotations",
    "no-energy": "relaxed",
    "style": "relaxed",
    "one-large-network": "relaxed",
    "means": "progressive",
    "primitives-1": "progressive",
    "primitives-3": "progressive",
    "primitives-4": "progressive",
    "uhc": "relaxed",
    "uhc-helped": "uhc",
}


NOTHING = "nothing (action 0)"
EXACT = (0,)


@cache
def library(places: Places, own: bool = False) -> ClipLibrary:
    """The clips on one skeleton. own: with the lengths of each clip's own bones."""
    if places.smoke:
        return ClipLibrary.of([moment("a"), moment("b", 0.9)])
    how = LibraryConfig(rates=SIXTY, own_bones=own)
    folders = [places.data / f for f in FOLDERS]
    onto = places.data / "cmu_amc/02/02_01.amc"
    every = clips_of(folders, BodyConfig(), (), (), print, onto, how)[0]
    return ClipLibrary.of([c for c in every if c.name.endswith(CLIPS)])


def units(places: Places) -> list[str]:
    """The null, rows and seeds."""
    if places.smoke:
        return [NOTHING, "relaxed, seed 0"]
    return [NOTHING, *(f"{n}, seed {s}" for n in (*LADDER, *UHC, *MORE) for s in SEEDS)]


def ablated(places: Places, unit: str) -> Any:
    """One training and its episodes."""
    name, _, seed = unit.partition(", seed ")
    if unit == NOTHING:
        task = build(library(places), tiny(places, settings("relaxed", 0)))
        return measured(task, None, EXACT)
    out = places.work / "perpetual" / f"{name}-{seed}"
    until = Until(samples=32 if places.smoke else SAMPLES)
    if name in UHC:
        if not (out / RESULT).exists():
            made = runs.begin(out, library(places), uhc(name, int(seed)))
            runs.train(made, out, until, threads=1, tensorboard=False)
        task = open_run(out).task
        policy, meta = runs.trained_policy(out, task)
        _, scale = runs.help_left(task, meta) if name == "uhc-helped" else (0.0, 0.0)
        return measured(task, policy, EXACT, scale)
    config = tiny(places, settings(name, int(seed)))
    if not (out / RESULT).exists():
        if (out / RUN_FILE).exists():
            task = resume(out, config, "library")
        else:
            task = begin(out, library(places, config.shapes.own), config, "library")
        train(task, out, until, threads=1)
    run = open_run(out)
    return measured(run.task, run.policy, EXACT)


def tiny(places: Places, config: StagedPerpetual) -> StagedPerpetual:
    """The same with networks of no size, for a smoke test."""
    if not places.smoke:
        return config
    ppo = PPOConfig(horizon=4, epochs=1, std=0.02, policy_hidden=(8,), value_hidden=(8,))
    clone = CloneConfig(steps=4, rounds=0, critic_steps=4)
    return replace(config, ppo=ppo, clone=clone, num_envs=8, style=None, expert=False, max_primitives=1)


def rows(places: Places, raws: Raws) -> Iterator[Figure]:
    """Figures of each row from exact starts, with their range over seeds, and differences of the share
    done."""
    done: dict[str, list[float]] = {}
    for name in dict.fromkeys(u.partition(", seed ")[0] for u in raws):
        own = [r for u, r in raws.items() if u.partition(", seed ")[0] == name]
        subject = f"Perpetual Humanoid Control, Table 3; {name}"
        policy = "" if name == NOTHING else f"{name} (trained for this table)"
        seeds = [{f.metric: f for f in figures(subject, r) if f.subject == subject} for r in own]
        done[name] = [s["done"].value for s in seeds]
        for metric, f in seeds[0].items():
            values = [s[metric].value for s in seeds if metric in s]
            mean = statistics.fmean(values)
            yield f._replace(value=mean, spread=between(values), policy=policy, seeds=len(values))
        if policy:
            yield Figure(subject, "samples", SAMPLES, len(own), seeds=len(own), policy=policy)
    for name, other in AGAINST.items():
        if name in done and other in done:
            gaps = [a - b for a, b in zip(done[name], done[other], strict=False)]
            yield Figure(
                f"Perpetual Humanoid Control, Table 3; {name} beside {other}",
                "done_more",
                statistics.fmean(gaps),
                len(gaps),
                between(gaps),
                len(gaps),
                f"{name} (trained for this table)",
            )


PARTS = {"perpetual": Part("Table 3 of Perpetual Humanoid Control", units, ablated, rows, hours=4.0)}
