"""The help budget: what is left of the limits, how it follows the episodes, and that it is kept."""

from __future__ import annotations

import pytest
import torch

from poise.control import SuccessHelp
from poise.env.help import HelpBudget, scale_in


def push(env, scale: float) -> torch.Tensor:
    env.help.set(scale)
    env.reset_to(torch.zeros(env.num_envs, dtype=torch.long), torch.full((env.num_envs,), 3))
    action = torch.zeros(env.num_envs, env.num_actions)
    action[:, -6:] = torch.tensor([0.6, 0.0, 0.0, 0.0, 0.3, 0.0])
    step = env.step(action)
    assert step.log["help/limit_n"] == pytest.approx(100.0 * scale)
    return torch.cat((env.wrench.force[:, 0], env.wrench.torque[:, 0]), -1).norm(dim=-1)


def test_the_scale_multiplies_the_limits_on_both_paths(make_env):
    """The recorded path, taken first at full help, must follow a scale that changes later."""
    env = make_env(3)
    full = push(env, 1.0)
    torch.testing.assert_close(full, torch.full((3,), 100 * (0.6**2 + 0.3**2) ** 0.5))
    torch.testing.assert_close(push(env, 0.25), full / 4)
    assert push(env, 0.0).abs().max() == 0


def test_without_help_the_drive_is_that_of_help_scaled_to_nothing(make_env):
    """The short way taken without help moves the characters as the long one does, to the last digit."""
    short, long = make_env(2), make_env(2)
    long.controls.actuation.functions[False] = long.controls.actuation.with_help
    for env in (short, long):
        env.help.set(0.0)
        env.reset_to(torch.zeros(2, dtype=torch.long), torch.full((2,), 3))
        for k in range(4):
            env.step(torch.full((2, env.num_actions), 0.1 * k))
    assert torch.equal(short.backend.state.qpos, long.backend.state.qpos)
    for ours, theirs in zip(short.wrench[:3], long.wrench[:3], strict=True):
        torch.testing.assert_close(ours, theirs)
    assert short.wrench.body == long.wrench.body


def count(budget: HelpBudget, ended: int, failed: int) -> None:
    """One control step in which episodes of a single group ended, some by failure."""
    budget.add(torch.zeros(ended).long(), torch.ones(ended), torch.arange(ended) < failed)


def test_it_counts_with_fading_memory():
    budget = HelpBudget(SuccessHelp(lower_at=0.8, raise_at=0.5, factor=0.5, every=2))
    count(budget, 10, 0)
    assert float(budget.scale) == 1.0
    count(budget, 0, 0)
    assert float(budget.scale) == 0.5 and budget.success == 1.0
    count(budget, 2, 2)
    # 8 remembered successes and 2 failures.
    assert budget.success == pytest.approx(0.8)
    count(budget, 0, 0)
    assert float(budget.scale) == 0.25


def test_nothing_ended_is_no_success():
    budget = HelpBudget(SuccessHelp(every=1))
    count(budget, 0, 0)
    assert float(budget.scale) == 1.0


def test_the_state_goes_on_where_it_was(make_env):
    one, two = (
        make_env(4, help_start=100.0, help_limit=0.0),
        make_env(4, help_start=100.0, help_limit=0.0),
    )
    one.help.schedule = two.help.schedule = SuccessHelp(factor=0.9, every=3)
    g = torch.Generator().manual_seed(0)
    one.reset()
    for _ in range(7):
        one.step(0.1 * torch.randn(4, one.num_actions, generator=g))
    two.load_state(one.state())
    assert float(two.help.scale) == float(one.help.scale) and two.help.steps == 7
    assert scale_in({"env/help": one.state()["help"]}) == float(one.help.scale)
    action = torch.randn(4, one.num_actions, generator=g)
    for _ in range(5):
        a, b = one.step(action), two.step(action)
        assert torch.equal(a.obs, b.obs) and torch.equal(a.reward, b.reward)


def test_evaluation_does_not_change_it(make_env):
    env = make_env(2, auto_reset=False, help_start=100.0, help_limit=0.0)
    assert env.help.schedule is None


def test_a_finished_clip_is_worth_as_many_last_steps_as_stated(make_env):
    """With discount 0.95 the last reward counts 1 + 19 times; a failed or running episode's once."""
    env, plain = make_env(3, expert=False), make_env(3, completion_bonus=False)
    assert env.task.completion_bonus == pytest.approx(19.0) and plain.task.completion_bonus == 0.0
    last = int(env.reference.length[0]) - 2
    for e in (env, plain):
        e.reset_to(torch.zeros(3, dtype=torch.long), torch.tensor([last, last - 1, last]))
    a, b = (e.step(torch.zeros(3, env.num_actions)) for e in (env, plain))
    assert a.terminated.tolist() == [True, False, True] and not a.failed.any()
    torch.testing.assert_close(a.reward / b.reward, torch.tensor([20.0, 1.0, 20.0]))
    torch.testing.assert_close(env.imitation, plain.imitation)
