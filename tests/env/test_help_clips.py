"""Help by clip: each follows its own episodes, worlds get that of their clip, and it is kept."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch

from poise.control import ExplicitResidual, LinearHelp, SuccessHelp
from poise.env import ImitationEnv
from poise.env.help import EPISODES, KEPT, HelpBudget, scale_in
from poise.recipes.imitation import Imitation
from refusals import refused
from toy_human import swing

CLIPS = (swing(0.5), swing(0.6, bend=0.4, name="second"), swing(0.7, bend=0.6, name="third"))
RULE = SuccessHelp(factor=0.5, smallest=0.2, every=2)


@pytest.fixture(scope="module")
def task(make_task: Callable[..., Imitation]) -> Imitation:
    built = make_task(*CLIPS, help_start=100.0, help_limit=0.0)
    return replace(built, task=replace(built.task, help=RULE, help_by="clip"))


def ended(budget: HelpBudget, *outcomes: tuple[int, bool]) -> None:
    """One step in which episodes of clips ended, and whether by failure."""
    clips = torch.tensor([c for c, _ in outcomes], dtype=torch.long)
    failed = torch.tensor([f for _, f in outcomes]).double()
    budget.add(clips, torch.ones_like(failed), failed)


def test_one_group_counts_as_plain_python_does():
    """Against the rule written out for numbers, to the last bit."""
    rule, rng = SuccessHelp(every=3, factor=0.93), torch.Generator().manual_seed(0)
    budget, scale, counts = HelpBudget(rule), 1.0, [0.0, 0.0]
    for step in range(1, 400):
        n = int(torch.randint(0, 6, (), generator=rng))
        failed = torch.rand(n, generator=rng) < (0.9 if step % 100 > 60 else 0.2)
        budget.add(torch.randint(0, 7, (n,), generator=rng), torch.ones(n), failed)
        counts = [counts[0] + n, counts[1] + int(failed.sum())]
        if step % 3 == 0:
            success = 1.0 - counts[1] / counts[0] if counts[0] else float("nan")
            scale = float(torch.tensor(rule.scale(scale, step, success), dtype=torch.float32))
            counts = [KEPT * x for x in counts]
        assert budget.now == float(budget.scale) == scale
        assert budget.state()["help"].tolist() == [scale, step, *counts]
    assert scale < 1.0 and budget.scale.dim() == 0


def test_who_succeeds_loses_help_and_who_fails_keeps_it():
    budget = HelpBudget(RULE, groups=3)
    for _ in range(20):
        ended(budget, *((0, True), (1, False)) * 3)
    # The third clip has had no episode at all.
    assert budget.scale.tolist() == [1.0, 0.0, 1.0] and budget.now == 1.0
    assert budget.success == pytest.approx(0.5)
    for _ in range(20):
        ended(budget, *((0, False), (1, True)) * 3)
    assert budget.scale.tolist() == [0.0, 1.0, 1.0]


def test_a_clip_waits_until_enough_is_known_of_it():
    budget = HelpBudget(RULE, groups=2)
    for _ in range(int(EPISODES) - 1):
        ended(budget, (0, False))
        ended(budget)
    assert budget.scale.tolist() == [1.0, 1.0]
    # Nothing of it fades in the meantime; from now on each episode more is one decision.
    for k in (1, 2):
        ended(budget, (0, False))
        ended(budget)
        assert budget.scale.tolist() == [0.5**k, 1.0]
    ended(budget)
    ended(budget)
    assert budget.scale.tolist() == [0.25, 1.0]


def test_help_comes_back_from_nothing_as_that_of_all_does():
    one, many = HelpBudget(RULE), HelpBudget(RULE, groups=2)
    one.set(0.0)
    many.set(torch.tensor([0.0, 0.0]))
    for _ in range(2):
        ended(one, *[(0, True)] * 5)
        ended(many, *[(1, True)] * 5)
    assert one.now == many.now == pytest.approx(RULE.smallest / RULE.factor)
    assert many.scale.tolist() == [0.0, many.now]


def test_time_alone_lowers_whatever_is_known():
    budget = HelpBudget(LinearHelp(0, 4, every=2), groups=2)
    ended(budget, (0, True))
    ended(budget)
    assert budget.scale.tolist() == [0.5, 0.5]


def test_clips_that_are_not_drawn_help_nobody(task: Imitation):
    env = task.env(3, threads=1)
    env.help.set(torch.tensor([0.5, 1.0, 0.25]))
    assert env.help.now == 1.0
    env.weights = torch.tensor([1.0, 0.0, 1.0])
    assert env.help.now == 0.5
    env.help.cap(0.3)
    torch.testing.assert_close(env.help.left, torch.tensor([0.3, 0.3, 0.25]))
    env.weights = torch.tensor([1.0, 1.0, 0.0])
    env.help.set(torch.tensor([0.0, 0.0, 0.5]))
    assert env.help.now == 0.0 and env.help.left == 0.0
    env.close()


def pushed(env: ImitationEnv, clip: list[int]) -> torch.Tensor:
    """Newtons on the worlds of these clips, which all ask for as much."""
    here = torch.tensor(clip)
    env.reset_to(here, torch.full_like(here, 3))
    action = torch.zeros(len(clip), env.num_actions)
    action[:, env.hinges :] = 0.2
    log = env.step(action).log
    assert env.wrench is not None
    force = env.wrench.force.norm(dim=-1).sum(-1)
    assert log["help/force_n"] == pytest.approx(float(force.mean()))
    assert log["help/limit_n"] == pytest.approx(100.0 * float(env.help.at(here).mean()))
    return force


@pytest.mark.parametrize("fused", [True, False])
@pytest.mark.parametrize("explicit", [False, True])
def test_worlds_are_helped_by_what_their_clip_has_left(task: Imitation, fused: bool, explicit: bool):
    """Recorded or not; the recording, which is made at full help, follows clips and scales."""
    if explicit:
        kind = ExplicitResidual((0, 2), limit_n=100.0)
        task = replace(task, task=replace(task.task, residual=kind))
    plain = task.env(4, threads=1, auto_reset=False)
    env = ImitationEnv(task.reference, plain.backend, plain.task, task.config.sim.substeps, fused=fused)
    full = pushed(env, [0, 1, 2, 1])
    assert float(full.min()) > 1.0
    env.help.set(torch.tensor([1.0, 0.5, 0.0]))
    torch.testing.assert_close(pushed(env, [0, 1, 2, 1]), full * torch.tensor([1.0, 0.5, 0.0, 0.5]))
    swapped = pushed(env, [2, 1, 0, 0])
    torch.testing.assert_close(swapped[:2], full[:2] * torch.tensor([0.0, 0.5]))
    env.help.set(0.25)
    torch.testing.assert_close(pushed(env, [0, 1, 2, 1]), full / 4)
    assert sorted(env.controls.actuation.functions) == [True]
    env.help.set(0.0)
    assert float(pushed(env, [0, 1, 2, 1]).max()) == 0.0
    env.close()


def test_equal_scales_are_one_scale_to_the_last_bit(task: Imitation):
    each = task.env(4, threads=1)
    one = replace(task, task=replace(task.task, help_by="all")).env(4, threads=1)
    rng = torch.Generator().manual_seed(3)
    for env in (each, one):
        env.help.schedule = None
        env.help.set(0.6)
        env.reset()
    for _ in range(6):
        action = 0.2 * torch.randn(4, each.num_actions, generator=rng)
        a, b = each.step(action), one.step(action)
        assert torch.equal(a.obs, b.obs) and torch.equal(a.reward, b.reward)
        assert dict(a.log) == pytest.approx(dict(b.log))
    for env in (each, one):
        env.close()


def test_a_run_goes_on_where_it_was(task: Imitation):
    one, two = task.env(6, threads=1), task.env(6, threads=1)
    rng = torch.Generator().manual_seed(0)
    # The third clip fails, the others do not; the second is almost never drawn.
    one.weights = torch.tensor([1.0, 0.01, 1.0])
    one.reset()
    for _ in range(60):
        action = 0.1 * torch.randn(6, one.num_actions, generator=rng)
        action[one.clip == 2] *= 30
        one.step(action)
    assert len(set(one.help.scale.tolist())) > 1
    two.load_state(one.state())
    assert torch.equal(one.help.scale, two.help.scale) and one.help.now == two.help.now
    assert scale_in({"env/help": one.state()["help"]}) == one.help.now
    for _ in range(30):
        action = torch.randn(6, one.num_actions, generator=rng)
        a, b = one.step(action), two.step(action)
        assert torch.equal(a.obs, b.obs) and torch.equal(a.reward, b.reward)
    assert torch.equal(one.state()["help"], two.state()["help"])
    one.close()
    two.close()


def test_states_of_other_kinds():
    budget = HelpBudget(RULE, groups=2)
    budget.set(torch.tensor([0.5, 0.25]))
    ended(budget, (0, True), (1, False))
    # One of all worlds: its scale for all, and episodes of no clip in particular.
    other = HelpBudget(RULE, groups=3)
    other.load_state({"help": torch.tensor([0.75, 8.0, 6.0, 2.0], dtype=torch.float64)})
    assert other.scale.tolist() == [0.75] * 3 and other.steps == 8
    assert other.state()["help"].tolist() == [0.75, 8, 0, 0, *[0.75] * 3, *[0] * 6]
    single = HelpBudget(RULE)
    single.load_state(budget.state())
    assert single.state()["help"].tolist() == [0.5, 1, 2, 1]
    with refused("state-differs", says=("2", "3")):
        other.load_state(budget.state())
    with refused("count-differs", says="2"):
        budget.set(torch.ones(3))
    with refused("out-of-range"):
        HelpBudget(groups=0)


def test_another_way_to_share_is_refused(task: Imitation):
    with refused("unknown-choice", says="world"):
        replace(task.task, help_by="world")  # type: ignore[arg-type]
