"""Strength and mass follow the size, and are left alone at the size at which they were tried."""

from __future__ import annotations

import pytest

from poise.body import generate_table
from poise.body.body_table import Strength, default_mass, length_factor
from toy_human import human

TOY_M = 0.82 / 0.491


@pytest.mark.parametrize("height", [1.55, 1.63, 1.70, 1.80])
def test_adults_keep_the_gains_that_were_tried(height):
    assert length_factor(height) == 1.0
    assert Strength.of(62.0, height) == Strength(2.0, 1.0, 2.0)
    assert default_mass(height) == 22.0 * height**2


def test_a_body_of_twice_the_size_is_as_strong_for_its_weight():
    # Twice the length and eight times the mass: 16 in torque, 2^0.5 in time, 32 in inertia.
    one, two = Strength.of(50.0, 2.0), Strength.of(400.0, 4.0)
    assert two.torque == pytest.approx(16 * one.torque)
    assert two.time == pytest.approx(2**0.5 * one.time)
    assert two.inertia == pytest.approx(32 * one.inertia)
    small, less = Strength.of(30.0, 1.4), Strength.of(3.75, 0.7)
    assert small.torque == pytest.approx(16 * less.torque)


def test_the_factors_are_continuous():
    for edge in (1.55, 1.80):
        assert length_factor(edge - 1e-6) == pytest.approx(length_factor(edge + 1e-6), abs=1e-5)
    for edge in (1.2, 1.55, 2.0):
        assert default_mass(edge - 1e-6) == pytest.approx(default_mass(edge + 1e-6), rel=1e-4)


@pytest.mark.parametrize(
    ("height", "low", "high"), [(0.9, 12, 14.5), (1.2, 21, 24.5), (2.0, 87.9, 88.1), (3.5, 450, 490)]
)
def test_masses_of_children_and_giants(height, low, high):
    # Growth charts: medians of 13 kg at 0.9 m and 22.5 kg at 1.2 m.
    assert low < default_mass(height) < high


def test_every_number_of_the_table_scales_by_its_law():
    base, tall = (generate_table(human(h / TOY_M)) for h in (2.5, 3.5))
    s, m = 3.5 / 2.5, default_mass(3.5) / default_mass(2.5)
    assert m == pytest.approx(s**3)
    for a, b in zip(base.rows, tall.rows, strict=True):
        assert b.mass == pytest.approx(a.mass * m)
        assert b.kp == pytest.approx(a.kp * m * s) and b.torque == pytest.approx(a.torque * m * s)
        assert b.kd == pytest.approx(a.kd * m * s**1.5)
        assert b.armature == pytest.approx(a.armature * m * s**2)
        assert b.ranges == a.ranges
