"""Perpetual Humanoid Control for Real-time Simulated Avatars: one policy for a whole library.

Luo, Cao, Winkler, Kitani and Xu, ICCV 2023.

| paper                                             | here                                        |
|---------------------------------------------------|---------------------------------------------|
| Sec. 3.1 s^p, s^g-rot, s^g-kp, beta               | `env.terms.phc_obs`                         |
| Sec. 3.1 Eqs. 1, 2, energy; style                 | `env.terms.phc_reward`, `learn.Amp`         |
| Sec. 3.1 relaxed early termination                | `env.terms.done`, `all_but_feet`            |
| Sec. 3.2 progressive primitives, hard negatives   | `jobs.perpetual.stage_order`                |
| Alg. 1, line 3: until success no longer improves  | `learn.mining`                              |
| lateral connections, weight sharing               | `learn.progressive`, `nets.ProgressiveNet`  |
| fail-states, Eq. 3 point goal, Eq. 4              | `env.recovery`, `env.terms.phc_reward`      |
| P^(F) on Q^loco; interleaved recovery             | `jobs.perpetual.evaluation`                 |
| in place of them, by default: recovery clips      | `jobs.perpetual.demonstrations`             |
| Eqs. 5, 6 multiplicative composer                 | `learn.compose`, `nets.Composer`            |
| Sec. 4, success: mean distance within 0.5 m       | `jobs.perpetual.evaluation`                 |
| the authors' later single network                 | `Perpetual.single`                          |

What is ours: the first primitive begins as a clone of a scripted expert, a residual force helps at first
and is taken away clip by clip (`control.SuccessHelp`), and the composer begins by imitating for each
clip the primitive that learned it, and the recovery primitive for characters that are far. At the end of
every stage there is no help.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from poise.body import BodyTable, Humanoid
from poise.control import Compliance, ImplicitResidual, PDTargets, SuccessHelp, range_scale
from poise.env import DoneTerm, ObsTerm, Recovery, RewardTerm, TaskConfig
from poise.env.events.pushes import Pushes
from poise.env.recovery.clips import RecoveryClips
from poise.env.terms import done, phc_obs, phc_reward, reward
from poise.env.terms.phc_reward import recovery_terms
from poise.kin.solids import shapes_of
from poise.metrics import foot_points
from poise.recipes.imitation import Clips, Imitation, fitted
from poise.recipes.perpetual.config import Perpetual, Recovers, RecoveryPlan
from poise.recipes.perpetual.noisy import noisy
from poise.recipes.perpetual.recovery import known_recovery_clips
from poise.recipes.perpetual.shapes import shaped

__all__ = ["RECIPE", "Perpetual", "RecoveryPlan", "build", "stage_task", "task"]

#: Parts of which a window of the reference tells the places.
KEY_PARTS = ("head", "hand", "shin", "foot")


def task(config: Perpetual, humanoid: Humanoid, guided: bool = False) -> TaskConfig:
    """Imitation as terms, as the finished policy knows it: with point goals if it learned recovery by
    them. guided: it learned recovery motions, which are tracked as all motions."""
    return stage_task(config, humanoid, "composer" if config.recovery and not guided else None)


def stage_task(config: Perpetual, humanoid: Humanoid, recovers: Recovers | None) -> TaskConfig:
    """The task of a stage that learns to recover as PHC's recovery "primitive" or as its "composer", or
    tracks alone (None). The observations are of the same size in all of them."""
    own = (ObsTerm("self_state", phc_obs.self_state),)
    if config.shape or config.shapes.several:
        own += (ObsTerm("shape", phc_obs.shape, {"sizes": phc_obs.shape_of(humanoid)}),)
    left = None if config.heading == "twist" else torch.tensor(humanoid.left)
    goal = phc_obs.rotation_goal if config.goal == "rotations" else phc_obs.keypoint_goal
    limit, gamma = config.help_start, config.ppo.gamma
    recovery = None
    if recovers is not None:
        recovery = Recovery.phc(config.faithful, recovers)
        recovery = replace(recovery, drop=replace(recovery.drop, count=config.recovering.falls))
    return TaskConfig(
        obs=(*own, ObsTerm(goal.__name__, goal), *_more_seen(config, humanoid)),
        rewards=_rewards(config, humanoid, recovers is not None),
        dones=(_failure(config, humanoid),),
        pd=_targets(config, humanoid),
        residual=ImplicitResidual(limit, limit) if limit else None,
        # What is learned with recovery is learned without help.
        help=_help(config) if limit and recovers is None else None,
        help_by=config.help_by,
        left=left,
        filter=config.filter,
        window=config.window,
        horizon=config.horizon,
        # As many of the last rewards as a character that goes on would earn: g + g^2 + ...
        completion_bonus=gamma / max(1.0 - gamma, 1.0 / config.horizon),
        first=config.first,
        adaptive=config.adaptive_sampling,
        adaptive_over=config.adaptive_over,
        style=phc_obs.style_terms(humanoid) if config.style else (),
        velocities=phc_obs.velocity_columns(
            len(humanoid.bodies), shape=len(own) > 1, rotations=config.goal == "rotations"
        ),
        recovery=recovery,
    )


def _more_seen(config: Perpetual, humanoid: Humanoid) -> tuple[ObsTerm, ...]:
    """What is observed beside the paper's, each term under a name by which it is found again, see
    `jobs.warm_start.widened`."""
    given = {
        "bodies": torch.tensor(humanoid.rows_of(*KEY_PARTS)),
        # Keypoints tell no rotation.
        "turns": config.goal == "rotations",
    }
    later = tuple(
        ObsTerm(f"goal_in_{k}", phc_obs.goal_later, {"step": i, **given})
        for i, k in enumerate(config.window)
    )
    last = (ObsTerm("last_action", phc_obs.last_action),) if config.filter else ()
    yields = (ObsTerm("yielding", phc_obs.yielding),) if config.pushes else ()
    return (*last, *later, *yields)


def pushed(task: TaskConfig, config: Perpetual, humanoid: Humanoid) -> TaskConfig:
    """The task of a training in which characters are pushed; as it is without `Perpetual.pushes`."""
    plan = config.pushes
    if plan is None:
        return task
    rows = tuple(humanoid.rows_of(*plan.parts))
    event = Pushes(
        plan.newtons, plan.every_s, plan.lasts_s, rows, config.sim.control_hz, config.seed, plan.share,
        plan.impulse_ns,
    )  # fmt: skip
    return replace(task, plugins=(*task.plugins, event), compliance=Compliance(drawn=plan.level))


def _rewards(config: Perpetual, humanoid: Humanoid, recovers: bool) -> tuple[RewardTerm, ...]:
    """Eqs. 1 and 2, ours, and where recovery is learned Eq. 4."""
    rewards = phc_reward.imitation_terms(config.faithful)
    if config.root:
        rewards += (RewardTerm("root_position", phc_reward.root_position, config.root),)
    halved = config.style.task_weight if config.style else 1.0
    if config.energy:
        rewards += (phc_reward.energy_term(halved, config.energy_form, config.energy),)
    if config.action_rate:
        rewards += (phc_reward.cost_term(phc_reward.action_rate, config.action_rate, halved),)
    if config.torque_rate:
        limits = torch.tensor(humanoid.model.actuator_forcerange[:, 1]).float()
        rewards += (
            phc_reward.cost_term(phc_reward.torque_rate, config.torque_rate, halved, limits=limits),
        )
    if config.acceleration:
        rough = phc_reward.cost_term(phc_reward.acceleration, config.acceleration, halved)
        rewards += (replace(rough, when="near"),)
    if config.foot_slide:
        soles = _soles(humanoid)
        rewards += (phc_reward.cost_term(phc_reward.foot_slide, config.foot_slide, halved, **soles),)
    if config.help_start:
        rewards += (RewardTerm("residual", reward.residual, 0.1, imitation=False),)
    return recovery_terms(rewards, config.faithful) if recovers else rewards


def _soles(humanoid: Humanoid) -> dict[str, Tensor]:
    """Points of the feet for `phc_reward.foot_slide`."""
    count, shapes = len(humanoid.bodies), shapes_of(humanoid.table, torch.float32)
    still = torch.zeros(count, 3), torch.eye(4)[:1].expand(count, 4)
    points = [foot_points(*still, shapes, [foot]) for foot in humanoid.feet]
    rows = [torch.full((len(p),), foot) for foot, p in zip(humanoid.feet, points, strict=True)]
    return {"rows": torch.cat(rows), "points": torch.cat(points)}


def _help(config: Perpetual) -> SuccessHelp:
    """When help becomes less.

    Half of all episodes succeed, which last 5 s on average, where 76 % come through the two seconds by
    which a motion bin is judged. There are many more bins than clips, so that each is decided less often
    and by more episodes.
    """
    if config.help_by == "bin":
        return SuccessHelp(lower_at=0.8, raise_at=0.6, factor=0.93)
    return SuccessHelp()


def _failure(config: Perpetual, humanoid: Humanoid) -> DoneTerm:
    """When an episode of training has failed."""
    if config.termination == "all":
        return DoneTerm("bodies_too_far", done.bodies_too_far, {"limit": 0.5})
    free = {"bodies": done.all_but_feet(humanoid)}
    if config.termination == "code":
        return DoneTerm("any_body_too_far", done.any_body_too_far, {**free, "limit": 0.25, "grace": 1})
    return DoneTerm("bodies_too_far", done.bodies_too_far, {**free, "limit": 0.5})


def _targets(config: Perpetual, humanoid: Humanoid) -> PDTargets:
    if config.action == "additive":
        return PDTargets("additive")
    ranges = torch.tensor(humanoid.model.jnt_range[1:]).float()
    return PDTargets("absolute", range_scale(ranges))


def build(
    library: Clips,
    config: Perpetual | None = None,
    table: BodyTable | None = None,
    known: RecoveryClips | None = None,
) -> Imitation:
    """Body, reference and task for a library of one skeleton; train it with `perpetual.run.train`.

    table: the body of a policy that goes on to learn, see `fit_humanoid`; by default one is made.
    known: the recovery clips of that policy; by default those of the library.
    """
    config = config or Perpetual()
    widens, rate = table is None or config.widens, config.sim.control_hz
    library, humanoid, reference, report = fitted(library, config.body, rate, table, widens)
    recovery_clips = known_recovery_clips(config, reference, known)
    if recovery_clips is None:
        # Without recovery clips a point goal is practised by a primitive of its own.
        config = replace(config, recovering=replace(config.recovering, primitive="own"))
    guided = recovery_clips is not None
    own = task(config, humanoid, guided)
    built = Imitation(library, humanoid, reference, report, config, own, recovery_clips)
    built = noisy(built, config.noise, config.seed)
    return shaped(built, config.shapes, lambda body: task(config, body, guided))


#: Expected figures: see `benchmarks/perpetual.md`.
RECIPE: dict[str, Any] = {"name": "perpetual", "config": Perpetual, "build": build, "expected": {}}
