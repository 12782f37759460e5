"""What no humanoid can do alone, on motions made for it."""

from __future__ import annotations

import math

import numpy as np
import pytest

from poise.body import BodyTable, generate_table
from poise.kinematics import lowest_height
from poise.kinematics.forward import extreme_points
from poise.kinematics.ground import fit_heights
from poise.kinematics.rate import balance_point, hull_distance
from poise.kinematics.repair.needs import AloneRules, longest_alone, not_alone
from poise.motion import Clip, shifted
from toy_human import human, swing, turn

FPS = 30.0


def table_of(clip: Clip) -> BodyTable:
    return generate_table(clip.skeleton, None, [clip])


def standing(clip: Clip, table: BodyTable) -> Clip:
    """The clip lifted onto z = 0."""
    joints = [r.joint for r in table.rows]
    pos, quat = (x[:, joints] for x in clip.world())
    return shifted(clip, (0.0, 0.0, fit_heights(table, pos, quat, clip.fps).lift_m))


def stand(seconds: float = 3.0) -> tuple[Clip, BodyTable]:
    clip = swing(seconds=seconds, fps=FPS)
    table = table_of(clip)
    return standing(clip, table), table


def raised(clip: Clip, height: np.ndarray) -> Clip:
    offset = np.zeros((clip.frames, 3))
    offset[:, 2] = height
    return shifted(clip, offset)


def test_a_body_that_stands_and_swings_is_alone() -> None:
    clip, table = stand()
    assert not_alone(clip, table) == ()
    assert longest_alone(clip, ()) == (0, clip.frames)


def test_held_above_the_floor_is_found_and_the_longest_rest_is_kept() -> None:
    clip, table = stand(4.0)
    height = np.zeros(clip.frames)
    height[20:50] = 0.5
    (found,) = not_alone(raised(clip, height), table)
    assert (found.kind, found.start, found.stop) == ("held", 20, 49)
    assert found.size_m == pytest.approx(0.5, abs=0.03)
    assert found.sentence(FPS).startswith("for 1.0 s from 0.7 s on it is up to 0.4")
    first, stop = longest_alone(clip, [found])
    assert (first, stop) == (53, clip.frames)


def test_what_leads_away_from_a_spell_goes_with_it() -> None:
    """From a platform the body is let down by 0.3 m, touches, and is held for another half second."""
    clip, table = stand(4.0)
    height = np.zeros(clip.frames)
    height[20:50], height[53:66] = 0.5, 0.3
    (found,) = not_alone(raised(clip, height), table)
    assert (found.start, found.stop) == (20, 49) and found.trail == pytest.approx(16, abs=2)
    assert longest_alone(clip, [found])[0] == 50 + found.trail + 3
    # By itself half a second is a jump for all that is known.
    height[20:50] = 0.0
    assert not_alone(raised(clip, height), table) == ()


def test_a_jump_falls_and_a_slow_one_does_not() -> None:
    clip, table = stand(3.0)
    t = np.arange(clip.frames) / FPS - 1.0
    jump = np.where((t >= 0) & (t <= 0.8), 0.5 * 9.81 * t * (0.8 - t), 0.0)
    assert not_alone(raised(clip, jump), table) == ()
    # The same height over twice the time: a fourth of gravity.
    slow = np.where((t >= 0) & (t <= 1.6), 0.125 * 9.81 * t * (1.6 - t), 0.0)
    assert [f.kind for f in not_alone(raised(clip, slow), table)] == ["held"]
    # A fall with gravity for longer than anybody jumps.
    far = np.where((t >= 0) & (t <= 1.4), 0.5 * 9.81 * t * (1.4 - t), 0.0)
    assert [f.kind for f in not_alone(raised(clip, far), table)] == ["held"]


def test_under_its_floor() -> None:
    clip, table = stand(4.0)
    height = np.zeros(clip.frames)
    height[60:] = -0.4
    (found,) = not_alone(raised(clip, height), table)
    assert (found.kind, found.start, found.stop) == ("below", 60, clip.frames - 1)


def leaning(clip: Clip, angle: float) -> Clip:
    """The whole body tilted forward about its feet."""
    rot = clip.rot.copy()
    rot[:, 0] = turn("Y", np.full((clip.frames,), angle))
    pos = clip.root_pos.copy()
    pos[:, 0] += 0.9 * math.sin(angle)
    pos[:, 2] = 0.9 * math.cos(angle)
    return clip.replaced(rot=rot, root_pos=pos)


def test_leaning_on_nothing() -> None:
    clip, table = stand(2.0)
    assert not_alone(standing(leaning(clip, 0.1), table), table) == ()
    found = not_alone(standing(leaning(clip, 0.6), table), table)
    assert [f.kind for f in found] == ["leaning"]
    assert found[0].seconds == pytest.approx(clip.frames / FPS)
    assert "sits, leans or is held" in found[0].sentence(FPS)
    lenient = AloneRules(margin_m=1.0)
    assert not_alone(standing(leaning(clip, 0.6), table), table, lenient) == ()


def sitting(clip: Clip) -> Clip:
    """Thighs level, shins upright, hips at the height of a chair."""
    rot = clip.rot.copy()
    n = clip.frames
    still = np.zeros((n, 4))
    still[:, 0] = 1.0
    for j in range(len(clip.skeleton)):
        rot[:, j] = still
    for side in ("Left", "Right"):
        rot[:, human().index(f"{side}UpLeg")] = turn("Y", np.full((n,), -math.pi / 2).astype(float))
        rot[:, human().index(f"{side}Leg")] = turn("Y", np.full((n,), math.pi / 2).astype(float))
    return clip.replaced(rot=rot)


def test_sitting_on_a_chair_that_is_not_there() -> None:
    clip, table = stand(2.0)
    (found,) = not_alone(standing(sitting(clip), table), table)
    assert found.kind == "leaning"
    assert found.size_m == pytest.approx(0.3, abs=0.12)


def test_extreme_points_reach_as_low_as_the_shapes() -> None:
    clip, table = stand(1.0)
    pos, quat = (x[:, [r.joint for r in table.rows]] for x in clip.world())
    low = lowest_height(table, pos, quat).min(-1)
    np.testing.assert_allclose(extreme_points(table, pos, quat)[..., 2].min(-1), low, atol=1e-7)


def test_hull_distance_by_hand() -> None:
    square = np.array([[[0, 0], [1, 0], [1, 1], [0, 1], [9, 9]]], dtype=float)
    mask = np.array([[True, True, True, True, False]])
    for at, want in (((0.5, 0.5), -0.5), ((2.0, 0.5), 1.0), ((2.0, 2.0), math.sqrt(2)), ((1, 0), 0.0)):
        got = hull_distance(square, mask, np.array([at], dtype=float))
        assert got[0] == pytest.approx(want, abs=0.005 * max(abs(want), 1))
    assert hull_distance(square, ~mask & False, np.array([[0.0, 0.0]]))[0] == np.inf


def test_the_balance_point_of_known_paths() -> None:
    t = np.arange(90) / FPS
    still = np.tile([0.3, -0.2, 0.9], (90, 1))
    balance, weight = balance_point(still, FPS)
    np.testing.assert_allclose(balance, np.tile([0.3, -0.2], (90, 1)), atol=1e-12)
    np.testing.assert_allclose(weight, 1.0, atol=1e-12)
    # Constant speed keeps it under the body, to the very ends.
    even = still + np.stack((1.5 * t, 0 * t, 0 * t), -1)
    np.testing.assert_allclose(balance_point(even, FPS)[0], even[:, :2], atol=1e-9)
    # Constant acceleration a: it lags by z a / g.
    fast = still + np.stack((0.5 * 2.0 * t**2, 0 * t, 0 * t), -1)
    lag = balance_point(fast, FPS)[0][30:60, 0] - fast[30:60, 0]
    # The Gaussian adds a s^2 / 2 to a parabola.
    np.testing.assert_allclose(lag, -0.9 * 2.0 / 9.81 + 0.5 * 2.0 * 0.01, atol=1e-3)
