"""imitate, train, play and eval in miniature: the files, the score, going on, Ctrl-C."""

from __future__ import annotations

import csv
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from poise.cli.main import main
from poise.cli.training import clock, command_line
from poise.errors import PoiseError
from poise.jobs.keep import claimed
from poise.learn import CloneConfig
from poise.score import TRACKING

MINIATURE = ["--envs", "16", "--threads", "1"]
#: Control steps of cloning the expert, 16 characters at once.
CLONED = 16 * ((CloneConfig().rounds + 1) * CloneConfig().steps + CloneConfig().critic_steps)
SCORE = {"succ", "succ_rule", "mpjpe_mm", "mpjpe_global_mm", "foot_slide_mm_per_s", "jerk", "help"}


def iterations(run: Path) -> list[int]:
    with (run / "log.csv").open(newline="") as file:
        return [int(row["iteration"]) for row in csv.DictReader(file)]


def test_imitate_writes_everything(trained: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = {p.name for p in trained.iterdir()}
    assert files == {"simulated.bvh", "score.json", "report.html", "run"}
    score = json.loads((trained / "score.json").read_text())
    assert set(score) >= SCORE and score["episodes"] == 1
    assert score["samples"] == CLONED + 2 * 16 * 16
    assert 0 <= score["succ"] <= 1 and score["method"] == "rfc-implicit"
    # Taken away as episodes succeed, from 100 N.
    assert 0 < score["help"]["limit_n"] <= 100
    assert iterations(trained / "run") == [1, 2]
    assert main(["info", "--json", str(trained / "simulated.bvh")]) == 0
    facts = json.loads(capsys.readouterr().out)["result"]
    assert facts["frames"] == 16 and facts["fps"] == pytest.approx(30, rel=1e-4)


def test_the_motion_goes_into_the_file_that_was_named(
    clip: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "moved.glb"
    assert main(["imitate", str(clip), "-o", str(out), *MINIATURE, "--iterations", "1"]) == 0
    assert {p.name for p in tmp_path.glob("moved*")} == {"moved.glb", "moved"}
    assert {p.name for p in (tmp_path / "moved").iterdir()} == {"score.json", "report.html", "run"}
    assert str(out) in capsys.readouterr().out
    assert main(["info", "--json", str(out)]) == 0
    assert json.loads(capsys.readouterr().out)["result"]["format"] == "gltf"


def test_a_file_that_cannot_be_written_is_refused_before_any_work(
    clip: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["imitate", str(clip), "-o", str(tmp_path / "moved.amc")]) == 2
    assert "cannot be written as '.amc'" in capsys.readouterr().err and not list(tmp_path.glob("moved*"))
    same = str(tmp_path / "walk.bvh")
    assert main(["convert", str(clip), same]) == 0
    assert main(["imitate", same, "-o", same]) == 2
    assert "written over itself" in capsys.readouterr().err


def test_resume_goes_on(
    trained: Path, clip: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = shutil.copytree(trained, tmp_path / "out")
    again = ["imitate", str(clip), "-o", str(out), *MINIATURE, "--iterations", "3", "--resume"]
    assert main(again) == 0
    said = capsys.readouterr().out
    assert iterations(out / "run") == [1, 2, 3]
    assert json.loads((out / "score.json").read_text())["samples"] == CLONED + 3 * 16 * 16
    for name in ("simulated.bvh", "score.json", "report.html"):
        assert str(out / name) in said
    assert "Success" in said and "verdict" in said


def test_train_takes_a_library_and_plays_each(
    clip: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    command = ["train", "residual-force", str(clip), str(clip), "-o", str(run), *MINIATURE]
    assert main([*command, "--iterations", "1", "--method", "deepmimic"]) == 0
    assert {p.name for p in run.iterdir()} >= {"run.safetensors", "checkpoint.safetensors"}
    page = tmp_path / "page.html"
    assert main(["play", str(run), "-o", str(page), "--clip", "stand-2", "--start", "9"]) == 0
    assert capsys.readouterr().out.rstrip().endswith(str(page))
    assert "stand-2" in page.read_text()


def test_play_opens_the_page_when_asked(
    trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[str] = []
    monkeypatch.setattr("webbrowser.open", lambda url: bool(opened.append(url)) or True)
    page = tmp_path / "play.html"
    assert main(["play", str(trained), "-o", str(page), "--open"]) == 0
    assert opened == [page.as_uri()]


def test_eval_gives_the_score_of_the_result(
    trained: Path, capsys: pytest.CaptureFixture[str], answered
) -> None:
    said = answered("eval", trained)["result"]
    result = json.loads((trained / "score.json").read_text())
    # Only a delivery writes a motion with feet that can be told.
    assert result.pop("delivered")[0]["delivered"]["point_penetration_mm"] < 0.01
    # Only an evaluation says what doing nothing comes to.
    assert set(said["nothing"]) == {"succ", *TRACKING}
    assert said == {**result, "delivered": [], "nothing": said["nothing"]}
    assert main(["eval", str(trained / "run"), "--rule", "any_25cm"]) == 0
    assert "Success (any_25cm)" in capsys.readouterr().out


@pytest.mark.skipif(os.name != "posix", reason="signals")
def test_ctrl_c_saves_and_says_how_to_go_on(clip: Path, tmp_path: Path) -> None:
    out = tmp_path / "my out"
    argv = ["imitate", str(clip), "-o", str(out), *MINIATURE, "--minutes", "5", "--no-expert"]
    command = [sys.executable, "-m", "poise", *argv]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    checkpoint, deadline = out / "run" / "checkpoint.safetensors", time.monotonic() + 90
    while not checkpoint.exists() and time.monotonic() < deadline and process.poll() is None:
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    said, complained = process.communicate(timeout=60)
    assert process.returncode == 130, complained
    assert command_line("imitate", argv[1:]) in complained and "Traceback" not in complained
    assert "'" in command_line("imitate", argv[1:]) and "Success" not in said
    assert {p.name for p in out.iterdir()} == {"run"} and iterations(out / "run")


def test_claimed_leaves_no_folder_after_a_failure(tmp_path: Path) -> None:
    deep = tmp_path / "a" / "b"
    with pytest.raises(PoiseError), claimed(deep):
        assert deep.is_dir()
        raise PoiseError("no", code="internal-fault")
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(PoiseError), claimed(deep):
        (deep / "kept").touch()
        raise PoiseError("no", code="internal-fault")
    assert (deep / "kept").exists()
    with claimed(deep):
        pass
    assert [p.name for p in deep.iterdir()] == ["kept"]


def test_clock() -> None:
    assert [clock(s) for s in (0, 59.6, 245, 3725)] == ["0:00", "1:00", "4:05", "1:02:05"]


def test_ctrl_c_while_cloning_says_that_nothing_is_saved(
    clip: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def stopped(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("poise.jobs.runs.start_training", stopped)
    assert main(["imitate", str(clip), "-o", str(tmp_path / "out"), *MINIATURE]) == 130
    told = capsys.readouterr().err
    assert (
        "Stopped before there was anything to save. Begin again with:" in told and "saved." not in told
    )
