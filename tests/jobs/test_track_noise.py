"""Noise by name, and the robustness curve."""

from __future__ import annotations

import math

import pytest

from poise.jobs.open import open_run
from poise.jobs.track import TrackConfig, track
from poise.jobs.track.robustness import KINDS, noise_of, robustness
from poise.jobs.tracker import Tracker
from poise.motion.noise import VIDEO, Drift, FrameLoss, Jitter, Level, robustness_levels
from refusals import refused
from toy_policy import toy_run, walk


@pytest.fixture(scope="module")
def tracker(tmp_path_factory: pytest.TempPathFactory) -> Tracker:
    return open_run(toy_run(tmp_path_factory.mktemp("run"))).tracker


def test_noise_by_name() -> None:
    assert noise_of(()) == ()
    assert noise_of(("jitter:0.5", "drift")) == (Jitter(strength=0.5), Drift())
    assert noise_of(("video:1",)) == VIDEO
    assert noise_of(("lost-frames : 2",)) == (FrameLoss(strength=2.0),)
    assert all(noise_of((f"{kind}:1",)) == chain for kind, chain in KINDS.items())
    for text in ("jitter:", "jitter:-1", "jitter:nan", "jitter:inf", "jitter:a"):
        with refused("out-of-range"):
            noise_of((text,))
    with refused("unknown-choice", says=("jiter", "jitter")):
        noise_of(("jiter:1",))


def test_the_curve_is_that_of_tracking(tracker: Tracker) -> None:
    motions = [walk(0, 20), walk(20, 45, "later")]
    levels = robustness_levels((Jitter(sigma_m=0.01),), (0.0, 1.0))
    told: list[str] = []
    found = robustness(tracker, motions, levels, seed=3, tell=told.append)
    assert found == robustness(tracker, motions, levels, seed=3)
    assert [r.name for r in found.rungs] == ["clean", "all x1"] and len(told) == 2
    clean, noisy = found.rungs
    assert clean.succ == clean.succ_clean and clean.noise_mm == 0.0
    # Without noise the input is the motion itself.
    assert clean.mpjpe_mm == pytest.approx(clean.off_mm, rel=1e-5)
    assert 5.0 < noisy.noise_mm < 100.0 and noisy.motions == 2
    cards = [
        track(m, tracker, TrackConfig(levels[1].noise, 3, controller="policy")).evaluation.card
        for m in motions
    ]
    assert noisy.mpjpe_mm == pytest.approx(sum(c.mpjpe_global_mm for c in cards) / 2)
    said = found.to_dict()
    assert said["rungs"][1]["noise_mm"] == noisy.noise_mm and said["refused"] == []


def test_what_cannot_be_measured(tracker: Tracker) -> None:
    with refused("no-clips"):
        robustness(tracker, [])
    with refused("clip-too-short"):
        robustness(tracker, [walk(0, 2)], [Level("clean", 0.0, ())])
    # A motion that noise makes unusable counts as failed.
    (rung,) = (found := robustness(tracker, [walk(0, 2)], [Level("x1", 1.0, (Jitter(),))])).rungs
    assert rung.succ == 0.0 and math.isnan(rung.mpjpe_mm) and found.refused[0][1] == "walk"
