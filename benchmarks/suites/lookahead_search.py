"""The policy with lookahead beside itself alone, with other draws, while things go wrong; search.

Every figure but success is a median over the episodes that were done whole. "nothing" is the null. What
goes wrong stands in `CONDITIONS`. Search is what 512 characters find of the motions that the policy
loses.
"""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import mujoco
import numpy as np
import torch
from torch import Tensor

from benchmarks.common.clips import SETS, Places, clip_of, names_of
from benchmarks.common.field import done, episodes
from benchmarks.common.rows import Figure, between, mean_of, median_of, of
from benchmarks.common.runner import Part, Raws
from benchmarks.common.starts import SPREAD, Nothing, scattered
from poise.env import Acts
from poise.errors import PoiseError
from poise.formats.point_noise import smooth
from poise.jobs.open import open_run
from poise.jobs.perpetual.evaluation import evaluate_clips
from poise.jobs.track import imitation_of, look_ahead
from poise.jobs.track.placement import place
from poise.jobs.track.recovery_run import look_for, replay
from poise.jobs.tracker import Tracker
from poise.metrics import foot_contacts, foot_points
from poise.motion import Clip
from poise.motion.noise import VIDEO, perturb_clip
from poise.motion.noise import scaled as noise_scaled
from poise.motion.rotations import unwrap_quats
from poise.plan import Lookahead, LookaheadConfig, SamplingConfig
from poise.recipes.imitation import Imitation
from poise.score import Recorder, run_episodes, score_rollouts, simulate
from poise.score.rollouts import RolloutSet
from poise.sim import CpuBackend

#: Pushes begin after a second and come every 2 s; each lasts 0.1 s. Control steps at 30 Hz.
FIRST, EVERY, LASTS = 30, 60, 3
#: mm/s that feet may slide whatever their source does. Hz, the low-pass of goals with noise.
CLEAN, CUTOFF = 40.0, 4.0
SMALL = LookaheadConfig(candidates=10, horizon=4)


@dataclass(frozen=True)
class Condition:
    """Faults of an episode.

    mass, friction, gains: factors of the planner's model; the world stays as it is. push_n: N, on the
    upper trunk, in a horizontal direction that is drawn for each push. noise: strength of a video
    estimator's errors on the motion. smoothed: the motion with noise goes through a low-pass (Gaussian,
    zero-phase, `CUTOFF`). delay: actions act one control step late.
    """

    mass: float = 1.0
    friction: float = 1.0
    gains: float = 1.0
    push_n: float = 0.0
    noise: float = 0.0
    smoothed: bool = False
    delay: bool = False


CONDITIONS = {
    "mass +10 %": Condition(mass=1.1),
    "friction -30 %": Condition(friction=0.7),
    "gains -10 %": Condition(gains=0.9),
    "pushes": Condition(push_n=150.0),
    "delay": Condition(delay=True),
    "noise 0.5": Condition(noise=0.5),
    "noise 0.5, smoothed": Condition(noise=0.5, smoothed=True),
}


# --- what goes wrong ------------------------------------------------------------------------------


def planners(task: Imitation, condition: Condition) -> Imitation:
    """The task as a planner believes it to be."""
    if (condition.mass, condition.friction, condition.gains) == (1.0, 1.0, 1.0):
        return task
    model = copy.copy(task.model)
    model.body_mass[:] *= condition.mass
    model.body_inertia[:] *= condition.mass
    model.geom_friction[:, 0] *= condition.friction
    model.actuator_gainprm[:, 0] *= condition.gains
    model.actuator_biasprm[:, 1] *= condition.gains
    model.dof_damping[:] *= condition.gains
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return replace(task, physics=model)


class Pushed(CpuBackend):
    """One world in which a body is pushed, see `FIRST`, every time in another direction."""

    def __init__(self, model: mujoco.MjModel, body: int, newtons: float, seed: int):
        super().__init__(model, 1, 1)
        self.body, self.newtons, self.steps = body, newtons, 0
        self._rng = np.random.default_rng(seed)
        self._force = torch.zeros(3)

    def step(self, nstep: int = 1) -> None:
        since = (self.steps - FIRST) % EVERY
        if self.steps >= FIRST and since < LASTS:
            if since == 0:
                way = self._rng.uniform(0.0, 2.0 * math.pi)
                self._force = self.newtons * torch.tensor([math.cos(way), math.sin(way), 0.0])
            self.drive.xfrc_applied[:, self.body, :3] += self._force
        self.steps += 1
        super().step(nstep)


class Delayed:
    """Acts as another controller wanted to one control step ago."""

    def __init__(self, acts: Acts):
        self.acts = acts
        self._late: Tensor | None = None

    def act(self, obs: Tensor) -> Tensor:
        """Actions `(N, A)`; at the start those of now."""
        now = self.acts.act(obs)
        late, self._late = self._late, now
        return now if late is None else late


def disturbed(clip: Clip, condition: Condition, seed: int) -> Clip:
    """The motion as it comes in."""
    if not condition.noise:
        return clip
    clip = perturb_clip(clip, noise_scaled(VIDEO, condition.noise), seed)
    if not condition.smoothed:
        return clip
    rot = smooth(unwrap_quats(torch.tensor(clip.rot)).numpy(), clip.fps, CUTOFF)
    rot = rot / np.linalg.norm(rot, axis=-1, keepdims=True)
    return clip.replaced(root_pos=smooth(clip.root_pos, clip.fps, CUTOFF), rot=rot)


# --- episodes -------------------------------------------------------------------------------------


def followed(
    places: Places,
    clip: str,
    of_set: str,
    controller: str,
    trials: tuple[int, ...],
    seed: int = 0,
    condition: Condition | None = None,
) -> Any:
    """One clip with one controller: what each start comes to. The draws of lookahead at start k are of
    the seed and k."""
    tracker, wrong = open_run(None).tracker, condition or Condition()
    motion, out = clip_of(places, of_set, clip), []
    config = SMALL if places.smoke else LookaheadConfig()
    try:
        clean = imitation_of(tracker, [place(motion, tracker)])
    except PoiseError as problem:
        return {"refused": problem.what, "episodes": []}
    for k in trials[:2] if places.smoke else trials:
        task = clean
        if wrong.noise:
            task = imitation_of(tracker, [place(disturbed(motion, wrong, seed + k), tracker)])
        out.append(_episode(tracker, task, controller, config, wrong, k, seed + k))
    return {"episodes": out}


def _episode(
    tracker: Tracker,
    task: Imitation,
    controller: str,
    config: LookaheadConfig,
    wrong: Condition,
    trial: int,
    seed: int,
) -> dict[str, Any]:
    backend = None
    if wrong.push_n:
        backend = Pushed(task.model, task.humanoid.rows_of("spine")[-1] + 1, wrong.push_n, seed)
    env = task.env(1, None, False, 1, help_scale=0.0, guard=False, backend=backend)
    ahead: Lookahead | None = None
    if controller == "lookahead":
        ahead = look_ahead(tracker, planners(task, wrong), config, 1, seed)
        ahead.watch(env)
    acts: Acts = ahead or (tracker.policy if controller == "policy" else Nothing(env.num_actions))
    acts = Delayed(acts) if wrong.delay else acts
    zero = torch.zeros(1, dtype=torch.long)
    obs = env.reset_to(zero, zero)
    if trial:
        obs = scattered(env, torch.tensor([trial]))
    recorder = Recorder(env, zero, zero, 1)
    begun = time.process_time()
    simulate(env, acts, obs, recorder.total - 1, recorder)
    spent, rollouts = time.process_time() - begun, recorder.rollouts()
    env.close()
    row = episodes(rollouts, trial)[0] | plausible(rollouts)
    row["core_s_a_s"] = spent / (row["frames"] / rollouts.fps)
    if ahead is not None:
        ahead.copies.close()
        row["decision_ms"] = [round(1000 * t, 1) for t in ahead.seconds]
        row["steps_a_step"] = ahead.steps / max(1, row["frames"] - 1)
    return row


def plausible(rollouts: RolloutSet) -> dict[str, float | None]:
    """Errors, jerk, slide and contacts of an episode, with the source's own."""
    card = score_rollouts(rollouts)
    source = card.reference
    found = {
        "g_mpjpe_mm": card.mpjpe_global_mm,
        "mpjpe_mm": card.mpjpe_mm,
        "acc_mm_per_frame2": card.acc_mm_per_frame2,
        "jerk_ratio": _ratio(card.jerk, source["jerk"]),
        "slide_mm_per_s": card.foot_slide_mm_per_s,
        "source_slide_mm_per_s": source["foot_slide_mm_per_s"],
        "stance_ratio": stance(rollouts),
    }
    return {k: v if math.isfinite(v) else None for k, v in found.items()}


def _ratio(a: float, b: float) -> float:
    return a / b if b else math.nan


def stance(rollouts: RolloutSet) -> float:
    """Contacts of sole points with the ground beside those of the reference."""
    counts, shapes = [], rollouts.shapes
    assert shapes is not None
    for pos, quat in ((rollouts.pos, rollouts.quat), (rollouts.ref_pos, rollouts.ref_quat)):
        points = foot_points(pos[0], quat[0], shapes, rollouts.feet)
        counts.append(float(foot_contacts(points, rollouts.fps)[1].sum()))
    return _ratio(*counts)


# --- figures --------------------------------------------------------------------------------------

MEDIANS = (
    "g_mpjpe_mm",
    "mpjpe_mm",
    "acc_mm_per_frame2",
    "jerk_ratio",
    "slide_mm_per_s",
    "source_slide_mm_per_s",
    "stance_ratio",
)


def figures(places: Places, raws: Raws, subject: str) -> Iterator[Figure]:
    """Success by rule over all episodes, its spread over starts; medians over those done whole."""
    rows = [e for raw in raws.values() for e in raw["episodes"]]
    trials = sorted({e["trial"] for e in rows})
    if trials != [0]:
        subject = f"{subject}, {SPREAD}"
    for rule in ("phc", "sonic", "blinkmimic"):
        each = [done([e for e in rows if e["trial"] == t], rule) for t in trials]
        name = "done" if rule == "phc" else f"done_{rule}"
        yield Figure(subject, name, done(rows, rule), len(rows), between(each), len(trials))
    whole = [e for e in rows if e["won"]["phc"]]
    values = {f"median_{k}": median_of(e[k] for e in whole) for k in MEDIANS}
    values["slides_as_source"] = mean_of(_slides_as_source(e) for e in whole)
    times = sorted(t for e in rows for t in e.get("decision_ms", ()))
    if times:
        values |= {
            "decision_ms_p50": times[len(times) // 2],
            "decision_ms_p99": times[int(0.99 * (len(times) - 1))],
        }
        values["steps_a_step"] = mean_of(e.get("steps_a_step") for e in rows)
    values["core_s_a_s"] = median_of(e["core_s_a_s"] for e in rows)
    yield from of(subject, values, len(rows), seeds=len(trials))


def _slides_as_source(e: Mapping[str, Any]) -> float | None:
    """Whether feet slide no more than the source's, or than `CLEAN`."""
    if e["slide_mm_per_s"] is None or e["source_slide_mm_per_s"] is None:
        return None
    return float(e["slide_mm_per_s"] <= max(e["source_slide_mm_per_s"], CLEAN))


def draws(places: Places, raws: Raws, subject: str) -> Iterator[Figure]:
    """Success of several draws: the mean, and from the least to the most."""
    seeds = sorted({unit.rpartition(", seed ")[2] for unit in raws})
    each = [
        done([e for u, raw in raws.items() if u.endswith(f", seed {s}") for e in raw["episodes"]])
        for s in seeds
    ]
    yield Figure(subject, "done", mean_of(each), len(raws), between(each), len(seeds))


# --- search ---------------------------------------------------------------------------------------


def searched(places: Places, clip: str, of_set: str) -> Any:
    """A clip alone, as `poise track` has it, and where the policy loses it what many characters find."""
    tracker = open_run(None).tracker
    try:
        task = imitation_of(tracker, [place(clip_of(places, of_set, clip), tracker)])
    except PoiseError as problem:
        return {"refused": problem.what}
    one = torch.tensor([0])
    alone = bool(evaluate_clips(task, tracker.policy, one, threads=1, worlds=1).succeeded[0])
    if alone and not places.smoke:
        return {"alone": True}
    begun = time.process_time()
    config = SamplingConfig(16) if places.smoke else SamplingConfig(512)
    found = look_for(tracker, task, config, 0, 1)
    spent = time.process_time() - begun
    rollouts, _ = run_episodes(
        lambda n: task.bare().env(n, None, False, 1, help_scale=0.0, guard=False),
        replay(found, tracker.policy),
        one,
        one,
        cycles=1,
    )
    seconds = len(found.actions) / task.config.sim.control_hz
    return {"alone": False, "core_s_a_s": spent / seconds, **episodes(rollouts)[0]}


def search_rows(places: Places, raws: Raws, subject: str) -> Iterator[Figure]:
    """How many of those that the policy loses are found, and all together."""
    tried = [r for r in raws.values() if "refused" not in r]
    lost = [r for r in tried if not r["alone"]]
    found = sum(r["won"]["phc"] for r in lost)
    values = {
        "lost_alone": len(lost),
        "found": found,
        "done": (len(tried) - len(lost) + found) / len(tried),
        "core_s_a_s": median_of(r["core_s_a_s"] for r in lost),
    }
    yield from of(subject, values, len(tried))


# --- parts ----------------------------------------------------------------------------------------


def _units(places: Places, name: str, every: int = 1) -> list[str]:
    return names_of(places, name)[::every]


def part(
    name: str, title: str, controller: str, every: int, trials: tuple[int, ...], hours: float
) -> Part:
    """A set with one controller."""
    said = {"policy": "policy alone", "nothing": "nothing (action 0)"}.get(controller, controller)
    needs = ("data",) if SETS[name].pattern else ("library",)
    return Part(
        f"{title}, {SETS[name].learned}; {said}",
        partial(_units, name=name, every=every),
        partial(followed, of_set=name, controller=controller, trials=trials),
        partial(figures, subject=f"{title}; {said}"),
        ("tracker",),
        hours=hours,
        needs=needs,
    )


def wrong_part(name: str) -> Part:
    """Every eighth unseen clip by lookahead, while something goes wrong."""
    return Part(
        f"lookahead, {name}",
        partial(_units, name="bandai", every=8),
        partial(
            followed, of_set="bandai", controller="lookahead", trials=(0,), condition=CONDITIONS[name]
        ),
        partial(figures, subject=f"every eighth of Bandai; lookahead, {name}"),
        ("tracker",),
        hours=0.2,
    )


def drawn(places: Places, unit: str, of_set: str) -> Any:
    """One clip by lookahead with the draws of a seed."""
    clip, _, seed = unit.rpartition(", seed ")
    return followed(places, clip, of_set, "lookahead", (0,), 1000 * int(seed))


def draws_part(name: str, title: str, every: int, seeds: tuple[int, ...], hours: float) -> Part:
    """The same with other draws of lookahead."""

    def units(places: Places) -> list[str]:
        return [
            f"{c}, seed {s}"
            for s in seeds[: 1 if places.smoke else None]
            for c in _units(places, name, every)
        ]

    needs = ("data",) if SETS[name].pattern else ("library",)
    return Part(
        f"{title}; other draws",
        units,
        partial(drawn, of_set=name),
        partial(draws, subject=f"{title}; lookahead, other draws"),
        ("tracker",),
        hours=hours,
        needs=needs,
    )


_BANDAI, _TEST, _HELD = (SETS[n].title for n in ("bandai", "bandai-test", "held-out"))
_EIGHTH = "every eighth recording, learned"
PARTS = {
    "bandai, policy": part("bandai", _BANDAI, "policy", 1, (0,), 0.2),
    "bandai, lookahead": part("bandai", _BANDAI, "lookahead", 1, (0,), 1.3),
    "bandai, nothing": part("bandai", _BANDAI, "nothing", 1, (0,), 0.2),
    "bandai, draws": draws_part("bandai", _BANDAI, 1, (1, 2, 3, 4), 5.0),
    "bandai-test, policy": part("bandai-test", _TEST, "policy", 1, (0,), 0.1),
    "bandai-test, lookahead": part("bandai-test", _TEST, "lookahead", 1, (0,), 0.6),
    "held-out, policy": part("held-out", _HELD, "policy", 1, tuple(range(1, 9)), 0.1),
    "held-out, lookahead": part("held-out", _HELD, "lookahead", 1, tuple(range(1, 9)), 1.0),
    "library, policy": part("library", _EIGHTH, "policy", 8, (0,), 0.1),
    "library, lookahead": part("library", _EIGHTH, "lookahead", 8, (0,), 0.6),
    "library, draws": draws_part("library", _EIGHTH, 8, (1, 2), 1.2),
    **{name: wrong_part(name) for name in CONDITIONS},
    "search, bandai": Part(
        "what 512 characters find of what the policy loses",
        partial(_units, name="bandai"),
        partial(searched, of_set="bandai"),
        partial(search_rows, subject=f"{_BANDAI}; search"),
        ("tracker",),
        hours=0.5,
    ),
}
