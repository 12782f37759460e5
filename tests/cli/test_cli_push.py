"""`poise push`: files, the JSON document, exit codes, what is refused."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from poise.cli.console import LOST
from poise.cli.main import main
from poise.formats import read_clip
from toy_policy import WALK

ALONE = ("--controller", "policy")


def test_the_motion_comes_back_with_a_push_in_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out.bvh"
    argv = ["push", str(WALK), "--force", "30", "--at", "left_hand", "--level", "0.12", *ALONE]
    argv += ["--from", "0.8", "--seconds", "0.3", "--direction", "0,1,0", "-o", str(out)]
    assert main([*argv, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["result"]["outcome"] == "pushed" and told["result"]["push"]["part"] == "lwrist"
    assert told["result"]["push"]["force"] == [0.0, 30.0, 0.0]
    assert read_clip(out).skeleton.names == read_clip(WALK).skeleton.names
    assert (tmp_path / "out/report.html").exists() and (tmp_path / "out/score.json").exists()
    # Nothing is written over without a word, and newtons are no permission.
    assert main(argv) == 2
    assert "write over it with --overwrite" in capsys.readouterr().err
    # A push that it cannot bear is told, and the motion is written all the same.
    hard = ["push", str(WALK), "--force", "900", *ALONE, "--overwrite", "-o", str(out)]
    assert main(hard) == LOST
    said = capsys.readouterr().out
    assert "Lost: the character failed at" in said and "rwrist was pushed with 900 N" in said
    assert "may be borne" in said


@pytest.mark.parametrize(
    ("words", "what"),
    [
        (("--level", "1.2"), "level must lie in 0 to 1, got 1.2"),
        (("--at", "wing"), "there is no part 'wing' to push"),
        (("--force", "-5"), "--force must be above 0"),
        (("--from", "60"), "the push begins at 60 s, and the motion lasts"),
        (("--direction", "0,1"), "--direction needs three numbers, got '0,1'"),
        (("--direction", "0,1,nan"), "direction must be a finite number"),
        (("--stiffness", "0"), "stiffness must be above 0 N/m"),
    ],
)
def test_mistakes(
    words: tuple[str, str], what: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["push", str(WALK), "-o", str(tmp_path / "out"), *words]) == 2
    assert what in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
