"""What is measured on a GPU: all of it tiny on the CPU, going on where it was stopped."""

from __future__ import annotations

import time
from pathlib import Path

import pytest
import torch

from benchmarks.suites.gpu import OnDevice, bench_figure
from poise.learn import Trainer
from poise.recipes.imitation import Imitation
from poise.recipes.perpetual import build as build_tracking
from toy_library import PLAIN, library, tiny


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
    one.close()
    two.close()
