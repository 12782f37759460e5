"""The stages of the perpetual recipe follow one another by themselves, and end as they should."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from poise.jobs.perpetual import perpetual_run as perpetual_result
from poise.jobs.perpetual import stage_trainer as perpetual_judge
from poise.jobs.perpetual.perpetual_run import PerpetualResult, begin, train
from poise.jobs.perpetual.stage_trainer import StageTrainer
from poise.jobs.perpetual.stages import Progress
from poise.jobs.run_file import FINAL
from poise.learn import LATEST, ConvergenceConfig, IterationStats, Trainer, Until, load_policy
from poise.learn.composer import Composer
from poise.learn.primitives import primitive
from poise.recipes.imitation import Imitation
from poise.recipes.perpetual_settings import Perpetual
from poise.sim import UnstableError
from refusals import refused
from toy_library import PPO, Script, Scripted, library, tiny


def script(kind: str, columns: int, scale: float, clip: int) -> bool:
    """Primitive k learns clip k - 1 without help, the composer the first two, none the third."""
    return clip < 2 if kind == "composer" else clip == columns - 1 and clip < 2


def watched(
    folder: Path, config: Perpetual, iterations: int
) -> tuple[PerpetualResult, list[Progress], Imitation]:
    """A whole training and all that it showed."""
    shown: list[Progress] = []
    imitation = begin(folder, library(), config)
    until = Until(iterations=iterations)
    result = train(imitation, folder, until, shown.append, threads=1, tensorboard=False, save_s=0.0)
    return result, shown, imitation


@pytest.fixture
def scripted(monkeypatch: pytest.MonkeyPatch) -> Iterator[type[Scripted]]:
    """Makes evaluations follow a script."""

    def install(rule: Script) -> Scripted:
        made = Scripted(rule)
        for module in (perpetual_judge, perpetual_result):
            monkeypatch.setattr(module, "evaluate_clips", made)
        return made

    yield install  # type: ignore[misc]


def test_primitives_follow_on_what_fails_and_the_composer_on_all(tmp_path: Path, scripted) -> None:
    asked = scripted(script).asked
    result, shown, imitation = watched(tmp_path, tiny(), 40)
    stages = list(dict.fromkeys(p.stage.name for p in shown))
    assert stages == ["primitive 1", "primitive 2", "primitive 3", "composer"]
    assert [p.following.name for p in shown if p.following] == stages[1:]
    trained_on = {(kind, columns): clips for kind, columns, _, clips in asked[:-1]}
    assert trained_on == {
        ("progressive", 1): (0, 1, 2),
        ("progressive", 2): (1, 2),
        ("progressive", 3): (2,),
        ("composer", 3): (0, 1, 2),
    }
    assert result.primitives == 3 and not result.solved and not result.interrupted
    # Whatever was left of the help before: the finished policy is judged without.
    assert asked[-1] == ("composer", 3, 0.0, (0, 1, 2))
    assert shown[-1].help_n == 0.0 and shown[-1].stats.terms["help/force_n"] == 0.0
    said = json.loads((tmp_path / "result.json").read_text())
    assert [row["primitive"] for row in said["per_clip"]] == [1, 2, 3]
    assert said["hardest"] == ["turn"] and said["succ"] == pytest.approx(2 / 3)
    # What a stage learned is frozen in the next ones.
    whole = load_policy(tmp_path / FINAL, imitation.humanoid.identity)
    assert isinstance(whole.policy, Composer)
    obs = torch.randn(20, whole.num_obs, generator=torch.Generator().manual_seed(0))
    for k in range(3):
        own = load_policy(tmp_path / f"primitive-{k + 1}.safetensors")
        assert torch.equal(primitive(whole, k).act(obs), own.act(obs))


def test_odds_are_those_of_the_stage(tmp_path: Path, scripted) -> None:
    scripted(script)
    imitation = begin(tmp_path, library(), tiny())
    stages = StageTrainer(imitation, tmp_path, Until(iterations=40), 1, tensorboard=False)
    while stages.stage.number < 2:
        stages.iterate()
    assert stages.env.weights[0] == 0 and bool((stages.env.weights[1:] > 0).all())
    assert set(stages.env.clip.tolist()) <= {0, 1, 2}
    stages.iterate()
    assert 0 not in stages.env.clip.tolist()
    stages.close()


def test_where_nothing_fails_training_ends_happily(tmp_path: Path, scripted) -> None:
    asked = scripted(lambda *_: True).asked
    result, shown, _ = watched(tmp_path, tiny(), 40)
    assert result.solved and result.primitives == 1 and shown[-1].iteration < 40
    # With help nothing is solved yet; the help was taken away first.
    assert asked[0][2] > 0 and [scale for *_, scale, _ in asked[-2:]] == [0.0, 0.0]
    again = train(
        begin(tmp_path, library(), tiny()), tmp_path, Until(iterations=80), threads=1, tensorboard=False
    )
    assert again.last is None and again.solved and again.results is not None


def test_one_larger_network_has_the_same_samples(tmp_path: Path, scripted) -> None:
    scripted(script)
    result, shown, _ = watched(tmp_path / "one", tiny(single=True, expert=False), 6)
    many, _, _ = watched(tmp_path / "many", tiny(expert=False, composer_clone=False), 6)
    assert {p.stage.name for p in shown} == {"single"} and result.primitives == 0
    assert result.last is not None and many.last is not None
    assert result.last.stats.samples == many.last.stats.samples == 6 * 8 * 4
    policy = load_policy(tmp_path / "one" / FINAL)
    assert policy.shape["hidden"] == [24, 16]
    assert not list((tmp_path / "one").glob("primitive-*"))


def test_the_help_has_ended_whatever_fails(tmp_path: Path, scripted) -> None:
    scripted(lambda *_: False)
    _, shown, _ = watched(tmp_path, tiny(max_primitives=1), 10)
    help_n = [p.help_n for p in shown]
    # From 100 N down by the share of the time, to nothing at 0.8 of it.
    assert help_n[0] == pytest.approx(87.5) and help_n[7:] == [0.0, 0.0, 0.0]
    assert help_n == sorted(help_n, reverse=True)
    assert {p.stage.name for p in shown} == {"primitive 1"}


def test_every_evaluation_is_in_the_table(tmp_path: Path, scripted) -> None:
    scripted(script)
    watched(tmp_path, tiny(max_primitives=1), 4)
    with (tmp_path / "success.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert {r["clip"] for r in rows} == {"calm", "walk", "turn"}
    last = [r for r in rows if r["stage"] == "final"]
    assert [r["succeeded"] for r in last] == ["1", "0", "0"] and {r["help_n"] for r in last} == {"0"}
    assert [r["iteration"] for r in rows if r["stage"] != "final"][::3] == ["2", "4"]
    # The library goes into the checkpoint of no stage.
    files = {p.name for p in tmp_path.iterdir()}
    wanted = {"run.safetensors", LATEST, FINAL, "log.csv", "success.csv", "result.json"}
    assert files == wanted


def test_shares_of_limits() -> None:
    assert Until(minutes=10, iterations=100).share(50, 0, 60.0) == 0.5
    assert Until(samples=0).share(0, 0, 0.0) == 1.0
    assert Until(minutes=1).share(9, 9, 90.0) == 1.0


def test_no_clock_decides_where_iterations_are_counted(tmp_path: Path) -> None:
    both = Until(minutes=10, iterations=100)
    assert both.done(5, 0, 1.0) == both.done(5, 0, 500.0) == 0.05
    assert both.done(5, 0, 600.0) == 1.0
    assert Until(minutes=10).done(5, 9, 300.0) == 0.5
    assert Until(minutes=10, samples=50).done(5, 5, 300.0) == 0.1
    stages = StageTrainer(begin(tmp_path, library(), tiny()), tmp_path, both, 1, tensorboard=False)
    stages.trainer.seconds = 300.0
    assert stages.share == 0.0
    stages.close()


def test_a_simulation_that_goes_bad_does_not_end_the_training(
    tmp_path: Path, scripted, monkeypatch: pytest.MonkeyPatch
) -> None:
    scripted(script)
    plain, calls = Trainer.iterate, [0]
    monkeypatch.setattr(UnstableError, "__init__", lambda self, failures: None)
    monkeypatch.setattr(UnstableError, "__str__", lambda self: "the knee")

    def shaky(self: Trainer) -> IterationStats:
        calls[0] += 1
        if calls[0] == 2:
            plain(self)
            raise UnstableError([])
        return plain(self)

    monkeypatch.setattr(Trainer, "iterate", shaky)
    _, shown, _ = watched(tmp_path, tiny(max_primitives=1, expert=False), 4)
    assert [p.iteration for p in shown] == [1, 2, 3, 4]
    assert [p.trouble for p in shown] == ["", "the knee", "", ""]
    with (tmp_path / "log.csv").open(newline="") as file:
        assert [r["iteration"] for r in csv.DictReader(file)] == ["1", "2", "3", "4"]


def test_a_simulation_that_always_goes_bad_ends_it(
    tmp_path: Path, scripted, monkeypatch: pytest.MonkeyPatch
) -> None:
    scripted(script)
    monkeypatch.setattr(UnstableError, "__init__", lambda self, failures: None)

    def bad(self: Trainer) -> IterationStats:
        raise UnstableError([])

    monkeypatch.setattr(Trainer, "iterate", bad)
    with pytest.raises(UnstableError):
        watched(tmp_path, tiny(max_primitives=1, expert=False), 4)


def test_steps_become_smaller_towards_the_end_of_a_stage(tmp_path: Path, scripted) -> None:
    scripted(lambda kind, columns, scale, clip: False)
    fixed = replace(PPO, kl_target=None, policy_lr=1e-3)
    plain = {"single": True, "expert": False, "convergence": ConvergenceConfig(patience=100)}
    config = tiny(ppo=fixed, cooling=0.5, **plain)
    _, shown, _ = watched(tmp_path, config, 20)
    lr = [p.stats.update.policy_lr for p in shown]
    assert lr[:10] == [1e-3] * 10 and lr[-1] == pytest.approx(1e-4)
    assert lr[10:] == sorted(lr[10:], reverse=True) and lr[14] == pytest.approx(0.6e-3)
    # So large they are after the clone of an expert, too.
    plain["expert"] = True
    _, shown, _ = watched(tmp_path / "cloned", tiny(ppo=fixed, **plain), 1)
    assert shown[0].stats.update.policy_lr == 1e-3
    with refused("settings-conflict", says="cooling"):
        replace(config, ppo=replace(fixed, kl_target=0.05))
