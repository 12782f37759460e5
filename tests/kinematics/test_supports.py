"""What a motion rests on is found by inverse dynamics, and is as large as the motion leaves room for."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from poise.jobs.open import open_run
from poise.jobs.track.placement import place
from poise.jobs.track.tracking import imitation_of
from poise.jobs.tracker import Tracker
from poise.kinematics import lowest_height
from poise.kinematics.find_supports import FRICTION, asked, find_supports
from poise.kinematics.forward import poses_of
from poise.kinematics.supports import Support, face, read_supports, rectangle
from poise.motion import Clip
from refusals import refused
from support_motions import motion
from toy_policy import walk


@pytest.fixture(scope="module")
def tracker() -> Tracker:
    return open_run(None).tracker


def found(clip: Clip, tracker: Tracker) -> tuple[Support, ...]:
    table = tracker.humanoid.table
    return find_supports(table, *poses_of(clip, table), clip.fps)


@pytest.mark.parametrize(("name", "bent"), [("sit_chair", 0.42), ("sit_low", 0.52), ("sit_stool", 0.30)])
def test_one_that_sits_gets_a_seat_under_its_hips(tracker: Tracker, name: str, bent: float):
    clip, table = motion(name, tracker), tracker.humanoid.table
    (seat,) = found(clip, tracker)
    pos, quat = poses_of(clip, table)
    at = int(4.0 * clip.fps)
    under = float(lowest_height(table, pos, quat)[at, 0])
    assert seat.kind == "seat"
    assert abs(seat.top - under) < 0.08
    # From the hips on forward, below the pelvis.
    hips = pos[at, 0, :2] - np.array(seat.pos[:2])
    assert np.abs(hips).max() < 0.25
    assert abs(hips[1]) < 0.05
    weight = 9.81 * sum(r.mass for r in table.rows)
    assert 0.4 * weight < seat.force_n < 1.1 * weight
    assert seat.start_s < 2.3 < 4.5 < seat.stop_s
    assert "pelvis" in seat.sentence()


def test_stairs_are_as_high_as_the_feet_that_stand_on_them(tracker: Tracker):
    steps = found(motion("stairs", tracker), tracker)
    assert [s.kind for s in steps] == ["step"] * 3
    assert [s.top for s in steps] == pytest.approx([0.17, 0.34, 0.51], abs=0.03)
    assert all(s.size[0] > 0.25 and s.size[1] > 0.2 for s in steps)


@pytest.mark.parametrize(
    ("name", "kind"), [("wall_back", "wall"), ("wall_hands", "wall"), ("table", "table")]
)
def test_one_that_leans_gets_what_it_leans_on(tracker: Tracker, name: str, kind: str):
    assert {s.kind for s in found(motion(name, tracker), tracker)} == {kind}


def test_a_walk_gets_nothing(tracker: Tracker):
    clip = motion("table", tracker)
    still = clip.replaced(root_pos=clip.root_pos[:12], rot=clip.rot[:12])
    assert found(still, tracker) == ()
    r = imitation_of(tracker, [place(walk(), tracker)]).reference
    assert (
        find_supports(tracker.humanoid.table, r.pose.pos.numpy(), r.pose.quat.numpy(), r.rate_hz) == ()
    )


def test_what_stands_still_asks_for_its_weight(tracker: Tracker):
    clip = motion("table", tracker)
    still = clip.replaced(
        root_pos=np.repeat(clip.root_pos[:1], 30, 0), rot=np.repeat(clip.rot[:1], 30, 0)
    )
    wanted = asked(tracker.humanoid.table, *poses_of(still, tracker.humanoid.table), 30.0)
    assert wanted.force[15] == pytest.approx([0.0, 0.0, wanted.weight], abs=1e-6 * wanted.weight)
    below = wanted.com[15] * np.array([1.0, 1.0, 0.0])
    up = np.array([[0.0, 0.0, 1.0]])
    left, forces = wanted.missing(15, below[None], up)
    assert left < 1e-6
    assert forces[0] == pytest.approx([0.0, 0.0, wanted.weight], rel=1e-6)
    # Half an arm aside, half of the weight's moment is missing, and friction gives none of it.
    assert wanted.missing(15, below[None] + [0.25, 0.0, 0.0], up)[0] > 0.2
    assert wanted.missing(15, np.zeros((0, 3)), np.zeros((0, 3)))[0] == pytest.approx(1.0)
    assert 0 < FRICTION < 1


def test_a_support_ends_where_something_passes():
    wanted, core = np.array([[-0.5, -0.5], [0.5, 0.5]]), np.array([[-0.05, -0.05], [0.05, 0.05]])
    ball, radius = np.array([[0.3, 0.0, -0.2]]), np.array([0.1])
    made = rectangle(ball, radius, wanted, core, depth=0.4)
    assert made is not None
    assert 0.14 < made[1, 0] < 0.21
    assert made[0] == pytest.approx([-0.5, -0.5])
    # What lies on it, and what is below its board, are not in the way.
    for z in (0.08, -0.6):
        free = rectangle(np.array([[0.3, 0.0, z]]), radius, wanted, core, depth=0.4)
        assert free == pytest.approx(wanted)
    assert rectangle(np.array([[0.0, 0.0, -0.2]]), radius, wanted, core, depth=0.4) is None


def test_faces_are_right_handed():
    for normal in (np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0]), np.array([0.0, -1.0, 0.0])):
        axes = face(normal, 0.4)
        assert np.linalg.det(axes) == pytest.approx(1.0)
        assert axes[2] == pytest.approx(normal)


def test_supports_are_read_as_they_were_written(tmp_path: Path):
    path = tmp_path / "chair.json"
    seat = Support("seat", (0.4, 0.5, 0.45), (1.0, 2.0, 0.225), 0.3, 1.0, 4.0, ("pelvis",), 500.0)
    path.write_text(json.dumps([seat.to_dict()]))
    assert read_supports(path) == (seat,)
    path.write_text(json.dumps({"size": [0.4, 0.5, 0.45], "pos": [1, 2, 0.225]}))
    (plain,) = read_supports(path)
    assert plain.top == pytest.approx(0.45)
    assert plain.sentence() == "There is a seat 0.45 m high at (1.00, 2.00) m, as was stated."
    assert "stop_s" not in plain.to_dict()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[", ("bad-json",)),
        ("[]", ("out-of-range", "0")),
        ("[1]", ("bad-support", "support 1")),
        ('{"size": [1, 1, 1]}', ("bad-support", "pos")),
        ('{"size": [1, 1, -1], "pos": [0, 0, 0]}', ("bad-support", "size")),
        ('{"size": [1, 1, 1], "pos": [0, 0, 0], "kind": "sofa"}', ("bad-support", "kind")),
        ('{"size": [1, 1, 1], "pos": [0, 0, 0], "colour": 1}', ("bad-support", "colour")),
        ('{"size": [1, 1, NaN], "pos": [0, 0, 0]}', ("bad-support", "size")),
        ('{"size": [1, 1, 1], "pos": [0, 0, 0], "yaw": "much"}', ("bad-support", "yaw")),
    ],
)
def test_a_file_that_makes_no_sense_is_refused(tmp_path: Path, text: str, said: tuple):
    path = tmp_path / "chair.json"
    path.write_text(text)
    with refused(*said):
        read_supports(path)


def test_poses_are_doubles(tracker: Tracker):
    clip, table = motion("sit_chair", tracker), tracker.humanoid.table
    pos, quat = poses_of(clip, table)
    single = find_supports(table, pos.astype(np.float32), quat.astype(np.float32), clip.fps)
    assert len(single) == 1
    assert single[0].size == pytest.approx(found(clip, tracker)[0].size, abs=0.05)
