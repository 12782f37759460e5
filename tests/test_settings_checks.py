"""Settings refuse what their fields cannot be, when they are made."""

from __future__ import annotations

import pytest

from poise.errors import PoiseError
from poise.jobs.inbetween.training import Inbetween
from poise.learn import PPOConfig
from poise.recipes import ResidualForce
from poise.recipes.perpetual_settings import Perpetual, RecoveryPlan


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: ResidualForce(method="ppo"), r"method cannot be 'ppo'. Known: rfc-implicit"),
        (lambda: ResidualForce(reward="wrld"), r"Did you mean 'world'"),
        (lambda: ResidualForce(help_schedule="linea"), r"Did you mean 'linear'"),
        (lambda: ResidualForce(seed=-1), r"seed must be a whole number"),
        (lambda: ResidualForce(seed=2**70), r"seed must be a whole number"),
        (lambda: Perpetual(goal="rotation"), r"Did you mean 'rotations'"),
        (lambda: Perpetual(help_by="moment"), r"help_by cannot be 'moment'"),
        (lambda: RecoveryPlan(primitive="last"), r"primitive cannot be 'last'"),
        (lambda: Inbetween(net="gru"), r"Known: transformer, rtn"),
        (lambda: PPOConfig(products="half"), r"products cannot be 'half'"),
    ],
)
def test_another_value_is_refused(make, words: str) -> None:
    with pytest.raises(PoiseError, match=words):
        make()
