"""What is measured on a GPU: all of it tiny on the CPU, going on where it was stopped."""

from __future__ import annotations

import json
import time
from pathlib import Path
from types import SimpleNamespace

import gpu
import pytest
import torch
from gpu import PIECES, main
from speed import conformance
from speed.conformance import bench_conformance, run_tests
from speed.learning import ActsOn, OnDevice, bench_figure

from poise.learn import Trainer
from poise.recipes import ResidualForce, build
from poise.recipes.imitation import Imitation
from poise.recipes.perpetual import build as build_tracking
from toy_human import swing
from toy_library import PLAIN, library, tiny
from warp_device import WARP_DEVICE, needs_warp


@pytest.fixture(autouse=True)
def without_gpu(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    if "warp" not in request.node.name:
        monkeypatch.setattr(torch.cuda, "is_available", lambda: False)


@pytest.fixture(scope="module")
def tracked() -> Imitation:
    return build_tracking(library(), tiny(**PLAIN))


def said(capsys: pytest.CaptureFixture) -> str:
    told = capsys.readouterr()
    return " ".join((told.out + told.err).split())


def test_all_pieces_are_measured_once(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    path = tmp_path / "gpu.json"
    assert main(["--tiny", "--json", str(path)]) == 0
    rows = json.loads(path.read_text())["rows"]
    assert tuple(r["piece"] for r in rows) == PIECES and all(r["finished"] for r in rows)
    found = {r["piece"]: r["result"] for r in rows}
    assert found["conformance"] == {"why": "there is no GPU"}
    # So short a timing says nothing of the ratio.
    assert found["stepping"]["stepping_of_raw"] > 0 and found["stepping"]["envs"] == 8
    assert found["labels"]["labels_per_s"] > 0 and 0 < found["labels"]["copies_share"] < 1
    assert found["training"]["samples_per_s"] > 0 and found["training"]["batch"] == 32
    curve = found["figure"]["curve"]
    assert [r["samples"] for r in curve] == [32, 64] and 0 <= curve[-1]["succ"] <= 1
    assert all(r["machine"]["mujoco_warp"] is None or r["machine"]["gpu"] is None for r in rows)
    said(capsys)
    assert main(["--tiny", "--json", str(path)]) == 0
    assert said(capsys).count("is there") == 5
    assert json.loads(path.read_text())["rows"] == rows
    # A row of another machine stays, and says nothing about this one.
    rows[3]["machine"]["cores"] += 1
    path.write_text(json.dumps({"rows": rows}))
    assert main(["conformance", "training", "--tiny", "--json", str(path)]) == 0
    again = json.loads(path.read_text())["rows"]
    assert said(capsys).count("is there") == 1 and again[:5] == rows and len(again) == 6
    assert main(["conformance", "--tiny", "--again", "--json", str(path)]) == 0
    assert "is there" not in said(capsys) and len(json.loads(path.read_text())["rows"]) == 6


def test_what_the_clock_leaves_is_told(
    tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(gpu, "LIMIT_S", -1.0)
    assert main(["stepping", "--tiny", "--json", str(tmp_path / "gpu.json")]) == 0
    assert "Stopped by the clock: stepping, MuJoCo on the cores. The same command" in said(capsys)
    assert not (tmp_path / "gpu.json").exists()


def test_training_to_a_figure_goes_on(tracked: Imitation, tmp_path: Path) -> None:
    path, about = tmp_path / "gpu.safetensors", {"clips": "three"}
    far, past = time.monotonic() + 100, time.monotonic() - 1
    first = bench_figure(tracked, "cpu", "cpu", path, about, far, 0.0, 1)
    stopped = bench_figure(tracked, "cpu", "cpu", path, about, past)
    assert not stopped["finished"] and not stopped["reached"]
    assert stopped["samples"] == first["samples"] and stopped["curve"] == first["curve"]
    second = bench_figure(tracked, "cpu", "cpu", path, about, far, 0.0, 2)
    assert second["samples"] == 2 * first["samples"] and second["curve"][:1] == first["curve"]
    # What was trained with other settings is no beginning.
    other = bench_figure(tracked, "cpu", "cpu", path, {"clips": "one"}, far, 0.0, 1)
    assert other["samples"] == first["samples"] and len(other["curve"]) == 1


def test_worlds_for_a_learner_elsewhere_are_the_same(tracked: Imitation) -> None:
    ppo, seed = tracked.ppo(), tracked.config.seed
    one = Trainer(tracked.env(threads=1), ppo, seed)  # type: ignore[arg-type]
    two = Trainer(OnDevice(tracked.env(threads=1), "cpu"), ppo, seed)
    for _ in range(2):
        assert one.iterate().reward == two.iterate().reward
    assert torch.equal(one.state()["trainer/obs"], two.state()["trainer/obs"])
    obs = torch.randn(3, one.env.num_obs)
    assert torch.equal(ActsOn(one.ppo.actor, "cpu").act(obs), two.ppo.actor.act(obs))
    one.close()
    two.close()


def test_the_tests_of_the_backend_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    text = "FAILED tests/sim/test_warp.py::test_it - no\n1 failed, 20 passed, 3 deselected in 9.1s\n"
    told = SimpleNamespace(stdout=text, returncode=1)
    monkeypatch.setattr(conformance.subprocess, "run", lambda *_, **__: told)
    found = run_tests(time.monotonic() + 9)
    assert found["failed"] == 1 and found["passed"] == 20 and found["exit_code"] == 1
    assert found["which_failed"] == ["tests/sim/test_warp.py::test_it - no"]


@needs_warp
def test_warp_is_set_beside_the_cpu() -> None:
    imitation = build(swing(), ResidualForce(num_envs=4))
    until = time.monotonic() + 250
    found = bench_conformance(imitation, 4, WARP_DEVICE, 2, until, "elliptic")
    assert [r["control_steps"] for r in found["rows"]] == [1, 2] and found["rows"][0]["within"] == 1
    assert found["rows"][0]["reward"]["max"] < 1e-3
    json.dumps(found, allow_nan=False)


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        ([], "PyTorch finds no CUDA GPU"),
        (["--tiny", "--library", "clips"], "--library and --onto go together"),
        (["sleeping", "--tiny"], "sleeping"),
    ],
)
def test_mistakes_are_told(
    argv: list[str], words: str, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    assert main([*argv, "--json", str(tmp_path / "gpu.json")]) == 2
    assert words in said(capsys) and not list(tmp_path.iterdir())


def test_a_file_of_something_else_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    path = tmp_path / "gpu.json"
    path.write_text("{}")
    assert main(["--tiny", "--json", str(path)]) == 2
    assert "holds no figures of this benchmark" in said(capsys) and path.read_text() == "{}"
