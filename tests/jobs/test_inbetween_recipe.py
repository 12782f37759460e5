"""From a folder of clips to a model, and the command lines around it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from poise.cli.main import main
from poise.formats import read_clip, write_bvh
from poise.jobs.inbetween.inbetween_settings import Inbetween, small
from poise.jobs.inbetween.inbetween_training import (
    FRAMES,
    begin,
    library_bank,
    motion_files,
    prepare,
    steps_in,
    train,
)
from poise.jobs.run_file import RUN_FILE
from poise.learn.checkpoint import load_checkpoint, save_checkpoint
from poise.learn.inbetween_model import load_model, save_model
from refusals import refused
from toy_human import swing


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("clips")
    for k in range(4):
        style = ("happy", "sad", "old", "plain")[k]
        write_bvh(swing(3.2, speed=0.4 * k, bend=0.2 * k), folder / f"walk_{style}_{k}.bvh")
    return folder


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory, library: Path) -> Path:
    """A miniature model."""
    folder = tmp_path_factory.mktemp("run")
    config = small(Inbetween(name="toy", final="old", validation="sad"))
    training = replace(config.between_training, batch=4)
    task, steps = begin(folder, library, replace(config, between_training=training), 1.0, 4)
    train(task, folder, steps, tensorboard=False, validate_every=4)
    return folder


def test_the_split_reaches_training_statistics_and_validation(library: Path, tmp_path: Path) -> None:
    bank, notes = library_bank(library, tmp_path / "bank.safetensors")
    config = small(Inbetween(name="toy", final="old", validation="sad"))
    task = prepare(bank, config, notes)
    assert len(task.bank.clips) == 4 and len(task.data.first) == 3
    rows = [task.bank.clips.index(c) for c in ("walk_happy_0", "walk_plain_3")]
    own = np.concatenate([bank.root[bank.first[c] : bank.first[c + 1]] for c in rows])
    assert np.allclose(task.data.root, own, atol=1e-6)
    assert task.validation is not None and len(task.validation.root) == 1
    assert steps_in(task, 0.01, trials=1) >= 20


def test_a_library_is_read_once(library: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cache = tmp_path / "bank.safetensors"
    first, _ = library_bank(library, cache)
    reads: list[Path] = []
    monkeypatch.setattr("poise.jobs.inbetween.inbetween_training.read_clip", lambda p: reads.append(p))
    again, _ = library_bank(library, cache)
    assert reads == [] and again.clips == first.clips and bool((again.rot == first.rot).all())
    assert again.facing == first.facing and again.feet == first.feet


def test_what_cannot_be_used_is_left_out_with_a_sentence(library: Path, tmp_path: Path) -> None:
    folder = tmp_path / "mixed"
    folder.mkdir()
    for file in library.glob("*.bvh"):
        (folder / file.name).write_bytes(file.read_bytes())
    (folder / "broken.bvh").write_text("HIERARCHY\n")
    clip = swing(2.0)
    s = clip.skeleton
    renamed = replace(s, names=("Pelvis", *s.names[1:]))
    write_bvh(clip.replaced(skeleton=renamed), folder / "other.bvh")
    bank, notes = library_bank(folder, tmp_path / "b.safetensors")
    assert len(bank.clips) == 4 and len(notes) == 2
    assert "broken.bvh" in notes[0] and "1 clips of other skeletons, such as 'other'" in notes[1]
    with refused("file-missing"):
        motion_files(tmp_path / "absent")


def test_a_run_is_kept_with_its_settings(run: Path, library: Path) -> None:
    model = load_model(run)
    assert model.kind == "transformer" and model.meta["name"] == "toy" and model.meta["step"] == 4
    assert (run / FRAMES).exists()
    with refused("settings-differ"):
        begin(run, library, small(Inbetween(name="toy", seed=5)), 1.0, 4)


def test_a_training_may_begin_from_a_model(run: Path, library: Path, tmp_path: Path) -> None:
    """Its first step is a tiny one, so that the weights are still nearly those of the model."""
    first, folder = load_model(run), tmp_path / "more"
    other = replace(small(Inbetween(name="toy", final="old", validation="sad")), seed=9)
    task, steps = begin(folder, library, other, 1.0, 1)
    model, stats, _ = train(task, folder, steps, tensorboard=False, first=first)
    assert stats is not None and stats.step == 1
    before, after = first.net.state_dict(), model.net.state_dict()
    assert all(float((before[k] - after[k]).abs().max()) < 1e-3 for k in before)


def test_a_run_of_before_a_setting_existed_goes_on(run: Path, library: Path, tmp_path: Path) -> None:
    tensors, meta = load_checkpoint(run / RUN_FILE)
    del meta["config"]["stretch"], meta["config"]["between_training"]["dropout"]
    save_checkpoint(tmp_path / RUN_FILE, tensors, meta)
    config = small(Inbetween(name="toy", final="old", validation="sad"))
    training = replace(config.between_training, batch=4)
    assert begin(tmp_path, library, replace(config, between_training=training), 1.0)[1] == 4
    other = replace(training, dropout=0.2)
    with refused("settings-differ"):
        begin(tmp_path, library, replace(config, between_training=other), 1.0)


def test_poise_inbetween_meets_its_keyframes(run: Path, library: Path, tmp_path: Path) -> None:
    source, out = library / "walk_plain_3.bvh", tmp_path / "out.bvh"
    argv = ["inbetween", str(source), "--keyframes", "5,35,50", "-o", str(out), "--model", str(run)]
    argv += ["--adapt", "2"]
    assert main(argv) == 0
    a, b = read_clip(source), read_clip(out)
    assert b.frames == a.frames
    for k in (5, 35, 50):
        assert np.abs(a.positions()[k] - b.positions()[k]).max() < 1e-3
    argv += ["--samples", "2"]
    assert main(argv) == 0
    assert (tmp_path / "out-0.bvh").exists() and (tmp_path / "out-1.bvh").exists()


@pytest.mark.parametrize(
    "keys, words",
    [
        ("0,999", "keyframe 999 is out of range"),
        ("0,5,5", "given twice"),
        ("9,3", "rising order"),
        ("4", "at least 2"),
        ("a,b", "whole numbers"),
    ],
)
def test_bad_keyframes_are_one_sentence(
    run: Path, library: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], keys: str, words: str
) -> None:
    out = tmp_path / "out.bvh"
    source = str(library / "walk_plain_3.bvh")
    code = main(["inbetween", source, "--keyframes", keys, "-o", str(out), "--model", str(run)])
    said = capsys.readouterr().err
    assert code == 2 and said.count("error: ") == 1 and words in said.splitlines()[-1]
    assert not out.exists()


def test_half_precision_models_are_used_alike(run: Path, library: Path, tmp_path: Path) -> None:
    save_model(tmp_path / "model.safetensors", load_model(run), half=True)
    outs: list[np.ndarray] = []
    for folder in (run, tmp_path):
        out = tmp_path / f"out-{len(outs)}.bvh"
        source = str(library / "walk_plain_3.bvh")
        argv = ["inbetween", source, "--keyframes", "5,35", "-o", str(out), "--model", str(folder)]
        assert main([*argv, "--adapt", "0"]) == 0
        outs.append(read_clip(out).positions())
    assert np.abs(outs[0] - outs[1]).max() < 0.01


def test_train_inbetween_says_what_it_needs(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    for argv, words in (
        (["-o", str(tmp_path / "r")], "needs --library"),
        (["x.bvh", "-o", str(tmp_path / "r"), "--library", str(tmp_path)], "not from single clips"),
        (["-o", str(tmp_path / "r"), "--library", str(tmp_path / "none")], "no such folder"),
        (
            ["-o", str(tmp_path / "r"), "--library", str(tmp_path), "--hold-out", "("],
            "regular expression",
        ),
    ):
        assert main(["train", "inbetween", *argv]) == 2
        assert words in capsys.readouterr().err
    assert not (tmp_path / "r").exists()


def test_resuming_the_command_line(
    library: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("poise.cli.train.imported", lambda place: lambda: small(Inbetween()))
    argv = ["train", "inbetween", "--library", str(library), "-o", str(tmp_path / "run")]
    argv += ["--iterations", "3", "--threads", "1", "--hold-out", "sad"]
    assert main(argv) == 0
    assert main(argv) == 2
    assert "already holds a run" in capsys.readouterr().err
    assert main([*argv, "--resume"]) == 0
    assert "nothing was trained" in capsys.readouterr().out
