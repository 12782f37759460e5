"""When steps begin, by hand."""

from __future__ import annotations

import numpy as np
import pytest

from poise.live.session import MARGIN_S, MOVES_S, Phase

PERIOD = 1 / 30


@pytest.mark.parametrize("after", [0.001, 0.01, 0.02, 0.032])
def test_steps_come_to_begin_soon_after_the_packets(after: float) -> None:
    """Packets of four people come at the same time in each period, 1 ms jitter."""
    rng, phase, due = np.random.default_rng(0), Phase(PERIOD), 0.0
    for k in range(400):
        phase.add([k * PERIOD + after + rng.uniform(0, 0.001) for _ in range(4)])
        due += PERIOD
        moved = phase.shift(due)
        assert abs(moved) <= MOVES_S
        due += moved
    wait = (due - after) % PERIOD
    assert MARGIN_S / 2 < wait < MARGIN_S + 0.003


def test_packets_at_any_time_leave_steps_where_they_are() -> None:
    rng, phase = np.random.default_rng(0), Phase(PERIOD)
    assert phase.shift(1.0) == 0.0
    moved = 0.0
    for k in range(300):
        phase.add([(k + rng.uniform()) * PERIOD for _ in range(4)])
        moved += phase.shift((k + 1) * PERIOD + moved)
    assert abs(moved) < 0.3
