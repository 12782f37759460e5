"""Residual Force Control for Agile Human Behavior Imitation and Extended Motion Synthesis.

Yuan and Kitani, NeurIPS 2020; the motion imitation half.

| paper                                   | here                                                  |
|-----------------------------------------|-------------------------------------------------------|
| Sec. 3 PD targets, Eq. 1                | `control.PDTargets` (absolute), MuJoCo position servos |
| Sec. 5 additive action u = q^ + du      | `control.PDTargets` (additive), the default            |
| Sec. 4.1 RFC-Explicit, Eqs. 2, 3        | `control.ExplicitResidual`                             |
| Sec. 4.2 RFC-Implicit, Eqs. 4, 5        | `control.ImplicitResidual`                             |
| App. B.1 world reward, Eqs. 7 to 11     | `env.rewards`, `world_rewards`                    |
| App. B.2 local reward, Eqs. 12 to 14    | `env.rewards`, `local_rewards`                    |
| App. C early termination                | `env.rewards.root_too_low`                          |
| Table 4 PPO                             | `learn.PPOConfig.paper()`                              |
"""

from __future__ import annotations

from typing import Any

import torch

from poise.body import Humanoid
from poise.control import (
    ExplicitResidual,
    HelpSchedule,
    ImplicitResidual,
    LinearHelp,
    PDTargets,
    Residual,
    SuccessHelp,
)
from poise.env import DoneTerm, ObsTerm, RewardTerm, TaskConfig
from poise.env import observations as obs
from poise.env import rewards as reward
from poise.env.frame import TermFunction
from poise.recipes.imitation import Clips, Imitation, fitted
from poise.recipes.residual_force_settings import ResidualForce, most_help


def schedule(config: ResidualForce) -> HelpSchedule | None:
    """How the limit comes down; None where it is constant."""
    most = most_help(config)
    if config.method == "deepmimic" or config.help_limit >= most:
        return None
    final = config.help_limit / most
    if config.help_schedule == "linear":
        return LinearHelp(*config.help_steps, final=final)
    return SuccessHelp(final=final)


def residual(config: ResidualForce, humanoid: Humanoid) -> Residual | None:
    """The kind of help: none, a root wrench, or wrenches on pelvis and feet or on all bodies."""
    most, capped = most_help(config), config.help_capped
    if config.method == "rfc-implicit":
        return ImplicitResidual(most, most, capped=capped)
    if config.method == "rfc-explicit":
        every = config.help_bodies == "all"
        bodies = tuple(range(len(humanoid.bodies))) if every else (0, *humanoid.feet)
        return ExplicitResidual(bodies, most, most, capped=capped)
    return None


def world_rewards(humanoid: Humanoid, faithful: str = "paper") -> tuple[RewardTerm, ...]:
    """Eq. 7 with the paper's weights (0.3, 0.1, 0.5, 0.1) or the code's (0.3, 0.1, 0.45, 0.1)."""
    code = faithful == "code"
    bodies = torch.tensor(humanoid.end_effectors)
    return (
        RewardTerm("pose", reward.pose, 0.3, {"alpha": 2.0, "half": code}),
        RewardTerm("velocity", reward.velocity, 0.1, {"alpha": 0.005}),
        RewardTerm("end_effectors", reward.end_effectors, 0.45 if code else 0.5, {"bodies": bodies}),
        RewardTerm("centre_of_mass", reward.centre_of_mass, 0.1, {"alpha": 100.0}),
    )


def local_rewards(humanoid: Humanoid, faithful: str = "paper") -> tuple[RewardTerm, ...]:
    """Eq. 12 with weights (0.5, 0.3, 0.1, 0.1), the code's being (0.5, 0.3, 0.05, 0.1)."""
    code = faithful == "code"
    tips = {"bodies": torch.tensor(humanoid.end_effectors), "alpha": 20.0, "local": True}
    return (
        RewardTerm("pose", reward.pose, 0.5, {"alpha": 2.0, "half": code}),
        RewardTerm("end_effectors", reward.end_effectors, 0.3, tips),
        RewardTerm("root_pose", reward.root_pose, 0.05 if code else 0.1, {"alpha": 300.0, "half": code}),
        RewardTerm("root_velocity", reward.root_velocity, 0.1, {"alpha": 0.1}),
    )


def completion_bonus(config: ResidualForce) -> float:
    """Rewards of the last step that a finished clip is worth: g + g^2 + ... = g / (1 - g)."""
    gamma = config.ppo.gamma
    return gamma / max(1.0 - gamma, 1.0 / config.horizon) if config.completion_bonus else 0.0


def observations(config: ResidualForce, humanoid: Humanoid, frames: int) -> tuple[ObsTerm, ...]:
    """What the policy sees. frames: how many of the next reference frames, each on its own."""
    own: tuple[TermFunction, ...] = (
        obs.root_height,
        obs.root_tilt,
        obs.root_velocity,
        obs.joint_angles,
        obs.joint_velocities,
    )
    if not frames:
        own += (obs.phase,)
    if config.observation != "phase":
        own += (obs.body_positions,)
    if config.observation == "reference":
        own += (obs.target_joints, obs.target_root, obs.target_bodies)
    out = tuple(ObsTerm(t.__name__, t) for t in own)
    if not frames:
        return out
    # Where there is no head, the pelvis takes its place.
    head = {"head": humanoid.head or 0}
    out += (ObsTerm("joints_from_head", obs.joints_from_head, head),)
    for k in range(frames):
        at = {"step": k}
        out += (
            ObsTerm(f"angles_{k + 1}", obs.next_angles, at),
            ObsTerm(f"joints_{k + 1}", obs.next_joints, at | head),
            ObsTerm(f"velocities_{k + 1}", obs.next_velocities, at),
        )
    return out


def task(config: ResidualForce, humanoid: Humanoid) -> TaskConfig:
    """Imitation as terms."""
    help_ = residual(config, humanoid)
    rewards = (world_rewards if config.reward == "world" else local_rewards)(humanoid, config.faithful)
    if help_ is not None:
        weight = 0.05 if config.faithful == "code" else 0.1
        rewards += (RewardTerm("residual", reward.residual, weight, imitation=False),)
    dones = {
        "bodies": DoneTerm("bodies_too_far", reward.bodies_too_far, {"limit": 0.5}),
        "height": DoneTerm("root_too_low", reward.root_too_low, {"margin": 0.1}),
        "below": DoneTerm("root_below", reward.root_below, {"margin": 0.5}),
    }
    frames = {"next frame": (1,), "next two": (1, 2)}.get(config.observation, ())
    return TaskConfig(
        obs=observations(config, humanoid, len(frames)),
        rewards=rewards,
        dones=(dones[config.done],),
        window=frames,
        pd=PDTargets(config.action),
        residual=help_,
        help=schedule(config),
        horizon=config.horizon,
        completion_bonus=completion_bonus(config),
    )


def build(clips: Clips, config: ResidualForce | None = None) -> Imitation:
    """Body, reference and task for a clip, a motion file or a library; train with `.trainer()`."""
    config = config or ResidualForce()
    library, humanoid, reference, report = fitted(clips, config.body, config.sim.control_hz)
    return Imitation(library, humanoid, reference, report, config, task(config, humanoid))


#: What to expect of the default settings (see `results/imitate.csv`, from nothing).
RECIPE: dict[str, Any] = {
    "name": "residual-force",
    "config": ResidualForce,
    "build": build,
    "expected": {"cmu 02_01 walk": {"succ": 0.95, "mpjpe_mm": 60.0}, "tolerance": 0.05},
}
