"""`poise track` in miniature: a run, a policy file, other skeletons, noise, what is refused."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from tiny_clips import deepmimic, put

from poise.cli import track as track_verb
from poise.cli.console import LOST
from poise.cli.main import main
from poise.formats import read_clip, write_clip
from poise.jobs.open import open_run
from poise.jobs.track import learning, tracking
from poise.kinematics import sole_slide
from poise.motion import shifted, trim
from toy_policy import WALK, toy_run

#: Without lookahead and search, with which even this policy comes far.
ALONE = ("--controller", "policy")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run on two cuts of the embedded walk."""
    return toy_run(tmp_path_factory.mktemp("run"))


@pytest.fixture(scope="module")
def short(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A second of the embedded walk as a file."""
    path = tmp_path_factory.mktemp("short") / "short.bvh"
    write_clip(trim(read_clip(WALK), 0, 30), path)
    return path


@pytest.fixture(scope="module")
def file(run: Path, short: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The policy as one file, as the command line writes it."""
    folder = tmp_path_factory.mktemp("policy")
    path = folder / "policy.safetensors"
    argv = ["track", str(short), "--policy", str(run), "-o", str(folder / "out"), *ALONE]
    # A policy that was trained for three iterations loses it.
    assert main([*argv, "--save-policy", str(path)]) == LOST
    return path


def test_motion_score_and_report(
    file: Path, short: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "made.bvh"
    assert main(["track", str(short), "--policy", str(file), "-o", str(out), *ALONE]) == LOST
    said = capsys.readouterr().out
    assert "Lost: the character failed at" in said and "--reset-on-fail puts it back" in said
    assert str(out) in said and (tmp_path / "made/report.html").exists()
    score = json.loads((tmp_path / "made/score.json").read_text())
    assert score["episodes"] == 1 and score["help"]["limit_n"] == 0.0
    assert score["method"] == "perpetual-single"
    made, source = read_clip(out), read_clip(short)
    assert made.frames == source.frames and made.skeleton.names == source.skeleton.names
    np.testing.assert_allclose(made.skeleton.offsets, source.skeleton.offsets, atol=1e-5)


def test_a_motion_that_is_lost_is_learned(
    file: Path,
    short: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(learning, "WORLDS", 32)
    out = tmp_path / "made.bvh"
    argv = [
        "track",
        str(short),
        "--policy",
        str(file),
        "-o",
        str(out),
        *ALONE,
        "--threads",
        "1",
        "--learn",
    ]
    before = file.read_bytes()
    assert main([*argv, "0.02"]) == LOST
    said = capsys.readouterr()
    assert "loses the motion at" in said.err and "minutes at most" in said.err
    assert "it gets to" in said.err and "Learned 0:0" in said.err
    assert f"{tmp_path / 'made/learned'}\n" in said.out
    assert out.exists() and (tmp_path / "made/learned/policy.safetensors").exists()
    assert file.read_bytes() == before
    score = json.loads((tmp_path / "made/score.json").read_text())
    about, earlier = (open_run(p).tracker.about for p in (tmp_path / "made/learned", file))
    # The score is of what is kept, and that is said.
    stays = "the motion as it was before stays" in said.err
    kept = earlier if stays else about
    assert score["samples"] == kept["samples"] and about["samples"] > earlier["samples"]
    # A tiny network does not learn it in a second; more minutes go on.
    assert "--learn 0.04" in said.out
    # The results are those of its own run.
    assert main([*argv, "0.04"]) == LOST
    assert open_run(tmp_path / "made/learned").tracker.about["samples"] > about["samples"]


def test_a_motion_that_is_lost_is_looked_for(
    file: Path, short: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    argv = [
        "track",
        str(short),
        "--policy",
        str(file),
        "-o",
        str(tmp_path / "o.bvh"),
        "--controller",
        "search",
    ]
    code = main([*argv, "--characters", "16", "--threads", "1"])
    said = capsys.readouterr()
    assert code == (0 if "Found by a search to its end" in said.out else LOST)
    assert "searching, 0 % done" in said.err and "16 characters looked for it" in said.out
    score = json.loads((tmp_path / "o/score.json").read_text())
    assert score["method"] == "perpetual-single, searched" and score["help"]["limit_n"] == 0.0
    if "Found by a search to its end" not in said.out:
        assert "Try --characters 32" in said.out
    assert main([*argv, "--rounds", "0"]) == 2 and "--rounds must" in capsys.readouterr().err
    assert main([*argv, "--characters", "4"]) == 2
    assert "--characters must lie in 8 to" in capsys.readouterr().err
    crowd = ["track", str(short), "-o", str(tmp_path / "many"), "--controller", "search", "--count", "2"]
    assert main(crowd) == 2 and "single character" in capsys.readouterr().err


def test_by_default_it_looks_ahead(
    file: Path, short: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    argv = ["track", str(short), "--policy", str(file), "--characters", "8", "--threads", "1"]
    code = main([*argv, "-o", str(tmp_path / "a"), "--budget", "30", "--seed", "1"])
    said = capsys.readouterr()
    assert "looking ahead, 0 % done" in said.err
    score = json.loads((tmp_path / "a/score.json").read_text())
    if code == 0 and "Tracked with lookahead to its end" in said.out:
        assert score["method"] == "perpetual-single, lookahead" and "mm off on average" in said.out
        assert "The policy alone loses the motion" in said.out
    else:
        assert "8 characters looked for it" in said.out
    # Alone it does not search, and it says what would.
    code = main([*argv, "-o", str(tmp_path / "b"), "--controller", "lookahead", "--budget", "30"])
    assert code == 0 or "--controller auto" in capsys.readouterr().out
    # Again the same.
    main([*argv, "-o", str(tmp_path / "c"), "--budget", "30", "--seed", "1"])
    again = json.loads((tmp_path / "c/score.json").read_text())
    assert again["mpjpe_mm"] == score["mpjpe_mm"]
    for wrong, words in (("3", "at least 10 candidates"), ("0", "--budget must lie in")):
        assert main([*argv, "-o", str(tmp_path / "d"), "--budget", wrong]) == 2
        assert words in capsys.readouterr().err
    assert not (tmp_path / "d").exists()


def test_what_cannot_be_learned_is_refused(
    file: Path, short: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    argv = ["track", str(short), "--policy", str(file), "-o", str(tmp_path / "o.bvh"), "--learn"]
    assert main([*argv, "-1"]) == 2 and "--learn must lie in 0 to" in capsys.readouterr().err
    assert main([*argv, "1", "--noise", "jitter:1"]) == 2
    assert "without errors" in capsys.readouterr().err
    assert not (tmp_path / "o").exists()


def test_another_skeleton_with_noise_and_resets(
    file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    person = put(tmp_path, "person.txt", deepmimic(45))
    out = tmp_path / "out"
    argv = ["track", str(person), "--policy", str(file), "-o", str(out), *ALONE, "--noise", "jitter:0.2"]
    assert main([*argv, "--seed", "3", "--reset-on-fail"]) == LOST
    said = capsys.readouterr().out
    assert "on another skeleton" in said and "without noise" in said
    back = read_clip(out / "simulated.bvh")
    assert set(back.skeleton.names) == set(read_clip(person).skeleton.names)
    assert (out / "body.bvh").exists()
    (held,) = json.loads((out / "score.json").read_text())["delivered"]
    # What holding the feet did is told of the file that is written, as the doctor sees it.
    assert held["delivered"]["sole_slide_mm_per_s"] == pytest.approx(sole_slide(back), rel=1e-3)


def test_jitter_is_named_with_what_takes_it_away(
    file: Path, short: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    clip, keys = read_clip(short), tmp_path / "keys.npz"
    points = clip.positions() + np.random.default_rng(0).normal(size=clip.positions().shape) * 0.01
    np.savez(keys, positions=points, names=np.array(clip.skeleton.names), fps=clip.fps)
    argv = ["track", str(keys), "--policy", str(file), *ALONE]
    assert main([*argv, "-o", str(tmp_path / "a")]) in (0, LOST)
    assert capsys.readouterr().out.count("The keypoints tremble by") == 1
    assert main([*argv, "-o", str(tmp_path / "b"), "--smooth", "6"]) in (0, LOST)
    assert "The keypoints tremble" not in capsys.readouterr().out


def test_a_rate_that_is_likely_wrong_is_told_before_anything_is_simulated(
    file: Path, short: Path, tmp_path: Path, monkeypatch, capsys: pytest.CaptureFixture[str]
) -> None:
    doubt, order = "the clip likely has 60 frames per second; state it with --fps 60.", list[str]()
    monkeypatch.setattr(tracking, "rate_doubts", lambda placed: [doubt])
    monkeypatch.setattr(track_verb, "tell", lambda text, style="": order.append(text))
    simulates = tracking.done_by
    monkeypatch.setattr(tracking, "done_by", lambda *a: order.append("simulated") or simulates(*a))
    argv = ["track", str(short), "--policy", str(file), *ALONE]
    assert main([*argv, "-o", str(tmp_path / "a")]) == LOST
    assert order == [doubt, "simulated"] and doubt not in capsys.readouterr().out
    assert main([*argv, "-o", str(tmp_path / "b"), "--json"]) == LOST
    assert doubt in json.loads(capsys.readouterr().out)["notes"]


def test_the_report_tells_of_the_file_that_came_in(
    file: Path, tmp_path: Path, refused, capsys: pytest.CaptureFixture[str]
) -> None:
    person, out = put(tmp_path, "person.txt", deepmimic(45)), tmp_path / "out"
    main(["track", str(person), "--policy", str(file), "-o", str(out), *ALONE])
    page = (out / "report.html").read_text("utf-8")
    assert "deepmimic" in page and "The file states no unit" not in page
    put(out, "score.json", "{}")
    for verb in ("eval", "play"):
        refused(verb, out, words=("result of poise track", "report.html"))
    (out / "learned").mkdir()
    put(out / "learned", "run.safetensors", "")
    refused("eval", out, words=(str(out / "learned"),))


def test_a_crowd(file: Path, short: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    assert (
        main(["track", str(short), "--policy", str(file), "-o", str(out), *ALONE, "--count", "2"])
        == LOST
    )
    assert "0 of 2 characters tracked all" in capsys.readouterr().out
    assert {p.name for p in out.iterdir()} == {
        "simulated_short-1.bvh", "simulated_short-2.bvh", "score.json", "report.html"
    }  # fmt: skip


def test_what_it_refuses(run: Path, file: Path, short: Path, tmp_path: Path, refused) -> None:
    out = str(tmp_path / "out")
    given = ("--policy", file, "-o", out)
    refused(
        "track", short, "--policy", tmp_path / "absent", "-o", out, words=("no such file or folder",)
    )
    weights = run / "policy.safetensors"
    refused("track", short, "--policy", weights, "-o", out, words=("without the body", str(run)))
    refused("track", short, *given, "--noise", "jiter:1", words=("no noise 'jiter'", "'jitter'"))
    refused("track", short, *given, "--noise", "jitter:lots", words=("must be a number",))
    refused("track", short, *given, "--seed", "-1", words=("--seed must",))
    refused("track", short, *given, "--count", "0", words=("--count must",))
    refused(
        "track", short, *given, "--recover", words=("has not learned to come back", "Leave --recover")
    )
    refused("track", short, *given, "--recover", "--count", "2", words=("a single character",))
    one = ("--policy", file, "-o", tmp_path / "one.bvh", "--count", "2")
    refused("track", short, *one, words=("several files",))
    refused("track", short, "--policy", file, "-o", tmp_path / "a.amc", words=("cannot be written",))
    refused("track", tmp_path / "absent.bvh", *given, words=("absent.bvh",))
    chair = tmp_path / "chair.json"
    refused("track", short, *given, "--support", chair, words=("chair.json", "cannot be read"))
    chair.write_text('{"size": [1, 1, 1], "pos": [0, 0, "high"]}')
    refused("track", short, *given, "--support", chair, words=("support 1: pos must be",))
    chair.write_text('{"size": [1, 1, 1], "pos": [0, 0, 1]}')
    refused("track", short, *given, "--support", chair, "--count", "2", words=("a single character",))
    refused("track", short, *given, "--support", chair, "--no-supports", words=("--no-supports",))


def test_motions_that_cannot_be_tracked(
    file: Path, tmp_path: Path, tmp_path_factory: pytest.TempPathFactory, refused
) -> None:
    folder, out = tmp_path_factory.mktemp("bad"), tmp_path / "out"
    write_clip(trim(read_clip(WALK), 0, 2), folder / "brief.bvh")
    refused("track", folder / "brief.bvh", "--policy", file, "-o", out, words=("at least 3",))
    snake = ["HIERARCHY"]
    for k in range(4):
        snake += [f"{'JOINT' if k else 'ROOT'} b{k}", "{", "OFFSET 0 30 0"]
        count = "6 Xposition Yposition Zposition" if k == 0 else "3"
        snake += [f"CHANNELS {count} Zrotation Xrotation Yrotation"]
    snake += ["End Site", "{", "OFFSET 0 30 0", "}", *["}"] * 4]
    rows = [" ".join(["0", "50", "0", *["0"] * 12])] * 20
    text = "\n".join([*snake, "MOTION", "Frames: 20", "Frame Time: 0.0333333", *rows]) + "\n"
    refused("track", put(folder, "snake.bvh", text), "--policy", file, "-o", out)
    damaged = folder / "damaged.safetensors"
    shutil.copy(file, damaged)
    damaged.write_bytes(damaged.read_bytes()[:-100])
    refused("track", WALK, "--policy", damaged, "-o", out, words=("damaged",))


def test_clips_one_after_another(
    short: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    later, clip = tmp_path / "later.bvh", read_clip(short)
    to = clip.root_pos[-1] - clip.root_pos[0] + np.array([0.5, 0.8, 0.0])
    write_clip(shifted(clip, to), later)
    out = tmp_path / "out.bvh"
    argv = ["track", str(short), str(later), "-o", str(out), "--controller", "policy"]
    assert main([*argv, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["inputs"] == [str(short), str(later)] and told["result"]["outcome"] == "tracked"
    first, second = told["result"]["clips"]
    assert first["done"] and second["done"] and second["clip"] == "later" and 0 < second["after"] < 10
    assert "2 of 2 clips done one after another" in told["result"]["sentence"]
    assert read_clip(out).seconds == pytest.approx(second["ends"], abs=0.05)
    assert main([*argv, "--force"]) == 0
    assert f"later: reached {second['after']:.1f} s after the clip before" in capsys.readouterr().out


def test_several_clips_that_are_refused(file: Path, short: Path, tmp_path: Path, refused) -> None:
    two, out = (short, short), ("-o", tmp_path / "out")
    refused("track", *out, words=("needs a motion file",))
    refused("track", short, tmp_path / "absent.bvh", *out, words=("absent.bvh",))
    refused("track", short, tmp_path, *out, words=("is a folder", "Name its files"))
    refused("track", *two, *out, "--learn", "1", words=("--learn is for a single clip",))
    refused("track", *two, *out, "--count", "2", words=("single clip", "several characters"))
    refused("track", *two, *out, "--noise", "jitter:1", words=("single clip", "noise"))
    refused("track", *two, *out, "--reset-on-fail", words=("single clip",))
    refused("track", *two, *out, "--controller", "search", words=("single clip", "search"))
    refused("track", *two, "-o", short, words=("written over itself",))
    refused("track", *two, *out, "--policy", file, words=("go from one clip to the next", "one clip"))
    pickled = tmp_path / "motion.npy"
    np.save(pickled, np.array({"a": 1}, dtype=object), allow_pickle=True)
    refused("track", short, pickled, *out, words=("pickled",))
    assert not (tmp_path / "out").exists()
