"""Every bad input: exit code 2, one `error:` line that names the place, and nothing written."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import pytest
import torch
from tiny_clips import ASF, BVH, ROW, amc, bvh, put

from poise.learn.checkpoint import LATEST, load_checkpoint, save_checkpoint

FLAT = BVH.replace("0 65 0", "0 0 0").replace("10 -85 0", "0 0 0").replace("0 20 0", "0 0 0")
BAD = {
    "empty": ("a.bvh", "", ("empty",)),
    "cut header": ("a.bvh", BVH[:200], ("cut off",)),
    "cut motion": ("a.bvh", bvh(frames=9), ("9 frames", "line", "cut off")),
    "wrong channel count": ("a.bvh", bvh([ROW, ROW + " 1", ROW]), ("line 29", "13", "12")),
    "nan": ("a.bvh", bvh([ROW, ROW.replace("4", "nan")]), ("Head", "frame 1", "nan")),
    "infinite": ("a.bvh", bvh([ROW, ROW.replace("90", "inf")]), ("Hips", "frame 1", "inf")),
    "word": ("a.bvh", bvh([ROW, ROW.replace("90", "high")]), ("'high'", "line 29")),
    "zero bones": ("a.bvh", bvh(header=FLAT.replace("0 -5 15", "0 0 0")), ("length",)),
    "duplicate joint": ("a.bvh", bvh(header=BVH.replace("LeftFoot", "Head")), ("Head", "twice")),
    "one frame": ("a.bvh", bvh([ROW]), ("1 frame", "at least 2")),
    "garbage": ("a.bvh", bytes(range(256)) * 40, ("a.bvh",)),
    "garbage without suffix": ("a", b"\x80\x04\x95" + bytes(900), ("pickle",)),
    "fbx": ("a.fbx", b"Kaydara FBX Binary", ("FBX", "BVH")),
    "json of something": ("a.json", '{"Frames": 3}', ("Frames",)),
    "short deepmimic row": ("a.txt", '{"Loop": "none", "Frames": [[1, 2]]}', ("frame 0", "44")),
}


@pytest.mark.parametrize("case", BAD)
@pytest.mark.parametrize("verb", ["info", "imitate"])
def test_bad_files(verb: str, case: str, tmp_path: Path, refused) -> None:
    name, content, words = BAD[case]
    path = put(tmp_path, name, content)
    more = ["-o", tmp_path / "out"] if verb == "imitate" else []
    refused(verb, path, *more, words=(str(path), *words))


def test_missing_files_and_folders(tmp_path: Path, refused) -> None:
    refused("info", tmp_path / "no.bvh", words=("no.bvh", "no such file"))
    refused("imitate", tmp_path / "no.bvh", "-o", tmp_path / "out", words=("no such file",))
    refused("info", tmp_path, words=("folder",))
    refused("eval", tmp_path / "no", words=("no such file or folder",))
    refused("play", tmp_path, words=("is no run folder",))
    refused("body", tmp_path / "no.bvh", words=("no such file",))
    refused("convert", tmp_path / "no.bvh", tmp_path / "x.bvh", words=("no such file",))


def test_bad_amc_files(tmp_path: Path, refused) -> None:
    put(tmp_path, "02.asf", ASF)
    refused("info", put(tmp_path, "02_01.amc", amc(bone="haed")), words=("'haed'", "line", "'head'"))
    refused("info", put(tmp_path, "02_02.amc", amc()[:-12]), words=("lfoot", "line"))
    refused(
        "info",
        put(tmp_path, "02_03.amc", amc().replace("head 4", "head nan", 1)),
        words=("head", "frame 1"),
    )
    refused("info", put(tmp_path, "02_04.amc", amc().replace("\n2\n", "\n5\n")), words=("frame 5",))
    round_ = ASF.replace("spine head", "spine head\n    head spine")
    put(tmp_path, "03.asf", round_)
    refused("info", put(tmp_path, "03_01.amc", amc()), words=("03.asf",))


def test_an_ambiguous_skeleton_lists_the_candidates(tmp_path: Path, refused) -> None:
    path = put(tmp_path, "07_01.amc", amc())
    refused("info", path, words=("--skeleton",))
    put(tmp_path, "02.asf", ASF)
    put(tmp_path, "03.asf", ASF)
    refused("info", path, words=("02.asf", "03.asf", "--skeleton"))
    refused("info", path, "--skeleton", tmp_path / "no.asf", words=("no.asf",))


@pytest.mark.parametrize(("unit", "size"), [("0.25", "m tall"), ("0.000025", "mm tall")])
def test_giants_and_dwarfs(unit: str, size: str, tmp_path: Path, refused) -> None:
    path = put(tmp_path, "a.bvh", bvh())
    refused("info", path, "--unit", unit, words=(size, "--unit"))
    refused("imitate", path, "-o", tmp_path / "out", "--unit", unit, words=(size,))


def test_a_huge_line(tmp_path: Path, refused, monkeypatch: pytest.MonkeyPatch) -> None:
    sparse = put(tmp_path, "a.bvh", "HIERARCHY ")
    with sparse.open("r+b") as file:
        file.truncate(300_000_000)
    refused("info", sparse, words=("binary",))
    monkeypatch.setattr("poise.formats.text.MAX_LINE_BYTES", 1000)
    monkeypatch.setattr("poise.formats.text._CHUNK", 100)
    long = put(tmp_path, "b.bvh", bvh([ROW, "0 " * 2000]))
    refused("info", long, words=("line 29", "longer"))


OPTIONS = (
    (("--minutes", "0"), "--minutes"),
    (("--minutes", "-3"), "--minutes"),
    (("--minutes", "nan"), "--minutes"),
    (("--minutes", "soon"), "--minutes"),
    (("--help-limit", "-1"), "--help-limit"),
    (("--help-limit", "nan"), "--help-limit"),
    (("--help-limit", "inf"), "--help-limit"),
    (("--method", "magic"), "rfc-implicit"),
    (("--reward", "none"), "local, world"),
    (("--envs", "0"), "--envs"),
    (("--threads", "-1"), "--threads"),
    (("--iterations", "0"), "--iterations"),
    (("--seed", "-1"), "--seed"),
    (("--mass", "1"), "mass"),
    (("--set", "lfoot.kp"), "NAME=VALUE"),
    (("--set", "nobody.kp=3"), "nobody"),
    (("--set", "right_ankle.taste=3"), "torque"),
    (("--fps", "0"), "--fps"),
    (("--up", "W"), "X, Y, Z"),
    (("--minuts", "3"), "Did you mean --minutes? See poise imitate --help"),
)


@pytest.mark.parametrize(("argv", "word"), OPTIONS, ids=["=".join(argv) for argv, _ in OPTIONS])
def test_bad_options(argv: tuple[str, ...], word: str, clip: Path, tmp_path: Path, refused) -> None:
    refused("imitate", clip, "-o", tmp_path / "a" / "out", *argv, words=(word,))


@pytest.mark.parametrize(
    ("argv", "sentence"),
    [
        (("push", "--force", "0"), "--force must be above 0 and at most 10000 N, got 0.0"),
        (("push", "--from", "-1"), "--from must be at least 0 s, got -1.0"),
        (("push", "--seconds=0"), "--seconds must be above 0 s, got 0.0"),
        (("push", "--stiffness", "nan"), "--stiffness must be above 0 N/m, got nan"),
        (("push", "--level", "2"), "--level must lie in 0 to 1, got 2.0"),
        (("body", "--mass", "1"), "--mass must lie in 2 to 5000 kg, got 1.0"),
        (("body", "--smooth", "-1"), "--smooth must be "),
        (("track", "--seed", "-1"), "--seed must be a whole number from 0 to 2**63 - 1, got -1"),
        (("complete", "--keyframes", "0,9", "--threads", "-1"), "--threads must be at least 0, got -1"),
        (("imitate", "--mass", "nan"), "--mass must lie in 2 to 5000 kg, got nan"),
        (("imitate", "--set", "body.mass_kg=1"), "mass_kg must lie in 2 to 5000 kg, got 1"),
    ],
)
def test_an_option_is_named_as_it_is_written(
    argv: tuple[str, ...], sentence: str, clip: Path, tmp_path: Path, refused
) -> None:
    """And not as the setting that it states; a setting that --set states keeps its own name."""
    verb, *options = argv
    out = tmp_path / ("out.xml" if verb == "body" else "out")
    error = refused(verb, clip, *options, "-o", out, words=(sentence,))
    assert f"error: {sentence}" in error or not sentence.startswith("--")


def test_incomplete_command_lines(clip: Path, tmp_path: Path, refused) -> None:
    refused("imitate", clip, words=("poise imitate needs -o DIR",))
    refused("imitate", words=("CLIP",))
    refused("info", words=("no clip",))
    refused("train", "residual-force", "-o", tmp_path / "out", words=("no clip",))
    refused("train", "residual-farce", clip, "-o", tmp_path / "out", words=("'residual-force'",))


def test_folders_that_cannot_be_written(clip: Path, tmp_path: Path, refused) -> None:
    blocked = put(tmp_path, "file", "in the way")
    refused("imitate", clip, "-o", blocked, words=(str(blocked), "another folder"))
    refused("imitate", clip, "-o", blocked / "deep" / "out", words=("is a file", "another folder"))
    refused("convert", clip, blocked / "x.bvh", words=("x.bvh",))
    if sys.platform == "linux":
        refused("imitate", clip, "-o", "/proc/poise/out", words=("/proc/poise/out", "another folder"))
        refused("convert", clip, "/proc/poise.bvh", words=("/proc",))


def test_clips_of_two_skeletons(clip: Path, tmp_path: Path, refused) -> None:
    other = put(tmp_path, "a.bvh", bvh())
    refused("train", "residual-force", clip, other, "-o", tmp_path / "run", words=("joints differ",))


def test_a_clip_without_a_body(tmp_path: Path, refused) -> None:
    # It has a head and a foot, so it can be read, but neither knees nor hands.
    refused("imitate", put(tmp_path, "a.bvh", bvh()), "-o", tmp_path / "out")
    refused("body", put(tmp_path, "a.bvh", bvh()))


def test_checkpoints_of_others(
    trained: Path, tmp_path: Path, refused, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = shutil.copytree(trained / "run", tmp_path / "run")
    tensors, meta = load_checkpoint(run / LATEST)
    save_checkpoint(run / LATEST, tensors, {**meta, "character": "someone else"})
    refused("eval", run, words=("someone else",))
    refused("play", run, words=("someone else",))
    with monkeypatch.context() as patch:
        patch.setattr("poise.learn.checkpoint.FORMAT", 99)
        save_checkpoint(run / LATEST, tensors, meta)
    refused("eval", run, words=("format 99",))
    (run / LATEST).write_bytes(b"\x08" + bytes(40))
    refused("eval", run, words=("damaged",))
    (run / LATEST).unlink()
    refused("eval", run, words=("nothing has been trained",))
    (run / "run.safetensors").write_bytes(b"\xff" * 64)
    refused("eval", run, words=("damaged",))


def test_runs_are_not_mixed(trained: Path, clip: Path, tmp_path: Path, refused) -> None:
    out = shutil.copytree(trained, tmp_path / "out")
    refused("imitate", clip, "-o", out, words=("already holds a run", "--resume"))
    more = ("--resume", "--envs", "16", "--help-limit", "7")
    refused("imitate", clip, "-o", out, *more, words=("other settings",))


def test_frames_and_clips_that_are_not_there(trained: Path, tmp_path: Path, refused) -> None:
    page = tmp_path / "play.html"
    refused("play", trained, "-o", page, "--start", "16", words=("0 to 15",))
    refused("play", trained, "-o", page, "--start", "-1", words=("0 to 15",))
    refused("play", trained, "-o", page, "--clip", "stnd", words=("'stand'",))
    refused("eval", trained, "--rule", "mine", words=("phc",))


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
@pytest.mark.parametrize("verb", ["imitate", "eval"])
def test_a_gpu_that_is_not_there(verb: str, tmp_path: Path, refused) -> None:
    path = put(tmp_path, "a.bvh", BVH)
    more = {"imitate": [path, "-o", tmp_path / "out"], "eval": [tmp_path]}[verb]
    refused(verb, *more, "--device", "cuda", words=("'cuda'", "CUDA", "--device cpu"))
    refused(verb, *more, "--device", "gpu", words=("'gpu'", "'cuda:0'"))
    assert not (tmp_path / "out").exists()
