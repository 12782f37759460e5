"""Perpetual Humanoid Control for Real-time Simulated Avatars: one policy for a whole library.

Luo, Cao, Winkler, Kitani and Xu, ICCV 2023; the training without fail-state recovery.

| paper                                             | here                                        |
|---------------------------------------------------|---------------------------------------------|
| Sec. 3.1 s^p, s^g-rot, s^g-kp, beta               | `env.terms.phc_obs`                         |
| Sec. 3.1 Eqs. 1, 2, energy; style                 | `env.terms.phc_reward`, `learn.Amp`         |
| Sec. 3.1 relaxed early termination                | `env.terms.done`, `all_but_feet`            |
| Sec. 3.2 progressive primitives, hard negatives   | `recipes.perpetual_stages`                  |
| Alg. 1, line 3: until success no longer improves  | `learn.converge`, `learn.mining`            |
| lateral connections, weight sharing               | `learn.progressive`, `nets.ProgressiveNet`  |
| Eqs. 5, 6 multiplicative composer                 | `learn.compose`, `nets.Composer`            |
| Sec. 4, success: mean distance within 0.5 m       | `recipes.perpetual_eval`                    |
| the authors' later single network                 | `Perpetual.single`                          |

What is ours: the first primitive begins as a clone of a scripted expert, a residual force helps at first
and is taken away (`control.SuccessHelp`), and the composer begins by imitating for each clip the
primitive that learned it. At the end of every stage there is no help.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import torch

from poise.body import BodyConfig, Humanoid
from poise.control import ImplicitResidual, PDTargets, SuccessHelp, range_scale
from poise.env import DoneTerm, ObsTerm, Reference, RewardTerm, TaskConfig
from poise.env.terms import done, phc_obs, phc_reward, reward
from poise.errors import PoiseError
from poise.kin import fit_humanoid
from poise.kin.own_body import on_own_body
from poise.learn import AmpConfig, CloneConfig, ConvergenceConfig, MiningConfig, PPOConfig
from poise.motion import Clip, ClipLibrary
from poise.recipes.imitation import Imitation
from poise.sim import SimConfig


@dataclass(frozen=True)
class Perpetual:
    """Settings of one run.

    goal: what is told of the next frame, "rotations" and places or "keypoints", which are places alone.
    shape: limb lengths and masses are observed, too. action: "absolute" as in the paper, or "additive"
    to the reference's angles. faithful: where the paper and its code disagree about Eq. 2.
    energy: weight of the energy penalty in the code's form, 0 for none; by default that of the code's
    composer, since with ten times as much falling early would pay, see `phc_reward.energy_term`.
    style: the motion prior, None for none.
    termination: mean distance without the feet ("relaxed"), of "all" bodies, or any body's as in the
    "code". first: share of the episodes that begin on frame 0, as evaluations do.
    single: one larger network of the widths `single_hidden` on all clips, in place of primitives of
    `ppo.policy_hidden` and a composer of `composer_hidden`.
    max_primitives: no more than so many; fewer where nothing fails any more.
    start: a primitive begins as a "copy" of the one before it, or "random". lateral: whether it sees the
    hidden layers of the earlier ones. combine, weights: see `nets.Composer`.
    composer_clone: the composer first imitates for each clip the primitive that learned it.
    expert: the first primitive begins as a clone of a scripted expert, by `clone`.
    help_start: N and N m, what the residual force may give at first; 0 does without. In each stage it
    has ended at the share `help_share` of the stage's time, or before by success.
    residual_std: deviation of the noise on the residual action, in units of the limits.
    shares: where in the whole training the first and the last primitive end at the latest.
    evaluate_every: iterations between evaluations of the stage's clips; 0 has them take a tenth of the
    control steps. mining, convergence: what fails is trained more; when a stage has learned what it can.
    """

    goal: Literal["rotations", "keypoints"] = "rotations"
    shape: bool = False
    action: Literal["absolute", "additive"] = "absolute"
    faithful: Literal["paper", "code"] = "code"
    energy: float = 0.00005
    style: AmpConfig | None = field(default_factory=AmpConfig)
    termination: Literal["relaxed", "all", "code"] = "relaxed"
    first: float = 0.1
    single: bool = False
    max_primitives: int = 3
    start: Literal["copy", "random"] = "copy"
    lateral: bool = False
    combine: Literal["product", "means"] = "product"
    weights: Literal["softmax", "softplus", "relu", "silu"] = "softmax"
    single_hidden: tuple[int, ...] = (1024, 512, 512)
    composer_hidden: tuple[int, ...] = (256, 128)
    composer_clone: bool = True
    expert: bool = True
    help_start: float = 100.0
    help_share: float = 0.8
    residual_std: float = 0.3
    shares: tuple[float, float] = (0.5, 0.8)
    evaluate_every: int = 0
    num_envs: int = 512
    horizon: int = 300
    seed: int = 0
    mining: MiningConfig = field(default_factory=MiningConfig)
    convergence: ConvergenceConfig = field(default_factory=ConvergenceConfig)
    clone: CloneConfig = field(default_factory=CloneConfig)
    body: BodyConfig = field(default_factory=BodyConfig)
    sim: SimConfig = field(default_factory=SimConfig)
    ppo: PPOConfig = field(
        default_factory=lambda: PPOConfig(
            std=0.02,
            policy_lr=2e-5,
            kl_target=0.05,
            lr_range=(5e-6, 3e-4),
            policy_hidden=(512, 256),
        )
    )

    def __post_init__(self) -> None:
        if self.max_primitives < 1:
            raise PoiseError(f"there must be at least 1 primitive, got {self.max_primitives}")
        first, last = self.shares
        if not 0 < first <= last <= 1:
            raise PoiseError(f"shares must rise within (0, 1], got {self.shares}", "Perpetual")
        if not 0 < self.help_share <= 1:
            raise PoiseError(f"help_share must lie in (0, 1], got {self.help_share}", "Perpetual")
        if self.ppo.learn_std:
            raise PoiseError("primitives keep their action noise", "Perpetual", "Set learn_std=False")

    @property
    def method(self) -> str:
        """What a score card calls it."""
        return "perpetual-single" if self.single else "perpetual"

    @property
    def help_limit(self) -> float:
        """N and N m that are left at the end."""
        return 0.0


def task(config: Perpetual, humanoid: Humanoid) -> TaskConfig:
    """Imitation as terms."""
    own = (ObsTerm("self_state", phc_obs.self_state),)
    if config.shape:
        own += (ObsTerm("shape", phc_obs.shape, {"sizes": phc_obs.shape_of(humanoid)}),)
    goal = phc_obs.rotation_goal if config.goal == "rotations" else phc_obs.keypoint_goal
    rewards = phc_reward.imitation_terms(config.faithful)
    if config.energy:
        halved = config.style.task_weight if config.style else 1.0
        rewards += (phc_reward.energy_term(halved, weight=config.energy),)
    if config.help_start:
        rewards += (RewardTerm("residual", reward.residual, 0.1, imitation=False),)
    limit, gamma = config.help_start, config.ppo.gamma
    return TaskConfig(
        obs=(*own, ObsTerm(goal.__name__, goal)),
        rewards=rewards,
        dones=(_failure(config, humanoid),),
        pd=_targets(config, humanoid),
        residual=ImplicitResidual(limit, limit) if limit else None,
        help=SuccessHelp() if limit else None,
        horizon=config.horizon,
        # As many of the last rewards as a character that goes on would earn: g + g^2 + ...
        finish=gamma / max(1.0 - gamma, 1.0 / config.horizon),
        first=config.first,
        style=phc_obs.style_terms(humanoid) if config.style else (),
    )


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


def build(library: ClipLibrary | Clip, config: Perpetual | None = None) -> Imitation:
    """Body, reference and task for a library of one skeleton; train it with `perpetual_stages.train`."""
    config = config or Perpetual()
    library = ClipLibrary.of(library) if isinstance(library, Clip) else library
    library, _ = on_own_body(library, config.body)
    humanoid, motions, report = fit_humanoid(library, config.body, config.sim.control_hz)
    config.sim.apply(humanoid.model)
    reference = Reference(humanoid, motions, config.sim.control_hz, library.names, report.cyclic)
    return Imitation(library, humanoid, reference, report, config, task(config, humanoid))


#: Expected figures: see `benchmarks/perpetual.md`.
RECIPE = {"name": "perpetual", "config": Perpetual, "build": build, "expected": {}}
