"""A motion that sits is tracked on the seat that was put there, and delivered with it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from poise.formats import read_clip
from poise.jobs.open import open_run
from poise.jobs.track import TrackConfig, track
from poise.jobs.track.placement import place
from poise.jobs.track.surroundings import at_home, on_body
from poise.jobs.tracker import Tracker
from poise.kinematics.supports import Support, read_supports
from refusals import refused
from support_motions import motion
from toy_policy import walk


@pytest.fixture(scope="module")
def tracker() -> Tracker:
    return open_run(None).tracker


def test_a_motion_that_sits_is_tracked_on_its_seat(tracker: Tracker, tmp_path: Path):
    clip = motion("sit_chair", tracker)
    done = track(clip, tracker, controller="lookahead", threads=1)
    (seat,) = done.supports
    assert seat.kind == "seat"
    assert any("seat" in note for note in done.notes)
    # It sits: in the middle the pelvis is where the reference has it, and it is not lost.
    r = done.evaluation.rollouts
    assert not done.failures
    assert abs(float(r.pos[0, 110, 0, 2] - r.ref_pos[0, 110, 0, 2])) < 0.1
    assert done.card.tracked == 1.0
    assert done.card.needs == ()
    # What begins and ends at rest was borne by its weight on average (impulse = change of momentum).
    touched = done.evaluation.recordings[0].contacts
    weight = 9.81 * tracker.humanoid.mass
    assert len(touched) == len(done.evaluation.recordings[0].qpos)
    borne = float(np.mean([rows[:, 5].sum() for rows in touched]))
    assert borne == pytest.approx(weight, rel=0.1)
    # While it sits, more than a third of it stands on the seat, but for moments.
    on_seat = [rows[np.abs(rows[:, 2] - seat.top) < 0.05][:, 5].sum() for rows in touched[80:130]]
    assert np.mean(np.array(on_seat) > weight / 3) > 0.8 and np.median(on_seat) > weight / 2
    paths = done.write(tmp_path).paths
    assert read_supports(paths["supports"]) == done.supports
    assert "seat1" in paths["scene"].read_bytes().decode("latin-1")
    again = read_clip(paths["scene"])
    assert again.frames == done.clip.frames
    assert np.abs(again.world()[0][:, 0] - done.clip.world()[0][:, 0]).max() < 1e-4
    page = paths["report"].read_text(encoding="utf-8")
    assert '"things":[{"kind":"box"' in page.replace(" ", "").replace("\n", "")
    assert '"pushes":{"rows":' in page.replace(" ", "")
    score = json.loads(paths["score"].read_text())
    assert score["tracked"] == 1.0


def test_a_stated_support_is_scaled_as_the_motion(tracker: Tracker):
    placed = place(walk(), tracker)
    assert placed.moved is not None
    seat = Support("seat", (0.4, 0.4, 0.4), (3.0, 1.0, 0.2))
    (there,) = on_body((seat,), placed)
    assert there.size[0] == pytest.approx(0.4 * placed.moved.scale)
    (back,) = at_home((there,), placed)
    assert back.pos == pytest.approx(seat.pos)
    assert back.size == pytest.approx(seat.size)


def test_what_makes_no_sense_is_refused(tracker: Tracker):
    seat = Support("seat", (0.4, 0.4, 0.4), (3.0, 1.0, 0.2))
    for settings in ({"recover": True}, {"count": 2}):
        with refused("single-character-only", says="support"):
            TrackConfig(supports=(seat,), **settings)
    with refused("single-clip-only", says="a support"):
        TrackConfig(supports=(seat,)).check(2)
    inside = Support("seat", (0.6, 0.6, 0.6), (0.0, 0.0, 0.3))
    with refused("bodies-overlap", says="seat1"):
        track(motion("sit_chair", tracker), tracker, controller="policy", supports=(inside,))
