"""Sitting down: the planned motion, and who goes to which seat when."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from poise.env.generator_goal import Footprint
from poise.env.recovery.get_up import GetUpPlanner
from poise.env.recovery.seats import BEFORE, Seat, Seats, sit_down
from poise.jobs.open import open_run
from poise.jobs.tracker import Tracker
from poise.kinematics import Kinematics
from poise.motion.rotations import facing
from refusals import refused

CHAIR = Seat(Footprint((3.0, 0.0), (0.5, 0.5)), 0.45)


@pytest.fixture(scope="module")
def tracker() -> Tracker:
    return open_run(None).tracker


@pytest.fixture(scope="module")
def get_up(tracker: Tracker) -> GetUpPlanner:
    assert tracker.recovery_clips is not None
    return GetUpPlanner(tracker.recovery_clips, tracker.humanoid.table, 30.0)


def test_feet_stay_while_it_sits_down(tracker: Tracker, get_up: GetUpPlanner) -> None:
    ease = facing(get_up.recovery_clips.ease, 0.5).double()
    sit = sit_down(tracker.humanoid, ease, 0.45, 30.0)
    kinematics = Kinematics(tracker.humanoid.table)
    for way in (sit.down, sit.up):
        feet = kinematics(way).pos[:, list(tracker.humanoid.feet)]
        assert float((feet - feet[:1]).norm(dim=-1).max()) < 0.01
        low, high = torch.tensor(tracker.humanoid.model.jnt_range[1:]).T
        assert bool(((way[:, 7:] >= low - 1e-6) & (way[:, 7:] <= high + 1e-6)).all())
        # No hinge is faster than people's, and nothing jumps.
        assert float(way[:, 7:].diff(dim=0).abs().max()) * 30 < 10
    torch.testing.assert_close(sit.down[0, :3], ease[:3])
    torch.testing.assert_close(sit.up[-1], sit.down[0], rtol=0, atol=1e-6)
    assert float(sit.down[-1, 2]) == pytest.approx(0.45 + sit.height - 0.01)
    assert float((sit.up[0] - sit.down[-1]).abs().max()) < 0.02


def test_one_goes_there_sits_and_gets_up_while_another_waits(
    tracker: Tracker, get_up: GetUpPlanner
) -> None:
    seats = Seats([CHAIR], tracker.humanoid, get_up, 2, [CHAIR.foot], seed=3)
    here = np.array([0.0, 0.0])
    assert seats.leads(0, 0, here) is None
    to = seats.leads(0, 200, here)
    assert to is not None
    # It is led to the nearest side.
    np.testing.assert_allclose(to, [3.0 - 0.25 - BEFORE, 0.0], atol=1e-9)
    assert seats.leads(1, 200, here) is None and not seats.due(0, here)
    near = np.array([2.0, 0.1])
    assert seats.due(0, near)
    assert tracker.recovery_clips is not None
    stands = facing(tracker.recovery_clips.ease, 0.0).double()
    stands[:2] = torch.tensor(near)
    way = seats.motion(0, 300, stands, None)
    on = CHAIR.foot.depth(way[:, :2]) > 0
    assert 4 * 30 < int(on.sum()) < 12 * 30
    assert seats.sits(0) and not seats.sits(1) and seats.leads(0, 320, near) is None
    for frame in way.numpy():
        seats.watch(0, frame)
    seats.over(0, 700, True)
    (visit,) = seats.visits
    assert (visit.world, visit.step, visit.seat, visit.back) == (0, 300, 0, True)
    assert visit.sat_s > 4.0
    # The other one's turn has come.
    assert seats.leads(0, 701, near) is None and seats.leads(1, 701, here) is not None


def test_no_side_is_free_in_a_corner(tracker: Tracker, get_up: GetUpPlanner) -> None:
    walls = [Footprint((3.0, 0.0), (8.0, 8.0))]
    seats = Seats([CHAIR], tracker.humanoid, get_up, 1, [CHAIR.foot, *walls])
    assert seats.leads(0, 200, np.zeros(2)) is None
    with refused("out-of-range", says="0.35 to 0.5"):
        Seat(CHAIR.foot, 0.9)
