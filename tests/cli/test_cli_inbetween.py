"""`poise inbetween` with the network that comes with Poise."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

from poise.cli.main import main
from poise.formats import read_clip
from poise.jobs.inbetween.fill import shipped_model
from poise.learn.inbetween_model import load_model


def test_it_fills_without_training_and_keeps_keyframes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    walk, out = Path(str(files("poise"))) / "data/walk.bvh", tmp_path / "out.bvh"
    assert main(["inbetween", str(walk), "--keyframes", "0,30,60", "-o", str(out), "--adapt", "2"]) == 0
    assert "keyframes 0,30,60" in capsys.readouterr().out
    old, new = read_clip(walk), read_clip(out)
    keys = [0, 30, 60, *range(61, old.frames)]
    # A text file rounds.
    assert np.abs(new.positions()[keys] - old.positions()[keys]).max() < 1e-4
    gap = np.abs(new.positions() - old.positions()).max((1, 2))
    assert gap[1:30].max() > 0.01
    # The made motion walks on the floor and stays near the recorded one.
    assert gap.max() < 0.8 and new.positions()[..., 2].min() > old.positions()[..., 2].min() - 0.05


def test_it_is_small_and_says_what_it_learned_from() -> None:
    model = load_model(shipped_model())
    path = Path(str(files("poise"))) / "data/inbetween/model.safetensors"
    assert path.stat().st_size < 6e6
    assert model.kind == "transformer" and model.longest == 60 and model.fps == 30
    assert model.meta["name"] == "CMU" and model.example is not None


def test_iterations_must_be_a_sensible_number(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    walk = Path(str(files("poise"))) / "data/walk.bvh"
    argv = ["inbetween", str(walk), "--keyframes", "0,30", "-o", str(tmp_path / "o.bvh")]
    assert main([*argv, "--adapt", "-1"]) == 2
    assert "--adapt must be 0 to 1000" in capsys.readouterr().err
    assert main([*argv, "--samples", "0"]) == 2
    assert "--samples must lie in 1 to 100, got 0" in capsys.readouterr().err


def test_a_name_without_a_format_is_refused_before_the_work(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    walk = Path(str(files("poise"))) / "data/walk.bvh"
    argv = ["inbetween", str(walk), "--keyframes", "0,30", "-o", str(tmp_path / "out"), "--samples", "3"]
    assert main(argv) == 2
    told = capsys.readouterr().err
    assert "cannot be written as 'out-0'" in told and "filling" not in told
    assert list(tmp_path.iterdir()) == []
