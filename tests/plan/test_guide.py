"""A hand that leads the root: none without help, more the farther off, within its limit."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch

from poise.env import ImitationEnv
from poise.plan import Guide
from poise.recipes.imitation import Imitation

N = 4
MakeTask = Callable[..., Imitation]


@pytest.fixture
def led(make_task: MakeTask) -> ImitationEnv:
    """Characters that a hand leads which no inverse dynamics tells anything."""
    task = make_task(help_limit=5000.0)
    nothing = torch.zeros(len(task.reference.qpos), 3)
    assert task.task.residual is not None
    guide = Guide(task.reference, task.task.residual, nothing, nothing)
    return replace(task, task=replace(task.task, guide=guide)).env(N, auto_reset=False, threads=1)


def wrench(env: ImitationEnv, lift: float, scale: float = 1.0) -> torch.Tensor:
    """The force `(N, 3)` on characters that are `lift` m above their motion and begin to act."""
    env.reset_to(torch.zeros(N, dtype=torch.long), torch.arange(N) * 5)
    qpos, qvel = env.backend.state.qpos.clone(), env.backend.state.qvel.clone()
    qpos[:, 2] += lift
    env.backend.write(None, qpos, qvel)
    env.help.set(scale)
    env.step(torch.zeros(N, env.num_actions))
    assert env.wrench is not None
    return env.wrench.force[:, 0]


def test_it_pulls_back_by_the_stated_spring(led: ImitationEnv) -> None:
    k = led.reference.humanoid.mass * 5.0**2
    down = wrench(led, 0.1) - wrench(led, 0.0)
    torch.testing.assert_close(down[:, 2], torch.full((N,), -0.1 * k), atol=0.5, rtol=2e-3)
    assert float(down[:, :2].abs().max()) < 0.5
    # With half of the help left it is half as strong, and with none there is none.
    torch.testing.assert_close(wrench(led, 0.1, 0.5), wrench(led, 0.1) / 2, atol=0.5, rtol=2e-3)
    assert float(wrench(led, 0.1, 0.0).abs().max()) == 0.0


def test_it_stays_within_the_limit(led: ImitationEnv) -> None:
    assert float(wrench(led, 50.0).norm(dim=-1).max()) <= 5000.0 * (1 + 1e-5)
