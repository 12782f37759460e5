"""Motion in place: the travel that feet tell, and clips that none was taken out of."""

from __future__ import annotations

import math

import numpy as np
import pytest

from poise.kinematics import examine, heal
from poise.kinematics.travel import find_travel, in_place, travelled
from poise.motion import Clip
from poise.motion.rotations import quat_distance
from toy_human import swing
from toy_walker import walker


@pytest.mark.parametrize(
    ("speed", "turning", "rise"),
    [
        (1.0, 0.0, 0.0), (0.4, 0.0, 0.0), (-0.8, 0.0, 0.0), (0.0, 1.5, 0.0), (0.0, -1.0, 0.0),
        (1.0, 0.8, 0.0), (0.5, 0.0, 0.25), (0.5, 0.0, -0.25),
    ],
)  # fmt: skip
def test_the_travel_is_that_of_the_feet(speed: float, turning: float, rise: float) -> None:
    travel = find_travel(walker(speed, turning, rise, fps=60.0))
    assert travel is not None
    np.testing.assert_allclose(travel.velocity, (speed, 0.0, rise), atol=0.02)
    assert travel.turning == pytest.approx(turning, abs=0.03)
    assert travel.share > 0.9


@pytest.mark.parametrize("angle", [0.7, 2.4])
def test_the_travel_is_in_the_world_of_the_clip(angle: float) -> None:
    travel = find_travel(turned(walker(1.0), angle))
    assert travel is not None
    expected = (math.cos(angle), math.sin(angle), 0.0)
    np.testing.assert_allclose(travel.velocity, expected, atol=0.02)


def test_rate_and_periods_do_not_matter() -> None:
    for clip in (walker(0.9, fps=24.0), walker(0.9, fps=120.0, periods=3), walker(0.9, period=1.3)):
        travel = find_travel(clip)
        assert travel is not None
        assert travel.speed == pytest.approx(0.9, rel=0.03)


def test_a_foot_that_bears_stands_still_once_the_clip_travels() -> None:
    clip = walker(1.0, 0.8, fps=60.0)
    travel = find_travel(clip)
    assert travel is not None
    moving = travelled(clip, travel)
    foot = moving.positions()[:, clip.skeleton.index("LeftFoot")]
    # It bears for the first 0.6 s.
    assert np.ptp(foot[1:36, :2], axis=0).max() < 0.02
    # A circle of v / w, from its begin along x.
    radius, angle = 1.0 / 0.8, 0.8
    end = (radius * math.sin(angle), radius * (1 - math.cos(angle)))
    np.testing.assert_allclose(moving.root_pos[-1, :2], end, atol=0.03)


def test_taking_the_travel_out_undoes_it() -> None:
    for clip in (walker(1.0, 0.8), walker(0.5, 0.0, 0.25), turned(walker(0.0, 1.2), 1.0)):
        travel = find_travel(clip)
        assert travel is not None
        back = in_place(travelled(clip, travel), travel)
        np.testing.assert_allclose(back.root_pos, clip.root_pos, atol=1e-12)
        assert quat_distance(back.rot, clip.rot).max() < 1e-6


def test_a_clip_that_travels_is_not_in_place() -> None:
    clip = walker(1.0, periods=3)
    travel = find_travel(clip)
    assert travel is not None
    assert find_travel(travelled(clip, travel)) is None


def test_half_of_the_travel_left_in_is_no_motion_in_place() -> None:
    clip = walker(1.0, periods=3)
    way = 0.5 * np.arange(clip.frames)[:, None] / clip.fps * np.array([1.0, 0.0, 0.0])
    assert find_travel(clip.replaced(root_pos=clip.root_pos + way)) is None


def test_standing_gestures_are_not_taken_for_a_walk() -> None:
    stands = walker(0.0)
    assert find_travel(stands) is None
    assert find_travel(swing()) is None
    # Weight that shifts by 10 cm from side to side over feet that stand.
    t = np.arange(61) / 30.0
    still = stands.replaced(
        root_pos=np.repeat(stands.root_pos[:1], 61, 0), rot=np.repeat(stands.rot[:1], 61, 0)
    )
    sway = np.stack((0.0 * t, 0.05 * np.sin(np.pi * t), 0.0 * t), -1)
    assert find_travel(still.replaced(root_pos=still.root_pos + sway)) is None


def test_a_body_that_slides_to_and_fro_is_a_fault_and_no_walk() -> None:
    stands = walker(0.0)
    t = np.arange(91) / 30.0
    still = stands.replaced(
        root_pos=np.repeat(stands.root_pos[:1], 91, 0), rot=np.repeat(stands.rot[:1], 91, 0)
    )
    slide = np.stack((0.2 * np.sin(2 * np.pi * t / 1.5), 0.0 * t, 0.0 * t), -1)
    clip = still.replaced(root_pos=still.root_pos + slide)
    assert find_travel(clip) is None
    assert any(f.kind == "foot slide" for f in examine(clip).faults)


def test_one_foot_that_slides_beside_one_that_stands_is_no_walk() -> None:
    walks, stands = walker(0.6, periods=2), walker(0.0, periods=2)
    rot = np.array(stands.rot)
    leg = [j for j, n in enumerate(walks.skeleton.names) if n.startswith("Left") and "Arm" not in n]
    rot[:, leg] = walks.rot[:, leg]
    right = [j for j, n in enumerate(walks.skeleton.names) if n.startswith("Right") and "Arm" not in n]
    rot[:, right] = stands.rot[:1, right]
    assert find_travel(stands.replaced(rot=rot)) is None


def test_the_doctor_judges_feet_with_the_travel() -> None:
    found = examine(walker(1.0, periods=2, fps=60.0))
    assert found.travel is not None
    assert found.travel.words() == "walks in place at 1.0 m/s"
    assert found.to_dict()["in_place"]["speed_m_per_s"] == pytest.approx(1.0, rel=0.02)
    slides = [f for f in found.faults if f.kind == "foot slide"]
    assert not slides, slides


def test_a_mended_loop_stays_in_place_and_closes() -> None:
    clip = walker(1.0, fps=60.0)
    # The left foot slips by 8 cm in the middle of its stance.
    t = np.arange(clip.frames) / clip.fps
    slip = 0.08 * np.exp(-(((t - 0.3) / 0.08) ** 2))
    j = clip.skeleton.index("LeftUpLeg")
    rot = np.array(clip.rot)
    half = 0.5 * slip / 0.7
    turn = np.stack((np.cos(half), 0 * half, np.sin(half), 0 * half), -1)
    from poise.motion.rotations import quat_mul

    rot[:, j] = quat_mul(turn, rot[:, j])
    healed = heal(clip.replaced(rot=rot))
    assert healed.frames == clip.frames
    assert np.ptp(healed.root_pos[:, :2], axis=0).max() < 0.1
    np.testing.assert_allclose(healed.root_pos[0], healed.root_pos[-1], atol=1e-9)


def turned(clip: Clip, angle: float) -> Clip:
    """The clip turned about the vertical."""
    from poise.motion.rotations import axis_angle_to_quat, quat_mul, quat_rotate

    up = np.array([0.0, 0.0, 1.0], dtype=float)
    turn = axis_angle_to_quat(up, np.asarray(angle, dtype=float))
    rot = clip.rot.copy()
    rot[:, 0] = quat_mul(np.broadcast_to(turn, (len(rot), 4)), rot[:, 0])
    root = quat_rotate(np.broadcast_to(turn, (len(rot), 4)), clip.root_pos)
    return clip.replaced(root_pos=root, rot=rot)
