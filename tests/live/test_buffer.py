"""The jitter buffer, by hand."""

from __future__ import annotations

import numpy as np
import pytest

from poise.live.stream import FADE_S, JitterBuffer, margin
from poise.motion.rotations import ahead_angle, yaw_quat

STILL = np.array([[1.0, 0, 0, 0]])


def filled(delay: float, rate: float, seconds: float, late: float = 0.0, seed: int = 0) -> JitterBuffer:
    """A root that moves along x with 1 m/s; the source's clock is 100 s behind."""
    rng, out = np.random.default_rng(seed), JitterBuffer(delay)
    times = np.arange(0, seconds, 1 / rate)
    for t, came in sorted(((t, t + rng.uniform(0, late)) for t in times), key=lambda x: x[1]):
        out.add(t, 100 + came, np.array([t, 0, 0.0]), STILL)
    return out


@pytest.mark.parametrize("rate", [10, 24, 30, 60, 120])
@pytest.mark.parametrize("late", [0.0, 0.02])
def test_a_steady_motion_is_read_steadily(rate: float, late: float) -> None:
    buffer = filled(0.4, rate, 4.0, late)
    if rate == 120:
        # No more is kept than is needed.
        assert len(buffer.frames) <= 320
    for now in (103.6, 103.8, 103.9):
        pose = buffer.read(now)
        assert pose is not None
        assert pose.root_pos[0] == pytest.approx(now - 100 - margin(0.4), abs=late + 1 / rate + 1e-9)


def test_without_a_buffer_it_is_extrapolated_and_comes_to_rest() -> None:
    buffer = filled(0.0, 30, 1.0)
    last = 29 / 30
    for ahead in (0.02, 0.1, 5.0):
        pose = buffer.read(100 + last + ahead)
        assert pose is not None
        assert pose.root_pos[0] == pytest.approx(last + FADE_S * (1 - np.exp(-ahead / FADE_S)))
    assert buffer.read(110.0).stale_s == pytest.approx(10 - last)  # type: ignore[union-attr]


def test_rotations_go_on_turning() -> None:
    buffer = JitterBuffer(0.0)
    for k in range(3):
        buffer.add(k / 30, 100 + k / 30, np.zeros(3), yaw_quat(0.1 * k)[None])
    pose = buffer.read(100 + 2 / 30 + 0.01)
    assert pose is not None
    assert ahead_angle(pose.rot[0]) == pytest.approx(0.2 + 3 * FADE_S * (1 - np.exp(-0.1)), abs=1e-9)


def test_jumps_are_told_once_and_not_walked_through() -> None:
    buffer = JitterBuffer(0.1)
    for k in range(10):
        buffer.add(k / 30, 100 + k / 30, np.array([0.0 if k < 5 else 5.0, 0, 0]), STILL)
    seen = [buffer.read(100 + t) for t in np.arange(0.1, 0.35, 0.01)]
    assert {float(p.root_pos[0]) for p in seen if p} == {0.0, 5.0}
    assert [p.jumped for p in seen if p].count(True) == 1 and buffer.jumps == 1


@pytest.mark.parametrize("delay", [0.0, 0.1, 0.4])
def test_a_leap_is_told_with_the_first_pose_after_it(delay: float) -> None:
    buffer, told = JitterBuffer(delay), list[tuple[bool, bool]]()
    for k in range(60):
        buffer.add(k / 30, 100 + k / 30, np.array([0.0 if k < 20 else 5.0, 0, 0]), STILL)
        pose = buffer.read(100 + (k + 0.5) / 30)
        assert pose is not None
        told.append((pose.jumped, float(pose.root_pos[0]) > 2.5))
    first = [there for _, there in told].index(True)
    assert [jumped for jumped, _ in told].index(True) == first
    assert sum(jumped for jumped, _ in told) == 1


def test_what_comes_late_or_twice_is_left_out_and_a_new_clock_begins_anew() -> None:
    buffer = filled(0.1, 30, 1.0)
    buffer.add(0.5, 101.0, np.array([9.0, 0, 0]), STILL)
    assert buffer.late == 1 and buffer.read(100.6).root_pos[0] < 1  # type: ignore[union-attr]
    assert JitterBuffer().read(0.0) is None
    late = filled(0.1, 30, 4.0)
    late.add(0.0, 105.0, np.array([7.0, 0, 0]), STILL)
    assert late.read(105.1).root_pos[0] == 7.0  # type: ignore[union-attr]
