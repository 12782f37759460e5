"""What is measured of a motion whose physics is known."""

from __future__ import annotations

import numpy as np
import pytest
from walker import hops, in_place, leap, played, walk

from poise.body import generate_table
from poise.kinematics.rate import Moved
from toy_human import human

TABLE = generate_table(human())


def test_a_pendulums_walk_is_balanced_at_its_own_rate() -> None:
    moved = Moved(walk(), TABLE)
    # The moments at which the weight goes from foot to foot are smoothed out, hence not 0.
    assert moved.unbalanced(1.0) < 0.3 and moved.unbalanced(2.0) > 0.6
    slow = Moved(walk(step=0.5, seconds=0.6), TABLE)
    assert slow.unbalanced(1.0) < 0.01 and slow.unbalanced(2.0) > 0.6
    # The same frames, asked at half of a doubled rate, are the same motion.
    double = Moved(played(walk(), 2.0), TABLE)
    assert double.unbalanced(0.5) == pytest.approx(moved.unbalanced(1.0), abs=1e-9)
    assert double.unbalanced(1.0) == pytest.approx(moved.unbalanced(2.0), abs=1e-9)


def test_the_gait_of_a_walk() -> None:
    gait = Moved(walk(), TABLE).gait
    assert gait is not None
    assert gait.speed == pytest.approx(0.66 / 0.5, rel=0.05)
    assert gait.steps_s == pytest.approx(2.0, rel=0.05)
    # Legs of 0.82 m on soles 5 cm below the ankle and a little more.
    length = gait.speed**2 / 9.81 / gait.froude
    assert 0.85 < length < 0.92 and gait.rate == pytest.approx(2 * np.sqrt(length / 9.81), rel=0.05)
    assert gait.vault > 0.7
    fast = Moved(played(walk(), 2.0), TABLE).gait
    assert fast is not None
    assert fast.froude == pytest.approx(4 * gait.froude) and fast.rate == pytest.approx(2 * gait.rate)


def test_travel_is_what_standing_feet_tell() -> None:
    there, here = Moved(walk(), TABLE), Moved(in_place(walk()), TABLE)
    assert there.slip is not None and there.slip < 0.1 and there.travels
    assert here.slip is not None and here.slip > 0.8 and not here.travels


def test_a_free_fall_is_no_pull() -> None:
    moved = Moved(hops(), TABLE)
    assert moved.flights == () and moved.pulled(1.0) == (0.0, 0)
    part, spells = moved.pulled(2.0)
    assert spells == 8 and part > 0.1


def test_a_leap_falls_with_gravity() -> None:
    (flight,) = Moved(leap(), TABLE).flights
    assert flight.clear and flight.fall == pytest.approx(9.81, rel=1e-3)
    (fast,) = Moved(played(leap(), 2.0), TABLE).flights
    assert fast.clear and fast.fall == pytest.approx(4 * 9.81, rel=1e-3)
