"""A run of the real task, killed at any moment, goes on bit for bit."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

SCRIPT = """
import sys
from pathlib import Path
sys.path.insert(0, {tests!r})
import torch
torch.set_num_threads(1)
from toy_human import swing
from poise.learn import PPOConfig, Until
from poise.motion import ClipLibrary
from poise.recipes.residual_force import ResidualForce
from poise.jobs.runs import begin, train
folder = Path(sys.argv[1])
small = {{"policy_hidden": (16,), "value_hidden": (16,)}}
ppo = PPOConfig(horizon=4, minibatch=32, epochs=2, norm_warmup=2, **small)
imitation = begin(folder, ClipLibrary.of(swing(2.0)), ResidualForce(num_envs=16, ppo=ppo, seed=3))
train(imitation, folder, Until(iterations={iterations}), threads=1, tensorboard=False)
print("finished", flush=True)
"""


def _run(folder: Path, iterations: int, kill_after: float | None = None) -> bool:
    tests = str(Path(__file__).resolve().parents[1])
    code = SCRIPT.format(tests=tests, iterations=iterations)
    process = subprocess.Popen(
        [sys.executable, "-c", code, str(folder)], stdout=subprocess.PIPE, stderr=subprocess.STDOUT
    )
    if kill_after is not None:
        checkpoint = folder / "checkpoint.safetensors"
        deadline = time.monotonic() + 60
        before = checkpoint.stat().st_mtime_ns if checkpoint.exists() else 0
        while time.monotonic() < deadline and process.poll() is None:
            if checkpoint.exists() and checkpoint.stat().st_mtime_ns != before:
                break
            time.sleep(0.002)
        time.sleep(kill_after)
        if process.poll() is None:
            os.kill(process.pid, signal.SIGKILL)
    out = process.communicate(timeout=120)[0].decode()
    assert kill_after is not None or "finished" in out, out
    return "finished" in out


def _tensors(folder: Path) -> dict[str, torch.Tensor]:
    from poise.learn import load_checkpoint

    tensors = load_checkpoint(folder / "checkpoint.safetensors")[0]
    # The clock is the one number that differs between two runs.
    tensors["trainer/counters"][2] = 0.0
    return tensors


@pytest.mark.timeout(240)
def test_killed_runs_end_like_the_uninterrupted_one(tmp_path: Path) -> None:
    iterations, rng = 60, random.Random(0)
    _run(tmp_path / "whole", iterations)
    kills = 0
    for _ in range(4):
        if _run(tmp_path / "killed", iterations, kill_after=rng.uniform(0.0, 0.15)):
            break
        kills += 1
    _run(tmp_path / "killed", iterations)
    assert kills >= 2
    a, b = _tensors(tmp_path / "whole"), _tensors(tmp_path / "killed")
    assert a.keys() == b.keys()
    different = [k for k in a if not torch.equal(a[k], b[k])]
    assert not different
