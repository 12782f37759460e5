"""Flights of filled gaps: gravity, one level speed from take-off to landing, feet that stay planted."""

from __future__ import annotations

import math

import numpy as np
import pytest

from poise.jobs.inbetween.fill import inbetween
from poise.kinematics.feet import off_floor
from poise.motion import Clip
from poise.motion.rotations import forward_kinematics
from poise.synthesis.limits import ALOFT_M, fall_s, flight_speeds, flown
from toy_human import swing

FPS = 30.0


def ends(way: float) -> np.ndarray:
    return np.array([[0.0, 0.0], [way, 0.0]], dtype=float)


def test_a_keyframe_in_the_air_is_reached_by_gravity() -> None:
    n, h = 29, 0.3
    line = 0.9 + h * np.arange(1, n + 1, dtype=float) / (n + 1)
    got = flown(line, ends(0.5), 0.0, h, FPS)
    up, in_air = got.height, got.in_air
    t = np.arange(n, 0, -1, dtype=float) / FPS
    flight = math.sqrt(2 * h / 9.81)
    assert np.array_equal(in_air, t < flight) and got.falls == pytest.approx((0.0, flight), abs=1e-3)
    np.testing.assert_allclose(up[in_air], 0.9 + h - 0.5 * 9.81 * t[in_air] ** 2, atol=1e-3, rtol=0)
    # Before it, a crouch from which it is pushed off with the speed of the flight; it begins at rest.
    assert float(up[~in_air].min()) == pytest.approx(0.9 - 0.7 * h, abs=0.02)
    assert float(np.abs(up[:5] - 0.9).max()) < 1e-6
    speed = np.diff(up, axis=0) * FPS
    assert float(np.abs(np.diff(speed, axis=0)).max()) * FPS < 20.0
    # The trunk leans ahead while it crouches, and is back where the flight begins.
    assert float(got.lean.max()) == pytest.approx(0.45, abs=0.02)
    assert float(np.abs(got.lean[in_air]).max()) < 1e-6 and float(np.abs(got.lean[:5]).max()) < 1e-6
    # It goes ahead from rest and then evenly in the air, from one to the other without a jump.
    along = got.level[:, 0]
    assert float(np.abs(along[:8]).max()) < 1e-9 and float(along[-1]) == pytest.approx(0.5, abs=0.08)
    even = np.diff(along[in_air], axis=0)
    np.testing.assert_allclose(even, np.broadcast_to(even[:1], even.shape), atol=1e-6, rtol=0)
    assert float(np.abs(np.diff(along, n=2, axis=0) * FPS**2).max()) < 10.0
    # Down again is the same backwards, and two keyframes of one flight lie on one parabola.
    back = flown(np.flip(line, 0), np.flip(ends(0.5), 0), h, 0.0, FPS)
    np.testing.assert_allclose(back.height, np.flip(up, 0), atol=1e-7)
    np.testing.assert_allclose(back.level, np.flip(got.level, 0), atol=1e-7)
    few = np.full((5,), 1.2)
    fell = flown(few, ends(0.5), h, h, FPS)
    down = np.diff(fell.height, n=2, axis=0) * FPS**2
    np.testing.assert_allclose(down, np.full_like(down, -9.81), atol=1e-3, rtol=0)
    assert float(np.abs(np.diff(fell.level, n=2, axis=0)).max()) < 1e-9
    # Too short a gap to come from the floor: no step at its other end.
    short = 0.9 + h * np.arange(1, 4, dtype=float) / 4
    assert float(np.abs(np.diff(flown(short, ends(0.1), 0.0, h, FPS).height)).max()) < 0.12
    assert np.array_equal(flown(line, ends(0.5), 0.0, 0.0, FPS).height, line)


def test_a_flight_keeps_its_level_speed_from_take_off_to_landing() -> None:
    """0.9 m before the top and 0.5 m after it in the same time: one speed, and less way on the floor."""
    places = np.zeros((61, 2))
    places[30, 0], places[60, 0] = 0.9, 1.4
    speeds = flight_speeds(places, (0, 30, 60), {30: 0.3}, FPS)
    assert set(speeds) == {30}
    v = float(speeds[30][0])
    assert 0.5 / 0.9 < v < 0.9 / fall_s(0.3)
    line = np.full((29,), 1.0)
    before = flown(line, places[[0, 30]], 0.0, 0.3, FPS, (None, speeds[30]))
    after = flown(line, places[[30, 60]], 0.3, 0.0, FPS, (speeds[30], None))
    path = np.concatenate((before.level, places[30:31], after.level))[:, 0]
    air = np.concatenate((before.in_air, np.ones(1, dtype=bool), after.in_air))
    even = np.diff(path[air], axis=0) * FPS
    np.testing.assert_allclose(even, np.full_like(even, v), atol=1e-6, rtol=0)
    assert float(np.abs(np.diff(path, n=2, axis=0) * FPS**2).max()) < 25.0
    # What is kept after the last keyframe says how fast it goes there.
    kept = places.copy()
    kept[31:, 0] = 0.9 + 0.05 * np.arange(1, 31)
    assert float(flight_speeds(kept, (0, 30), {30: 0.3}, FPS)[30][0]) == pytest.approx(1.5)


def leap() -> Clip:
    """A figure that stands, is 0.35 m up and 0.5 m ahead a second later, and stands 1 m ahead at 2 s."""
    clip = swing(1.0)
    root = clip.root_pos[:1].repeat(61, 0)
    root[30:] += (0.5, 0.0, 0.0)
    root[31:] += (0.5, 0.0, 0.0)
    root[30, 2] += 0.35
    return clip.replaced(root_pos=root, rot=clip.rot[:1].repeat(61, 0))


def test_feet_stay_planted_before_a_jump_and_after_it() -> None:
    clip = leap()
    made = inbetween(clip, (0, 30, 60), adapt=0)
    assert not any("knee" in f.sentence() or "floor" in f.sentence() for f in made.faults)
    skeleton = clip.skeleton
    pos = made.clip.positions()
    feet = [k for k, n in enumerate(skeleton.names) if n.endswith("Foot")]
    assert len(feet) == 2
    still = pos[:12][:, feet]
    assert abs(still - still[:1]).max() < 0.01
    rest = pos[46:][:, feet]
    assert abs(rest - rest[-1:])[..., :2].max() < 0.02
    # Never under where they stand, and in the air where the root flies.
    assert pos[:, feet, 2].min() > pos[0, feet, 2].min() - 0.02
    root, rot = made.clip.arrays()
    up = off_floor(skeleton, (root, rot))
    assert float(up[30]) == pytest.approx(0.35, abs=0.03)
    assert int((up > ALOFT_M).sum()) > 6
    again = forward_kinematics(skeleton.parents, skeleton.offsets, root, rot)[0]
    np.testing.assert_allclose(again[[0, 30, 60]], clip.positions()[[0, 30, 60]], atol=1e-7)
