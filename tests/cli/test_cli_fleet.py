"""`poise fleet` in miniature: a table of results, a killed job, Ctrl-C and going on, refusals."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from functools import partial
from inspect import signature
from pathlib import Path

import pytest
from tiny_clips import deepmimic, put

from poise.cli.fleet import Options, plan
from poise.cli.main import main
from poise.cli.options import clips_in
from poise.jobs.fleet import run_fleet
from poise.learn import PPOConfig
from poise.recipes import ResidualForce
from poise.settings import to_toml

ITERATIONS = ["--set", "iterations=2"]


@pytest.fixture
def library(tmp_path: Path) -> Path:
    folder = tmp_path / "clips"
    (folder / "more").mkdir(parents=True)
    put(folder, "stand.txt", deepmimic())
    put(folder / "more", "short.txt", deepmimic(12))
    put(folder, "readme.txt", "No motion.")
    return folder


@pytest.fixture
def tiny(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Options of a training of few worlds, which begins from nothing."""
    file = tmp_path_factory.mktemp("settings") / "tiny.toml"
    ppo = PPOConfig(policy_hidden=(16,), value_hidden=(16,), std=ResidualForce().ppo.std)
    file.write_text(to_toml(ResidualForce(num_envs=16, expert=False, ppo=ppo)))
    return ["--set", f"config={file}"]


def table(out: Path) -> dict[str, dict]:
    try:
        jobs = json.loads((out / "fleet.json").read_text())["jobs"]
    except FileNotFoundError:
        return {}
    return {entry["name"]: entry for entry in jobs}


@pytest.mark.skipif(os.name != "posix", reason="signals")
@pytest.mark.timeout(240)
def test_a_fleet_with_a_killed_job_completes(
    library: Path, tiny: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, killed = tmp_path / "out", []

    def kill_one() -> None:
        limit = time.monotonic() + 100
        while not killed and time.monotonic() < limit:
            pid = table(out).get("stand", {}).get("pid")
            if pid is not None:
                os.kill(pid, signal.SIGKILL)
                killed.append(pid)
            time.sleep(0.05)

    thread = threading.Thread(target=kill_one)
    thread.start()
    code = main(["fleet", str(library), "-o", str(out), "--workers", "2", *tiny, *ITERATIONS])
    thread.join()
    said, told = capsys.readouterr()
    assert code == 0 and killed, told
    assert "stand: failed and will be tried again: its process was killed (SIGKILL)" in told
    jobs = table(out)
    assert set(jobs) == {"stand", "more-short"} and jobs["stand"]["attempts"] == 2
    for name, entry in jobs.items():
        assert entry["state"] == "done" and entry["score"]["episodes"] > 0
        files = {p.name for p in (out / name).iterdir()}
        assert files == {"simulated.bvh", "score.json", "report.html", "run"}
        assert name in said
    assert said.rstrip().endswith("fleet.json")
    # Results are no clips, and nothing is done twice.
    capsys.readouterr()
    assert main(["fleet", str(library), "-o", str(out), *tiny, *ITERATIONS]) == 0
    assert capsys.readouterr().err.count("was done before") == 2
    assert [n for n, _ in clips_in((tmp_path,), out)] == ["clips-more-short", "clips-stand"]


@pytest.mark.skipif(os.name != "posix", reason="signals")
@pytest.mark.timeout(240)
def test_ctrl_c_and_going_on(library: Path, tiny: list[str], tmp_path: Path) -> None:
    out = tmp_path / "out"
    argv = ["fleet", str(library / "stand.txt"), "-o", str(out), *tiny]
    command = [sys.executable, "-m", "poise", *argv]
    # Shells start background jobs with SIGINT turned off, and processes inherit that.
    process = subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL) and None,
    )
    checkpoint, limit = out / "stand" / "run" / "checkpoint.safetensors", time.monotonic() + 90
    while not checkpoint.exists() and time.monotonic() < limit and process.poll() is None:
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    _, told = process.communicate(timeout=90)
    assert process.returncode == 130, told
    assert "Stopped; 0 of 1 jobs are done. Go on with:" in told and "Traceback" not in told
    assert "poise fleet" in told and table(out)["stand"]["state"] == "waiting"
    log = (out / "logs" / "stand.txt").read_text()
    assert "the training so far is saved" in log


def test_a_failed_job_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    # Each attempt is a process; that there are three by default tests/jobs/test_fleet.py shows.
    assert signature(run_fleet).parameters["retries"].default == 2
    monkeypatch.setattr("poise.jobs.fleet.run_fleet", partial(run_fleet, retries=0))
    bad = put(tmp_path, "bad.bvh", "HIERARCHY\nROOT\n")
    assert main(["fleet", str(bad), "-o", str(tmp_path / "out"), *ITERATIONS]) == 1
    said, told = capsys.readouterr()
    assert "bad failed 1 times: " in told and "bad.bvh" in told.splitlines()[-1]
    assert "failed" in said and table(tmp_path / "out")["bad"]["error"]


def options(*library: Path, out: Path, **more: object) -> Options:
    return Options(tuple(library), out, **more)  # type: ignore[arg-type]


def test_a_sweep_is_every_combination(library: Path, tmp_path: Path) -> None:
    sweep = ("help_limit=0,50", "lfoot.kp=300,400", "method=rfc-implicit")
    jobs = plan(options(library, out=tmp_path / "out", seeds="0,7", set=sweep))
    assert len(jobs) == len({j.name for j in jobs}) == 2 * 2 * 4
    last = jobs[-1]
    assert last.name == "stand-s7-help-limit-50-lfoot.kp-400"
    text = " ".join(last.command)
    assert "--seed 7 --help-limit 50 --set lfoot.kp=400 --method rfc-implicit" in text
    assert last.facts["set"] == {"help-limit": "50", "lfoot.kp": "400", "method": "rfc-implicit"}
    one = plan(options(library / "stand.txt", library / "stand.txt", out=tmp_path / "out"))
    assert [j.name for j in one] == ["stand", "stand-2"]


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (["--seeds", "0,x"], "--seeds needs different whole numbers, got '0,x'. Write for example"),
        (["--seeds", "1,1"], "--seeds needs different whole numbers"),
        (["--set", "help-limit"], "--set needs NAME=VALUE or NAME=V,V,..."),
        (["--set", "seed=1,2"], "--set cannot set seed. Use --seeds"),
        (["--set", "help-limit=0,-3"], "--help-limit must be a number of at least 0 newtons"),
        (["--set", "colour=red"], "colour"),
        (["--set", "lfoot.kp=soft"], "needs a number, got 'soft'"),
        (["--minutes", "0"], "--minutes must be above 0"),
        (["--workers", "-1"], "--workers must be a whole number"),
        (["--address", "nonsense"], "Ray"),
        (["--address", "127.0.0.1:9"], "Ray"),
    ],
)
def test_mistakes_are_one_sentence(
    clip: Path, tmp_path: Path, refused: Callable[..., str], more: list[str], words: str
) -> None:
    begun = time.monotonic()
    refused("fleet", clip, "-o", tmp_path / "out", *more, words=(words,))
    assert time.monotonic() - begun < 15


def test_a_library_without_clips_is_refused(tmp_path: Path, refused: Callable[..., str]) -> None:
    refused("fleet", tmp_path / "none", "-o", tmp_path / "out", words=("there is no such file",))
    put(tmp_path, "notes.txt", "x")
    refused("fleet", tmp_path, "-o", tmp_path / "out", words=("holds no motion file",))
