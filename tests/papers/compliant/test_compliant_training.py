"""A scene learned on top of the policy, in miniature."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from poise.cli.main import main
from poise.jobs.open import open_run
from poise.jobs.tracker import Tracker
from poise.learn import PPOConfig, Until
from poise.learn.checkpoint import load_checkpoint, save_checkpoint
from poise.papers.compliant.scene_play import play
from poise.papers.compliant.scene_training import (
    Added,
    Compliant,
    OnTop,
    open_learned,
    save_learned,
    scene_task,
    shipped,
    train,
)
from poise.papers.compliant.scenes.ball import FictionalForces
from refusals import refused

PPO = PPOConfig(
    horizon=4, epochs=1, minibatch=16, std=0.1, policy_hidden=(8,), value_hidden=(8,), norm_warmup=1
)
TINY = Compliant(seconds=0.5, num_envs=4, ppo=PPO)


@pytest.fixture(scope="module")
def tracker() -> Tracker:
    return open_run(None).tracker


def test_what_is_on_top_adds_to_what_is_below(tracker: Tracker) -> None:
    config = replace(TINY, reach=0.1, num_envs=2)
    task = scene_task(config, tracker)
    env = task.env(2, threads=1, help_scale=0.0, guard=False)
    added = config.added(tracker.policy.num_obs)
    assert added == Added(tracker.policy.num_obs, 0.1, True)
    top = OnTop(env, tracker.policy, added)
    hinges = len(tracker.humanoid.hinges)
    assert top.num_actions == hinges + 6
    # Root (1 + 2 or 3 + 6), u (6 + n) and the ball (12); the policy below sees what it always does.
    obs = top.reset()
    assert obs.shape == (2, top.num_obs) and top.num_obs > hinges + 6 + 12
    whole = env.observe()
    torch.testing.assert_close(whole[:, added.seen :], obs)
    below = tracker.policy.act(whole[:, : added.seen])
    own = torch.zeros(2, top.num_actions)
    own[1, 0], own[1, hinges + 1] = 0.5, 1.0
    top.step(own)
    given = env.given.clone()
    given[1, 0] -= 0.05
    torch.testing.assert_close(given, below, atol=1e-5, rtol=1e-5)
    forces = env.event(FictionalForces)
    assert forces is not None and forces.asked is not None and forces.asked[1].tolist()[1] == 1.0
    top.close()


def test_a_tiny_training_goes_on_and_is_played(tracker: Tracker, tmp_path: Path) -> None:
    for folder, stops in (("a", (2,)), ("b", (1, 2))):
        for stop in stops:
            train(TINY, tracker, tmp_path / folder, Until(iterations=stop), threads=1, tensorboard=False)
    rows = [list(csv.DictReader((tmp_path / f / "log.csv").open())) for f in "ab"]
    # The same seed gives the same numbers, stopped in between or not.
    for name in ("reward", "samples", "env/reward/task/above"):
        assert [r[name] for r in rows[0]] == [r[name] for r in rows[1]], name
    assert 0.3 < float(rows[0][0]["env/reward/task/above"]) <= 1.0
    learned = open_learned(tmp_path / "a", tracker)
    made = play(TINY.play(), tracker, None, None, 2, 0.5, 1, "ball", learned)
    assert made.figures["goal_moved_m"] > 0.0 and made.figures["stays_s"] > 0.3
    one = tmp_path / "one.safetensors"
    save_learned(learned, tracker, one)
    again = open_learned(one, tracker)
    assert again.config == TINY and again.added == learned.added
    seen = torch.randn(3, learned.top.num_obs)
    torch.testing.assert_close(again.top.act(seen), learned.top.act(seen), atol=1e-2, rtol=1e-2)
    tensors, meta = load_checkpoint(one)
    for odd in ({}, {"recipe": "compliant"}, {"recipe": "compliant", "config": 3}):
        save_checkpoint(one, tensors, {**meta, "metadata": odd})
        with refused("not-a-run"):
            open_learned(one, tracker)
    with refused("settings-differ"):
        train(replace(TINY, seed=1), tracker, tmp_path / "a", Until(iterations=3), threads=1)
    with refused("not-a-run"):
        open_learned(tmp_path, tracker)


def test_what_comes_along_for_the_ball_balances_it(tracker: Tracker) -> None:
    learned = shipped("ball", tracker)
    assert learned is not None and shipped("door", tracker) is None
    made = play(learned.config.play(), tracker, None, None, 2, 5.0, 1, "ball", learned)
    # A rod that nobody balances has fallen after 1.5 s.
    assert made.figures["stays_s"] > 4.9 and made.stiff["stays_s"] < 2.0 and made.figures["lost"] == 0
    other = replace(tracker, policy=tracker.policy.copy())
    other.policy.load_state({k: 1.01 * v for k, v in tracker.policy.state().items()})
    assert shipped("ball", other) is None


def test_from_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = tmp_path / "run"
    argv = ["train", "compliant", "ball", "-o", str(run), "--envs", "2", "--iterations", "1", "--json"]
    argv += ["--threads", "1", "--set", "seconds=0.5", "--set", "ppo.horizon=2"]
    argv += ["--set", "ppo.policy_hidden=[8]", "--set", "ppo.value_hidden=[8]"]
    assert main(argv) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["result"]["samples"] == 4 and (run / "checkpoint.safetensors").exists()
    assert main(argv) == 2
    assert "already holds a run" in json.loads(capsys.readouterr().out)["error"]["what"]
    wrong = ["play", "compliant", "door", "--learned", str(run), "-o", str(tmp_path / "out")]
    assert main(wrong) == 2 and "learned the scene 'ball', not 'door'" in capsys.readouterr().err


def test_steps_become_smaller_in_the_end(tracker: Tracker, tmp_path: Path) -> None:
    lr: list[float] = []
    train(
        replace(TINY, cooling=0.5), tracker, tmp_path / "run", Until(iterations=4),
        lambda stats: lr.append(stats.update.policy_lr), 1, False,
    )  # fmt: skip
    assert lr == pytest.approx([PPO.policy_lr] * 3 + [PPO.policy_lr / 2])
    with refused("out-of-range", says="cooling"):
        replace(TINY, cooling=1.5)


@pytest.mark.parametrize(
    ("scene", "what"),
    [("pull", "the scene 'pull' has no reward"), ("dor", "Did you mean 'door'")],
)
def test_scenes_that_are_not_learned(
    scene: str, what: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["train", "compliant", scene, "-o", str(tmp_path / "run")]) == 2
    assert what in capsys.readouterr().err and not (tmp_path / "run").exists()
    with refused("settings-conflict", says="reach"):
        Compliant(scene="door")
