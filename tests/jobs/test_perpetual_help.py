"""Help by clip through the stages: limits, evaluations, the table, the record, and a resumed run."""

from __future__ import annotations

import csv
from collections.abc import Callable
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import pytest
import torch
from torch import Tensor

from poise.control import SuccessHelp
from poise.jobs.perpetual import perpetual_run as result
from poise.jobs.perpetual import stage_trainer as stage_evaluation
from poise.jobs.perpetual.evaluation import StageRecord, evaluate_clips, mean_help
from poise.jobs.perpetual.perpetual_run import begin
from poise.jobs.perpetual.stage_trainer import StageTrainer
from poise.learn import LATEST, PolicyBundle, Until, load_checkpoint
from poise.papers.perpetual.ablations import StagedPerpetual
from poise.recipes.imitation import Imitation
from poise.recipes.perpetual import build
from poise.recipes.perpetual_settings import config_of
from poise.score import ClipResults
from poise.settings import to_data
from toy_library import PPO, Scripted, library, tiny

ALL = torch.arange(3)


class Pushing:
    """Holds the joints and asks for all the force there is, upward."""

    def __init__(self, actions: int):
        self.actions = actions

    def act(self, obs: Tensor) -> Tensor:
        action = torch.zeros(len(obs), self.actions)
        action[:, -4] = 1.0
        return action


def test_every_clip_is_evaluated_with_what_it_has_left() -> None:
    imitation = build(library(), tiny())
    env = imitation.env(1, threads=1)
    policy = Pushing(env.num_actions)
    env.close()
    own = torch.tensor([1.0, 0.0, 0.5])
    mixed = evaluate_clips(imitation, policy, None, own, 1)
    some = evaluate_clips(imitation, policy, torch.tensor([2, 0]), own, 1)
    errors = []
    for clip, scale in enumerate(own.tolist()):
        alone = evaluate_clips(imitation, policy, torch.tensor([clip]), scale, 1)
        assert float(mixed.global_mm[clip]) == pytest.approx(float(alone.global_mm[0]), rel=1e-5)
        assert int(mixed.tracked[clip]) == int(alone.tracked[0])
        errors.append(float(evaluate_clips(imitation, policy, ALL[[clip]], 1 - scale, 1).global_mm[0]))
    torch.testing.assert_close(some.global_mm, mixed.global_mm[[2, 0]], rtol=1e-5, atol=0.0)
    # Help does make a difference here.
    assert errors[0] != pytest.approx(float(mixed.global_mm[0]), rel=0.01)


def test_the_switch_is_in_the_task() -> None:
    task = build(library(), tiny())
    for by, groups in (("bin", len(task.reference.bins)), ("clip", 3), ("all", 1)):
        env = build(library(), tiny(help_by=by)).env(2, threads=1)
        assert env.help.groups == groups
        env.close()


@pytest.fixture
def watched(monkeypatch: pytest.MonkeyPatch) -> list[float | Tensor]:
    """Evaluations in which nothing succeeds; the scales that they had."""
    asked: list[float | Tensor] = []
    made = Scripted(lambda *_: False)

    def watch(imitation: Imitation, policy: PolicyBundle, clips: Tensor | None,
              scale: float | Tensor, *more: object, starts: int = 1) -> ClipResults:  # fmt: skip
        asked.append(scale)
        return made(imitation, policy, clips, scale, *more, starts=starts)

    for module in (stage_evaluation, result):
        monkeypatch.setattr(module, "evaluate_clips", watch)
    return asked


def test_time_limits_every_clip_and_stages_hand_their_help_on(
    tmp_path: Path, watched: list[float | Tensor]
) -> None:
    imitation = begin(tmp_path, library(), tiny(expert=False, help_by="clip"))
    stages = StageTrainer(imitation, tmp_path, Until(iterations=400), 1, tensorboard=False)
    stages.env.help.set(torch.tensor([0.1, 1.0, 0.6]))
    stages.iterate()
    # A 160th of what the stage has for its help is over.
    most = 1.0 - 1 / 160
    torch.testing.assert_close(stages.helps, torch.tensor([0.1, most, 0.6]))
    assert stages.help == pytest.approx(most)
    shown = stages.iterate()
    most = 1.0 - 2 / 160
    own = torch.tensor([0.1, most, 0.6])
    assert shown.help_n == pytest.approx(100 * most) and isinstance(watched[0], Tensor)
    torch.testing.assert_close(watched[0], own)
    with (tmp_path / "success.csv").open(newline="") as file:
        assert [r["help_n"] for r in csv.DictReader(file)] == ["10", "98.75", "60"]
    while stages.stage.number < 2:
        least = stages.helps
        stages.iterate()
    # Nothing is gained, as clips lose less than 1 % on average: the stage ends before its help does, by
    # an evaluation without.
    assert watched[-1] == 0.0 and stages.help > 0
    with (tmp_path / "success.csv").open(newline="") as file:
        assert [r["help_n"] for r in csv.DictReader(file)][-3:] == ["0", "0", "0"]
    assert isinstance(stages.helps, Tensor) and isinstance(least, Tensor)
    torch.testing.assert_close(stages.helps, least, rtol=0.05, atol=0.0)
    assert stages.help < 1.0
    stages.close()


def results(won: list[bool]) -> ClipResults:
    frames = torch.full((3,), 10)
    error = torch.full((3,), 20.0).double()
    return ClipResults(ALL, torch.tensor(won), frames, frames, error, error)


def untrained(seed: int) -> PolicyBundle:
    return PolicyBundle.make(4, 2, (3,), generator=torch.Generator().manual_seed(seed))


def test_less_help_on_average_is_better_then_more_clips() -> None:
    policies = [untrained(k) for k in range(3)]
    stage_record = StageRecord(tiny(), torch.tensor([20, 20, 20]))

    def best(k: int, scale: float | Tensor, *won: bool) -> bool:
        stage_record.record(results(list(won)), policies[k], scale)
        return all(torch.equal(v, stage_record.best[name]) for name, v in policies[k].state().items())

    assert best(0, torch.tensor([0.9, 0.3, 0.3]), True, True, True)
    # Whichever world has the help; a difference within 1 % is none.
    assert best(1, torch.tensor([0.0, 0.0, 1.2]), False, False, False)
    assert best(2, torch.tensor([0.399, 0.4, 0.4]), True, False, False)
    assert not best(1, torch.tensor([0.396, 0.4, 0.4]), False, False, False)
    # A trace of help is more than none.
    assert best(0, torch.tensor([0.0, 0.0, 0.001]), True, True, True)
    assert best(1, 0.0, False, False, False)
    assert not best(0, torch.tensor([0.0, 0.0, 0.001]), True, True, True)


def test_a_stage_is_not_solved_while_any_clip_is_helped() -> None:
    stage_record = StageRecord(tiny(), torch.tensor([20, 20, 20]))
    policy = untrained(0)
    for scale, decision in ((torch.tensor([0.0, 0.01, 0.0]), "go on"), (0.0, "solved")):
        stage_record.record(results([True] * 3), policy, scale)
        assert stage_record.decide(scale) == decision
    # Clips outside of the stage do not matter.
    stage_record.begin(torch.tensor([True, False, True]))
    assert mean_help(torch.tensor([0.0, 1.0, 0.0]), stage_record.clips) == 0.0
    assert stage_record.least == 1.0


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Help that follows success within a few steps, and that exploration cannot but raise or lower."""

    def hasty() -> SuccessHelp:
        return SuccessHelp(lower_at=0.6, raise_at=0.59, factor=0.8, every=2)

    monkeypatch.setattr(import_module("poise.recipes.perpetual"), "SuccessHelp", hasty)


def test_a_resumed_run_helps_each_clip_as_before(
    tmp_path: Path, quick: None, watched: list[float | Tensor]
) -> None:
    ppo = replace(PPO, horizon=20, std=0.3)
    config = tiny(single=True, expert=False, help_share=1.0, ppo=ppo, help_by="clip")
    until = Until(iterations=1000)

    def train(folder: Path, *pieces: int) -> dict[str, Tensor]:
        for count in pieces:
            stages = StageTrainer(begin(folder, library(), config), folder, until, 1, tensorboard=False)
            for _ in range(count):
                stages.iterate()
            stages.save()
            stages.close()
        tensors = load_checkpoint(folder / LATEST)[0]
        tensors["trainer/counters"][2] = 0.0
        return tensors

    whole, pieces = train(tmp_path / "whole", 6), train(tmp_path / "pieces", 1, 3, 2)
    assert len(set(whole["env/help"][4:7].tolist())) > 1
    assert whole.keys() == pieces.keys()
    assert not [k for k in whole if not torch.equal(whole[k].nan_to_num(), pieces[k].nan_to_num())]
    assert (tmp_path / "whole/success.csv").read_text() == (tmp_path / "pieces/success.csv").read_text()


def test_a_checkpoint_with_one_scale_for_all_goes_on_by_clip(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, watched: list[float | Tensor]
) -> None:
    """Settings of before there was help by clip or moment say that all share one."""
    config, until = tiny(single=True, expert=False, help_by="clip"), Until(iterations=8)
    old = {k: v for k, v in to_data(config).items() if k not in ("help_by", "adaptive_sampling")}
    assert config_of(old, kind=StagedPerpetual) == replace(config, help_by="all", adaptive_sampling=0.0)
    stages = StageTrainer(begin(tmp_path, library(), config), tmp_path, until, 1, tensorboard=False)
    plain: Callable[[], dict[str, Tensor]] = stages.env.help.state
    monkeypatch.setattr(stages.env.help, "state", lambda: {"help": plain()["help"][:4]})
    stages.iterate()
    stages.save()
    left = stages.help
    stages.close()
    stages = StageTrainer(begin(tmp_path, library(), config), tmp_path, until, 1, tensorboard=False)
    torch.testing.assert_close(stages.helps, torch.full((3,), left))
    stages.close()
