"""Clips in place are simulated with their travel and written as they came."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from poise.formats import read_clip
from poise.jobs.complete import complete
from poise.jobs.open import open_run
from poise.jobs.track import track
from poise.jobs.track.direction import Direction
from poise.jobs.track.in_place import with_travel
from poise.jobs.track.simulation import Retake
from poise.jobs.tracker import Tracker
from poise.kinematics.directed import TouchPoint
from poise.kinematics.loops import overlap_of
from poise.motion import Clip
from poise.motion.rotations import quat_distance
from refusals import refused
from toy_policy import walk
from toy_walker import walker

SPEED = 0.9


@pytest.fixture(scope="module")
def tracker() -> Tracker:
    return open_run(None).tracker


@pytest.fixture(scope="module")
def loop() -> Clip:
    return walker(SPEED, period=1.0, duty=0.6)


def stays(clip: Clip) -> bool:
    return bool(np.ptp(clip.root_pos[:, :2], axis=0).max() < 0.3)


def test_a_loop_is_written_as_a_loop_in_place(tracker: Tracker, loop: Clip, tmp_path: Path) -> None:
    made = track(loop, tracker, controller="policy", supports="none")
    assert made.travel is not None and made.travel.travel.speed == pytest.approx(SPEED, rel=0.03)
    # What is simulated travels for several periods.
    source = made.placed.source
    assert source.frames == 4 * 30 + 1
    way = float(np.linalg.norm(source.root_pos[-1, :2] - source.root_pos[0, :2]))
    assert way == pytest.approx(4 * SPEED, rel=0.03)
    assert sum("walks in place at 0.90 m/s" in n for n in made.notes) == 1
    assert made.clip.frames == loop.frames and stays(made.clip)
    np.testing.assert_allclose(made.clip.root_pos[0], made.clip.root_pos[-1], atol=1e-9)
    apart = quat_distance(torch.tensor(made.clip.rot[0]), torch.tensor(made.clip.rot[-1]))
    assert float(apart.max()) < 1e-6
    files = made.save(tmp_path)
    again = read_clip(files["simulated"])
    assert again.frames == loop.frames and overlap_of(again) == 1 and stays(again)
    assert stays(read_clip(files["body"]))


def test_the_travel_may_stay(tracker: Tracker, loop: Clip) -> None:
    made = track(loop, tracker, controller="policy", supports="none", in_place="travel")
    way = made.clip.root_pos[-1] - made.clip.root_pos[0]
    assert made.clip.frames == loop.frames
    assert float(np.linalg.norm(way[:2])) == pytest.approx(SPEED, rel=0.05)


def test_kept_is_as_it_is(tracker: Tracker, loop: Clip) -> None:
    made = track(loop, tracker, controller="policy", supports="none", in_place="keep")
    assert made.travel is None and made.placed.source.frames == loop.frames
    assert not any("in place" in n for n in made.notes)


def test_a_clip_that_travels_is_untouched(tracker: Tracker) -> None:
    clip = walk(0, 30)
    auto, keep = (
        track(clip, tracker, controller="policy", supports="none", in_place=mode)
        for mode in ("auto", "keep")
    )
    assert auto.travel is None
    np.testing.assert_array_equal(auto.clip.rot, keep.clip.rot)
    np.testing.assert_array_equal(auto.clip.root_pos, keep.clip.root_pos)
    assert auto.notes == keep.notes


def test_several_clips_keep_their_travel(tracker: Tracker, loop: Clip) -> None:
    made = track([loop, loop], tracker, controller="policy", supports="none")
    assert sum("written with it" in n for n in made.notes) == 2
    assert not stays(made.clip)


def test_a_part_of_a_loop_is_refused(tracker: Tracker, loop: Clip) -> None:
    earlier = track(walk(0, 20), tracker, controller="policy", supports="none")
    assert earlier.simulation is not None
    with refused("range-of-loop"):
        track(loop, tracker, retake=Retake(earlier.simulation, 0.1, 0.3), supports="none")


def test_touch_points_travel_with_the_clip(loop: Clip) -> None:
    travel = with_travel(loop, repeats=False)
    assert travel is not None and travel.clip.frames == loop.frames
    asked = Direction(touches=(TouchPoint("right_hand", 15, (0.3, -0.2, 1.0)),))
    moved = travel.moved(asked).touches[0].point
    np.testing.assert_allclose(moved, (0.3 + 0.5 * SPEED, -0.2, 1.0), atol=0.02)


def test_keyframes_of_a_clip_in_place_are_completed_in_place(tracker: Tracker, loop: Clip) -> None:
    done = complete(loop, (0, 15, 30), tracker, controller="policy", adapt=0)
    assert stays(done.clip) and done.clip.frames == loop.frames
    assert done.travel is not None
    way = done.travel.clip.root_pos[-1] - done.travel.clip.root_pos[0]
    assert float(np.linalg.norm(way[:2])) == pytest.approx(SPEED, rel=0.05)
    assert any("in place" in n for n in done.notes)
