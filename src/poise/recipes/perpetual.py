"""Perpetual Humanoid Control for Real-time Simulated Avatars: one policy for a whole library.

Luo, Cao, Winkler, Kitani and Xu, ICCV 2023.

| paper                                             | here                                         |
|---------------------------------------------------|----------------------------------------------|
| Sec. 3.1 s^p, s^g-rot, s^g-kp, beta               | `env.observations`                           |
| Sec. 3.1 Eqs. 1, 2, energy; style                 | `env.rewards`, `learn.Amp`                   |
| Sec. 3.1 relaxed early termination                | `env.rewards`, `all_but_feet`                |
| Sec. 3.2 progressive primitives, hard negatives   | `papers.perpetual.primitive_stages`          |
| Alg. 1, line 3: until success no longer improves  | `learn.mining`                               |
| lateral connections, weight sharing               | `learn.primitives`, `networks.ProgressiveNet` |
| fail-states, Eq. 3 point goal, Eq. 4              | `env.recovery`, `env.rewards`                |
| P^(F) on Q^loco; interleaved recovery             | `walking_clips`, `jobs.perpetual.stages`     |
| in place of them, by default: recovery motions    | `env.recovery.planner`                       |
| Eqs. 5, 6 multiplicative composer                 | `learn.composer.Composer`                    |
| Sec. 4, success: mean distance within 0.5 m       | `jobs.perpetual.evaluation`                  |

Three things are ours. One network learns all clips; training by stages is `papers.perpetual`. Training
begins with a clone of a scripted expert. A residual force helps at first, and success takes it away
(`control.SuccessHelp`): at the end of every stage there is no help.
"""

# pyright: reportUnknownArgumentType=false, reportUnknownMemberType=false, reportUnknownVariableType=false
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from poise.body import BodyTable, Humanoid
from poise.control import Compliance, ImplicitResidual, PDTargets, SuccessHelp, range_scale
from poise.env import DoneTerm, ObsTerm, Recovery, Reference, RewardTerm, TaskConfig
from poise.env import observations as obs
from poise.env import rewards as reward
from poise.env.pushes import Pushes
from poise.env.recovery.get_up import QUICK, RecoveryClips, find_recovery_clips
from poise.env.rewards import recovery_terms
from poise.errors import PoiseError
from poise.kinematics import place_on_body
from poise.kinematics.forward import shapes_of
from poise.metrics import foot_points
from poise.motion import Clip, ClipLibrary
from poise.motion.noise import VIDEO, perturb_clip, scaled
from poise.recipes.body_shapes import motions_of, shaped
from poise.recipes.imitation import Clips, Imitation, fitted
from poise.recipes.perpetual_settings import Perpetual, Recovers


def noisy(imitation: Imitation, strengths: Sequence[float], seed: int = 0) -> Imitation:
    """The same task with each clip once more for every strength ("walk~0.25"); unchanged for none.

    A pose estimator's stream jitters, jumps, loses frames and swaps sides, and a policy that has only
    been told clean motion follows all of that. Here the observation's goal and what additive actions add
    to are noisy, while episodes begin on the clean clip, and rewards, failures and evaluations are those
    of the clean clip.

    A clip with noise is in no cycle. Its noise is that of `seed` and of its name.

    Args:
        strengths: 1 is one camera's noise, see `motion.noise.VIDEO`.

    Raises:
        PoiseError: a clip with noise does not have as many frames as without.
    """
    if not strengths:
        return imitation
    reference, own = imitation.reference, imitation.library
    clean, clips, weights = motions_of(reference), list(own.clips), list(own.weights)
    motions, told = list(clean), list(clean)
    for strength in strengths:
        for clip, qpos, weight in zip(own.clips, clean, own.weights, strict=True):
            clips.append(clip.replaced(name=f"{clip.name}~{strength:g}", cyclic=False))
            motions.append(qpos)
            told.append(_told(clip, qpos, strength, seed, imitation))
            weights.append(weight)
    library = ClipLibrary(tuple(clips), tuple(weights))
    cyclic = [*reference.cyclic.tolist(), *(False for _ in clips[len(clean) :])]
    rate = reference.rate_hz
    made = Reference(imitation.humanoid, motions, rate, library.names, cyclic).told(told)
    return replace(imitation, library=library, reference=made)


def _told(clip: Clip, qpos: np.ndarray, strength: float, seed: int, on: Imitation) -> np.ndarray:
    """A clip with noise in the body's coordinates, as `poise track --noise` puts it there."""
    seen = perturb_clip(clip.replaced(cyclic=False), scaled(VIDEO, strength), seed)
    body, rate = on.humanoid, on.reference.rate_hz
    out = place_on_body(seen, body.table, rate_hz=rate, near=body).qpos
    if len(out) != len(qpos):
        what = f"it has {len(out)} frames with noise and {len(qpos)} without"
        raise PoiseError(what, clip.name, "Leave noise out, or this clip", code="length-differs")
    return out


#: Shares of the standing heights, between which the root and above which the body's top stay in a clip
#: that walks or stands.
HEIGHT, TOP = (0.85, 1.15), 0.85
#: Share of a library's frames that are lower than standing; jumps are rarer than crawling.
STANDS = 0.7
#: m/s: in a walk the root is no faster, and limbs move no faster about the root, on average.
ROOT_SPEED, LIMB_SPEED = 2.5, 0.7
#: s: shorter clips are no walk.
SECONDS = 1.0


def walking_clips(reference: Reference) -> Tensor:
    """`(C,)` bool on the CPU: clips that walk or stand, for the recovery primitive.

    The paper picks walking and running by hand for that primitive (Q^loco), so that the motion prior
    knows nothing else; here rules do.

    In all frames the root is about as high, and the body about as tall, as in standing, the root does
    not move fast, and on average the limbs move about the root no faster than in a walk. All clips if
    there is no such one.
    """
    pos, vel = (getattr(reference.pose, k).cpu() for k in ("pos", "linvel"))
    height, top = pos[:, 0, 2], pos[:, :, 2].amax(-1)
    usual, tall = _standing(height), _standing(top)
    good = (height > HEIGHT[0] * usual) & (height < HEIGHT[1] * usual) & (top > TOP * tall)
    good &= vel[:, 0, :2].norm(dim=-1) < ROOT_SPEED
    limbs = (vel - vel[:, :1]).norm(dim=-1).mean(-1)
    starts, lengths = reference.start.cpu().tolist(), reference.length.cpu().tolist()
    least = SECONDS * reference.rate_hz
    out = torch.tensor(
        [
            n >= least and bool(good[s : s + n].all()) and float(limbs[s : s + n].mean()) < LIMB_SPEED
            for s, n in zip(starts, lengths, strict=True)
        ]
    )
    return out if bool(out.any()) else torch.ones_like(out)


def standing(reference: Reference) -> tuple[int, int]:
    """(clip, frame) of the reference of trials: the last frame of the clip that ends upright most
    quietly, on which it then goes on standing. Clips that go round and round end nowhere, and of several
    bodies it is the first."""
    pos, vel = (getattr(reference.pose, k).cpu() for k in ("pos", "linvel"))
    last = (reference.start + reference.length - 1).cpu()
    upright = pos[last, 0, 2] / _standing(pos[:, 0, 2])
    restless = vel[last].norm(dim=-1).mean(-1)
    unfit = (upright < HEIGHT[0]) | (upright > HEIGHT[1]) | reference.cyclic.cpu()
    unfit |= reference.body.cpu() != 0
    clip = int((restless + 1e3 * unfit).argmin())
    return clip, int(reference.length[clip]) - 1


def _standing(heights: Tensor) -> Tensor:
    """The standing height, m, of the heights `(F,)` in all frames of a library."""
    return heights.kthvalue(1 + int(STANDS * (len(heights) - 1))).values


def known_recovery_clips(
    config: Perpetual, reference: Reference, known: RecoveryClips | None = None
) -> RecoveryClips | None:
    """The recovery clips by which a policy learns to come back, on a library's own body; None where
    recovery is not learned by such.

    known: what a policy that goes on comes back by already; it stands in place of the library's, which
        may hold no clip that gets up from the belly, say.
    """
    if not (config.recovery and config.recovering.demonstrations) or config.shapes.own:
        return None
    found = known or find_recovery_clips(reference, standing(reference), walking_clips(reference))
    return replace(found, pace=QUICK) if found is not None and config.recovering.quick else found


#: Parts of which a window of the reference tells the places.
KEY_PARTS = ("head", "hand", "shin", "foot")


def task(config: Perpetual, humanoid: Humanoid, guided: bool = False) -> TaskConfig:
    """Imitation as terms, as the finished policy knows it: with point goals if it learned recovery by
    them. guided: it learned recovery motions, which are tracked as all motions."""
    return stage_task(config, humanoid, "composer" if config.recovery and not guided else None)


def stage_task(config: Perpetual, humanoid: Humanoid, recovers: Recovers | None) -> TaskConfig:
    """The task of a stage that learns to recover as PHC's recovery "primitive" or as its "composer", or
    tracks alone (None). The observations are of the same size in all of them."""
    own = (ObsTerm("self_state", obs.self_state),)
    if config.shape or config.shapes.several:
        own += (ObsTerm("shape", obs.shape, {"sizes": obs.shape_of(humanoid)}),)
    left = None if config.heading == "twist" else torch.tensor(humanoid.left)
    goal = ObsTerm("keypoint_goal", obs.keypoint_goal, parts=obs.KEYPOINT_PARTS)
    if config.goal == "rotations":
        goal = ObsTerm("rotation_goal", obs.rotation_goal, parts=obs.ROTATION_PARTS)
    limit, gamma = config.help_start, config.ppo.gamma
    recovery = None
    if recovers is not None:
        recovery = Recovery.phc(config.faithful, recovers)
        recovery = replace(recovery, drop=replace(recovery.drop, count=config.recovering.falls))
    return TaskConfig(
        obs=(*own, goal, *_more_seen(config, humanoid)),
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
        style=obs.style_terms(humanoid) if config.style else (),
        velocities=tuple(f"{goal.name}.{part}" for part in goal.parts if part.endswith("vel")),
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
        ObsTerm(f"goal_in_{k}", obs.goal_later, {"step": i, **given})
        for i, k in enumerate(config.window)
    )
    last = (ObsTerm("last_action", obs.last_action),) if config.filter else ()
    yields = (ObsTerm("yielding", obs.yielding),) if config.pushes else ()
    return (*last, *later, *yields)


def lengths_seen(config: Perpetual, humanoid: Humanoid) -> Tensor:
    """`(O,)` bool, the observations that are lengths or speeds, m or m/s; none where the policy is told
    the size of its body."""
    bodies, keys = len(humanoid.bodies), len(humanoid.rows_of(*KEY_PARTS))
    hinges, turns = len(humanoid.hinges), 2 if config.goal == "rotations" else 0
    # Height, places and velocities; angular velocities and rotations.
    widths = [(6 * bodies - 2, True), (9 * bodies, False)]
    parts = obs.ROTATION_PARTS if config.goal == "rotations" else obs.KEYPOINT_PARTS
    widths += [(n * bodies, part in ("pos", "linvel", "place")) for part, n in parts.items()]
    widths += [(hinges, False)] if config.filter else []
    widths += [(3 + 3 * keys, True), (turns, False)] * len(config.window)
    # The dial, the root's way, the hinges' turns.
    widths += [(1, False), (3, True), (hinges, False)] if config.pushes else []
    seen = torch.cat([torch.full((n,), length) for n, length in widths])
    return seen.new_zeros(0) if config.shape or config.shapes.several else seen


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
    return replace(task, events=(*task.events, event), compliance=Compliance(drawn=plan.level))


def _rewards(config: Perpetual, humanoid: Humanoid, recovers: bool) -> tuple[RewardTerm, ...]:
    """Eqs. 1 and 2, ours, and where recovery is learned Eq. 4."""
    rewards = reward.imitation_terms(config.faithful)
    if config.root:
        rewards += (RewardTerm("root_position", reward.root_position, config.root),)
    halved = config.style.task_weight if config.style else 1.0
    if config.energy:
        rewards += (reward.energy_term(halved, config.energy_form, config.energy),)
    if config.action_rate:
        rewards += (reward.cost_term(reward.action_rate, config.action_rate, halved),)
    if config.torque_rate:
        limits = torch.tensor(humanoid.model.actuator_forcerange[:, 1]).float()
        rewards += (reward.cost_term(reward.torque_rate, config.torque_rate, halved, limits=limits),)
    if config.acceleration:
        rough = reward.cost_term(reward.acceleration, config.acceleration, halved)
        rewards += (replace(rough, when="near"),)
    if config.foot_slide:
        soles = _soles(humanoid)
        rewards += (reward.cost_term(reward.foot_slide, config.foot_slide, halved, **soles),)
    if config.help_start:
        rewards += (RewardTerm("residual", reward.residual, 0.1, imitation=False),)
    return recovery_terms(rewards, config.faithful) if recovers else rewards


def _soles(humanoid: Humanoid) -> dict[str, Tensor]:
    """Points of the feet for `rewards.foot_slide`."""
    count, shapes = len(humanoid.bodies), shapes_of(humanoid.table)
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
        return DoneTerm("bodies_too_far", reward.bodies_too_far, {"limit": 0.5})
    free = {"bodies": reward.all_but_feet(humanoid)}
    if config.termination == "code":
        return DoneTerm("any_body_too_far", reward.any_body_too_far, {**free, "limit": 0.25, "grace": 1})
    return DoneTerm("bodies_too_far", reward.bodies_too_far, {**free, "limit": 0.5})


def _targets(config: Perpetual, humanoid: Humanoid) -> PDTargets:
    if config.action == "additive":
        return PDTargets("additive", interpolate=config.interpolate)
    ranges = torch.tensor(humanoid.model.jnt_range[1:]).float()
    return PDTargets("absolute", range_scale(ranges), interpolate=config.interpolate)


def build(
    library: Clips,
    config: Perpetual | None = None,
    table: BodyTable | None = None,
    known: RecoveryClips | None = None,
) -> Imitation:
    """Body, reference and task for a library of one skeleton; train it with `perpetual_run.train`.

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


#: Expected figures: see `results/track.csv`.
RECIPE: dict[str, Any] = {"name": "perpetual", "config": Perpetual, "build": build, "expected": {}}
