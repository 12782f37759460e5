"""Scenes played with compliance and without, in miniature."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from poise.control import Stiffness
from poise.formats import read_clip
from poise.jobs.open import open_run
from poise.jobs.tracker import Tracker
from poise.papers.compliant.scene_play import WORDS, play
from poise.papers.compliant.scenes import (
    Balance,
    Chicken,
    DoorScene,
    HandInHand,
    PullScene,
    Throws,
    TrampolineScene,
)
from poise.papers.compliant.watch import footfalls
from poise.plan import LookaheadConfig
from refusals import refused
from toy_policy import WALK


@pytest.fixture(scope="module")
def tracker() -> Tracker:
    return open_run(None).tracker


def test_hand_in_hand_it_gives_way(tracker: Tracker, tmp_path: Path) -> None:
    made = play(HandInHand(), tracker, read_clip(WALK), Stiffness(500.0, 0.5), count=4, threads=1)
    a, b = made.figures, made.stiff
    assert set(a) == set(b) == set(WORDS)
    assert a["force_mean_n"] < 0.7 * b["force_mean_n"] and a["lost"] < b["lost"]
    assert a["goal_moved_m"] > 0.02 and b["goal_moved_m"] == 0.0
    assert "less than without compliance" in made.sentence()
    # The partner's hand is drawn where the character's is, since they hold one another.
    paths = made.write(tmp_path / "out")
    (mover,) = made.movers
    row = made.imitation.humanoid.bodies.index("lwrist")
    rollouts = made.evaluation.rollouts
    apart = np.linalg.norm(mover.pos[2:] - rollouts.pos[0, 2:, row].numpy(), axis=1)
    assert apart.max() < 0.15
    page = paths["report"].read_text()
    assert '"movers":[{' in page and '"pushed":true' in page and ">goal<" in page
    told = json.loads(paths["figures"].read_text())
    assert told["compliant"] == dict(a) and told["episodes"] == 4
    assert made.clip.frames == read_clip(paths["simulated"]).frames


def test_a_pull_and_throws_are_seen(tracker: Tracker) -> None:
    pulled = play(
        PullScene(15.0, start_s=0.2), tracker, None, Stiffness(200.0), 2, seconds=1.0, threads=1
    )
    for figures in (pulled.figures, pulled.stiff):
        assert figures["force_mean_n"] == pytest.approx(15.0) and figures["lost"] == 0
    assert pulled.figures["goal_moved_m"] > pulled.stiff["goal_moved_m"] == 0.0
    assert pulled.clip.name == "standing" and not pulled.movers
    assert [len(a) for a in pulled.arrows] == [0] * 6 + [1] * 25
    thrown = play(Throws(every_s=(0.8, 0.8)), tracker, None, None, 3, seconds=1.6, threads=1)
    assert thrown.figures["force_peak_n"] > 50.0 and len(thrown.movers) == 1
    assert 1.0 < thrown.figures["impulse_ns"] < 10.0
    # Starts differ, and the mean of the episodes is what is told.
    off = thrown.evaluation.rollouts
    apart = (off.pos[:, 0, 0] - off.ref_pos[:, 0, 0])[:, :2].norm(dim=-1)
    assert float(apart.std()) > 0.01 and thrown.count == 3
    assert thrown.figures["off_m"] == pytest.approx(thrown.episodes["off_m"].mean(), abs=1e-4)
    assert not thrown.notes
    torn = replace(thrown, episodes={**thrown.episodes, "force_peak_n": np.array([1.0, 9e5, 2.0])})
    (note,) = torn.notes
    assert "900,000 N" in note and "nobody bears" in note


def test_after_a_fall_it_gets_up_and_goes_on(tracker: Tracker) -> None:
    heavy = Throws(mass=40.0, speed=(4.0, 4.0), every_s=(7.0, 7.0))
    made = play(heavy, tracker, None, None, 3, seconds=14.0, threads=1, recover=True)
    a = made.episodes
    assert a["falls"].sum() >= 1 and 0 < a["up_again"].sum() <= a["falls"].sum()
    assert {"falls", "up_again"} <= set(made.words) and made.figures["falls"] == a["falls"].sum()
    height = made.evaluation.rollouts.pos[:, :, 0, 2]
    assert bool(((height.amin(1) < 0.4) & (height[:, -1] > 0.8)).any())
    with refused("recovery-not-learned"):
        play(heavy, replace(tracker, recovery_clips=None), None, recover=True)


def test_a_door_is_opened(tracker: Tracker, tmp_path: Path) -> None:
    made = play(DoorScene(1.0), tracker, None, Stiffness(500.0, 0.5), 2, threads=1, name="door")
    for figures in (made.figures, made.stiff):
        assert set(figures) == set(made.words) and len(figures) == len(WORDS) + 4
        assert figures["opened"] == 2.0 and figures["lost"] == 0.0 and figures["angle_rad"] > 0.7
    assert made.figures["across_n"] < made.stiff["across_n"]
    page = made.write(tmp_path / "out")["report"].read_text()
    assert "<title>door, opening" in page and len(made.movers) == 3
    with refused("settings-conflict"):
        play(DoorScene(1.0), tracker, read_clip(WALK), count=2, threads=1)


def test_a_wide_door_takes_a_motion_of_its_own(tracker: Tracker) -> None:
    wide, paper = (
        play(DoorScene(1.7, made_for=m), tracker, None, Stiffness(500.0, 0.5), 2, threads=1)
        for m in (None, 1.0)
    )
    assert wide.figures["opened"] == 2.0 and wide.figures["lost"] == 0.0
    assert wide.figures["angle_rad"] > 0.7 > paper.figures["angle_rad"]


def test_on_a_trampoline(tracker: Tracker) -> None:
    made = play(TrampolineScene(0.1), tracker, None, None, 2, seconds=2.2, threads=1, name="trampoline")
    assert set(made.figures) == set(made.words) and len(made.movers) == 1
    for figures in (made.figures, made.stiff):
        assert figures["plate_m"] > 0.05 and figures["force_peak_n"] > 300.0
        assert abs(figures["energy_j"]) < 1000.0 and abs(figures["foot_low_m"]) < 0.3
    # The plate goes up by about what its actuators do.
    height = made.movers[0].pos[:, 2]
    assert 0.04 < height.max() - height[0] < 0.25


def test_lookahead_tries_in_copies_of_the_scene(tracker: Tracker) -> None:
    scene, tight = TrampolineScene(0.1, first=0.2), {"count": 1, "seconds": 0.6, "threads": 1}
    few = LookaheadConfig(candidates=10, horizon=4)
    alone, ahead, again = (
        play(scene, tracker, None, None, controller=c, lookahead=few, **tight)  # type: ignore[arg-type]
        for c in ("policy", "lookahead", "lookahead")
    )
    # The plate does as it does without, and the same is done again.
    for a, b in zip(alone.movers, ahead.movers, strict=True):
        assert np.abs(a.pos - b.pos).max() < 0.1
    assert ahead.figures == again.figures != alone.figures and ahead.figures["lost"] == 0.0
    with refused("settings-conflict"):
        play(Chicken(against="rival"), tracker, controller="lookahead")


def test_with_a_ball_on_the_head(tracker: Tracker) -> None:
    made = play(Balance(), tracker, None, None, 2, seconds=0.8, threads=1, name="ball")
    assert made.figures["goal_moved_m"] > 0.0 == made.stiff["goal_moved_m"]
    for figures in (made.figures, made.stiff):
        assert figures["stays_s"] == pytest.approx(0.8, abs=0.1) and figures["tilt_deg"] < 45.0
    # The forces are fictional: what is felt is drawn, and the rod moves in the report.
    assert len(made.movers) == 2 and len(made.arrows[5]) == 2


def test_steps_by_hand() -> None:
    up, down, half = 0.1, 0.0, 0.03
    feet = [[down, up, half, down, down, up, down], [down, half, down, half, down, down, down]]
    height = torch.tensor(feet).T[None]
    assert footfalls(height).tolist() == [2]
