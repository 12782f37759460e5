"""More characters than memory allows are refused with the number that fits."""

from __future__ import annotations

from pathlib import Path

import pytest

from poise.recipes import ResidualForce, build
from poise.recipes.imitation import Imitation, check_memory, free_bytes, learner_bytes
from refusals import refused
from toy_human import swing


@pytest.fixture
def machine(tmp_path: Path) -> Path:
    (tmp_path / "proc").mkdir()
    (tmp_path / "sys/fs/cgroup").mkdir(parents=True)
    (tmp_path / "proc/meminfo").write_text("MemTotal: 9000 kB\nMemAvailable:    5000 kB\n")
    return tmp_path


def test_free_memory_is_the_least_that_is_known(machine: Path):
    group = machine / "sys/fs/cgroup"
    assert free_bytes(machine) == 5000 * 1024
    (group / "memory.max").write_text("max\n")
    (group / "memory.current").write_text("1000000\n")
    assert free_bytes(machine) == 5000 * 1024
    (group / "memory.max").write_text("3000000\n")
    assert free_bytes(machine) == 2_000_000
    assert free_bytes(machine / "elsewhere") is None


def test_what_fits_passes_and_what_does_not_is_told():
    check_memory(80, 10, 1000)
    check_memory(10**9, 10, None)
    with refused("out-of-memory", says=("81", "--envs 80")):
        check_memory(81, 10, 1000)
    assert learner_bytes(2, 10, 3) == 2 * (60 + 24 + 48) + 160


def test_a_trainer_of_millions_is_refused_before_anything_is_made(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("poise.recipes.imitation.free_bytes", lambda: 10**9)
    task: Imitation = build(swing(), ResidualForce(num_envs=5_000_000))
    with refused("out-of-memory", says="5,000,000") as told:
        task.trainer()
    fit = int(str(told.value).split("--envs ")[1].rstrip("."))
    # Some tens of kilobytes each.
    assert 10**9 / 200_000 < fit < 10**9 / 10_000
