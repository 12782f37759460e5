"""What `poise track` says of a motion that was survived, that lacks something, or has another rate."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

from poise.jobs.result import shortfalls
from poise.jobs.track import TrackConfig, rates
from poise.jobs.track.rates import rate_doubts, rate_notes
from poise.kinematics.rate import RateJudgement, Reason
from poise.score import Help, ScoreCard
from toy_human import swing

NAN = math.nan
UNKNOWN, FALLS = RateJudgement(120.0), RateJudgement(120.0, fall=9.8)
DOUBLE = RateJudgement(120.0, 60.0, (Reason("fall", 1.0, "in flight the body falls"),), 39.0)


def card(succ: float = 1.0, lost: float = NAN, fallen: float = NAN, off: float = NAN, **more: Any):
    """A card of one episode."""
    one = {"first_fail_s": lost, "fallen_s": fallen, "off_feet_s": off}
    aid = Help(0, 0, 0, 0, 0, 0, 0, 0)
    return ScoreCard(
        succ, "phc", *(NAN,) * 8, {"total": NAN}, aid, 0.0, 0, 0, per_clip=(one,), **more
    )  # fmt: skip


def need(what: str, start: float, stop: float) -> dict[str, Any]:
    return {"what": what, "start_s": start, "stop_s": stop}


def test_what_was_done_has_no_shortfalls() -> None:
    assert shortfalls(card(tracked=1.0)) == ()
    # What a motion lacks matters only where it was lost.
    assert shortfalls(card(tracked=1.0, needs=(need("a seat", 1.0, 2.0),))) == ()


def test_since_when_it_is_down_and_what_is_missing() -> None:
    seats = need("a seat", 2.1, 5.0), need("something to hold", 8.0, 9.0)
    said = shortfalls(card(fallen=2.4, tracked=0.0, needs=seats))
    assert said == (
        "The character is down from 2.4 s on, where the motion is upright.",
        "It needs a seat from 2.1 to 5.0 s.",
    )
    (said,) = shortfalls(card(0.0, lost=9.5, needs=seats))
    assert said == "It needs a seat from 2.1 to 5.0 s; it needs something to hold from 8.0 to 9.0 s."
    assert shortfalls(card(0.0, lost=1.0, needs=seats)) == ()
    (said,) = shortfalls(card(fallen=3.0, off=1.0, tracked=0.0))
    assert said == "The character is off its feet from 1.0 s on, where the motion is on them."


@pytest.fixture
def tries(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The rates tried; the one at 60 Hz is done."""
    tried: list[float] = []

    def done(task: float, acts: object, *_: object) -> bool:
        tried.append(task)
        return task == 60.0

    monkeypatch.setattr(rates, "_done", done)
    return tried


class Alone:
    """A tracker without a critic."""

    policy = value = None


def notes(fps: float, judged: RateJudgement = UNKNOWN, lost: bool = True, **settings: Any) -> list[str]:
    clip = swing(1.0, 30.0).replaced(fps=fps)
    config = replace(TrackConfig(), **settings)
    return rate_notes(Alone(), clip, judged, lambda c: c.fps, config, lost)  # type: ignore[arg-type, return-value]


def test_a_lost_motion_is_tried_at_half_and_double_its_rate(tries: list[float]) -> None:
    (said,) = notes(120.0)
    assert said == (
        "The motion was lost at its rate of 120 Hz; played at 60 Hz it is done: is the frame rate "
        "right? If not, state it with --fps 60."
    )
    assert tries == [60.0]
    (said,) = notes(30.0)
    assert "played at 60 Hz" in said
    # 15 and 12.5 Hz are no rates of files.
    assert tries == [60.0, 60.0] and notes(25.0) == [] and tries[2:] == [50.0]


def test_where_it_is_not_tried(tries: list[float]) -> None:
    assert notes(120.0, lost=False) == []
    assert notes(120.0, FALLS) == []
    assert notes(120.0, controller="policy") == []
    assert notes(120.0, recover=True) == []
    assert notes(120.0, count=2) == []
    assert tries == []


def fit(name: str, judged: RateJudgement) -> Any:
    """A motion of 120 Hz that was placed, and what physics says of its rate."""
    clip = swing(1.0, 30.0, name=name).replaced(fps=120.0)
    return SimpleNamespace(
        clip=clip, source=clip, report=SimpleNamespace(clips=(SimpleNamespace(rate=judged),))
    )


def test_physics_speaks_before_anything_is_simulated(tries: list[float]) -> None:
    (said,) = rate_doubts([fit("jump", DOUBLE)])
    assert "state it with --fps 60" in said and said.startswith("In flight")
    (said,) = rate_doubts([fit("fall", FALLS), fit("jump", DOUBLE)])
    assert said.startswith("jump: In flight")
    assert rate_doubts([fit("fall", FALLS), fit("still", UNKNOWN)]) == []
    # A motion that is doubted and lost is tried as well.
    assert len(notes(120.0, DOUBLE)) == 1 and tries == [60.0]
