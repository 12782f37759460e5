"""Perpetual Humanoid Control for Real-time Simulated Avatars: one policy for a whole library.

Luo, Cao, Winkler, Kitani and Xu, ICCV 2023; the training without fail-state recovery.

| paper                                             | here                                        |
|---------------------------------------------------|---------------------------------------------|
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

import dataclasses
import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from poise.body import BodyConfig
from poise.control import SuccessHelp
from poise.env import Reference, TaskConfig
from poise.errors import PoiseError
from poise.kin import fit_humanoid
from poise.kin.own_body import on_own_body
from poise.learn import CloneConfig, ConvergenceConfig, MiningConfig, PPOConfig
from poise.motion import Clip, ClipLibrary
from poise.recipes import residual_force
from poise.recipes.imitation import Imitation
from poise.sim import SimConfig


@dataclass(frozen=True)
class Perpetual:
    """Settings of one run.

    single: one larger network of the widths `single_hidden` on all clips, in place of primitives of
    `ppo.policy_hidden` and a composer of `composer_hidden`.
    max_primitives: no more than so many; fewer where nothing fails any more.
    start: a primitive begins as a "copy" of the one before it, or "random". lateral: whether it sees the
    hidden layers of the earlier ones. combine, weights: see `nets.Composer`.
    composer_clone: the composer first imitates for each clip the primitive that learned it.
    expert: the first primitive begins as a clone of a scripted expert, by `clone`.
    help_start: N and N m, what the residual force may give at first; 0 does without. In each stage it has
    ended at the share `help_share` of the stage's time, or before by success.
    residual_std: deviation of the noise on the residual action, in units of the limits.
    shares: where in the whole training the first and the last primitive end at the latest.
    evaluate_every: iterations between evaluations of the stage's clips; 0 has them take a tenth of the
    control steps. mining, convergence: what fails is trained more; when a stage has learned what it can.
    """

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
        default_factory=lambda: PPOConfig(std=0.055, policy_lr=3e-4, policy_hidden=(512, 256))
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


def task(config: Perpetual, humanoid: Any) -> TaskConfig:
    """Imitation as terms."""
    plain = residual_force.ResidualForce(
        method="rfc-implicit" if config.help_start else "deepmimic",
        help_limit=0.0,
        help_start=config.help_start,
        residual_std=config.residual_std,
        horizon=config.horizon,
        ppo=config.ppo,
    )
    return replace(
        residual_force.task(plain, humanoid), help=SuccessHelp() if config.help_start else None
    )


def build(library: ClipLibrary | Clip, config: Perpetual | None = None) -> Imitation:
    """Body, reference and task for a library of one skeleton; train it with `perpetual_stages.train`."""
    config = config or Perpetual()
    library = ClipLibrary.of(library) if isinstance(library, Clip) else library
    library, _ = on_own_body(library, config.body)
    humanoid, motions, report = fit_humanoid(library, config.body, config.sim.control_hz)
    config.sim.apply(humanoid.model)
    reference = Reference(humanoid, motions, config.sim.control_hz, library.names, report.cyclic)
    return Imitation(library, humanoid, reference, report, config, task(config, humanoid))


def to_json(config: Perpetual) -> dict[str, Any]:
    """The settings as JSON data."""
    return json.loads(json.dumps(dataclasses.asdict(config)))


def from_json(data: Mapping[str, Any]) -> Perpetual:
    """Settings from JSON data.

    Raises:
        PoiseError: they are of another version.
    """
    try:
        return _filled(Perpetual(), data)
    except (TypeError, KeyError, AttributeError) as problem:
        raise PoiseError(
            f"the run was made by another version of Poise ({problem})", hint="Train it again"
        ) from None


def _filled(default: Any, data: Mapping[str, Any]) -> Any:
    """A dataclass of the default's type; its own dataclasses are filled likewise, lists are tuples."""
    values = {
        k: _filled(getattr(default, k), v) if dataclasses.is_dataclass(getattr(default, k)) else _tuples(v)
        for k, v in data.items()
    }
    return type(default)(**values)


def _tuples(value: Any) -> Any:
    return tuple(_tuples(v) for v in value) if isinstance(value, list) else value


#: Expected figures: see `benchmarks/perpetual.md`.
RECIPE = {"name": "perpetual", "config": Perpetual, "build": build, "expected": {}}
