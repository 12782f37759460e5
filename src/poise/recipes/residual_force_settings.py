"""The settings of residual force control, see `recipes.residual_force`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from poise.settings import Checked, Migration, from_data, part

if TYPE_CHECKING:
    from poise.body import BodyConfig
    from poise.learn import PPOConfig
    from poise.motion import Clip
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
        num_envs: environments that are simulated at once.
        seed: seed of everything random.
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
    body: BodyConfig = part("poise.body:BodyConfig")
    sim: SimConfig = part("poise.sim:SimConfig")
    ppo: PPOConfig = part("poise.learn:PPOConfig", std=0.055, policy_lr=3e-4)

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
    from poise.body import BodyConfig
    from poise.learn import PPOConfig
    from poise.sim import SimConfig

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


#: What earlier versions called the settings, and what runs did that do not name a setting.
MIGRATION = Migration(
    keys={"finish": "completion_bonus"}, absent={"help_limit": 100.0, "help_start": None}
)


def config_of(data: Mapping[str, Any], where: Path | str | None = None) -> ResidualForce:
    """The settings that a run holds as JSON data, also of earlier versions."""
    return from_data(ResidualForce, MIGRATION(data), where)
