"""Evaluation of a library from its first frames, against the score card; its table; the composer's
teacher."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from poise.env import ImitationEnv
from poise.jobs.perpetual.evaluation import EvaluationLog, evaluate_clips
from poise.learn import PolicyBundle, compose, first_column, next_column
from poise.learn.primitives import primitive
from poise.metrics import mpjpe_global
from poise.papers.perpetual.primitive_stages import Owners
from poise.recipes.imitation import Imitation
from poise.recipes.perpetual import build
from poise.score import ClipResults, run_episodes, score_rollouts
from poise.score import rollouts as clip_results
from toy_library import library, tiny


@pytest.fixture(scope="module")
def task() -> Imitation:
    return build(library(), tiny())


def sizes(task: Imitation) -> tuple[int, int]:
    env = task.env(1, threads=1)
    env.close()
    return env.num_obs, env.num_actions


def idle(task: Imitation) -> PolicyBundle:
    """A policy that hardly moves: it holds the joints, and falls sooner or later."""
    rng = torch.Generator().manual_seed(0)
    return PolicyBundle.make(*sizes(task), (8,), generator=rng)


def test_it_agrees_with_the_score_card(task: Imitation) -> None:
    policy = idle(task)
    mine = evaluate_clips(task, policy, None, 0.0, 1)
    start = torch.zeros(3, dtype=torch.long)

    def make(worlds: int) -> ImitationEnv:
        return task.env(worlds, auto_reset=False, threads=1, help_scale=0.0)

    rollouts, _ = run_episodes(make, policy, torch.arange(3), start, cycles=1)
    card = score_rollouts(rollouts)
    assert mine.rate == pytest.approx(card.succ)
    assert mine.error_mm == pytest.approx(card.mpjpe_global_mm, rel=1e-5)
    far = (rollouts.pos - rollouts.ref_pos).norm(dim=-1).mean(-1)
    for c, n in enumerate(mine.frames.tolist()):
        bad = (far[c, :n] > 0.5).nonzero().flatten()
        first = int(bad[0]) if len(bad) else n
        assert int(mine.tracked[c]) == first and bool(mine.succeeded[c]) == (first == n)
        seen = min(first + 1, n)
        assert float(mine.global_mm[c]) == pytest.approx(1000 * float(far[c, :seen].mean()), rel=1e-5)


def test_batches_and_subsets_change_nothing(task: Imitation) -> None:
    policy = idle(task)
    whole = evaluate_clips(task, policy, None, 0.0, 1)
    told: list[tuple[int, int]] = []
    single = evaluate_clips(task, policy, None, 0.0, 1, worlds=1, on_batch=lambda *n: told.append(n))
    assert told == [(1, 3), (2, 3), (3, 3)]
    for name in ("clip", "succeeded", "frames", "tracked"):
        assert torch.equal(getattr(whole, name), getattr(single, name))
    assert torch.allclose(whole.global_mm, single.global_mm, rtol=1e-5)
    part = evaluate_clips(task, policy, torch.tensor([2, 0]), 0.0, 1)
    assert part.clip.tolist() == [2, 0]
    assert torch.allclose(part.global_mm, whole.global_mm[[2, 0]], rtol=1e-5)


def test_a_world_that_goes_bad_has_failed_and_stops_nobody(
    task: Imitation, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole, steps = evaluate_clips(task, idle(task), None, 0.0, 1), [0]

    def without_one(sim: torch.Tensor, ref: torch.Tensor) -> torch.Tensor:
        steps[0] += 1
        far = mpjpe_global(sim, ref)
        # Clips are simulated in the order of their lengths, so this is the first one.
        return far.index_fill(0, torch.tensor([0]), torch.nan) if steps[0] >= 3 else far

    monkeypatch.setattr(clip_results, "mpjpe_global", without_one)
    bad = evaluate_clips(task, idle(task), None, 0.0, 1)
    assert not bool(bad.succeeded[0]) and int(bad.tracked[0]) == 3
    assert bool(bad.global_mm.isfinite().all()) and torch.equal(bad.global_mm[1:], whole.global_mm[1:])


def results(won: list[bool], tracked: list[int]) -> ClipResults:
    clip, frames = torch.arange(len(won)), torch.full((len(won),), 10)
    error = torch.arange(len(won)).double()
    return ClipResults(clip, torch.tensor(won), frames, torch.tensor(tracked), error, 2 * error)


def test_the_hardest_are_those_that_fail_first() -> None:
    r = results([False, True, False, False], [7, 10, 2, 5])
    assert r.hardest(2) == [2, 3] and r.rate == 0.25
    # Frames 8, 10, 3 and 6 were seen, the last one of failures included.
    assert r.error_mm == pytest.approx((0 * 8 + 2 * 10 + 4 * 3 + 6 * 6) / 27)
    assert r.spread(r.tracked, 5).tolist() == [7, 10, 2, 5, 0]


def test_the_table_of_a_resumed_run_has_no_row_twice(tmp_path: Path) -> None:
    names = ("a", "b")
    table = EvaluationLog(tmp_path, names)
    for iteration in (1, 2, 3):
        table.add(iteration, "primitive 1", 12.5, results([True, False], [10, 4]))
    table.add(3, "final", 0.0, results([True, True], [10, 10]))
    whole = table.path.read_text()
    with table.path.open("a") as file:
        file.write("4,primi")
    again = EvaluationLog(tmp_path, names, last=2)
    assert len(again.path.read_text().splitlines()) == 1 + 2 * 2
    again.add(3, "primitive 1", 12.5, results([True, False], [10, 4]))
    again.add(3, "final", 0.0, results([True, True], [10, 10]))
    assert again.path.read_text() == whole
    assert whole.splitlines()[2] == "1,primitive 1,12.5,b,0,10,4,1.0000,2.0000"


def test_the_composers_teacher_is_the_owner_of_each_clip(task: Imitation) -> None:
    rng = torch.Generator().manual_seed(0)
    columns = next_column(first_column(*sizes(task), (8,), generator=rng), "random", generator=rng)
    policy = compose(columns, hidden=(8,), generator=rng)
    env = task.env(6, threads=1)
    obs = env.reset()
    env.clip.copy_(torch.tensor([0, 1, 2, 2, 1, 0]))
    acts = Owners(env, policy, torch.tensor([0, 1, 1])).act(obs)
    one, two = (primitive(policy, k).act(obs) for k in (0, 1))
    assert torch.allclose(acts[[0, 5]], one[[0, 5]], atol=1e-6)
    assert torch.allclose(acts[1:5], two[1:5], atol=1e-6) and not torch.allclose(one, two)
    env.close()
