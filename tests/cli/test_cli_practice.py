"""`poise imitate` from a policy: what comes first, what is learned, going on, what is refused."""

from __future__ import annotations

import csv
import json
from dataclasses import fields
from pathlib import Path

import pytest

import poise
from poise.cli.console import LOST
from poise.cli.main import main
from poise.formats import read_clip, write_clip
from poise.jobs import practice
from poise.jobs.open import open_run
from poise.motion import trim
from poise.score.card import Help
from refusals import refused
from sparing import spare
from toy_policy import WALK, toy_run


@pytest.fixture(scope="module")
def short(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A second and a half of the embedded walk as a file."""
    path = tmp_path_factory.mktemp("short") / "short.bvh"
    write_clip(trim(read_clip(WALK), 0, 45), path)
    return path


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run on two cuts of the embedded walk."""
    return toy_run(tmp_path_factory.mktemp("run"))


@pytest.fixture(autouse=True)
def soon(monkeypatch: pytest.MonkeyPatch) -> None:
    """A motion is looked for by few characters, and learned in few worlds."""
    spare(monkeypatch)
    monkeypatch.setattr(practice, "help_wanted", lambda *_: 200.0)


def iterations(run: Path) -> list[int]:
    with (run / "log.csv").open(newline="") as file:
        return [int(row["iteration"]) for row in csv.DictReader(file)]


def test_a_policy_learns_the_clip_and_goes_on(
    run: Path, short: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    argv = ["imitate", str(short), "-o", str(out), "--from", str(run), "--threads", "1"]
    code = main([*argv, "--iterations", "5"])
    said = capsys.readouterr()
    assert "First result: " in said.err and "the policy tracks" in said.err
    # Exit code, sentence and score are of what is kept.
    score = json.loads((out / "score.json").read_text())
    assert code == (LOST if score["succ"] < 1 and score["episodes"] == 1 else 0)
    assert ("\nLost: " in said.out) == (code == LOST)
    # What is lost at first is learned with help, which is said; none is left in what is written.
    if "First result: Lost" in said.err:
        assert "a residual force of at first up to 200 N" in said.err
        assert "A residual force of at first up to 200 N" in said.out
    assert iterations(out / "run") == [1, 2, 3, 4, 5]
    assert {p.name for p in out.iterdir()} >= {"simulated.bvh", "score.json", "report.html", "run"}
    made, source = read_clip(out / "simulated.bvh"), read_clip(short)
    assert made.skeleton.names == source.skeleton.names and made.frames == source.frames
    opened = open_run(out)
    assert opened.recipe == "perpetual" and opened.config.starts == 32
    # The bones are the clip's, the joints the policy's.
    tracker = open_run(run).tracker
    assert opened.tracker.humanoid.hinges == tracker.humanoid.hinges
    assert main([*argv, "--iterations", "5"]) == 2
    assert "already holds a run" in capsys.readouterr().err
    assert main([*argv, "--iterations", "6", "--resume"]) in (0, LOST)
    assert "First result" not in capsys.readouterr().err and iterations(out / "run")[-1] == 6
    score = json.loads((out / "score.json").read_text())
    assert score["episodes"] in (1, 15) and set(score["help"]) == {f.name for f in fields(Help)}


def test_python_does_the_same(run: Path, short: Path, tmp_path: Path) -> None:
    brief = trim(read_clip(short), 0, 20)
    made = poise.imitate(brief, policy=run, iterations=1, threads=1)
    assert made.card.method.startswith("perpetual-single")
    assert made.clip.skeleton.names == read_clip(short).skeleton.names
    paths = made.save(tmp_path / "made")
    assert paths["report"].exists() and (paths["run"] / "run.safetensors").exists()
    with refused("settings-conflict"):
        poise.imitate(short, policy=run, help_limit=50.0)


def test_a_policy_beside_settings_of_the_recipe(
    run: Path, short: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    argv = ["imitate", str(short), "-o", str(tmp_path / "out"), "--from", str(run)]
    assert main([*argv, "--help-limit", "50"]) == 2
    said = capsys.readouterr().err
    assert "and there is help_limit" in said and "--from none" in said
    assert not (tmp_path / "out").exists()
