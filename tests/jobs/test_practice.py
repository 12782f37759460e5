"""`imitate` from a policy: when help comes, what it says, and which of all that was tried is kept."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from poise.jobs import practice
from poise.jobs.practice import Watching, practise
from poise.jobs.result import LOST, TRACKED, Merit
from poise.learn import Until


def result(ended: int, reached: float = 1.0, **more: Any) -> Any:
    """As much of a tracked motion as is compared."""
    merit = Merit(ended, 0.0, float("inf") if ended else reached)
    aid = SimpleNamespace(limit_n=100.0, force_mean_n=0.0)
    body = SimpleNamespace(humanoid=SimpleNamespace(mass=50.0))
    own = {
        "merit": merit,
        "doubts": (),
        "placed": None,
        "controller": "search",
        "tracker": body,
        "travel": None,
    }
    return SimpleNamespace(card=SimpleNamespace(help=aid), **(own | more))


@pytest.fixture
def stubs(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """What each part gives, and what it was asked: of a motion that is lost whatever is tried."""
    tracker = SimpleNamespace(humanoid=SimpleNamespace(mass=50.0))
    learned = SimpleNamespace(tracker=tracker, result=SimpleNamespace(interrupted=False))
    made: dict[str, Any] = {
        "first": result(LOST, 1.0), "own": result(LOST, 0.5), "again": result(LOST, 0.7),
        "wanted": 300.0, "aided": None, "said": [], "minutes": None, "help_n": None,
    }  # fmt: skip

    def learn(*given: Any, help_n: float = 0.0) -> Any:
        made["minutes"], made["help_n"] = given[3].minutes, help_n
        return learned

    follows = iter(("first", "again"))
    made["tracker"] = tracker
    made["watching"] = Watching(lambda *_: made[next(follows)], lambda _: None, made["said"].append)
    for name, stub in {
        "with_travel": lambda *_: None,
        "learn": learn, "from_every_start": lambda *_: made["own"],
        "help_wanted": lambda *_: made["wanted"], "with_help": lambda *_: made["aided"],
    }.items():  # fmt: skip
        monkeypatch.setattr(practice, name, stub)
    return made


def run(stubs: dict[str, Any], tmp_path: Path, minutes: float = 5.0) -> Any:
    until = Until(minutes=minutes)
    return practise(None, stubs["tracker"], tmp_path, until, watching=stubs["watching"])  # type: ignore[arg-type]


def test_what_is_found_is_learned_without_help(stubs: dict[str, Any], tmp_path: Path) -> None:
    stubs["first"] = result(TRACKED)
    done = run(stubs, tmp_path)
    assert stubs["help_n"] == 0.0 and stubs["said"] == []
    # The policy still loses it: what was found stays, and is what is kept and spoken of.
    assert done.tracked is stubs["first"]
    assert done.sentences == ("The policy did not learn to do it better: what was found first is kept.",)


def test_what_is_lost_is_learned_with_help_that_fades(stubs: dict[str, Any], tmp_path: Path) -> None:
    stubs["first"] = result(LOST, doubts=("The clip likely has 60 frames per second.",))
    stubs["own"] = result(TRACKED)
    done = run(stubs, tmp_path)
    rate, aid = stubs["said"]
    # What speaks against the rate comes first.
    assert "likely has 60" in rate and "300 N (61 % of body weight)" in aid and "fades" in aid
    assert stubs["help_n"] == 300.0 and 2.5 <= stubs["minutes"] <= 5.0
    assert done.tracked is stubs["own"]
    assert "helped while it was learned" in done.sentences[0]
    assert done.sentences[1] == "It has ended: nothing helps in what is written."


def test_the_search_with_what_was_learned_counts(stubs: dict[str, Any], tmp_path: Path) -> None:
    stubs["again"] = result(TRACKED)
    done = run(stubs, tmp_path)
    assert done.tracked is stubs["again"] and "what search does with it is kept" in done.sentences[-1]


def test_help_that_is_left_is_stated(stubs: dict[str, Any], tmp_path: Path) -> None:
    stubs["aided"] = result(TRACKED)
    done = run(stubs, tmp_path)
    assert done.tracked is stubs["aided"]
    assert done.sentences[-1] == (
        "Without help it is still lost; with up to 100 N (20 % of body weight) it is done."
    )


def test_where_all_is_lost_the_one_that_came_farthest_is_kept(
    stubs: dict[str, Any], tmp_path: Path
) -> None:
    stubs["wanted"] = None
    done = run(stubs, tmp_path)
    assert done.tracked is stubs["first"] and stubs["help_n"] == 0.0
    assert "learned without help" in stubs["said"][0]


def test_a_run_that_goes_on_keeps_its_help(
    stubs: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / practice.RUN_FILE).touch()
    monkeypatch.setattr(practice, "help_of", lambda _: 200.0)
    monkeypatch.setattr(practice, "place", lambda *_: None)
    done = run(stubs, tmp_path)
    # All of the minutes count; what had been found before is looked for again where all is lost.
    assert stubs["help_n"] == 200.0 and stubs["minutes"] == 5.0
    assert done.tracked in (stubs["first"], stubs["again"])
