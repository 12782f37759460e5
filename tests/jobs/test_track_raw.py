"""A motion that trembles is followed without it, and scored beside what came in; raw as it is."""

from __future__ import annotations

from importlib.resources import as_file, files
from pathlib import Path

import numpy as np
import pytest
import torch

from poise.formats import read_clip, write_clip
from poise.formats.point_fit import fit_clip
from poise.jobs.open import open_run
from poise.jobs.track import track
from poise.jobs.track.placement import place
from poise.jobs.tracker import Tracker
from poise.kinematics import Kinematics, clean_clip, examine, heal, sole_slide, without_noise
from poise.metrics import mpjpe_root
from poise.motion import Clip
from poise.motion.keypoints import Keypoints
from poise.motion.rotations import quat_mul, rotvec_to_quat, unwrap_quats
from poise.score import read_score, write_score


@pytest.fixture(scope="module")
def tracker() -> Tracker:
    """The policy that comes with Poise, which walks."""
    return open_run().tracker


@pytest.fixture(scope="module")
def shaky() -> Clip:
    """The walk that comes with Poise, all its joints trembling at 5 Hz."""
    with as_file(files("poise") / "data/walk.bvh") as path:
        walk = read_clip(path)
    phase = np.random.default_rng(0).uniform(0, 2 * np.pi, (len(walk.skeleton), 3))
    turn = 0.06 * np.sin(2 * np.pi * 5.0 * np.arange(walk.frames)[:, None, None] / walk.fps + phase)
    rot = quat_mul(torch.tensor(walk.rot), rotvec_to_quat(torch.tensor(turn)))
    return walk.replaced(rot=unwrap_quats(rot).numpy())


def raw_of(clip: Clip) -> Clip:
    return clip.replaced(skeleton=clip.skeleton.with_source(raw=True))


def test_the_score_stands_beside_what_came_in(tracker: Tracker, shaky: Clip, tmp_path: Path) -> None:
    tracked = track(shaky, tracker, controller="policy")
    raw = tracked.card.raw
    assert raw["noise_hz"] == pytest.approx(5.0, abs=0.1) and 8.0 < raw["noise_mm"] < 60.0
    came = place(raw_of(shaky), tracker)
    pos = Kinematics(tracker.humanoid.table)(torch.tensor(came.qpos)).pos
    sim = tracked.evaluation.rollouts.pos[0]
    assert raw["mpjpe_mm"] == pytest.approx(float(mpjpe_root(sim, pos.to(sim)).mean()), rel=1e-4)
    # The tremble is what the character does not do.
    assert raw["mpjpe_mm"] > tracked.card.mpjpe_mm
    told = f"the character is {raw['mpjpe_mm']:.0f} mm from the motion with it."
    assert any(n.startswith("The score is that against the motion without") and n.endswith(told)
               for n in tracked.notes)  # fmt: skip
    assert any("at 5.0 Hz: the tremble is taken off." in n for n in tracked.notes)
    assert read_score(write_score(tracked.card, tmp_path / "score.json")).raw == raw


def test_a_raw_motion_is_followed_as_it_is(tracker: Tracker, shaky: Clip) -> None:
    calm, rough = place(shaky, tracker).qpos, place(raw_of(shaky), tracker).qpos
    jerk = [np.abs(np.diff(q[:, 7:], 3, axis=0)).mean() for q in (calm, rough)]
    assert jerk[0] < 0.5 * jerk[1]
    tracked = track(raw_of(shaky), tracker, controller="policy")
    assert not tracked.card.raw and "raw" not in tracked.card.to_dict()
    assert not any("tremble" in n for n in tracked.notes)


def test_the_goal_is_what_the_doctor_makes_of_a_trembling_motion(tracker: Tracker, shaky: Clip) -> None:
    healed, followed = heal(shaky), place(shaky, tracker)
    np.testing.assert_array_equal(followed.calm.rot, healed.rot)
    np.testing.assert_array_equal(followed.calm.root_pos, healed.root_pos)
    np.testing.assert_array_equal(followed.qpos, place(raw_of(healed), tracker).qpos)
    # Noise alone taken off, feet go on sliding.
    assert sole_slide(followed.calm) < 0.8 * sole_slide(clean_clip(shaky)[0])


def test_the_goal_of_a_clean_motion_is_that_motion(tracker: Tracker) -> None:
    with as_file(files("poise") / "data/walk.bvh") as path:
        walk = read_clip(path)
    followed = place(walk, tracker)
    assert without_noise(walk)[0] is walk and followed.calm.rot is walk.rot
    np.testing.assert_array_equal(followed.qpos, place(raw_of(walk), tracker).qpos)


def test_a_clean_motion_has_no_raw_score(tracker: Tracker) -> None:
    with as_file(files("poise") / "data/walk.bvh") as path:
        tracked = track(read_clip(path), tracker, controller="policy")
    assert not tracked.card.raw


def test_keypoints_are_scored_beside_what_came_in(tracker: Tracker) -> None:
    with as_file(files("poise") / "data/walk.bvh") as path:
        walk = read_clip(path)
    noise = np.random.default_rng(0).standard_normal((walk.frames, len(walk.skeleton), 3))
    points = Keypoints(walk.skeleton.names, walk.positions() + 0.015 * noise, walk.fps)
    tracked = track(points, tracker, controller="policy")
    raw = tracked.card.raw
    # Three axes of 15 mm each.
    assert raw["noise_mm"] == pytest.approx(26.0, rel=0.1) and np.isnan(raw["noise_hz"])
    assert raw["mpjpe_mm"] > tracked.card.mpjpe_mm
    assert tracked.card.to_dict()["raw"]["noise_hz"] is None
    told = "The keypoints tremble by 26 mm from frame to frame: the tremble is taken off."
    assert told in tracked.notes
    # A clip that was made of them before knows how much it was, and not what it was.
    made = track(fit_clip(points), tracker, controller="policy").card.raw
    assert made["noise_mm"] == raw["noise_mm"] and np.isnan(made["mpjpe_mm"])


def test_raw_is_a_word_of_the_reading(shaky: Clip, tmp_path: Path) -> None:
    write_clip(shaky, tmp_path / "shaky.bvh")
    there, kept = (read_clip(tmp_path / "shaky.bvh", raw=raw) for raw in (False, True))
    assert kept.skeleton.source.raw and not there.skeleton.source.raw
    assert clean_clip(there)[1].noise and not clean_clip(kept)[1].noise
    assert without_noise(kept)[0] is kept
    calm, report = without_noise(there)
    assert report.noise_sentences() and "tremble" not in {f.kind for f in examine(calm).faults}
    # It is told, and stays.
    assert "tremble" in {f.kind for f in examine(kept).faults}
    # What a file remembers of an earlier reading does not count.
    write_clip(kept, tmp_path / "kept.poise.npz")
    assert not read_clip(tmp_path / "kept.poise.npz").skeleton.source.raw
