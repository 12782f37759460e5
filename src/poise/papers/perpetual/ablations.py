"""Training by stages (PHC, Sec. 3.2), and each ablation of the paper as a switch of its settings."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from poise.errors import PoiseError
from poise.recipes.perpetual_settings import STAGED, Perpetual, RecoveryPlan
from poise.settings import Count, Range, part

if TYPE_CHECKING:
    from poise.papers.perpetual.trajopt import TrajOptConfig


@dataclass(frozen=True)
class StagedPerpetual(Perpetual):
    """Settings of a run by stages: primitives, one after another, and a composer over them.

    Attributes:
        multiplicative: off, there is one network of a primitive's size and nothing that combines.
        progressive: off, all primitives and the composer learn together from the start, on all clips.
        single: one larger network of the widths `single_hidden` on all clips, in place of primitives of
            `ppo.policy_hidden` and a composer of `composer_hidden`.
        max_primitives: no more than so many; fewer where nothing fails any more. That of recovery is one
            more.
        start: a primitive begins as a "copy" of the one before it, or "random".
        lateral: whether it sees the hidden layers of the earlier ones.
        combine, weights: see `learn.composer.Composer`.
        composer_clone: the composer first imitates for each clip the primitive that learned it.
        trajopt: the expert follows trajectories that need no help, which are optimised first, see
            `trajopt`; None takes inverse dynamics, which need help.
        shares: where in the training the first and the last primitive end at the latest; with recovery,
            of what `recovering.share` leaves.
    """

    ORDER: ClassVar[str] = "poise.papers.perpetual.primitive_stages:PrimitiveOrder"

    multiplicative: bool = True
    progressive: bool = True
    single: bool = False
    max_primitives: Count = 3
    start: Literal["copy", "random"] = "copy"
    lateral: bool = False
    combine: Literal["product", "means"] = "product"
    weights: Literal["softmax", "softplus", "relu", "silu"] = "softmax"
    composer_hidden: tuple[int, ...] = (256, 128)
    composer_clone: bool = True
    trajopt: TrajOptConfig | None = part("poise.papers.perpetual.trajopt:TrajOptConfig", made=False)
    shares: Annotated[tuple[float, float], Range(0, 1, above=True, rising=True)] = (0.5, 0.8)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.recovery and self.shares[1] == 1:
            what = "with recovery something must follow the last primitive, got shares up to 1"
            raise PoiseError(what, "Perpetual", code="settings-conflict")
        if self.recovering.primitive == "first" and self.max_primitives < 2:
            what = "where the first primitive recovers there must be another, got max_primitives=1"
            raise PoiseError(what, "Perpetual", code="settings-conflict")
        if self.trajopt is not None and self.shapes.several:
            what = "trajectories are optimised for one body, and there are several shapes"
            raise PoiseError(what, "Perpetual", "Leave one of the two out", code="settings-conflict")
        other = [n for n in ("multiplicative", "progressive") if not getattr(self, n)]
        if len(other) + self.single > 1:
            given = " and ".join([*(["single"] if self.single else []), *(f"no {n}" for n in other)])
            what = f"only one of single, no multiplicative and no progressive can be, got {given}"
            raise PoiseError(
                what, hint="Each of them is another network; leave one out", code="settings-conflict"
            )
        if not self.progressive and self.combine != "product":
            raise PoiseError(
                "primitives that learn with their composer are combined as a product",
                "Perpetual",
                "Set combine='product'",
                code="settings-conflict",
            )
        if not self.progressive and self.max_primitives < 2:
            raise PoiseError(
                "a composer without progressive training needs at least 2 primitives",
                code="settings-conflict",
            )

    @classmethod
    def of(cls, config: Perpetual, **changes: Any) -> StagedPerpetual:
        """The settings of a run of one network, or these, as a run by stages; `changes` differ."""
        own: dict[str, Any] = {"single": True}
        own |= {f.name: getattr(config, f.name) for f in fields(config)}
        return cls(**(own | changes))

    @classmethod
    def paper(cls, **changes: Any) -> StagedPerpetual:
        """All that the paper states, for a GPU and a week. changes: settings that differ.

        PPO, the number of worlds and what of the motion prior the paper leaves open (Sec. 3.1) are the
        code's, see `code`. Of the two ways in which a primitive begins (Sec. 3.2), lateral connections
        to random weights are taken; start="copy", lateral=False is the other.

        Not expressed: the SMPL body with its gains (kd = 0.1 kp here as there), a composer with
        weights that only have to be positive (softmax), and an episode that is worth nothing after its
        last frame.
        """
        from poise.learn import AmpConfig, MiningConfig

        own: dict[str, Any] = {
            "faithful": "paper",
            "energy_form": "paper",
            "termination": "relaxed",
            "style": AmpConfig.phc("paper"),
            "mining": MiningConfig.phc("paper"),
            "start": "random",
            "lateral": True,
            "combine": "product",
            "weights": "softmax",
        }
        return cls(**(_phc() | own | changes))

    @classmethod
    def code(cls, **changes: Any) -> StagedPerpetual:
        """All that the authors' code does, of the version with the paper; changes: settings that differ.

        Not expressed: action noise on the composer's weights (here on the actions), the energy weight of
        0.00005 in the composer's stage alone, gains that differ between the SMPL body's joints, a critic
        and a discriminator that share PPO's optimiser, a new set of clips in memory every 500 epochs,
        fallen starts alone until a given epoch, and an episode that is worth nothing after its end.
        """
        from poise.learn import AmpConfig, MiningConfig

        own: dict[str, Any] = {
            "faithful": "code",
            "energy_form": "code",
            "termination": "code",
            "style": AmpConfig.phc("code"),
            "mining": MiningConfig.phc("code"),
            "start": "copy",
            "lateral": False,
            "combine": "means",
            "weights": "relu",
        }
        return cls(**(_phc() | own | changes))

    @property
    def method(self) -> str:
        """Its name on a score card."""
        kinds = {"single": self.single, "plain": not self.multiplicative, "joint": not self.progressive}
        return "-".join(["perpetual", *(name for name, other in kinds.items() if other)])

    @property
    def primitives(self) -> bool:
        """Whether the policy is made of primitives and a composer."""
        return self.multiplicative and not self.single


#: The settings of one network on all clips.
ONE_NETWORK = {"single": True, "multiplicative": True, "progressive": True, "trajopt": None}
#: What a policy that goes on keeps besides what `jobs.perpetual.perpetual_run.KEPT` names.
KEPT = STAGED - {"shares"}


def going_on(policy: Perpetual, wanted: StagedPerpetual, returns: bool = False) -> StagedPerpetual:
    """The settings of a run that goes on from a policy, see `jobs.perpetual.perpetual_run.going_on`.

    Where recovery is learned, the policy stays as it is, the first primitive of more, unless one network
    is to learn both.

    returns: the policy tracks recovery motions already, so that more primitives learn what it fails, and
        none of its own is needed for recovery.

    Raises:
        PoiseError: the policy is made of primitives.
    """
    from poise.jobs.perpetual import perpetual_run

    config = StagedPerpetual.of(perpetual_run.going_on(policy, wanted), trajopt=None)
    if not wanted.recovery or wanted.single:
        return config
    changes: dict[str, Any] = {"single": False, "multiplicative": True, "progressive": True}
    if returns and wanted.recovering.demonstrations:
        changes["recovering"] = replace(config.recovering, primitive="first")
        changes["max_primitives"] = wanted.max_primitives
    # Primitives have the sizes of the network that becomes the first of them.
    hidden = config.single_hidden if config.single else config.ppo.policy_hidden
    return replace(config, ppo=replace(config.ppo, policy_hidden=hidden), **changes)


def _phc() -> dict[str, Any]:
    """Settings that `paper` and `code` share. The paper: goals, absolute actions, no help, networks of
    1024 and 512 units, three primitives and one for recovery, 60 and 30 Hz. The code: PPO, worlds,
    steps."""
    from poise.body import BodyConfig
    from poise.learn import PPOConfig
    from poise.sim import SimConfig

    return {
        "goal": "rotations",
        "shape": False,
        "heading": "twist",
        "action": "absolute",
        "energy": 0.0005,
        "first": 0.0,
        "recovery": True,
        "recovering": RecoveryPlan(primitive="own", demonstrations=0),
        "multiplicative": True,
        "progressive": True,
        "single": False,
        "max_primitives": 3,
        "composer_hidden": (1024, 512),
        "composer_clone": False,
        "expert": False,
        "trajopt": None,
        "help_start": 0.0,
        "help_by": "all",
        "adaptive_sampling": 0.0,
        "adaptive_over": "clip",
        "cooling": 0.0,
        "num_envs": 3072,
        "horizon": 300,
        "body": BodyConfig(damping=0.1, armature=0.02),
        "sim": SimConfig(rate_hz=60.0, control_hz=30.0),
        "ppo": PPOConfig(
            horizon=32,
            minibatch=16_384,
            epochs=6,
            gamma=0.99,
            lam=0.95,
            clip=0.2,
            policy_lr=2e-5,
            value_lr=2e-5,
            policy_grad_norm=50.0,
            value_grad_norm=50.0,
            policy_hidden=(1024, 512),
            value_hidden=(1024, 512),
            activation="relu",
            std=math.exp(-2.9),
            bound_weight=10.0,
            bound_limit=1.0,
            kl_target=None,
            kl_stop=None,
            normalise_returns=True,
            obs_clip=5.0,
            bootstrap_timeouts=True,
        ),
    }
