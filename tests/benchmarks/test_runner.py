"""The runner: rows that are there stay, what was stopped goes on, figures stand once."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from benchmarks.common import policies, runner
from benchmarks.common.clips import SETS, Places
from benchmarks.common.policies import shipped
from benchmarks.common.rows import COLUMNS, Figure, Row, merge, read, short
from benchmarks.common.runner import Part, run
from refusals import refused

CALLS: list[str] = []
FAILS: set[str] = set()


def measure(places: Places, unit: str) -> Any:
    """Twice the number of a unit; some cannot."""
    if unit in FAILS:
        raise RuntimeError(unit)
    CALLS.append(unit)
    return {"value": 2 * int(unit)}


def rows(places: Places, raws: Any) -> Iterator[Figure]:
    """The sum."""
    yield Figure("toy", "sum", sum(r["value"] for r in raws.values()), len(raws))


@pytest.fixture
def toys(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Places:
    parts = {
        "some": Part("numbers", lambda _: ["1", "2", "3"], measure, rows, ("tracker",), needs=()),
        "some more": Part("others", lambda _: ["4"], measure, rows, needs=()),
        "far": Part("what is not here", lambda _: ["5"], measure, rows, needs=("data",)),
    }
    monkeypatch.setattr(runner, "parts_of", lambda _: parts)
    monkeypatch.setattr(runner, "commit", lambda: "abc1234")
    CALLS.clear()
    FAILS.clear()
    return Places(tmp_path / "data", tmp_path, tmp_path / "work")


def test_what_was_stopped_goes_on_and_what_is_there_stays(
    toys: Places, tmp_path: Path, monkeypatch: Any
) -> None:
    FAILS.add("3")
    told: list[str] = []
    with pytest.raises(RuntimeError):
        run("toy", ["some"], toys, tmp_path, 1, tell=told.append)
    assert CALLS == ["1", "2"] and not (tmp_path / "toy.csv").exists()
    FAILS.clear()
    run("toy", ["some"], toys, tmp_path, 1, tell=told.append)
    assert CALLS == ["1", "2", "3"]
    (row,) = read(tmp_path / "toy.csv")
    assert (row.subject, row.value, row.n, row.commit) == ("toy", "12", "3", "abc1234")
    assert row.policy == shipped("tracker") and row.command == "python -m benchmarks toy --only some"
    assert float(row.core_hours) >= 0 and "cores" in row.machine
    run("toy", ["some"], toys, tmp_path, 1, tell=told.append)
    assert CALLS == ["1", "2", "3"] and told[-1] == "toy, some: 1 rows are there"
    # Another commit is measured anew, and so is what is asked for again.
    monkeypatch.setattr(runner, "commit", lambda: "def5678")
    run("toy", ["some"], toys, tmp_path, 1, tell=told.append)
    assert len(CALLS) == 6 and read(tmp_path / "toy.csv")[0].commit == "def5678"
    run("toy", ["some"], toys, tmp_path, 1, again=True, tell=told.append)
    assert len(CALLS) == 9


def test_a_comparison_writes_nothing(toys: Places, tmp_path: Path) -> None:
    told: list[str] = []
    merge(tmp_path / "toy.csv", [Row("toy", "sum", "9", "", "3", "1", "", "old", "elsewhere")])
    before = (tmp_path / "toy.csv").read_text()
    run("toy", ["some"], toys, tmp_path, 1, compare=True, tell=told.append)
    assert "toy, sum: 12, before 9 (old)" in told and (tmp_path / "toy.csv").read_text() == before


def test_parts_are_chosen_by_their_names_and_left_out_without_their_data(
    toys: Places, tmp_path: Path
) -> None:
    assert list(runner.chosen("toy", ["some"])) == ["some"]
    assert list(runner.chosen("toy", ["so"])) == ["some", "some more"]
    told: list[str] = []
    run("toy", ["far"], toys, tmp_path, 1, tell=told.append)
    assert "left out, it needs the development set" in told[0] and CALLS == []
    with refused("unknown-choice", says="some more"):
        runner.chosen("toy", ["none"])


def test_rows_of_the_same_figure_are_replaced_where_they_stand(tmp_path: Path) -> None:
    path = tmp_path / "t.csv"

    def row(subject: str, value: str, command: str = "c") -> Row:
        return Row(subject, "m", value, "", "1", "1", "", "1", command)

    merge(path, [row("a", "1"), row("b", "2"), row("d", "4", "other")])
    merge(path, [row("b", "3"), row("e", "5")], "c")
    # What the command makes no more is gone, what others made stays.
    assert [(r.subject, r.value) for r in read(path)] == [("b", "3"), ("d", "4"), ("e", "5")]
    path.write_text("subject,metric,value,spread,n,seeds,policy,commit,command\na,m,1,,1,1,,1,c\n")
    assert read(path)[0].machine == "" and len(COLUMNS) == 11
    assert [short(v) for v in (3.0, 0.12345, 12345.6)] == ["3", "0.1235", "1.235e+04"]


def test_a_policy_that_no_release_lists_says_so(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    assert shipped("tracker").startswith("tracker-v")
    (tmp_path / "tracker.safetensors").write_bytes(b"another")
    monkeypatch.setattr(policies, "DATA", tmp_path)
    policies.shipped.cache_clear()
    try:
        assert shipped("tracker").startswith("tracker-unlisted ")
    finally:
        policies.shipped.cache_clear()


def test_sets_say_what_was_learned_of_them() -> None:
    assert SETS["bandai"].learned == "validation" and SETS["bandai-test"].learned == "test"
    assert SETS["held-out"].learned == "test" and SETS["library"].learned == "known"
    # The styles of the test are in no other set.
    assert not set(SETS["bandai-test"].only) - set(SETS["bandai"].without)
