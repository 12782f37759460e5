"""Stiffness of a standing character and throws at it, in miniature."""

from __future__ import annotations

import math
import statistics
from dataclasses import replace

import numpy as np
import pytest

from poise.control import Compliance, Stiffness
from poise.jobs.open import open_run
from poise.jobs.tracker import Tracker
from poise.papers.compliant.figures import AXES, Measured, measure, slope, throws
from poise.papers.compliant.motions import standing
from refusals import refused


@pytest.fixture(scope="module")
def tracker() -> Tracker:
    return open_run(None).tracker


def test_hands_are_as_stiff_as_commanded(tracker: Tracker) -> None:
    made = measure(tracker, Stiffness(), (30.0, 150.0), threads=1)
    assert len(made) == 2 * 2 * len(AXES) and not any(m.fell for m in made)
    for command in (30.0, 150.0):
        found = [m.stiffness for m in made if m.commanded == command]
        assert 0.75 < statistics.median(found) / command < 1.25


def test_what_did_not_move_or_fell_was_not_measured() -> None:
    one = Measured(10.0, "hand", AXES[0], 2.0, 0.1, False)
    assert one.stiffness == 20.0
    assert math.isnan(replace(one, moved_m=-0.1).stiffness) and math.isnan(
        replace(one, fell=True).stiffness
    )


def test_the_same_throws_at_each_level(tracker: Tracker) -> None:
    found = throws(tracker, Compliance(), (0.0, 0.2), 5, threads=1)
    assert found.impulse.shape == (2, 5) and np.isfinite(found.impulse).sum() >= 8
    # 1 kg at 2 to 3 m/s, and its fall; the ball bounces off with less than it came with.
    assert (found.impulse[0] > 1.0).all() and (found.impulse[0] < 10.0).all()
    assert (found.peak > found.impulse).all() and (found.torque > 1.0).all()
    assert not found.moved[0].any() and (found.moved[1] > 0.0).all()
    assert not found.fell.any() and not found.outside.any()
    again = throws(tracker, Compliance(), (0.0,), 5, threads=1)
    np.testing.assert_array_equal(again.impulse, found.impulse[:1])


def test_a_slope_by_hand() -> None:
    levels, values = (0.0, 0.1, 0.2), np.array([[2.0, 4.0], [1.8, 3.8], [1.6, 3.6]])
    middle, low, high = slope(levels, values)
    # Of the throws -1 and -0.5; their deviation is 0.354.
    assert middle == pytest.approx(-0.75)
    assert high - middle == pytest.approx(1.96 * 0.25 * np.sqrt(2) / np.sqrt(2))
    assert low == pytest.approx(2 * middle - high)


def test_a_policy_that_knows_no_ease(tracker: Tracker) -> None:
    with refused("no-pose-at-ease"):
        standing(replace(tracker, recovery_clips=None), 1.0)
