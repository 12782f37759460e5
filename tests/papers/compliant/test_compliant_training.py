"""A scene learned on top of the policy, in miniature."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from poise.cli.main import main
from poise.control import Compliance, Stiffness
from poise.env.yielding import Yielding
from poise.jobs.open import open_run
from poise.jobs.tracker import Tracker
from poise.learn import PPOConfig, Until
from poise.learn.checkpoint import load_checkpoint, save_checkpoint
from poise.papers.compliant.figures import throws
from poise.papers.compliant.scene_play import play
from poise.papers.compliant.scene_training import (
    RUN_FILE,
    SHIPPED,
    Added,
    Compliant,
    OnTop,
    along,
    config_of,
    open_learned,
    save_learned,
    scene_task,
    shipped,
    train,
)
from poise.papers.compliant.scenes import Chicken, DoorScene, Throws
from poise.papers.compliant.scenes.ball import FictionalForces
from poise.papers.compliant.scenes.body_scenes import Bounce
from poise.papers.compliant.watch import part_of
from poise.settings import to_data
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
    with refused("policies-differ"):
        train(TINY, another(tracker), tmp_path / "a", Until(iterations=3), threads=1)
    # Runs of earlier versions do not say what they lie on.
    run_file = tmp_path / "a" / RUN_FILE
    told = json.loads(run_file.read_text())
    run_file.write_text(json.dumps({k: v for k, v in told.items() if k != "below"}))
    assert learned.below is not None and open_learned(tmp_path / "a", another(tracker)).below is None
    with refused("not-a-run"):
        open_learned(tmp_path, tracker)
    # A new run goes on from it, unless it sees something else.
    slow = replace(TINY, ppo=replace(TINY.ppo, policy_lr=1e-9))
    train(slow, tracker, tmp_path / "c", Until(iterations=1), threads=1, earlier=learned)
    kept = open_learned(tmp_path / "c", tracker).top
    torch.testing.assert_close(kept.act(seen), learned.top.act(seen), atol=0.05, rtol=0.05)
    with refused("policy-unfit"):
        train(
            replace(TINY, body=True, reach=0.2),
            tracker,
            tmp_path / "d",
            Until(iterations=1),
            earlier=learned,
        )
    assert not (tmp_path / "d").exists()


def test_what_comes_along_for_the_ball_balances_it(tracker: Tracker) -> None:
    learned = shipped("ball", tracker)
    assert learned is not None and shipped("throws", tracker) is None
    made = play(learned.config.play(), tracker, None, None, 2, 5.0, 1, "ball", learned)
    # A rod that nobody balances has fallen after 1.5 s.
    assert made.figures["stays_s"] > 4.9 and made.stiff["stays_s"] < 2.0 and made.figures["lost"] == 0
    assert shipped("ball", another(tracker)) is None
    doors = shipped("door", tracker)
    assert doors is not None
    assert doors.config.suits(DoorScene(1.7)) == DoorScene(1.7, made_for=1.0)
    assert doors.config.suits(DoorScene(1.7, made_for=1.7)) is None
    assert doors.config.suits(DoorScene(2.0)) is None and doors.config.suits(Throws()) == Throws()
    assert along(DoorScene(2.0), tracker) is None and along(Throws(), tracker) is None
    for against in ("nobody", "bag", "rival"):
        top = along(Chicken(against=against), tracker)
        assert top is not None and (top.config.against == "nobody") == (against == "nobody")
    hops = shipped("chicken", tracker)
    assert hops is not None and hops.config.drawn == (0.0, 0.2)
    assert all(file.stat().st_size < 500_000 for file in SHIPPED.values())
    with refused("policies-differ"):
        play(learned.config.play(), another(tracker), None, None, 2, 5.0, 1, "ball", learned)


def another(tracker: Tracker) -> Tracker:
    """The same body with other weights."""
    other = replace(tracker, policy=tracker.policy.copy())
    other.policy.load_state({k: 1.01 * v for k, v in tracker.policy.state().items()})
    return other


@pytest.mark.parametrize("scene", ["throws", "hands", "trampoline", "chicken"])
def test_scenes_without_a_task_learn_to_give_way(tracker: Tracker, scene: str) -> None:
    config = replace(TINY, scene=scene, num_envs=6, seconds=0.5)
    assert config.added(0) == Added(0, 0.3, False) and config.drawn == (0.0, 0.2)
    assert config.learner(2).std == (0.1, 0.1)
    assert replace(config, scene="ball", reach=0.2).learner(1).std == (0.1,) + (PPO.std,) * 6
    env = scene_task(config, tracker).env(6, threads=1, help_scale=0.0, guard=False)
    top = OnTop(env, tracker.policy, config.added(tracker.policy.num_obs))
    obs, yields = top.reset(), env.event(Yielding)
    assert yields is not None
    # Levels are drawn for each episode, and seen; episodes begin off the motion.
    level, seen = yields.level.clone(), env.columns["level"]
    assert 0.0 <= float(level.min()) < float(level.max()) <= 0.2
    torch.testing.assert_close(obs[:, seen.start - top.added.seen], (5.0 * level).float())
    off = env.backend.state.qpos[:, 7:] - env.goal.start()[0][:, 7:]
    assert 0.01 < float(off.std()) < 0.04
    step = top.step(torch.zeros(6, top.num_actions))
    paid = env.terms["task/eased"]
    assert bool(((paid > 0.0) & (paid <= 1.0)).all()) and bool(step.reward.isfinite().all())
    if scene == "hands":
        assert float(paid.min()) < 0.9
    if scene == "trampoline":
        bounce = next(e for e in part_of(env).events if isinstance(e, Bounce))
        assert 0.05 <= float(bounce.rises.min()) < float(bounce.rises.max()) <= 0.2
    top.close()


def test_what_learned_levels_is_played_at_each(tracker: Tracker, tmp_path: Path) -> None:
    config = replace(TINY, scene="throws", num_envs=2, level=(0.0, 0.1))
    train(config, tracker, tmp_path / "run", Until(iterations=1), threads=1, tensorboard=False)
    learned = open_learned(tmp_path / "run", tracker)
    assert learned.config == config
    played = play(config.play(), tracker, None, Compliance(0.05), 1, 0.5, 1, "throws", learned)
    given = played.imitation.task.compliance
    assert isinstance(given, Compliance) and given.level == 0.05 and given.drawn is None
    # The twin that does not give way acts with it, too.
    lone = play(config.play(), tracker, None, Compliance(0.05), 1, 0.5, 1, "throws")
    assert (played.stiff_episodes["torque_nm"] != lone.stiff_episodes["torque_nm"]).all()
    # The policy on top acts, at the level that is asked for.
    found = throws(tracker, Compliance(), (0.0, 0.1), 2, threads=1, learned=learned)
    plain = throws(tracker, Compliance(), (0.0,), 2, threads=1)
    assert found.torque.shape == (2, 2) and (found.torque[:1] != plain.torque).any()
    assert not found.moved[0].any() and (found.moved[1] > 0.0).all()
    assert learned.config.played(None) == Compliance()
    with refused("option-not-applicable", says="no stiffness"):
        learned.config.played(Stiffness(200.0))
    one = replace(config, level=0.1)
    assert one.drawn is None and one.played(None) == Compliance(0.1)
    with refused("option-not-applicable", says="as it has learned"):
        one.played(Compliance(0.16))
    with refused("settings-conflict", says="a motion of its own"):
        replace(config, scene="door", clip="walk.bvh")


def test_an_opponent_acts_with_what_was_learned_too(tracker: Tracker, tmp_path: Path) -> None:
    config = replace(TINY, scene="chicken", num_envs=2)
    train(config, tracker, tmp_path / "run", Until(iterations=1), threads=1, tensorboard=False)
    run, scene = open_learned(tmp_path / "run", tracker), Chicken(against="rival")
    both, named, alone = (
        play(scene, tracker, None, Compliance(0.1), 1, 0.5, 1, learned=learned, rival=rival)
        for learned, rival in ((run, None), (run, run), (None, None))
    )
    ways = [np.stack([m.pos for m in played.movers]) for played in (both, named, alone)]
    np.testing.assert_array_equal(ways[0], ways[1])
    assert ways[0].shape == ways[2].shape and (ways[0] != ways[2]).any()


def test_rods_and_doors_are_drawn_for_each_episode(tracker: Tracker) -> None:
    config = replace(TINY, num_envs=8)
    env = scene_task(config, tracker).env(8, threads=1, help_scale=0.0, guard=False)
    env.reset()
    model = env.backend.get_model
    balls = [model(k).geom("rod/ball").pos[2] for k in range(8)]
    weights = [model(k).body("rod").mass[0] for k in range(8)]
    assert 0.8 <= min(balls) < max(balls) <= 1.2 and len(set(weights)) > 2
    # Of a rod that stands upright, all see the same height.
    height = env.observe()[:, env.columns["task/ball"]][:, 2]
    assert float(height.std()) < 0.02
    env.close()
    config = replace(config, scene="door", width=(1.0, 1.7), seconds=3.0)
    env = scene_task(config, tracker).env(8, threads=1, help_scale=0.0, guard=False)
    env.reset()
    knobs = [env.backend.get_model(k).site("link grip").pos[1] for k in range(8)]
    assert 0.9 < min(knobs) < max(knobs) < 1.7
    for _ in range(55):
        env.step(tracker.policy.act(env.observe()[:, : tracker.policy.num_obs]))
    # Hands hold the knobs of doors of all widths.
    held = env.observe()[:, env.columns["task/knob"]][:, :3].norm(dim=1)
    assert int((held < 0.2).sum()) >= 6
    env.close()


def test_runs_of_earlier_versions_open_as_they_were() -> None:
    old = {k: v for k, v in to_data(Compliant()).items() if k in _THEN} | {"reach": 0.2}
    config = config_of(old)
    then = (config.arc, config.length, config.mass, config.tilt, config.spread, config.body)
    assert then == (0.0, 1.0, 0.5, 0.02, 0.0, False) and config.learner(9) == config.ppo
    play = config.play()
    assert play.stage and len(play.rods((0.0, 0.0, 0.0))) == 1  # type: ignore[attr-defined]
    assert config.reach == 0.2 and config.given() is None


#: Settings that runs named before scenes without a task were learned.
_THEN = ("scene", "width", "pushes", "seconds", "level", "stiffness", "forces", "num_envs", "seed")


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
        Compliant(scene="door", reach=0.0)
