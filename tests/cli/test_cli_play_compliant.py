"""`poise play compliant SCENE`: files, the JSON document, what is refused."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from poise.cli.main import main
from poise.formats import write_clip
from toy_human import swing


def test_a_scene_from_one_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    argv = ["play", "compliant", "pull", "--newtons", "15", "--stiffness", "300", "--lag", "0.1"]
    argv += ["--count", "2", "--duration", "1.0", "--threads", "1", "-o", str(out)]
    assert main([*argv, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["result"]["scene"] == "pull" and told["result"]["compliant"]["lost"] == 0.0
    assert {p.name for p in out.iterdir()} == {
        "simulated.bvh", "score.json", "figures.json", "report.html",
    }  # fmt: skip
    assert main(argv) == 2
    assert "write over it with --force" in capsys.readouterr().err
    assert main([*argv, "--force"]) == 0
    assert "Interaction force, mean while it acts" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "what"),
    [
        (("gate",), "there is no scene 'gate'"),
        (("door", "--width", "0.2"), "the door is 0.2 m wide and the body"),
        (("door", "--width", "-1"), "--width must be above 0 and below 10 m"),
        (("pull", "--width", "2"), "--width says nothing of the scene 'pull'"),
        (("trampoline", "--height", "3"), "--height must lie in 0 to 1 m"),
        (("chicken", "--other", "1"), "--other must lie in 2 to 500 kg"),
        (("ball", "--length", "0"), "--length must lie in 0.1 to 5 m"),
        (("hand",), "Did you mean 'hands'?"),
        (("pull", "--mass", "2"), "--mass says nothing of the scene 'pull'"),
        (("pull", "--level", "1.2"), "level must lie in 0 to 1"),
        (("throws", "--mass", "0"), "--mass must be above 0"),
        (("pull", "--made-for", "1"), "--made-for says nothing of the scene 'pull'"),
        (("door", "--made-for", "9"), "--made-for must lie in 0.5 to 3 m"),
        (("pull", "--budget", "300"), "--budget is for --controller lookahead"),
        (("hands", "--count", "0"), "--count must lie in 1 to 1024"),
    ],
)
def test_mistakes(
    words: tuple[str, ...], what: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["play", "compliant", *words, "-o", str(tmp_path / "out")]) == 2
    assert what in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_scene_with_lookahead(tmp_path: Path) -> None:
    argv = ["play", "compliant", "pull", "--count", "1", "--duration", "0.5", "--threads", "1"]
    argv += ["--controller", "lookahead", "--budget", "40", "-o", str(tmp_path / "out")]
    assert main(argv) == 0
    # What comes along for the ball is not asked for.
    assert main(["play", "compliant", "ball", *argv[3:], "--force"]) == 0


def test_what_comes_along_is_asked_for_what_it_learned(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    argv = ["play", "compliant", "chicken", "--count", "1", "--duration", "0.5", "--threads", "1"]
    found = list[str]()
    for words in ((), ("--learned", "none"), ("--stiffness", "500")):
        out = tmp_path / str(len(found))
        assert main([*argv, *words, "--json", "-o", str(out)]) == 0
        found.append((out / "simulated.bvh").read_text())
        capsys.readouterr()
    # A stiffness is not among what was learned, so that the policy below acts alone.
    assert found[0] != found[1] and found[0] != found[2]


def test_a_run_of_that_name_is_a_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "compliant").mkdir()
    assert main(["play", "compliant"]) == 2
    assert "SCENE" not in capsys.readouterr().err


def test_the_imitation_controller_from_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    clips, run = tmp_path / "clips", tmp_path / "run"
    clips.mkdir()
    for name, speed in (("stand", 0.0), ("walk", 1.2)):
        write_clip(swing(2.0, speed=speed, name=name), clips / f"{name}.bvh")
    train = ["train", "compliant-imitation", str(clips), "-o", str(run), "--envs", "4", "--threads", "1"]
    train += ["--iterations", "1", "--set", "ppo.horizon=4", "--set", "ppo.minibatch=16"]
    assert main(train) == 0
    assert "poise play compliant hands --learned" in capsys.readouterr().out
    assert main(train) == 2 and "already holds a run" in capsys.readouterr().err
    assert main([*train, "--resume"]) == 0
    capsys.readouterr()
    assert main(["play", str(run), "--clip", "walk", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["result"]["clip"] == "walk"
    play = ["play", "compliant", "hands", "--learned", str(run), "-o", str(tmp_path / "out")]
    assert main([*play, "--stiffness", "200"]) == 2
    assert "--stiffness means nothing" in capsys.readouterr().err
    assert main([*play, "--lead", "0.5", "--count", "2", "--duration", "0.5", "--threads", "1"]) == 0
    assert (tmp_path / "out" / "report.html").exists()
    assert main(["train", "compliant-imitation", "-o", str(tmp_path / "two")]) == 2
    assert "no clip was given" in capsys.readouterr().err and not (tmp_path / "two").exists()
