"""What `lookahead.py` measures: episodes of a clip with a controller while something goes wrong."""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch
from field.sources import source_of
from lookahead_sets import Condition, disturbed
from torch import Tensor

from poise.env import Acts
from poise.formats import read_clip
from poise.jobs.open import open_run
from poise.jobs.track import imitation_of, look_ahead
from poise.jobs.track.placement import place
from poise.jobs.tracker import Tracker
from poise.metrics import foot_contacts, foot_points, mpjpe_global, mpjpe_root, success_rule
from poise.motion import Clip
from poise.plan import Lookahead, LookaheadConfig
from poise.recipes.imitation import Imitation
from poise.score import Nothing, Recorder, perturb, score_rollouts, simulate
from poise.score.rollouts import RolloutSet, judge
from poise.sim import CpuBackend

#: Pushes begin after a second and come every 2 s; each lasts 0.1 s. Control steps at 30 Hz.
FIRST, EVERY, LASTS = 30, 60, 3


# --- what goes wrong ------------------------------------------------------------------------------


def planners(task: Imitation, condition: Condition) -> Imitation:
    """The task as a planner believes it to be."""
    if not condition.of_planner:
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


# --- episodes -------------------------------------------------------------------------------------


def measured(
    name: str,
    source: Path | Clip,
    controller: str,
    config: LookaheadConfig,
    condition: Condition,
    starts: int,
) -> dict[str, Any]:
    """One clip with one controller under one condition: what each start comes to, and all decisions.

    The draws of lookahead at start k are those of the seed of `config` and k.
    """
    torch.set_num_threads(1)
    tracker = open_run(None).tracker
    clip = source if isinstance(source, Clip) else read_clip(source)
    clean = imitation_of(tracker, [place(clip, tracker)])
    episodes: list[dict[str, Any]] = []
    times: list[float] = []
    simulated = made = 0
    for k in range(starts):
        task = clean
        if condition.noise:
            task = imitation_of(tracker, [place(disturbed(clip, condition, k), tracker)])
        row, ahead = _episode(tracker, task, clean, controller, config, condition, k, starts > 1)
        episodes.append(row)
        made += row["frames"] - 1
        if ahead is not None:
            times += ahead.seconds
            simulated += ahead.steps
    out: dict[str, Any] = {"clip": name, "source": source_of(name), "episodes": episodes}
    if times:
        out["steps_per_step"] = round(simulated / made, 1)
        out["decision_ms"] = [round(1000 * t) for t in times]
    return out


def _episode(
    tracker: Tracker, task: Imitation, clean: Imitation, controller: str, config: LookaheadConfig,
    condition: Condition, seed: int, off: bool,
) -> tuple[dict[str, Any], Lookahead | None]:  # fmt: skip
    humanoid = task.humanoid
    backend = None
    if condition.push_n:
        torso = humanoid.rows_of("spine")[-1] + 1
        backend = Pushed(task.model, torso, condition.push_n, seed)
    env = task.env(1, None, False, 1, help_scale=0.0, guard=False, backend=backend)
    ahead = None
    if controller == "lookahead":
        ahead = look_ahead(tracker, planners(task, condition), config, 1, config.seed + seed)
        ahead.watch(env)
    acts: Acts = ahead or (tracker.policy if controller == "policy" else Nothing(env.num_actions))
    acts = Delayed(acts) if condition.delay else acts
    zero = torch.zeros(1, dtype=torch.long)
    obs = env.reset_to(zero, zero)
    if off:
        obs = perturb(env, zero, zero, torch.tensor([seed]))
    recorder = Recorder(env, zero, zero, 1)
    begun = time.perf_counter()
    simulate(env, acts, obs, recorder.total - 1, recorder)
    spent = time.perf_counter() - begun
    rollouts = recorder.rollouts()
    env.close()
    if ahead is not None:
        ahead.copies.close()
    row = figures(rollouts, seed)
    row["seconds_per_second"] = round(spent / (row["frames"] / rollouts.fps), 3)
    if condition.noise:
        row |= beside(rollouts, clean.reference.pose.pos)
    return row, ahead


def figures(rollouts: RolloutSet, seed: int) -> dict[str, Any]:
    """What an episode came to; of figures that count until a failure those over all frames beside."""
    card = score_rollouts(rollouts, seed=seed)
    fail, frames = int(judge(rollouts, success_rule("phc")).failed_at[0]), rollouts.pos.shape[1]
    uncut, source = card.variants["uncut_frame"], card.reference
    found = {
        "part": 1.0 if fail < 0 else fail / frames,
        "error_mm": card.mpjpe_global_mm, "error_uncut_mm": uncut["mpjpe_global_mm"],
        "root_error_mm": card.mpjpe_mm, "root_error_uncut_mm": uncut["mpjpe_mm"],
        "acc": card.acc_mm_per_frame2, "acc_uncut": uncut["acc_mm_per_frame2"],
        "vel": card.vel_mm_per_frame, "vel_uncut": uncut["vel_mm_per_frame"],
        "jerk": card.jerk, "source_jerk": source["jerk"],
        "slide": card.foot_slide_mm_per_s, "source_slide": source["foot_slide_mm_per_s"],
        "penetration": card.penetration_mm, "source_penetration": source["penetration_mm"],
        "floating": card.float_mm, "source_floating": source["float_mm"],
        "stance_ratio": stance(rollouts),
    }  # fmt: skip
    return {"start": seed, "whole": card.succ == 1.0, "frames": frames, **rounded(found)}


def rounded(found: Mapping[str, float]) -> dict[str, float | None]:
    """Figures as JSON has them; None where one was not measured."""
    return {k: round(v, 3) if math.isfinite(v) else None for k, v in found.items()}


def stance(rollouts: RolloutSet) -> float:
    """Contacts of sole points with the ground beside those of the reference."""
    counts, shapes = [], rollouts.shapes
    assert shapes is not None
    for pos, quat in ((rollouts.pos, rollouts.quat), (rollouts.ref_pos, rollouts.ref_quat)):
        points = foot_points(pos[0], quat[0], shapes, rollouts.feet)
        counts.append(float(foot_contacts(points, rollouts.fps)[1].sum()))
    return counts[0] / counts[1] if counts[1] else math.nan


def beside(rollouts: RolloutSet, truth: Tensor) -> dict[str, Any]:
    """How an episode that followed a motion with noise stands to the motion without, over all frames."""
    frames = min(len(truth), rollouts.pos.shape[1])
    pos, ref, true = rollouts.pos[0, :frames], rollouts.ref_pos[0, :frames], truth[:frames].cpu()
    off = mpjpe_global(pos, true)
    whole = bool((off <= 1000.0 * success_rule("phc").limit_m).all())
    root = mpjpe_root(pos, true)
    errors = {"true_error_mm": off, "true_root_error_mm": root, "noise_mm": mpjpe_global(ref, true)}
    return {"true_whole": whole, **rounded({k: float(v.nanmean()) for k, v in errors.items()})}
