"""Fleets on Ray: a killed worker's job is tried again; an address without a cluster is one sentence."""

from __future__ import annotations

import socket
import sys
import threading
import time
from importlib.util import find_spec
from pathlib import Path

import pytest
from fleet_jobs import job, tries

from poise.jobs import workers as fleet_workers
from poise.jobs.fleet import run_fleet
from poise.jobs.workers import make_workers
from refusals import refused

with_ray = pytest.mark.skipif(find_spec("ray") is None, reason="Ray is not installed")


@with_ray
@pytest.mark.timeout(240)
def test_a_fleet_on_ray_survives_a_killed_worker(tmp_path: Path) -> None:
    modes = ("work", "orphan", "work", "die", "refuse", "work")
    jobs = [job(tmp_path, f"{k}{mode}", mode) for k, mode in enumerate(modes)]
    failures: list[str] = []
    workers = make_workers("local", 2, len(jobs), 0)
    assert workers.slots == 2 and workers.threads >= 1

    def note(event: str, record) -> None:
        failures.extend([record.error] * (event == "again"))

    result = run_fleet(jobs, tmp_path, workers, retries=1, on_event=note)
    assert [r.state for r in result.records] == [*["done"] * 4, "failed", "done"]
    assert tries(tmp_path, "1orphan") == 2 and tries(tmp_path, "3die") == 2
    assert any("Ray worker was lost" in text for text in failures), failures
    assert any("killed (SIGKILL)" in text for text in failures)
    assert result.records[4].error == "walk.bvh: the clip is too short. Give a longer one"


@with_ray
@pytest.mark.timeout(240)
def test_ctrl_c_reaches_the_jobs_on_ray(tmp_path: Path) -> None:
    def press(event: str, record) -> None:
        deadline = time.monotonic() + 60
        while event == "started" and not tries(tmp_path, "slow") and time.monotonic() < deadline:
            time.sleep(0.05)
        time.sleep(0.3)
        raise KeyboardInterrupt

    jobs = [job(tmp_path, "slow", "hang")]
    result = run_fleet(jobs, tmp_path, make_workers("local", 1, 1, 0), on_event=press)
    assert result.interrupted and (tmp_path / "slow" / "saved").exists()


def test_an_address_without_a_cluster_is_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fleet_workers, "_import_ray", lambda: None)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    for address in (f"127.0.0.1:{port}", f"ray://127.0.0.1:{port}"):
        with refused("no-answer") as caught:
            make_workers(address, 1, 1, 1)
        assert address in str(caught.value)
    for address in ("nonsense", "host:port", ":6379", "host:99999"):
        with refused("address-malformed"):
            make_workers(address, 1, 1, 1)


@with_ray
def test_a_port_that_is_not_rays_is_one_sentence() -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        begun = time.monotonic()
        with refused("no-answer"):
            make_workers(f"127.0.0.1:{other.getsockname()[1]}", 1, 1, 1)
    assert time.monotonic() - begun < 25 and threading.active_count() >= 1


def test_the_missing_package_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with refused("extra-missing", says="poise-motion[fleet]"):
        make_workers("auto", 1, 1, 1)
