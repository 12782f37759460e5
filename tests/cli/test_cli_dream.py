"""`poise dream` and `poise train endless`, from the command line to files."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from poise.cli.dream import points_of, push_of
from poise.cli.main import main
from poise.formats import read_clip, write_clip
from poise.jobs.endless.dream_world import DreamPush
from poise.jobs.endless.endless_training import Endless
from poise.learn.cvae import CVAEConfig
from poise.settings import to_toml
from refusals import refused
from toy_policy import walk


def test_a_character_goes_about(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out.bvh"
    argv = ["dream", "--seconds", "0.5", "--controller", "policy", "--threads", "1", "-o", str(out)]
    assert main([*argv, "--steer", "5,0", "--past", "simulated", "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["result"]["past"] == "simulated"
    assert said["result"]["outcome"] == "dreamt" and said["result"]["falls"] == []
    assert read_clip(out).frames == 15
    assert {p.name for p in (tmp_path / "out").iterdir()} == {"score.json", "report.html"}
    ring = [*argv[:2], "2", *argv[3:-1], str(tmp_path / "ring"), "--loop", "1.2", "--json"]
    assert main(ring) == 0
    said = json.loads(capsys.readouterr().out)
    assert 1.08 < read_clip(said["outputs"]["loop"]).seconds < 1.4
    assert any("The loop lasts" in note for note in said["notes"])
    assert main(argv) == 2
    assert "--force" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (["--seconds", "0"], "--seconds must lie in 0.1 to 36000"),
        (["--steer", "5"], "'5' is no point"),
        (["--count", "99"], "count must lie in 1 to 16 characters"),
        (["--temperature", "-1"], "temperature must lie in 0 to 10"),
        (["--generator", "none"], "could not be read"),
        (["--past", "none"], "--past"),
        (["--loop", "50"], "Give --seconds 200"),
        (["--path", "5,0"], "points must have at least 2"),
        (["--path", "0,0 0.2,0"], "at least 1 m long"),
        (["--pace", "1"], "Give a path"),
        (["--path", "0,0 5,0", "--pace", "9"], "speed must lie in 0.3 to 3 m/s"),
        (["--path", "0,0 5,0", "--steer", "1,1"], "Leave one of them out"),
        (["--scene", "none.json"], "none.json: cannot be read"),
        (["--push", "force"], "'force' makes no push"),
        (["--push", "every=often"], "'every=often' has no number"),
        (["--push", "direction=0,0,0"], "not all 0"),
        (["--help-limit", "-1"], "--help-limit must lie in 0"),
    ],
)
def test_mistakes_are_one_sentence(
    more: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["dream", "-o", str(tmp_path / "out"), *more]) == 2
    told = capsys.readouterr().err.strip().splitlines()[-1]
    assert told.startswith("error: ") and said in told
    assert not (tmp_path / "out").exists()


def test_points_stand_on_the_line_or_in_a_file(tmp_path: Path) -> None:
    assert points_of("5,0 -1.5,2", "--steer") == ((5.0, 0.0), (-1.5, 2.0))
    (tmp_path / "way.txt").write_text("# there and back\n5, 0\n\n0,0  # home\n")
    assert points_of(str(tmp_path / "way.txt"), "--steer") == ((5.0, 0.0), (0.0, 0.0))
    (tmp_path / "way.txt").write_text("# nothing\n")
    with refused("out-of-range", says="0"):
        points_of(str(tmp_path / "way.txt"), "--steer")


def test_a_push_is_said_in_words() -> None:
    assert push_of("") == DreamPush()
    made = push_of("at=chest force=200 from=5 seconds=0.2 direction=0,1,0 every=5-15")
    assert made == DreamPush(200.0, "chest", 5.0, 0.2, (0.0, 1.0, 0.0), (5.0, 15.0))
    assert push_of("direction=any every=10") == DreamPush(direction="any", every_s=(10.0, 10.0))
    with refused("option-malformed", says="force=200"):
        push_of("power=5")


def test_a_generator_is_trained_and_gone_on_with(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    library, run = tmp_path / "clips", tmp_path / "run"
    library.mkdir()
    write_clip(walk(), library / "one.bvh")
    settings = tmp_path / "small.toml"
    argv = ["train", "endless", "--library", str(library), "-o", str(run), "--iterations", "4",
            "--threads", "1", "--config", str(settings)]  # fmt: skip
    settings.write_text(to_toml(Endless()))
    assert main(argv) == 2
    assert "the library has 0 windows of 90 frames" in capsys.readouterr().err and not run.exists()
    net = CVAEConfig(past=10, future=12, latent=4, hidden=16, decoder="cosine", cosines=6)
    settings.write_text(to_toml(Endless(net)))
    assert main(argv) == 0
    said = capsys.readouterr()
    assert "4 steps" in said.out and (run / "generator.safetensors").exists()
    assert main(argv) == 2
    assert "--resume" in capsys.readouterr().err
    assert main([*argv, "--resume"]) == 0
    assert "nothing was trained" in capsys.readouterr().out
    other = [*argv, "--resume"]
    other[other.index("4")] = "5"
    assert main(other) == 2
    assert "another library or with other settings" in capsys.readouterr().err
