"""Which clips are drawn after which failures, and when a stage ends; all by hand."""

from __future__ import annotations

import pytest
import torch

from poise.learn import Convergence, ConvergenceConfig, HardNegatives, MiningConfig
from refusals import refused


def flags(text: str) -> torch.Tensor:
    """Clips that succeeded are "1"."""
    return torch.tensor([c == "1" for c in text])


def after(config: MiningConfig, *evaluations: str, base: torch.Tensor | None = None) -> HardNegatives:
    mining = HardNegatives(4, config, base)
    for text in evaluations:
        mining.record(flags(text))
    return mining


def near(weights: torch.Tensor, *want: float) -> None:
    assert weights.tolist() == pytest.approx(list(want))
    assert float(weights.sum()) == pytest.approx(1.0)


def test_the_authors_soft_rule_counts_failures():
    soft = MiningConfig.phc("code")
    near(after(soft).weights(), 0.25, 0.25, 0.25, 0.25)
    near(after(soft, "1111").weights(), 0.25, 0.25, 0.25, 0.25)
    # One failure of clip 0, two of clip 2: clips 1 and 3 are never drawn.
    near(after(soft, "0101", "1101").weights(), 1 / 3, 0, 2 / 3, 0)
    near(after(soft, "0101", "1101", "1111").weights(), 1 / 3, 0, 2 / 3, 0)


def test_the_hard_rule_draws_only_what_failed_last():
    hard = MiningConfig(rule="hard")
    near(after(hard, "0101", "1101").weights(), 0, 0, 1, 0)
    near(after(hard, "0101", "1111").weights(), 0.25, 0.25, 0.25, 0.25)
    seconds = torch.tensor([1.0, 2.0, 3.0, 4.0])
    near(after(hard, "0101", base=seconds).weights(), 0.25, 0, 0.75, 0)


def test_ours_forgets_no_clip():
    ours = MiningConfig(floor=0.4, fade=0.5)
    near(after(ours).weights(), 0.25, 0.25, 0.25, 0.25)
    # Faded failures: clip 0 0.5, clip 2 1.5.
    near(after(ours, "0101", "1101").weights(), 0.1 + 0.15, 0.1, 0.1 + 0.45, 0.1)
    long = after(ours, "0111", *["1111"] * 5, "1101")
    assert float(long.weights()[2]) > 0.65 and float(long.weights().min()) == pytest.approx(0.1)
    seconds = torch.tensor([1.0, 2.0, 3.0, 4.0])
    near(after(ours, "1110", base=seconds).weights(), 0.04, 0.08, 0.12, 0.16 + 0.6)


def test_the_next_primitive_learns_the_union_of_the_last_five():
    code = after(MiningConfig.phc("code"), "0111", "1011", "1111", "1111", "1111", "1111")
    assert code.hard.tolist() == [False, True, False, False]
    assert code.next_stage() == 1
    near(code.weights(), 0, 1, 0, 0)
    paper = after(MiningConfig.phc("paper"), "0011", "1011")
    assert paper.hard.tolist() == [False, True, False, False]
    near(paper.weights(), 0.25, 0.25, 0.25, 0.25)
    # The hard sets shrink: a clip outside the stage that fails does not come back.
    small = after(MiningConfig.phc("paper"), "0011")
    assert small.next_stage() == 2
    near(small.weights(), 0.5, 0.5, 0, 0)
    small.record(flags("0101"))
    assert small.last_failed.tolist() == [True, False, False, False]
    assert small.next_stage() == 1
    small.record(flags("1111"))
    assert small.next_stage() == 0
    near(small.weights(), 1, 0, 0, 0)
    # The composer learns them all.
    assert small.next_stage(torch.ones(4)) == 4


def test_clips_that_were_not_evaluated_keep_their_place():
    mining = HardNegatives(4, MiningConfig(floor=0.4, fade=0.5))
    mining.record(flags("0111"))
    mining.record(flags("1110"), evaluated=flags("0011"))
    assert mining.faded.tolist() == [1, 0, 0, 1] and mining.tried.tolist() == [1, 1, 2, 2]
    assert mining.failed.tolist() == [1, 0, 0, 1]


def test_mining_goes_on_and_refuses_what_does_not_fit():
    mining = after(MiningConfig(), "0101", "1101")
    mining.next_stage()
    mining.record(flags("0000"))
    other = HardNegatives(4)
    other.load_state(mining.state())
    for one in (mining, other):
        one.record(flags("1101"))
    assert torch.equal(mining.weights(), other.weights()) and torch.equal(mining.hard, other.hard)
    with refused("state-differs", says=("4", "3")):
        HardNegatives(3).load_state(mining.state())
    with refused("wrong-shape", says="4"):
        mining.record(flags("111"))
    with refused("bad-weights"):
        HardNegatives(2, base=torch.tensor([1.0, 0.0]))
    for bad, code in (
        ({"rule": "harsh"}, "unknown-choice"),
        ({"union": "all"}, "unknown-choice"),
        ({"floor": 2.0}, "out-of-range"),
        ({"floor": 0.0}, "settings-conflict"),
        ({"memory": 0}, "out-of-range"),
    ):
        with refused(code, says="MiningConfig"):
            MiningConfig(**bad)  # type: ignore[arg-type]


def test_the_weights_decide_how_often_a_clip_is_drawn():
    weights = after(MiningConfig(floor=0.4, fade=0.5), "0101", "1101").weights()
    g = torch.Generator().manual_seed(0)
    drawn = torch.multinomial(weights, 20_000, replacement=True, generator=g).bincount(minlength=4)
    assert (drawn / 20_000).tolist() == pytest.approx(weights.tolist(), abs=0.015)


def test_a_stage_ends_when_its_success_no_longer_improves():
    stage = Convergence(ConvergenceConfig(patience=2))
    assert [stage.add(n, 10) for n in (3, 5, 5, 6, 4, 6)] == ["go on"] * 5 + ["next"]
    assert (stage.best, stage.best_at) == (0.6, 4)
    stage.reset()
    assert [stage.add(n, 10) for n in (0, 0, 0)] == ["go on", "go on", "next"]
    least = Convergence(ConvergenceConfig(patience=1, least=3, most=4))
    assert [least.add(n, 9) for n in (5, 4, 4)] == ["go on", "go on", "next"]
    least.reset()
    assert [least.add(n, 9) for n in (1, 2, 3, 4)] == ["go on", "go on", "go on", "next"]
    gain = Convergence(ConvergenceConfig(patience=2, gain=0.1))
    assert [gain.add(n, 100) for n in (50, 55, 59)] == ["go on", "go on", "next"]


def test_nothing_left_to_learn_ends_happily():
    assert Convergence().add(0, 0) == "solved"
    assert Convergence(ConvergenceConfig(least=5)).add(7, 7) == "solved"
    with refused("out-of-range", says=("8", "7")):
        Convergence().add(8, 7)
    with refused("out-of-range", says="ConvergenceConfig"):
        ConvergenceConfig(patience=0)


def test_a_stage_resumes():
    one = Convergence(ConvergenceConfig(patience=2))
    for n in (3, 5, 4):
        one.add(n, 10)
    two = Convergence(ConvergenceConfig(patience=2))
    two.load_state(one.state())
    assert one.add(5, 10) == two.add(5, 10) == "next"
