"""Motions that a policy loses are looked for by many characters; what they find is one simulation."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from poise.formats import read_clip
from poise.jobs.open import open_run
from poise.jobs.perpetual.evaluation import evaluate_clips
from poise.jobs.track import TrackConfig, imitation_of, track
from poise.jobs.track.placement import place
from poise.jobs.track.recovery_run import look_for, replay
from poise.jobs.tracker import Tracker, load_tracker, save_tracker
from poise.plan import SamplingConfig
from refusals import refused
from toy_policy import toy_run, walk

FEW = SamplingConfig(characters=32, retries=1)
SEARCH = TrackConfig(controller="search", search=FEW)


@pytest.fixture(scope="module")
def tracker(tmp_path_factory: pytest.TempPathFactory) -> Tracker:
    """A policy that hardly stands."""
    return open_run(toy_run(tmp_path_factory.mktemp("run"))).tracker


def test_what_is_found_is_one_simulation(tracker: Tracker) -> None:
    clip = walk(0, 40)
    plain = track(clip, tracker, controller="policy")
    (lost,) = plain.failed_s
    shown: list[tuple[int, int]] = []
    done = track(clip, tracker, SEARCH, progress=lambda _, *x: shown.append(x))
    found = done.found
    assert found is not None and found.reached > round(lost * 30) and found.tries >= 32 * found.reached
    assert shown[0] == (0, 39) and all(a <= found.reached for a, _ in shown)
    assert any("32 characters looked for it" in note for note in done.notes)
    # One character that repeats the actions is where the search was, to the bit and to its error.
    imitation = imitation_of(tracker, [place(clip, tracker)])
    again = evaluate_clips(imitation, replay(found, tracker.policy), threads=1)
    assert int(again.tracked) >= found.reached + 1
    if found.whole:
        steps = len(found.actions)
        assert float(again.global_mm) * (steps + 1) / steps == pytest.approx(found.error_mm, abs=0.1)
    # The same seed finds the same, another one something else.
    same = look_for(tracker, imitation, FEW, threads=2)
    assert torch.equal(same.actions, found.actions) and same.reached == found.reached
    other = look_for(tracker, imitation, replace(FEW, seed=1))
    assert not torch.equal(other.actions, found.actions)
    # Without a critic it goes by what was so far.
    assert tracker.value is not None
    blind = look_for(replace(tracker, value=None), imitation, FEW)
    assert blind.reached > 0 and not torch.equal(blind.actions, found.actions)


def test_another_round_comes_no_farther_away(tracker: Tracker) -> None:
    clip = walk(0, 14)
    imitation = imitation_of(tracker, [place(clip, tracker)])
    shown: list[tuple[int, int]] = []
    once = look_for(tracker, imitation, FEW)
    twice = look_for(tracker, imitation, replace(FEW, rounds=2), show=lambda *x: shown.append(x))
    assert once.whole and twice.whole and twice.error_mm < once.error_mm
    assert twice.tries == 2 * once.tries and shown[0] == (0, 26) and shown[-1][0] > 13
    again = evaluate_clips(imitation, replay(twice, tracker.policy), threads=1)
    assert bool(again.succeeded.all())


def test_where_nobody_comes_through_the_search_ends(tracker: Tracker) -> None:
    """A leap aside of 3 m in one frame."""
    clip = walk(0, 40)
    pos = clip.root_pos.copy()
    pos[12:, 1] += 3.0
    tracked = track(clip.replaced(root_pos=pos), tracker, SEARCH)
    found = tracked.found
    assert found is not None and not found.whole and found.reached <= 12
    # Tried anew from farther back, so that more was tried than one way there.
    assert found.tries > 32 * 12
    assert tracked.failed_s and "came as far as" in " ".join(tracked.notes)


def test_the_critic_goes_with_the_policy(tracker: Tracker, tmp_path: Path) -> None:
    save_tracker(tracker, tmp_path / "p.safetensors")
    kept = load_tracker(tmp_path / "p.safetensors").value
    assert tracker.value is not None and kept is not None
    obs = torch.randn(5, tracker.policy.num_obs, generator=torch.Generator().manual_seed(0))
    # Matrices are in half precision there.
    assert torch.allclose(kept(obs), tracker.value(obs), rtol=0.02, atol=0.02)
    save_tracker(replace(tracker, value=None), tmp_path / "q.safetensors")
    assert load_tracker(tmp_path / "q.safetensors").value is None


def test_bad_settings_are_refused() -> None:
    with refused("out-of-range", says="4 characters"):
        SamplingConfig(characters=4)
    with refused("out-of-range", says="noise_range"):
        SamplingConfig(noise_range=(0.3, 0.1))
    with refused("single-character-only"):
        TrackConfig(controller="search", count=2)
    with refused("single-character-only"):
        TrackConfig(controller="search", recover=True)


def test_a_motion_that_is_not_lost_is_not_searched() -> None:
    tracked = track(walk(), open_run().tracker, SEARCH)
    assert tracked.found is None and not tracked.failures


def test_a_kick_that_the_policy_loses_is_found(data_dir: Path) -> None:
    clip = read_clip(data_dir / "deepmimic_txt/humanoid3d_spinkick.txt")
    tracked = track(clip, open_run().tracker, TrackConfig(controller="search"))
    assert tracked.found is not None and tracked.found.whole
    card = tracked.evaluation.card
    assert not tracked.failures and card.succ == 1.0 and card.help.limit_n == 0.0
