"""`poise demo`: what it refuses, and what it writes over."""

from __future__ import annotations

from pathlib import Path

import pytest

from poise.cli.console import Answer
from poise.cli.demo import WALK
from poise.cli.main import main
from poise.jobs.run_file import RUN_FILE


def test_the_walk_is_in_the_package() -> None:
    assert WALK.read_text("utf-8").startswith("HIERARCHY")


def test_numbers_that_make_no_sense_and_folders_that_hold_something(tmp_path: Path, refused) -> None:
    refused("demo", "-o", tmp_path / "demo", "--minutes", "0", words=("--minutes",))
    refused("demo", "-o", tmp_path / "demo", "--threads", "-1", words=("--threads",))
    refused("demo", "walk.bvh", words=("one argument too many",))
    (tmp_path / "run").mkdir()
    refused("demo", "-o", tmp_path, words=("already holds a run", "--force"))
    # A folder of that name which is no run is not removed.
    refused("demo", "-o", tmp_path, "--force", words=("is no run",))
    (tmp_path / "run").rmdir()
    (tmp_path / "report.html").write_text("mine")
    refused("demo", "-o", tmp_path, words=("is there already", "--force"))


def test_force_begins_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / RUN_FILE).write_text("a former one")
    seen = []

    def imitated(options: object, argv: list[str]) -> Answer:
        seen.append((options, argv, (tmp_path / "run").exists()))
        return Answer()

    monkeypatch.setattr("poise.cli.demo.run_whole", imitated)
    assert main(["demo", "-o", str(tmp_path), "--minutes", "0.5", "--force"]) == 0
    [(options, argv, there)] = seen
    assert not there and options.training.minutes == 0.5 and options.clip == WALK
    # The line that goes on after Ctrl-C is one of `poise imitate`.
    assert argv == [str(WALK), "-o", str(tmp_path), "--minutes", "0.5"]
