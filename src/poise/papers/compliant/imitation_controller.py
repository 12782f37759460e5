"""Deep Compliant Control (Lee, Chang and Lee, SIGGRAPH 2022): the imitation controller, from nothing.

| paper                                      | here                                                |
|--------------------------------------------|-----------------------------------------------------|
| Sec. 4.1 Eq. 11 r_imit = r_q r_p           | `AmpConfig.product`, `terms.root_place`             |
| Eqs. 12, 13 the discriminator's r_q        | `AmpConfig.compliant`, `terms.posture`              |
| Eq. 14 r_p                                 | `terms.root_place`                                  |
| Sec. 4.2 s = s(q (-) u), two poses, u      | `shifted`, `terms`                                  |
| Sec. 5.1 network, PPO, noise of 6 degrees  | `CompliantImitation.paper`                          |
| Sec. 3, 5.2 compliance                     | `TaskConfig.compliance`                             |

Policy and discriminator both see q (-) u. Scenes that a policy learns on top of one that tracks stand in
`recipe`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import torch

from poise.body import BodyConfig, Humanoid
from poise.control import Compliance, PDTargets
from poise.env import DoneTerm, ObsTerm, RewardTerm, TaskConfig
from poise.env.events import Pushes
from poise.env.terms import done, obs
from poise.errors import PoiseError
from poise.learn import AmpConfig, PPOConfig
from poise.papers.compliant import terms
from poise.papers.compliant.shifted import Shifted
from poise.recipes.imitation import Clips, Imitation, fitted
from poise.settings import Migration, from_data, validate
from poise.sim import SimConfig

#: Three layers of 256 and the discount of Sec. 5.1; the rest is for minutes on a CPU.
_PPO = PPOConfig(
    policy_hidden=(256, 256, 256), value_hidden=(256, 256, 256), gamma=0.95, horizon=32, minibatch=1024,
    epochs=5, std=0.055, policy_lr=3e-4,
)  # fmt: skip


@dataclass(frozen=True)
class CompliantImitation:
    """Settings of one run.

    Attributes:
        style: the discriminator that gives r_q; None takes the distance to the displaced reference's
            pose.
        action: absolute targets, the paper's, or targets added to the displaced reference's angles. With
            these the policy also sees the reference's next angles.
        level: of compliance, alpha; None for a character that does not give way.
        newtons: between which pushes at the hands are drawn; None for none.
    """

    style: AmpConfig | None = field(default_factory=AmpConfig.compliant)
    action: Literal["absolute", "additive"] = "additive"
    level: float | None = 0.16
    newtons: tuple[float, float] | None = (10.0, 60.0)
    num_envs: int = 256
    horizon: int = 300
    seed: int = 0
    body: BodyConfig = BodyConfig()
    sim: SimConfig = SimConfig()
    ppo: PPOConfig = _PPO

    def __post_init__(self) -> None:
        validate(self)
        if self.style is not None and not self.style.product:
            what = "r_imit is the product of r_q and r_p (Eq. 11)"
            raise PoiseError(what, "CompliantImitation", "Set AmpConfig.product, as compliant() does")

    @classmethod
    def paper(cls, few: bool = True, **changes: Any) -> CompliantImitation:
        """All that the paper states: 600 Hz, absolute targets, updates of 2,048 control steps in
        minibatches of 128 at a rate of 1e-5, noise of 6 degrees, kv = 2 sqrt(kp) at kp = 400; for 6 to
        24 hours.

        few: whether the clips are few, see `AmpConfig.compliant`. changes: settings that differ.

        Not stated, and ours: control steps per second (30), how many worlds share an update, passes over
        it, limits of torques. Not expressed: one kp of 300 to 500 for all joints; here gains follow the
        body's size.
        """
        ppo = replace(
            _PPO, horizon=64, minibatch=128, epochs=PPOConfig().epochs, policy_lr=1e-5, value_lr=1e-5,
            std=math.radians(6.0),
        )  # fmt: skip
        stated: dict[str, Any] = {
            "style": AmpConfig.compliant(few), "action": "absolute", "num_envs": 32,
            "body": BodyConfig(damping=0.1), "sim": SimConfig(rate_hz=600.0), "ppo": ppo,
        }  # fmt: skip
        return cls(**(stated | changes))


def observations(config: CompliantImitation) -> tuple[ObsTerm, ...]:
    """(s_dyn, u), and where the displaced reference's root is."""
    u = ObsTerm("displacement", terms.displacement, {"source": "shifted/u"})
    own = (terms.two_poses, terms.turns)
    goal = (obs.target_root, *((obs.target_joints,) if config.action == "additive" else ()))
    before, after = (tuple(ObsTerm(t.__name__, t) for t in terms) for terms in (own, goal))
    return (*before, u, *after)


def task(config: CompliantImitation, humanoid: Humanoid) -> TaskConfig:
    """The controller's task as terms."""
    plugins: tuple[Any, ...] = (Shifted,)
    if config.newtons is not None:
        hands = humanoid.rows_of("hand")
        if not hands:
            raise PoiseError("the body has no hands to push", hint="Set newtons=None")
        hz = config.sim.control_hz
        plugins += (Pushes(config.newtons, (0.5, 1.5), 0.3, hands, hz, config.seed),)
    paid = terms.root_place if config.style else terms.posed_place
    root = torch.tensor([0])
    return TaskConfig(
        obs=observations(config),
        rewards=(RewardTerm(paid.__name__, paid, 1.0),),
        dones=(
            DoneTerm("root_below", done.root_below, {"margin": 0.35}),
            DoneTerm("root_far", done.bodies_too_far, {"limit": 1.0, "bodies": root}),
        ),
        pd=PDTargets(config.action),
        horizon=config.horizon,
        style=(ObsTerm("posture", terms.posture),) if config.style else (),
        compliance=None if config.level is None else Compliance(config.level),
        plugins=plugins,
    )


def build(clips: Clips, config: CompliantImitation | None = None) -> Imitation:
    """Body, reference and task of clips in any order; train with `.trainer(style=config.style)`."""
    config = config or CompliantImitation()
    library, humanoid, reference, report = fitted(clips, config.body, config.sim.control_hz)
    return Imitation(library, humanoid, reference, report, config, task(config, humanoid))


def config_of(data: Mapping[str, Any], where: Path | str | None = None) -> CompliantImitation:
    """The settings that a run holds as JSON data."""
    return from_data(CompliantImitation, Migration()(data), where)


#: See `benchmarks/compliant_imitation.json`.
RECIPE: dict[str, Any] = {"name": "compliant-imitation", "config": CompliantImitation, "build": build}
