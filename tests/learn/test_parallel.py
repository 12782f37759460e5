"""Two processes learn what one learns with all their environments, and go on after a kill."""

from __future__ import annotations

import csv
import os
import signal
import socket
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from toy_parallel import TOY, TwinEnv, spawned, trainer, twin_draws

from poise.learn import LAST_GOOD, LATEST, Trainer, Until, load_checkpoint, load_policy, run
from poise.learn.checkpoint import make_generator
from poise.learn.networks import RunningNorm
from poise.learn.parallel import ALONE, any_of, joined, moments, rank_seed, share_of, sums, together
from refusals import refused

pytestmark = pytest.mark.skipif(not torch.distributed.is_available(), reason="torch without distributed")
HERE = Path(__file__).resolve().parent


def free_port() -> int:
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return s.getsockname()[1]


def pair(*runs: tuple[Path, int, int]) -> None:
    """Runs of two processes, one after the other: folder, iterations and the rank that goes bad."""
    for folder, *_ in runs:
        folder.mkdir(exist_ok=True)
    told = [(free_port(), str(folder), iterations, bad) for folder, iterations, bad in runs]
    torch.multiprocessing.spawn(spawned, (2, told), nprocs=2)


def rows(folder: Path) -> list[dict[str, str]]:
    with (folder / "log.csv").open(newline="") as file:
        return [{k: v for k, v in r.items() if not k.startswith("time/")} for r in csv.DictReader(file)]


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of runs: "two" whole, "parts" gone on with in new processes, "bad" that stopped."""
    folder = tmp_path_factory.mktemp("runs")
    pair((folder / "two", 5, -1), (folder / "parts", 2, -1))
    pair((folder / "bad", 3, 1), (folder / "parts", 5, -1))
    return folder


@pytest.fixture(scope="module")
def two(runs: Path) -> Path:
    return runs / "two"


def test_two_processes_equal_one(two: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    one = Trainer(TwinEnv(32, 3), TOY, seed=3, character="point")
    noises = (make_generator(3, "noise"), make_generator(3, "noise 1"))
    twin_draws(one.ppo.actor.policy, monkeypatch, noises)
    run(one, Until(iterations=5), tmp_path, tensorboard=False)
    a, meta = load_checkpoint(two / LATEST)
    b, _ = load_checkpoint(tmp_path / LATEST)
    assert meta["processes"] == 2 and meta["num_envs"] == 32 and meta["samples"] == 5 * 8 * 32
    shared = [k for k in b if k.startswith(("norm/", "policy/", "critic/", "return_norm/", "adam/"))]
    assert len(shared) > 20
    for k in shared:
        torch.testing.assert_close(a[k], b[k], rtol=1e-4, atol=2e-6, msg=k)
    # The counts and means of what was seen are sums over the same numbers.
    for k in ("norm/count", "norm/mean", "norm/m2", "return_norm/count"):
        torch.testing.assert_close(a[k], b[k], rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(torch.cat([a["trainer/obs"], a["rank1/trainer/obs"]]), b["trainer/obs"],
                               rtol=1e-4, atol=1e-5)  # fmt: skip
    for x, y in zip(rows(two), rows(tmp_path), strict=True):
        assert x.keys() == y.keys()
        for k in x:
            assert float(x[k]) == pytest.approx(float(y[k]), rel=2e-3, abs=2e-5, nan_ok=True), k


def test_both_hold_the_same_weights_and_different_noise(two: Path) -> None:
    assert (two / "weights0.txt").read_text() == (two / "weights1.txt").read_text()
    state, _ = load_checkpoint(two / LATEST)
    assert not torch.equal(state["generator/noise"], state["rank1/generator/noise"])
    assert not torch.equal(state["env/rng"], state["rank1/env/rng"])
    assert load_policy(two / LATEST, character="point").num_obs == 4


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="threads are listed on Linux")
def test_no_thread_of_the_group_outlives_it(two: Path) -> None:
    """One that still held a tensor while Python ends would abort the process."""
    for rank in (0, 1):
        assert not [t for t in (two / f"threads{rank}.txt").read_text().split() if "gloo" in t]


def test_a_resumed_pair_is_bit_exact(two: Path, runs: Path) -> None:
    a, b = load_checkpoint(two / LATEST)[0], load_checkpoint(runs / "parts" / LATEST)[0]
    assert a.keys() == b.keys() and any(k.startswith("rank1/env/") for k in a)
    for k in a.keys() - {"trainer/counters"}:
        assert torch.equal(a[k], b[k]), k
    assert rows(two) == rows(runs / "parts")


def test_another_number_of_processes_is_refused(two: Path) -> None:
    with refused("checkpoint-unfit", says="2 processes"):
        trainer().load(two / LATEST)


def test_a_fault_in_one_process_stops_both(runs: Path) -> None:
    told = [(runs / "bad" / f"error{rank}.txt").read_text() for rank in (0, 1)]
    assert "process 1 stopped" in told[0]
    assert all("not finite" in text for text in told)
    assert (runs / "bad" / LAST_GOOD).exists()


@pytest.mark.skipif(os.name != "posix", reason="signals")
@pytest.mark.timeout(240)
def test_torchrun_goes_on_after_a_kill(two: Path, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "torch.distributed.run", "--nproc-per-node", "2"]
    command += [
        "--rdzv-backend",
        "c10d",
        "--rdzv-endpoint",
        "127.0.0.1:0",
        str(HERE / "toy_parallel.py"),
    ]
    env = {**os.environ, "PYTHONPATH": os.pathsep.join([str(HERE), *sys.path])}

    def start(iterations: int) -> subprocess.Popen[str]:
        return subprocess.Popen(
            [*command, str(tmp_path), str(iterations)],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env=env,
            start_new_session=True,
        )

    process, deadline = start(100_000), time.monotonic() + 100
    while not (tmp_path / LATEST).exists() and time.monotonic() < deadline and process.poll() is None:
        time.sleep(0.01)
    time.sleep(0.3)
    # Torchrun's workers have sessions of their own; they end when their parent has gone.
    workers = _children(process.pid)
    for pid in (*workers, process.pid):
        os.kill(pid, signal.SIGKILL)
    said = process.communicate(timeout=60)[0]
    assert workers, said
    reached = load_checkpoint(tmp_path / LATEST)[1]["iteration"]
    process = start(reached + 3)
    said = process.communicate(timeout=120)[0]
    assert process.returncode == 0 and "finished" in said, said
    table = rows(tmp_path)
    assert [int(r["iteration"]) for r in table] == list(range(1, reached + 4))
    assert table[:5] == rows(two)[: len(table[:5])]


def _children(pid: int) -> list[int]:
    listed = subprocess.run(["ps", "-o", "pid=", "--ppid", str(pid)], capture_output=True, text=True)
    return [int(x) for x in listed.stdout.split()]


def test_a_single_process_is_left_as_it_was(monkeypatch: pytest.MonkeyPatch) -> None:
    x = torch.randn(50)
    assert [float(v) for v in moments(ALONE, x)] == [float(x.mean()), float(x.std())]
    assert sums(ALONE, [1.0, 2.0]) == [1.0, 2.0] and any_of(ALONE, True) and not any_of(ALONE, False)
    with joined() as comm:
        assert comm is ALONE
    monkeypatch.setenv("WORLD_SIZE", "4")  # As a batch system may leave it behind.
    with joined() as comm:
        assert comm is ALONE
    with pytest.raises(ZeroDivisionError), together(ALONE):
        raise ZeroDivisionError
    assert rank_seed(5, 0) == 5 and len({rank_seed(s, r) for s in range(9) for r in range(9)}) == 81


def test_environments_are_dealt_out_evenly() -> None:
    comm = type("Three", (), {"rank": 0, "size": 3, "local_size": 3})()
    assert share_of(510, comm) == 170
    with refused("not-a-multiple", says=("512", "510", "--envs")):
        share_of(512, comm)


def test_merging_statistics_equals_observing_all() -> None:
    x, y = torch.randn(70, 3), 5 + torch.randn(30, 3)
    whole, parts = RunningNorm(3, window=80), RunningNorm(3, window=80)
    whole.observe(torch.cat([x, y]))
    both = torch.cat([x, y]).double()
    parts.merge(100, both.mean(0), (both - both.mean(0)).square().sum(0))
    for name, value in whole.state_dict().items():
        torch.testing.assert_close(value, parts.state_dict()[name])


def test_more_samples_per_minibatch_are_counted_over_all(two: Path) -> None:
    """With the whole batch as minibatch one Adam step is taken per epoch, in one process or two."""
    steps = load_checkpoint(two / LATEST)[0]["adam/policy/0/step"]
    alone = trainer(config=replace(TOY))
    for _ in range(5):
        alone.iterate()
    assert float(steps) == float(alone.ppo.state()["adam/policy/0/step"]) == 5 * TOY.epochs
