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

import poise
from poise.body import Humanoid
from poise.env import Frame, RewardTerm
from poise.jobs.runs import begin, train
from poise.learn import PPOConfig, Until, load_checkpoint
from poise.motion import ClipLibrary
from poise.recipes.residual_force_settings import ResidualForce
from refusals import refused
from toy_human import swing

SCRIPT = """
import sys
from pathlib import Path
sys.path[:0] = [{tests!r}, {here!r}]
import torch
torch.set_num_threads(1)
from test_resume_imitation import trained
trained(Path(sys.argv[1]), {iterations})
"""


def trained(folder: Path, iterations: int) -> None:
    small = {"policy_hidden": (16,), "value_hidden": (16,)}
    ppo = PPOConfig(horizon=4, minibatch=32, epochs=2, norm_warmup=2, **small)
    config = ResidualForce(num_envs=16, ppo=ppo, seed=3, expert=False)
    imitation = begin(folder, ClipLibrary.of(swing(1.0)), config)
    train(imitation, folder, Until(iterations=iterations), threads=1, tensorboard=False)


def _killed(folder: Path, iterations: int, kill_after: float) -> bool:
    """Whether a process that trains was killed, so many seconds after it saved."""
    here = Path(__file__).resolve().parent
    code = SCRIPT.format(tests=str(here.parent), here=str(here), iterations=iterations)
    process = subprocess.Popen(
        [sys.executable, "-c", code, str(folder)], stdout=subprocess.PIPE, stderr=subprocess.STDOUT
    )
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
    assert process.returncode in (0, -signal.SIGKILL), out
    return process.returncode != 0


def _tensors(folder: Path) -> dict[str, torch.Tensor]:
    tensors = load_checkpoint(folder / "checkpoint.safetensors")[0]
    # The clock is the one number that differs between two runs.
    tensors["trainer/counters"][2] = 0.0
    return tensors


@pytest.mark.timeout(240)
def test_killed_runs_end_like_the_uninterrupted_one(tmp_path: Path) -> None:
    iterations, rng = 40, random.Random(0)
    trained(tmp_path / "whole", iterations)
    for _ in range(2):
        assert _killed(tmp_path / "killed", iterations, kill_after=rng.uniform(0.0, 0.15))
    trained(tmp_path / "killed", iterations)
    a, b = _tensors(tmp_path / "whole"), _tensors(tmp_path / "killed")
    assert a.keys() == b.keys()
    different = [k for k in a if not torch.equal(a[k], b[k])]
    assert not different


def _low_hands(frame: Frame, bodies: torch.Tensor) -> torch.Tensor:
    return torch.exp(-frame.sim.pos.index_select(1, bodies)[..., 2].mean(-1))


def _own_rewards(body: Humanoid) -> list[RewardTerm]:
    hands = torch.tensor(body.rows_of("hand"))
    return [RewardTerm("low_hands", _low_hands, 0.5, {"bodies": hands}, imitation=False)]


def test_rewards_of_a_program_leave_a_run_that_opens(tmp_path: Path) -> None:
    """And nobody goes on with it without them."""
    ppo = PPOConfig(horizon=4, minibatch=16, policy_hidden=(8,))
    small = {"num_envs": 8, "expert": False, "ppo": ppo}
    heard: list[float] = []

    def tell(stats: poise.learn.IterationStats) -> None:
        heard.append(stats.terms["reward/low_hands"])

    clip = swing(1.0)
    how = {"iterations": 1, "folder": tmp_path, "threads": 1, "on_iteration": tell}
    made = poise.imitate(clip, rewards=_own_rewards, **how, **small)
    assert 0 < heard[0] < 1
    assert made.run is not None
    assert poise.open_run(tmp_path).score().succ == made.card.succ
    with refused("settings-differ", "low_hands"):
        poise.imitate(clip, **how, **small)
