"""`poise train` started by torchrun: one run, one voice, and it goes on."""

from __future__ import annotations

import csv
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from poise.cli.training import command_line
from poise.learn import LATEST, load_checkpoint, load_policy

pytestmark = pytest.mark.skipif(not torch.distributed.is_available(), reason="torch without distributed")
TORCHRUN = [sys.executable, "-m", "torch.distributed.run", "--nproc-per-node", "2"]
TORCHRUN += ["--rdzv-backend", "c10d", "--rdzv-endpoint", "127.0.0.1:0", "-m", "poise"]


def launch(*argv: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run([*TORCHRUN, *map(str, argv)], capture_output=True, text=True, timeout=150)


@pytest.mark.timeout(320)
def test_two_processes_train_one_run(clip: Path, tmp_path: Path) -> None:
    command = ("train", "residual-force", clip, "-o", tmp_path / "run", "--envs", 16)
    first = launch(*command, "--iterations", 1)
    assert first.returncode == 0, first.stderr
    assert first.stdout.count("Trained") == 1
    again = launch(*command, "--iterations", 2, "--resume")
    assert again.returncode == 0, again.stderr
    with (tmp_path / "run" / "log.csv").open(newline="") as file:
        samples = [int(r["samples"]) for r in csv.DictReader(file)]
        # The first process cloned the expert for both: four rounds of 56 steps, and 32 for the critic.
        cloned = 16 * (4 * 56 + 32)
        assert samples == [cloned + 16 * 16, cloned + 2 * 16 * 16]
    state, meta = load_checkpoint(tmp_path / "run" / LATEST)
    assert meta["processes"] == 2 and meta["num_envs"] == 16
    # Each process has eight worlds of its own, which started from other frames.
    assert len(state["env/clip"]) == len(state["rank1/env/clip"]) == 8
    assert not torch.equal(state["trainer/obs"], state["rank1/trainer/obs"])
    assert load_policy(tmp_path / "run" / LATEST).num_actions > 0


def test_the_way_to_go_on_names_torchrun(monkeypatch: pytest.MonkeyPatch) -> None:
    assert command_line("train", ["x"]) == "poise train x --resume"
    launched = {"TORCHELASTIC_RUN_ID": "1", "RANK": "0", "WORLD_SIZE": "4", "LOCAL_WORLD_SIZE": "4"}
    for name, value in launched.items():
        monkeypatch.setenv(name, value)
    assert command_line("train", ["x"]) == "torchrun --nproc-per-node 4 -m poise train x --resume"
    monkeypatch.setenv("LOCAL_WORLD_SIZE", "2")
    assert "--nnodes 2 --nproc-per-node 2" in command_line("train", ["x"])
