"""Presets, field by field: the value that the source states, and where it states it."""

from __future__ import annotations

import math
from typing import Any

import pytest

from poise.control import ImplicitResidual
from poise.env import rewards as reward
from poise.jobs.inbetween.inbetween_settings import Inbetween
from poise.jobs.presets import NAMES, preset_of
from poise.papers.perpetual.ablations import StagedPerpetual
from poise.recipes import ResidualForce, build
from poise.recipes.perpetual import build as build_perpetual
from poise.settings import from_data, to_data
from refusals import refused
from toy_human import swing

#: (setting, value, where): Residual Force Control, its supplement ("Sup.") and its code ("facts 4.1").
RFC_PAPER: list[tuple[str, Any, str]] = [
    ("method", "rfc-implicit", "Sec. 4.2"),
    ("help_limit", 100.0, "Sup. 3: residual forces are scaled by 100"),
    ("help_start", None, "Sup. 3: the scale is constant"),
    ("reward", "world", "Sup. 2 (1): short clips"),
    ("observation", "phase", "Sec. 6: the motion phase is added to the state"),
    ("action", "absolute", "Sec. 3, Eq. 1"),
    ("faithful", "paper", "Sup. 2 Eqs. 1 to 8"),
    ("done", "height", "Sup. 3.1: root 0.1 below the minimum"),
    ("residual_std", math.sqrt(0.1), "Sup. 3.1: diagonal elements of Sigma 0.1"),
    ("completion_bonus", False, "not there"),
    ("expert", False, "not there"),
    ("body.damping", 0.2, "Sup. 3: kd = 0.2 kp"),
    ("body.armature", 0.01, "Sup. 3: armature inertia 0.01"),
    ("sim.rate_hz", 450.0, "Sec. 6: the simulation runs at 450 Hz"),
    ("sim.control_hz", 30.0, "Sec. 6: the policy operates at 30 Hz"),
    ("ppo.gamma", 0.95, "Sup. table 2"),
    ("ppo.lam", 0.95, "Sup. table 2"),
    ("ppo.minibatch", 2048, "Sup. table 2"),
    ("ppo.policy_lr", 5e-5, "Sup. table 2"),
    ("ppo.value_lr", 3e-4, "Sup. table 2"),
    ("ppo.clip", 0.2, "Sup. table 2"),
    ("ppo.policy_hidden", (512, 256), "Sup. 3.1"),
    ("ppo.activation", "relu", "Sup. 3.1"),
    ("ppo.std", math.sqrt(0.1), "Sup. 3.1"),
    ("ppo.learn_std", False, "Sup. 3.1"),
]
RFC_CODE: list[tuple[str, Any, str]] = [
    ("faithful", "code", "facts 4.1: half angles, other weights"),
    ("body.damping", 0.1, "facts 4.1: kd = 0.1 kp"),
    ("residual_std", 0.1, "facts 4.1: log-std -2.3"),
    ("ppo.std", 0.1, "facts 4.1: log-std -2.3"),
    ("ppo.epochs", 10, "facts 4.1"),
    ("ppo.policy_grad_norm", 40.0, "facts 4.1"),
    ("ppo.value_hidden", (512, 256), "facts 4.1"),
    ("ppo.entropy_weight", 0.0, "facts 4.1"),
    ("ppo.normalise_returns", False, "facts 4.1: plain MSE value loss"),
    ("ppo.bootstrap_timeouts", False, "facts 4.1: time-outs are terminal"),
    ("ppo.obs_clip", 5.0, "facts 4.1: z-filter, clip 5"),
    ("sim.rate_hz", 450.0, "facts 4.1"),
]
#: Perpetual Humanoid Control ("Sec.") and its code ("facts 4.3"), by which the paper's gaps are filled.
PHC_BOTH: list[tuple[str, Any, str]] = [
    ("goal", "rotations", "Sec. 3.1, s^g-rot"),
    ("shape", False, "Sec. 4: the mean body shape"),
    ("action", "absolute", "Sec. 3.1: q^d = a"),
    ("help_start", 0.0, "Sec. 3.1: no external forces"),
    ("first", 0.0, "Sec. 3.1: a random starting point"),
    ("adaptive_sampling", 0.0, "Sec. 3.1: a random starting point"),
    ("expert", False, "not there"),
    ("composer_clone", False, "not there"),
    ("recovery", True, "Sec. 3.2"),
    ("recovering.demonstrations", 0, "Sec. 3.2, Eq. 3: a point goal"),
    ("recovering.primitive", "own", "Sec. 3.2: P^(F)"),
    ("max_primitives", 3, "Sec. 4: four primitives with that of recovery"),
    ("multiplicative", True, "Sec. 3.2"),
    ("progressive", True, "Sec. 3.2"),
    ("energy", 0.0005, "Sec. 3.1"),
    ("ppo.policy_hidden", (1024, 512), "Sec. 3.1: two layers of 1024 and 512"),
    ("ppo.value_hidden", (1024, 512), "Sec. 3.1"),
    ("composer_hidden", (1024, 512), "Sec. 3.1"),
    ("style.hidden", (1024, 512), "Sec. 3.1"),
    ("style.task_weight", 0.5, "Eq. 1"),
    ("style.style_weight", 0.5, "Eq. 1"),
    ("style.gradient_weight", 5.0, "AMP's 10 / 2; facts 4.3"),
    ("ppo.learn_std", False, "Sec. 3.1: fixed diagonal covariance"),
    ("sim.rate_hz", 60.0, "Sec. 4"),
    ("sim.control_hz", 30.0, "Sec. 4"),
    ("body.damping", 0.1, "facts 4.3: 800/80 to 300/30"),
    ("body.armature", 0.02, "facts 4.3"),
    ("num_envs", 3072, "facts 4.3"),
    ("horizon", 300, "facts 4.3"),
    ("ppo.horizon", 32, "facts 4.3"),
    ("ppo.minibatch", 16_384, "facts 4.3"),
    ("ppo.epochs", 6, "facts 4.3"),
    ("ppo.policy_lr", 2e-5, "facts 4.3"),
    ("ppo.gamma", 0.99, "facts 4.3"),
    ("ppo.lam", 0.95, "facts 4.3"),
    ("ppo.clip", 0.2, "facts 4.3"),
    ("ppo.bound_weight", 10.0, "facts 4.3"),
    ("ppo.policy_grad_norm", 50.0, "facts 4.3"),
    ("ppo.std", math.exp(-2.9), "facts 4.3: log-std -2.9"),
    ("ppo.kl_target", None, "facts 4.3: constant steps"),
    ("ppo.bootstrap_timeouts", True, "facts 4.3"),
    ("ppo.normalise_returns", True, "facts 4.3"),
    ("style.demos", 200_000, "facts 4.3"),
    ("style.replay", 200_000, "facts 4.3"),
    ("style.keep", 0.01, "facts 4.3"),
    ("style.minibatch", 4096, "facts 4.3"),
    ("style.fresh_demos", 512, "facts 4.3"),
    ("style.logit_weight", 0.01, "facts 4.3"),
    ("style.weight_decay", 1e-4, "facts 4.3"),
]
PHC_PAPER: list[tuple[str, Any, str]] = [
    ("faithful", "paper", "Eq. 2: norms"),
    ("energy_form", "paper", "Sec. 3.1: squares"),
    ("termination", "relaxed", "Sec. 3.1: mean over 0.5 m without ankles and toes"),
    ("style.loss", "least_squares", "Sec. 3.1: the loss of AMP"),
    ("style.scale", 1.0, "AMP"),
    ("mining.rule", "uniform", "Sec. 3.2"),
    ("mining.union", "last", "Sec. 3.2: what failed the step before"),
    ("start", "random", "Sec. 3.2: randomly initialised"),
    ("lateral", True, "Sec. 3.2"),
    ("combine", "product", "Eqs. 5, 6"),
]
PHC_CODE: list[tuple[str, Any, str]] = [
    ("faithful", "code", "facts 4.3: mean squared errors"),
    ("energy_form", "code", "facts 4.3: linear"),
    ("termination", "code", "facts 4.3: any body 0.25 m"),
    ("style.loss", "bce", "facts 4.3"),
    ("style.scale", 2.0, "facts 4.3"),
    ("mining.rule", "soft", "facts 4.3"),
    ("mining.union", "recent", "facts 4.3: the last five evaluations"),
    ("mining.memory", 5, "facts 4.3"),
    ("start", "copy", "facts 4.3"),
    ("lateral", False, "facts 4.3"),
    ("combine", "means", "facts 4.3: sum of w mu"),
    ("weights", "relu", "facts 4.3: ends in an activation, no softmax"),
]
#: Harvey et al. 2020 as the facts on in-betweening tell it (section 2), Skeleton2Humanoid Eq. 3.
RTN_PAPER: list[tuple[str, Any, str]] = [
    ("net", "rtn", "S2H Sec. 4.1"),
    ("final", "subject5", "1: split by actor"),
    ("contacts", "harvey", "1"),
    ("fps", 30.0, "1"),
    ("rtn.encoder", (512, 256), "2"),
    ("rtn.decoder", (512, 256), "2"),
    ("rtn.past", 10, "2: ten past frames"),
    ("rtn.longest", 30, "2: P_max; S2H B.2: 5 to 30 frames"),
    ("rtn.noise", 0.5, "2: target noise"),
    ("rtn_training.batch", 32, "2"),
    ("rtn_training.lr", 1e-3, "2: AMSGrad"),
    ("rtn_training.decay", False, "2"),
    ("rtn_training.shortest", 5, "2"),
    ("rtn_training.quat", 1.0, "2"),
    ("rtn_training.pos", 1.0, "2"),
    ("rtn_training.root", 0.5, "2"),
    ("rtn_training.contact", 0.1, "2"),
    ("rtn_training.adversarial", 0.1, "2"),
    ("mirror", False, "2: not confirmed"),
    ("ema", 0.0, "not there"),
]
RTN_CODE: list[tuple[str, Any, str]] = [
    ("rtn.hidden", 768, "2: two of three public codes"),
    ("rtn_training.adversarial", 0.01, "2"),
    ("rtn_training.slide", 0.1, "2"),
    ("mirror", True, "2: in both older ones"),
]

TABLES = [
    ("residual-force", "paper", RFC_PAPER),
    ("residual-force", "code", RFC_CODE),
    ("perpetual", "paper", PHC_BOTH + PHC_PAPER),
    ("perpetual", "code", PHC_BOTH + PHC_CODE),
    ("inbetween", "paper", RTN_PAPER),
    ("inbetween", "code", RTN_CODE),
]


@pytest.mark.parametrize(
    ("recipe", "name", "setting", "value", "where"),
    [(recipe, name, *row) for recipe, name, rows in TABLES for row in rows],
)
def test_what_a_source_states(recipe: str, name: str, setting: str, value: Any, where: str) -> None:
    here = preset_of(recipe, name)
    for part in setting.split("."):
        here = getattr(here, part)
    assert here == value, where


def test_the_batch_is_that_of_the_paper() -> None:
    for num_envs in (512, 1000):
        config = ResidualForce.paper(num_envs=num_envs)
        assert config.num_envs == num_envs
        assert 50_000 <= config.ppo.horizon * num_envs < 50_000 + num_envs


def test_the_clip_chooses_reward_and_damping() -> None:
    short, long = swing(0.5, name="90_02"), swing(5.5, name="05_13")
    assert preset_of("residual-force", "paper", short).reward == "world"
    assert preset_of("residual-force", "paper", long).reward == "local"
    assert preset_of("residual-force", "code", short).body.damping == 0.1
    assert preset_of("residual-force", "code", long).body.damping == 0.3


def test_the_presets_build_what_they_say() -> None:
    rfc = build(swing(), ResidualForce.paper(num_envs=2))
    assert isinstance(rfc.task.residual, ImplicitResidual) and rfc.task.help is None
    weights = {t.name: t.weight for t in rfc.task.rewards}
    assert weights["end_effectors"] == 0.5 and weights["residual"] == 0.1
    moving = [r for r in rfc.humanoid.table.rows if r.kp > 0]
    assert moving and all(r.kd == pytest.approx(0.2 * r.kp) for r in moving if r.order)
    code = build(swing(), ResidualForce.code(num_envs=2))
    assert next(t for t in code.task.rewards if t.fn is reward.pose).params["half"] is True
    for config in (StagedPerpetual.paper(num_envs=2), StagedPerpetual.code(num_envs=2)):
        phc = build_perpetual(swing(), config)
        energy = next(t for t in phc.task.rewards if t.fn is reward.energy)
        assert energy.params["form"] == config.energy_form
        # The penalty is not halved with the task's reward.
        assert energy.weight * 0.5 == pytest.approx(-0.0005)
        assert phc.task.residual is None and phc.task.recovery is not None
        env = phc.env(2, threads=1)
        env.reset()
        env.close()


def test_presets_by_name() -> None:
    for recipe, default in (
        ("residual-force", ResidualForce()),
        ("perpetual", StagedPerpetual.additive()),
        ("inbetween", None),
    ):
        for name in NAMES:
            config = preset_of(recipe, name)
            assert from_data(type(config), to_data(config)) == config
        if default is not None:
            assert preset_of(recipe, "fast") == default
    assert isinstance(preset_of("inbetween", "fast"), Inbetween)
    with refused("unknown-preset", says=("papr", "paper")):
        preset_of("perpetual", "papr")
    with refused("unknown-recipe", says="phc"):
        preset_of("phc", "paper")
