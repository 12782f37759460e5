"""One result, one story: what is kept is what notes, sentence, word and card speak of, for every
combination of what was lost and what was found."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from test_best import episodes

from poise.jobs.result import Merit, merit, story
from poise.jobs.track import controllers
from poise.jobs.track.controllers import TrackingRun, done_by
from poise.jobs.track_settings import TrackConfig
from poise.metrics import success_rule
from poise.plan import SamplingResult
from poise.score import score_rollouts
from poise.score.rollouts import judge

FRAMES = 40


def done(fail: int | None, by: str) -> TrackingRun:
    """An episode that is lost at a frame, or not."""
    rollouts = episodes(fail, frames=FRAMES)
    judged = judge(rollouts, success_rule("phc"))
    return TrackingRun(
        rollouts, [SimpleNamespace(row=0)], judged, [] if fail is None else [(0, fail)], by
    )  # type: ignore[list-item]


def tracked(kept: TrackingRun, **more: Any) -> Any:
    """As much of a result as a story reads."""
    card, rate = score_rollouts(kept.rollouts), 30.0
    reference = SimpleNamespace(length=torch.tensor([FRAMES]), rate_hz=rate)
    figures = {
        "imitation": SimpleNamespace(reference=reference),
        "card": card, "parts": (), "losses": None, "controller": kept.controller,
        "failures": tuple((k, t / rate) for k, t in kept.failures), "merit": merit(kept.rollouts),
        "failed_s": tuple(t / rate for _, t in kept.failures),
    }  # fmt: skip
    return SimpleNamespace(**(figures | more))


@pytest.mark.parametrize("first", [None, 5, 20, 39])
@pytest.mark.parametrize("again", [None, 5, 20, 39])
@pytest.mark.parametrize("claims", [5, 39])
def test_search_and_what_was_before_it(
    first: int | None, again: int | None, claims: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = {"policy": done(first, "policy"), "search": done(again, "search")}
    monkeypatch.setattr(controllers, "episode", lambda task, config, acts, by, *_: made[by])
    result = SamplingResult(torch.zeros(FRAMES - 1, 2), claims, 50.0, 1000)
    monkeypatch.setattr(controllers, "look_for", lambda *_: result)
    tracker: Any = SimpleNamespace(value=None, policy=None)
    task: Any = SimpleNamespace(reference=SimpleNamespace(rate_hz=30.0))
    kept, notes = done_by(tracker, task, TrackConfig(controller="search"))
    told, card = story(tracked(kept)), score_rollouts(kept.rollouts)
    # The best is kept, and the sentence, the word and the card are of it.
    tried = [d for by, d in made.items() if first is not None or by == "policy"]
    assert merit(kept.rollouts) == max(merit(d.rollouts) for d in tried)
    whole = card.succ == 1.0
    assert whole == (first is None or again is None) == (not told.failed)
    assert told.sentence.startswith("Lost: ") == (not whole) == bool(kept.failures)
    (note,) = [n for n in notes if "characters looked for it" in n] or [""]
    assert bool(note) == (first is not None)
    # A search says that it found a motion where that is what is kept, and only there.
    assert ("found it to its end" in note) == (first is not None and again is None)
    if first is not None and again is not None:
        assert f"came as far as {again / 30:.1f} s" in note
        assert ("is kept" in note) == (first >= again)
    farther = first is not None and (again is None or again > first)
    assert kept.controller == ("search" if farther else "policy")


def test_help_is_in_the_sentence() -> None:
    kept = done(None, "policy")
    card = score_rollouts(kept.rollouts)
    aid = replace(card.help, force_mean_n=23.4, torque_mean_nm=8.0, share_of_body_weight=0.0361)
    assert ", without help, " in story(tracked(kept)).sentence
    said = story(tracked(kept, card=replace(card, help=aid))).sentence
    assert "with help of 23 N on average, 3.6 % of body weight, and 8 N m" in said
    assert "without help" not in said


def test_what_only_survives_is_not_tracked() -> None:
    kept = done(None, "lookahead")
    low = replace(score_rollouts(kept.rollouts), tracked=0.0)
    told = story(tracked(kept, card=low, merit=Merit.of(low)))
    assert told.word == "not tracked" and told.failed and told.sentence.startswith("Not tracked: ")
    assert story(tracked(kept)).word == "tracked" and "with lookahead" in story(tracked(kept)).sentence


def test_a_crowd_one_by_one_and_one_that_comes_back() -> None:
    kept = done(7, "policy")
    length = SimpleNamespace(length=torch.tensor([FRAMES, FRAMES]), rate_hz=30.0)
    told = story(tracked(kept, imitation=SimpleNamespace(reference=length)))
    assert told.word == "lost" and told.sentence.startswith("1 of 2 characters tracked")
    for back, word in (((0.5,), "came back"), ((), "lost")):
        losses = SimpleNamespace(lost=(0.2,), back=back, sentence=lambda: "The character lost it once.")
        assert story(tracked(kept, losses=losses)).word == word
    for ends, word in ((True, "tracked"), (False, "lost")):
        part = SimpleNamespace(done=ends, after=None)
        assert story(tracked(kept, parts=(part,))).word == word
