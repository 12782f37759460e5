"""Help schedules against the paper's numbers and hand-made ones."""

from __future__ import annotations

import math

import pytest

from poise.control import LinearHelp, SuccessHelp
from poise.errors import PoiseError


def test_equation_9_with_the_papers_numbers():
    """S_init 220, alpha 0.1, i_start 100, i_end 1300: 220 N until 100, 160 N at 700, 100 N from 1300."""
    paper = LinearHelp(start=100, stop=1300, final=100 / 220)
    newtons = [round(220 * paper.scale(1.0, i, math.nan), 6) for i in (0, 100, 700, 1300, 1500)]
    assert newtons == [220, 220, 160, 100, 100]


def test_success_lowers_failure_raises_and_between_nothing_moves():
    plan = SuccessHelp(lower_at=0.8, raise_at=0.5, factor=0.9, smallest=0.05)
    assert plan.scale(0.5, 0, 0.8) == pytest.approx(0.45)
    assert plan.scale(0.5, 0, 0.79) == 0.5 == plan.scale(0.5, 0, 0.5)
    assert plan.scale(0.5, 0, 0.49) == pytest.approx(0.5 / 0.9)
    assert plan.scale(0.95, 0, 0.0) == 1.0
    assert plan.scale(0.5, 0, math.nan) == 0.5


def test_the_last_step_is_to_exactly_nothing_and_back_is_possible():
    plan = SuccessHelp(factor=0.9, smallest=0.05)
    assert plan.scale(0.051, 0, 1.0) == 0.0 == plan.scale(0.0, 0, 1.0)
    assert plan.scale(0.0, 0, 0.1) == pytest.approx(0.05 / 0.9)


def test_final_bounds_it_from_below():
    plan = SuccessHelp(final=0.2)
    assert plan.scale(0.2, 0, 1.0) == 0.2 and plan.scale(0.21, 0, 1.0) > 0.2


@pytest.mark.parametrize(
    "make",
    [
        lambda: LinearHelp(5, 5),
        lambda: LinearHelp(0, 5, final=1.5),
        lambda: SuccessHelp(lower_at=0.2),
        lambda: SuccessHelp(factor=1.0),
        lambda: SuccessHelp(final=-0.1),
    ],
)
def test_nonsense_is_refused(make):
    with pytest.raises(PoiseError):
        make()
