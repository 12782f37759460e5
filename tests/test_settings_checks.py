"""Settings refuse what their fields cannot be, when they are made."""

from __future__ import annotations

import pytest

from poise.jobs.inbetween.training import Inbetween
from poise.learn import PPOConfig
from poise.recipes import ResidualForce
from poise.recipes.perpetual_settings import Perpetual, RecoveryPlan
from refusals import refused


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: ResidualForce(method="ppo"), ("unknown-choice", ("method", "rfc-implicit"))),
        (lambda: ResidualForce(reward="wrld"), ("unknown-choice", "world")),
        (lambda: ResidualForce(help_schedule="linea"), ("unknown-choice", "linear")),
        (lambda: ResidualForce(seed=-1), ("out-of-range", "seed")),
        (lambda: ResidualForce(seed=2**70), ("out-of-range", "seed")),
        (lambda: Perpetual(goal="rotation"), ("unknown-choice", "rotations")),
        (lambda: Perpetual(help_by="moment"), ("unknown-choice", ("help_by", "moment"))),
        (lambda: RecoveryPlan(primitive="last"), ("unknown-choice", ("primitive", "last"))),
        (lambda: Inbetween(net="gru"), ("unknown-choice", "transformer, rtn")),
        (lambda: PPOConfig(products="half"), ("unknown-choice", ("products", "half"))),
    ],
)
def test_another_value_is_refused(make, words: tuple) -> None:
    with refused(*words):
        make()
