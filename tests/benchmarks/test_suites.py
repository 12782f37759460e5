"""Every suite's smoke test: each part that can run here makes rows, one of them of the null."""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest

from benchmarks.__main__ import arguments, main
from benchmarks.common.clips import Places
from benchmarks.common.rows import read
from benchmarks.common.runner import SUITES, missing, parts_of
from sparing import spare

#: A word of the subject of the rows in which nothing acts.
NULLS = {
    "engine": "nothing acts",
    "gpu": "on the cores",
    "read": "without motion",
    "attack": "a sound file",
    "retarget-repair": "onto itself",
    "track": "nothing",
    "lookahead-search": "nothing",
    "recover": "nothing",
    "imitate": "nothing (action 0)",
    "inbetween-complete": "standing still",
    "dream": "nothing",
    "scenes": "without",
    "live": "nobody sends",
    "papers": "nothing",
}


@pytest.mark.benchmarks
@pytest.mark.timeout(900)
@pytest.mark.parametrize("suite", SUITES)
def test_a_moment_of_each_part_makes_rows(
    suite: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spare(monkeypatch)
    assert main([suite, "--smoke", "--work", str(tmp_path), "--data", str(tmp_path / "none")]) == 0
    rows = read(tmp_path / "smoke" / f"{suite}.csv")
    places = Places(tmp_path, tmp_path, tmp_path, True)
    made = {row.command for row in rows}
    for name, part in parts_of(suite).items():
        if missing(part, places) or (suite == "retarget-repair" and name.startswith("repair")):
            continue
        if not (suite == "read" and name in ("in place, told", "in place, real")):
            assert f"python -m benchmarks {suite} --only {shlex.quote(name)}" in made
    assert any(NULLS[suite] in row.subject for row in rows)
    assert all(row.core_hours and row.machine and float(row.value) == float(row.value) for row in rows)
    # What is there is not made again, and the rows stay.
    again = main([suite, "--smoke", "--work", str(tmp_path), "--data", str(tmp_path / "none")])
    assert again == 0 and read(tmp_path / "smoke" / f"{suite}.csv") == rows


def test_every_command_of_a_row_is_a_part_of_a_suite() -> None:
    root = Path(__file__).resolve().parents[2]
    for table in (root / "results").glob("*.csv"):
        if table.stem in ("policies", "published"):
            continue
        for row in read(table):
            words = shlex.split(row.command)
            if words[:3] == ["python", "-m", "benchmarks"]:
                told = arguments().parse_args(words[3:])
                assert told.suite == table.stem and told.only[0] in parts_of(told.suite), row.command
            elif words[:2] == ["python", "-m"]:
                assert (root / words[2].replace(".", "/")).exists(), row.command
            else:
                assert words[0] == "python" and (root / words[1]).exists(), row.command
