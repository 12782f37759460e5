"""`import poise`: fast, typed, and the same numbers as the command line."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import poise
from poise.cli.main import main
from poise.motion import trim
from poise.plan import LookaheadConfig
from poise.recipes import build
from refusals import refused
from toy_human import swing

WALK = Path(poise.__file__).parent / "data/walk.bvh"
#: What the clock decides.
APART = ("seconds", "samples_per_s")


def figures(card: Any) -> dict[str, Any]:
    data = json.loads(json.dumps(card.to_dict() if hasattr(card, "to_dict") else card))
    return {k: v for k, v in data.items() if k not in APART}


def test_importing_it_is_fast_and_everything_is_there() -> None:
    code = (
        "import sys, poise; dir(poise); poise.PoiseError; "
        "assert not {'torch', 'mujoco', 'numpy', 'scipy'} & set(sys.modules), 'heavy'; "
        "assert all(getattr(poise, n) is not None for n in poise.__all__); print(len(poise.__all__))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert set(poise.__all__) <= set(dir(poise))
    with pytest.raises(AttributeError, match="no attribute 'imitat'"):
        _ = poise.imitat  # type: ignore[attr-defined]


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("clips") / "swing.bvh"
    poise.write(swing(0.5, speed=1.0), path)
    return path


@pytest.fixture(scope="module")
def imitated(clip: Path) -> poise.Result:
    return poise.imitate(str(clip), iterations=2, threads=1, num_envs=16, expert=False)


def test_imitate_gives_the_numbers_of_the_command(
    clip: Path, imitated: poise.Result, tmp_path: Path
) -> None:
    out = tmp_path / "cli"
    small = ["--iterations", "2", "--envs", "16", "--threads", "1", "--no-expert"]
    assert main(["imitate", str(clip), "-o", str(out), *small]) == 0
    said = json.loads((out / "score.json").read_text())
    assert figures(imitated.card) == figures(said)
    written = poise.read(out / "simulated.bvh")
    paths = imitated.save(tmp_path / "python")
    assert set(paths) == {"simulated", "score", "report", "run"}
    assert figures(json.loads(paths["score"].read_text())) == figures(said)
    np.testing.assert_array_equal(poise.read(paths["simulated"]).rot, written.rot)
    # What was saved opens again.
    again = poise.open_run(tmp_path / "python")
    assert again.recipe == "residual-force" and again.config == imitated.imitation.config
    apart = {"delivered": 0, "nothing": 0}
    assert figures(again.score()) | apart == figures(imitated.card) | apart


def test_what_it_shows(imitated: poise.Result, tmp_path: Path) -> None:
    source = imitated.imitation.library.clips[0]
    assert imitated.clip.skeleton == source.skeleton and imitated.clip.frames == source.frames
    assert imitated.notes and all(isinstance(n, str) for n in imitated.notes)
    assert repr(imitated).startswith("Result('swing', 0.5 s, success ") and len(repr(imitated)) < 120
    assert len(repr(imitated.imitation)) < 120 and len(repr(poise.open_run())) < 200
    page = imitated._repr_html_()
    assert page.count("<svg") == 1 and "Success" in page and "<script" not in page
    assert "http" not in page.replace("http://www.w3.org/2000/svg", "")
    assert imitated.save(tmp_path / "one.bvh") == {"motion": tmp_path / "one.bvh"}
    with refused("would-overwrite", says="force=True"):
        imitated.save(tmp_path / "one.bvh")
    (tmp_path / "all").mkdir()
    (tmp_path / "all" / "score.json").write_text("{}")
    with refused("would-overwrite", says=("score.json", "force=True")):
        imitated.save(tmp_path / "all")
    assert imitated.save(tmp_path / "one.bvh", force=True) == {"motion": tmp_path / "one.bvh"}
    with refused("format-not-written"):
        imitated.save(tmp_path / "one.amc")


def test_a_run_that_nobody_keeps_goes_with_its_result(clip: Path) -> None:
    made = poise.imitate(swing(0.4), iterations=1, threads=1, num_envs=8, expert=False)
    run = made.run
    assert (run / "run.safetensors").exists()
    del made
    assert not run.exists()


def test_a_folder_is_gone_on_with(tmp_path: Path) -> None:
    small: dict[str, Any] = {"threads": 1, "num_envs": 8, "expert": False, "folder": tmp_path}
    first = poise.imitate(swing(0.4), iterations=1, **small)
    second = poise.imitate(swing(0.4), iterations=2, **small)
    assert first.run == second.run == tmp_path / "run"
    assert second.card.samples == 2 * first.card.samples


def test_track_gives_the_numbers_of_the_command(tmp_path: Path) -> None:
    short = tmp_path / "walk.bvh"
    poise.write(trim(poise.read(WALK), 0, 20), short)
    tracked = poise.track(short, lookahead=LookaheadConfig().with_budget(30.0))
    assert main(["track", str(short), "-o", str(tmp_path / "out"), "--budget", "30"]) == 0
    said = json.loads((tmp_path / "out/score.json").read_text())
    assert figures(tracked.card) == figures(said)
    written = poise.read(tmp_path / "out/simulated.bvh")
    paths = tracked.save(tmp_path / "python")
    np.testing.assert_array_equal(poise.read(paths["simulated"]).rot, written.rot)
    assert repr(tracked).startswith("Result('walk'") and "<svg" in tracked._repr_html_()
    assert tracked.clip.skeleton.names == poise.read(WALK).skeleton.names


def test_inbetween_gives_the_frames_of_the_command(tmp_path: Path) -> None:
    keys, out, walk = (0, 20, 41), tmp_path / "out.bvh", tmp_path / "walk.bvh"
    poise.write(trim(poise.read(WALK), 0, 44), walk)
    made = poise.inbetween(walk, keys, adapt=2)
    command = ["--keyframes", "0,20,41", "--adapt", "2", "-o", str(out)]
    assert main(["inbetween", str(walk), *command]) == 0
    made.save(tmp_path / "mine.bvh")
    np.testing.assert_array_equal(poise.read(tmp_path / "mine.bvh").rot, poise.read(out).rot)
    assert made.card is None and made.keyframes == keys and "<svg" in made._repr_html_()
    np.testing.assert_allclose(made.clip.rot[20], poise.read(walk).rot[20])
    assert set(made.save(tmp_path / "all")) == {"filled"}


def test_defaults_are_those_of_the_command() -> None:
    from poise.cli import imitate

    assert imitate.config_of(imitate.Options(WALK, Path("out"))) == poise.ResidualForce()


def test_mistakes_are_sentences(tmp_path: Path) -> None:
    for ask, words in (
        (lambda: poise.imitate(WALK, help_limt=3), ("unknown-setting", "help_limt")),
        (lambda: poise.imitate(WALK, method="ppo"), ("unknown-choice", ("method", "ppo"))),
        (lambda: poise.imitate(tmp_path / "no.bvh"), ("file-missing", "no.bvh")),
        (lambda: poise.imitate(WALK, minutes=0), ("out-of-range", ("minutes", "0"))),
        (lambda: poise.imitate(WALK, minutes=math.nan), ("out-of-range", ("minutes", "nan"))),
        (lambda: poise.imitate(WALK, iterations=0), ("out-of-range", ("iterations", "0"))),
        (lambda: poise.track(WALK, tmp_path / "no"), ("file-missing", "no")),
        (lambda: poise.track(WALK, counts=3), ("unknown-setting", "count")),
        (lambda: poise.inbetween(WALK, (3, 3)), ("keyframe-repeated",)),
        (lambda: poise.inbetween(WALK, (0, 9), adapt=-1), ("out-of-range", ("adapt", "-1"))),
        (lambda: build(3), ("wrong-type",)),  # type: ignore[arg-type]
    ):
        with refused(*words):
            ask()
    assert math.isfinite(build(str(WALK)).humanoid.mass)
