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

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch

from poise.body import BodyConfig, Humanoid
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
from poise.learn import PPOConfig
from poise.motion import Clip
from poise.recipes.imitation import Clips, Imitation, fitted
from poise.settings import Checked, Migration, from_data
from poise.sim import SimConfig


@dataclass(frozen=True)
class ResidualForce(Checked):
    """Settings of one run.

    Attributes:
        method: rfc-implicit, rfc-explicit, or deepmimic (no residual force).
        help_limit: N, the most residual force that is left at the end; the torque limit is the same
            number in N m.
        help_start: N, the limit at the start; None (or a number that is not above help_limit) keeps the
            limit constant, as the paper does.
        help_capped: the limits bound what the policy may ask for. Without, as in the paper, they only
            scale it, and the score card says that the help had no limit.
        help_bodies: what RFC-Explicit acts on: "hip and feet", the paper's example, or "all" bodies, as
            the authors' code.
        help_schedule: from start to end by success (`control.SuccessHelp`) or linear in time over
            `help_steps`, control steps of each world (Skeleton2Humanoid Eq. 9, `control.LinearHelp`).
        reward: world (App. B.1) or local (App. B.2).
        observation: reference (state and next reference frame), phase (the paper's), or
            Skeleton2Humanoid's state with one or two next frames (`env.observations`).
        action: additive or absolute.
        faithful: to the paper or to its authors' code where their values disagree (rotation angle or
            half of it; reward weights).
        done: bodies (mean distance over 0.5 m), height (the paper's root height rule), or below (the
            root 0.5 m lower than the reference's, Skeleton2Humanoid's).
        residual_std: deviation of the noise on the residual action, in units of the limits; `ppo.std` is
            that of the joints. 0.3 is the paper's; with the joints' 0.055 the help is hardly tried.
        completion_bonus: a clip done to its end is worth what holding on as in its last step would be;
            without it the last steps matter little and characters fall in them.
        expert: start from a cloned expert (`jobs.warm_start`); without it PPO starts from nothing.
    """

    method: Literal["rfc-implicit", "rfc-explicit", "deepmimic"] = "rfc-implicit"
    help_limit: float = 0.0
    help_start: float | None = 100.0
    help_capped: bool = True
    help_bodies: Literal["hip and feet", "all"] = "hip and feet"
    help_schedule: Literal["success", "linear"] = "success"
    help_steps: tuple[int, int] = (1600, 16000)
    reward: Literal["world", "local"] = "world"
    observation: Literal["reference", "phase", "next frame", "next two"] = "reference"
    action: Literal["additive", "absolute"] = "additive"
    faithful: Literal["paper", "code"] = "paper"
    done: Literal["bodies", "height", "below"] = "bodies"
    residual_std: float = 0.3
    completion_bonus: bool = True
    expert: bool = True
    num_envs: int = 512
    horizon: int = 300
    seed: int = 0
    body: BodyConfig = BodyConfig()
    sim: SimConfig = SimConfig()
    ppo: PPOConfig = PPOConfig(std=0.055, policy_lr=3e-4)

    @classmethod
    def paper(cls, clip: Clip | None = None, **changes: Any) -> ResidualForce:
        """All that the paper and its supplement state, for a GPU or for hours.

        Args:
            clip: by its length the reward is chosen (Sup. 2): in world coordinates for less than 5 s or
                where no clip is given, else local.
            changes: settings that differ.

        Not stated, and ours: how many worlds share a batch, the friction, how far joint ranges reach
        beyond the motion. Not expressed: Euler steps with stable PD outside of the simulator (here
        MuJoCo's own implicit integrator, with the same gains), gains and torque limits of a body of
        31 kg (here they grow with the body), a policy that is updated for a number of epochs.
        """
        return _stated("paper", clip, changes)

    @classmethod
    def code(cls, clip: Clip | None = None, **changes: Any) -> ResidualForce:
        """All that the authors' code does instead of what the paper states, where both differ.

        That is: kd = 0.1 kp, three times as much for 05_13 and twice for 05_06 and 05_07; half rotation
        angles and other reward weights; a deviation of 0.1; time-outs that count as failures; explicit
        forces on every body.

        Not expressed: targets about a constant bent pose with a scale of 5 at some hinges, weights of
        the feet in the pose reward, reference velocities clipped at 10, ten frames after the end of a
        clip, episodes of whole clips per worker.
        """
        return _stated("code", clip, changes)


#: s; shorter clips are imitated in world coordinates (Sup. 2).
LONG_S = 5.0
#: kd / kp, s, in the authors' code; other clips have 0.1.
_CODE_DAMPING = {"05_06": 0.2, "05_07": 0.2, "05_13": 0.3}


def _stated(
    faithful: Literal["paper", "code"], clip: Clip | None, changes: dict[str, Any]
) -> ResidualForce:
    """What `ResidualForce.paper` and `.code` share."""
    num_envs: int = changes.get("num_envs", 512)
    ppo = PPOConfig.paper(num_envs, faithful)
    damping = 0.2
    if faithful == "code":
        damping = _CODE_DAMPING.get("" if clip is None else clip.name, 0.1)
    stated: dict[str, Any] = {
        "help_limit": 100.0,
        "help_start": None,
        "help_capped": False,
        "help_bodies": "hip and feet" if faithful == "paper" else "all",
        "reward": "local" if clip is not None and clip.seconds >= LONG_S else "world",
        "observation": "phase",
        "action": "absolute",
        "faithful": faithful,
        "done": "height",
        "residual_std": ppo.std,
        "completion_bonus": False,
        "expert": False,
        "num_envs": num_envs,
        # An episode ends with its clip, however long that is.
        "horizon": 100_000,
        "body": BodyConfig(damping=damping, armature=0.01),
        "sim": SimConfig(rate_hz=450.0, control_hz=30.0, integrator="implicitfast"),
        "ppo": ppo,
    }
    return ResidualForce(**(stated | changes))


def most_help(config: ResidualForce) -> float:
    """The highest limit that holds at any time, N and N m."""
    return max(config.help_limit, config.help_start or 0.0)


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


#: What earlier versions called the settings, and what runs did that do not name a setting.
MIGRATION = Migration(
    keys={"finish": "completion_bonus"}, absent={"help_limit": 100.0, "help_start": None}
)


def config_of(data: Mapping[str, Any], where: Path | str | None = None) -> ResidualForce:
    """The settings that a run holds as JSON data, also of earlier versions."""
    return from_data(ResidualForce, MIGRATION(data), where)


#: What to expect of the default settings (see `benchmarks/first_light.json`).
RECIPE: dict[str, Any] = {
    "name": "residual-force",
    "config": ResidualForce,
    "build": build,
    "expected": {"cmu 02_01 walk": {"succ": 0.95, "mpjpe_mm": 60.0}, "tolerance": 0.05},
}
