"""One clip from its file to a policy that does it without help, from the policy that ships and from
nothing.

"shown after" is until the first result, which looks ahead and searches for what is lost so; "learned in"
until the policy alone succeeds from 32 start frames, or five minutes are over; success is over all start
frames. From nothing help is taken away as the training can spare it. Beside the clips of Residual Force
Control stands when the training is as good as its authors' released policies: R is their reward with
their weights (rotation 0.3, velocity 0.1, end effectors 0.45, centre of mass 0.1, residual 0.05), mean
per step. The null does nothing (action 0).
"""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch

from benchmarks.common.clips import SINGLE, Places, single
from benchmarks.common.field import figures as tracked_figures
from benchmarks.common.field import measured
from benchmarks.common.rows import Figure, between, mean_of, of
from benchmarks.common.runner import Part, Raws
from benchmarks.suites.lookahead_search import SMALL
from poise.errors import PoiseError
from poise.jobs.imitate import imitate
from poise.jobs.open import open_run
from poise.jobs.runs import begin, evaluate, train, trained_policy
from poise.jobs.track import TrackConfig, imitation_of, track
from poise.jobs.track.placement import place
from poise.learn import IterationStats, PPOConfig, Until
from poise.motion import ClipLibrary
from poise.recipes.imitation import Imitation
from poise.recipes.residual_force import task
from poise.recipes.residual_force_settings import ResidualForce
from poise.score import RolloutSet

#: Of the paper's clips, what its authors' released policies reach: R from random start frames on a
#: cleaned reference, N, N m.
AUTHORS = {
    "05_06": (0.698, 15, 32),
    "05_07": (0.840, 16, 21),
    "05_13": (0.843, 18, 27),
    "90_02": (0.769, 21, 24),
    "90_05": (0.786, 21, 25),
    "90_08": (0.760, 17, 24),
    "90_11": (0.792, 23, 24),
}
#: Share of start frames from which a training is first called usable, and done.
USABLE, DONE = 0.9, 1.0
MINUTES, LONGEST, CHECK_S = 5.0, 45.0, 30.0
#: Of clips from nothing, how many seeds; the others have one.
SEEDS = {"90_08": 3, "90_11": 3}


# --- from the policy that ships -------------------------------------------------------------------


def names(places: Places) -> list[str]:
    """The clips."""
    return ["02_01"] if places.smoke else list(SINGLE)


def with_seed(places: Places, seeds: int) -> list[str]:
    """Clips and seeds."""
    return [f"{n}, seed {s}" for n in names(places) for s in range(1 if places.smoke else seeds)]


def imitated(places: Places, unit: str) -> Any:
    """A clip from reading the file on, on the policy's joints with the bones of the clip."""
    name, _, seed = unit.partition(", seed ")
    began = time.perf_counter()
    clip = single(places, name)
    config = TrackConfig(body="own", threads=1, seed=int(seed))
    config = replace(config, lookahead=SMALL) if places.smoke else config
    first = track(clip, config=config)
    seen = time.perf_counter() - began
    minutes = 0.02 if places.smoke else MINUTES
    with tempfile.TemporaryDirectory() as folder:
        try:
            card = imitate(clip, minutes, folder=folder, threads=1, seed=int(seed)).card
        except PoiseError as problem:
            return {"refused": problem.what}
    return {
        "shown_after_s": seen,
        "shown_whole": float(first.card.tracked == 1.0),
        "learned_in_s": time.perf_counter() - began - seen,
        "success_over_all_starts": card.succ,
        "mpjpe_mm": card.mpjpe_mm,
    }


def imitated_rows(places: Places, raws: Raws) -> Iterator[Figure]:
    """Means over seeds."""
    for name in dict.fromkeys(u.partition(",")[0] for u in raws):
        rows = [r for u, r in raws.items() if u.startswith(f"{name},") and "refused" not in r]
        for metric in rows[0] if rows else ():
            values = [r[metric] for r in rows]
            yield Figure(SINGLE[name][3], metric, mean_of(values), len(rows), between(values), len(rows))


def alone(places: Places, unit: str, acts: bool) -> Any:
    """A clip by the policy that ships before any training, or by nothing."""
    tracker = open_run(None).tracker
    made = imitation_of(tracker, [place(single(places, unit), tracker)])
    return measured(made, tracker.policy if acts else None)


def alone_rows(places: Places, raws: Raws, method: str) -> Iterator[Figure]:
    """All clips together."""
    yield from tracked_figures(f"all clips; {method}", [e for raw in raws.values() for e in raw])


# --- from nothing ---------------------------------------------------------------------------------


def authors_reward(r: RolloutSet) -> float:
    """R, from terms that were worked out with the authors' definitions."""
    alive, t = r.alive, r.reward
    force, torque = (x.norm(dim=-1).sum(-1) / 100.0 for x in (r.force, r.torque))
    residual = torch.exp(-(force.square() + torque.square()))
    value = 0.3 * t["pose"] + 0.1 * t["velocity"] + 0.45 * t["end_effectors"] + 0.1 * t["centre_of_mass"]
    return float((value + 0.05 * residual)[alive].mean())


class Watch:
    """Checks a training now and then, and ends it when nothing is left to be gained."""

    def __init__(self, imitation: Imitation, run: Path, every: float, goal: tuple[float, ...] | None):
        code = replace(imitation.config, faithful="code")
        self.judged = replace(imitation, task=task(code, imitation.humanoid))
        self.run, self.begun, self.every, self.goal = run, time.perf_counter(), every, goal
        self.next, self.marks = 0.0, dict[str, float]()

    def __call__(self, stats: IterationStats) -> bool | None:
        if self.seconds < self.next:
            return None
        row = self.check(64)
        self.next = self.seconds + self.every
        done = row["help_limit_n"] == 0 and row["success_over_all_starts"] >= DONE
        return False if done and self.check(None)["success_over_all_starts"] >= DONE else None

    @property
    def seconds(self) -> float:
        return time.perf_counter() - self.begun

    def check(self, starts: int | None) -> dict[str, float]:
        """The deterministic policy to the end from some start frames, under the help that is left."""
        policy, meta = trained_policy(self.run, self.judged)
        result = evaluate(self.judged, policy, meta, most=starts)
        card, reward = result.card, authors_reward(result.rollouts)
        row = {
            "help_limit_n": float(meta["help_limit"]),
            "success_over_all_starts": card.succ,
            "mpjpe_mm": card.mpjpe_mm,
        }
        reached = {
            "usable_after_s": card.succ >= USABLE,
            "no_help_after_s": row["help_limit_n"] == 0 and card.succ >= 0.95 and card.mpjpe_mm <= 60,
        }
        if self.goal is not None:
            less = card.help.force_mean_n <= self.goal[1] and card.help.torque_mean_nm <= self.goal[2]
            reached["as_authors_after_s"] = card.succ >= DONE and reward >= self.goal[0] and less
        for name, yes in reached.items():
            if yes:
                self.marks.setdefault(name, round(self.seconds))
        return row


def scratch_units(places: Places) -> list[str]:
    """Clips and seeds."""
    if places.smoke:
        return ["02_01, seed 0"]
    return [f"{n}, seed {s}" for n in SINGLE if n != "backflip" for s in range(SEEDS.get(n, 1))]


def scratch(places: Places, unit: str) -> Any:
    """One training from nothing; one that was interrupted is begun anew."""
    name, _, seed = unit.partition(", seed ")
    config = ResidualForce(help_start=100.0, help_limit=0.0, seed=int(seed))
    until = Until(minutes=LONGEST)
    if places.smoke:
        ppo = PPOConfig(horizon=4, epochs=1, policy_hidden=(8,), value_hidden=(8,), std=config.ppo.std)
        config, until = replace(config, ppo=ppo, num_envs=8, expert=False), Until(iterations=1)
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "run"
        made = begin(run, ClipLibrary.of(single(places, name)), config)
        watch = Watch(made, run, CHECK_S, AUTHORS.get(name))
        train(made, run, until, watch, 1, tensorboard=False)
        return watch.check(None) | {"learned_in_s": round(watch.seconds)} | watch.marks


def scratch_rows(places: Places, raws: Raws) -> Iterator[Figure]:
    """Each training."""
    for unit, raw in raws.items():
        name, _, seed = unit.partition(", ")
        told = {k: v for k, v in raw.items() if math.isfinite(v)}
        yield from of(f"{SINGLE[name][3]}; from nothing, {seed}", told, 1, policy="")


PARTS = {
    "shipped": Part(
        "from the policy that ships",
        partial(with_seed, seeds=3),
        imitated,
        imitated_rows,
        ("tracker",),
        hours=4.0,
    ),
    "before": Part(
        "the policy before any training",
        names,
        partial(alone, acts=True),
        partial(alone_rows, method="policy alone, before training"),
        ("tracker",),
        hours=0.05,
    ),
    "nothing": Part(
        "action 0",
        names,
        partial(alone, acts=False),
        partial(alone_rows, method="nothing (action 0)"),
        ("tracker",),
        hours=0.05,
    ),
    "from nothing": Part("training without a policy", scratch_units, scratch, scratch_rows, hours=8.0),
}
