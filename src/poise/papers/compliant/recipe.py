"""Deep Compliant Control (Lee, Chang and Lee, SIGGRAPH 2022): scenes that are learned while giving way.

| paper                                     | here                                                |
|-------------------------------------------|-----------------------------------------------------|
| Sec. 3 compliance-induced motion, Eq. 8   | `control.compliance`, `env.yielding`                |
| Sec. 5.3, 5.4 scenes, states and rewards  | `scenes`, one file each                             |
| Eq. 10 r = w_imit r_imit + w_task r_task  | `task`                                              |
| Sec. 4 imitation controller               | the universal policy, with a policy on top of it    |
|                                           | that is learned (`on_top`)                          |
| Sec. 4.2 state (s_dyn, u, s_task)         | `seen`: the root, u, and what the scene tells       |
| Sec. 5.4 six fictional forces as actions  | `Compliant.forces`                                  |

The paper's controller learns all of a motion from nothing by an adversarial reward, for 6 to 24 hours:
see `imitation_controller`. Here the policy that tracks any motion follows the displaced goal, and what
is learned on top is what the scene's task asks for beside that, in minutes.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from poise.control import Compliance, Stiffness
from poise.env import DoneTerm, ObsTerm, TaskConfig
from poise.env.terms import obs
from poise.errors import PoiseError, did_you_mean
from poise.learn import PPOConfig
from poise.papers.compliant import terms
from poise.papers.compliant.on_top import Added
from poise.papers.compliant.scenes import SCENES, PlayScene, Stage
from poise.settings import Migration, from_data, validate


@dataclass(frozen=True)
class Compliant:
    """Settings of one run.

    Attributes:
        scene: which scene is learned: those with a reward of their own, ball and door.
        width: m, of the door.
        pushes: N, of pushes at the chest while the ball is balanced.
        seconds: s, how long episodes last where the scene's motion has no end of its own.
        level: level of compliance; None takes what suits the scene.
        stiffness: N/m, a commanded stiffness in place of a level.
        reach: rad, what an action of 1 adds to each joint; 0 leaves the joints to the policy below.
        forces: six fictional forces are actions, where the scene has them.
        imitation_weight: w_imit of Eq. 10.
        task_weight: w_task of Eq. 10.
        cooling: share of the training, at its end, in which the policy's step size falls evenly to a
            tenth, so that it ends as it does on average; 0 for steps of one size.
    """

    scene: str = "ball"
    width: float = 1.0
    pushes: float = 0.0
    seconds: float = 6.0
    level: float | None = None
    stiffness: float | None = None
    reach: float = 0.0
    forces: bool = True
    imitation_weight: float = 0.5
    task_weight: float = 0.5
    cooling: float = 0.4
    num_envs: int = 128
    seed: int = 0
    # The paper's networks. Its rate of 1e-5, its gamma of .95 and its noise of 6 degrees are not taken:
    # this learns in minutes, over 33 control steps, with a noise of .3 of what an action may add.
    ppo: PPOConfig = PPOConfig(
        policy_hidden=(256, 256, 256), value_hidden=(256, 256, 256), gamma=0.97, std=0.3,
        policy_lr=3e-4, minibatch=512,
    )  # fmt: skip

    def __post_init__(self) -> None:
        validate(self)
        if self.scene not in LEARNED:
            hint = did_you_mean(self.scene, LEARNED)
            raise PoiseError(f"the scene '{self.scene}' has no reward to learn from", hint=hint)
        if not 0 <= self.cooling <= 1:
            raise PoiseError(f"cooling must lie in 0 to 1, got {self.cooling:g}", "compliant")
        if not 0.5 <= self.seconds <= 600.0:
            raise PoiseError(f"episodes last 0.5 to 600 s, got {self.seconds:g}", "compliant")
        if not (0.0 <= self.reach <= math.pi and (self.reach or self.added(0).forces)):
            what = "reach must lie in 0 to pi, and above 0 where there are no forces to learn"
            raise PoiseError(f"{what}, got {self.reach:g}", "compliant")

    def added(self, seen: int) -> Added:
        """What is learned on top of a policy that sees so many numbers."""
        return Added(seen, self.reach, self.forces and self.scene == "ball")

    def play(self) -> PlayScene:
        """The scene."""
        kind: Any = SCENES[self.scene]
        given = {"ball": {"pushes": self.pushes, "seed": self.seed}, "door": {"width": self.width}}
        return kind(**given[self.scene])

    def given(self) -> Compliance | Stiffness | None:
        """How the character gives way; None is what suits the scene."""
        if self.stiffness is not None:
            return Stiffness(self.stiffness, 0.5)
        return None if self.level is None else Compliance(self.level)


#: Scenes with a reward.
LEARNED = ("ball", "door")


def seen(stage: Stage) -> tuple[ObsTerm, ...]:
    """What the policy on top sees."""
    own = (obs.root_height, obs.root_tilt, obs.root_velocity)
    u = ObsTerm("displacement", terms.displacement)
    return (*(ObsTerm(f"own/{t.__name__}", t) for t in own), u, *stage.obs)


def task(base: TaskConfig, stage: Stage, config: Compliant, rate_hz: float) -> TaskConfig:
    """The task of the policy below, with what the scene adds to it (Eq. 10)."""
    imitation = tuple(replace(r, weight=config.imitation_weight * r.weight) for r in base.rewards)
    own = tuple(replace(r, weight=config.task_weight) for r in stage.rewards)
    dones: tuple[DoneTerm, ...] = (*base.dones, *stage.dones)
    return replace(
        base, obs=(*base.obs, *seen(stage)), rewards=(*imitation, *own), dones=dones,
        plugins=stage.plugins, compliance=stage.yields(config.given()), help_by="all", style=(),
        first=1.0 if stage.from_start else base.first, horizon=round(config.seconds * rate_hz),
        completion_bonus=0.0,
    )  # fmt: skip


def config_of(data: Mapping[str, Any], where: Path | str | None = None) -> Compliant:
    """The settings that a run holds as JSON data."""
    return from_data(Compliant, Migration()(data), where)


RECIPE: dict[str, Any] = {"name": "compliant", "config": Compliant}
