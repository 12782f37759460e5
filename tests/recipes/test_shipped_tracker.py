"""The policy that comes with Poise: small, honest about its data, and it walks."""

from __future__ import annotations

from pathlib import Path

import pytest

from poise.motion import read_clip
from poise.recipes.library.files import subject_of
from poise.recipes.track import track
from poise.recipes.track.policy import SHIPPED, Tracker, open_tracker
from toy_policy import WALK


@pytest.fixture(scope="module")
def tracker() -> Tracker:
    return open_tracker()


def test_it_is_small_and_says_what_it_learned(tracker: Tracker) -> None:
    assert SHIPPED.stat().st_size < 5_000_000
    about = tracker.about
    assert about["help_n"] == 0.0 and about["samples"] > 50_000_000 and about["finished"]
    learned = {subject_of(name) for name in about["clips"]}
    assert "cmu 02" in learned and not learned & {"cmu 05", "cmu 11", "cmu 14"}
    # Clips that may not be learned from by what ships.
    assert not any(
        x in name.lower() for name in about["clips"] for x in ("bandai", "lafan", "sie", "ase")
    )


def test_the_embedded_walk_is_done_without_help(tracker: Tracker) -> None:
    tracked = track(tracker, read_clip(WALK))
    card = tracked.evaluation.card
    assert not tracked.failures and card.succ == 1.0 and card.help.limit_n == 0.0
    assert card.mpjpe_mm < 60


def test_a_held_out_take_is_followed_for_a_while(tracker: Tracker, data_dir: Path) -> None:
    tracked = track(tracker, read_clip(data_dir / "cmu_bvh/ad/14_14.bvh"))
    assert not tracked.failures or tracked.failures[0][1] > 1.0
