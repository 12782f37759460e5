"""Algorithm 1: the control policy sees z and the present frame of fresh segments."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from poise.cli.main import main
from poise.env.generator_goal import GeneratorGoal
from poise.jobs.endless.model import load_generator
from poise.jobs.open import open_run
from poise.learn import PPOConfig
from poise.papers.opened import opened
from poise.papers.residual_force.dual_policy import DualPolicy, build, dual_task
from poise.papers.residual_force.dual_run import SEGMENTS
from poise.recipes.imitation import Imitation
from poise.synthesis.generator import Kinematic

WORLDS = 4


@pytest.fixture(scope="module")
def task() -> Imitation:
    tracker = open_run(None).tracker
    ppo = PPOConfig(horizon=4, epochs=1, policy_hidden=(8,), value_hidden=(8,))
    config = DualPolicy(sim=tracker.config.sim, num_envs=WORLDS, ppo=ppo, segments=2)
    generator = load_generator(None).generator(tracker.humanoid, 1.0, None)
    return build(generator, tracker.humanoid, tracker.example, config)


def test_the_state_is_that_of_line_13(task: Imitation) -> None:
    env = task.env(auto_reset=False, threads=1, guard=False)
    obs, goal = env.reset(), env.goal
    assert isinstance(goal, GeneratorGoal) and isinstance(goal.generator, Kinematic)
    z = goal.generator.latent
    assert z is not None and bool((z.norm(dim=1) > 0).all())
    torch.testing.assert_close(obs[:, env.columns["latent"]], z)
    # Characters stand on the present frame, off which they are by nothing; the next one is elsewhere.
    n = env.hinges
    assert float(obs[:, env.columns["target_joints"]][:, :n].abs().max()) < 1e-5
    later = goal.start(None, 1)[0][:, 7:] - goal.start(None)[0][:, 7:]
    assert float(later.abs().max()) > 1e-3
    assert env.task.horizon == 2 * goal.generator.future
    first = z.clone()
    for _ in range(goal.generator.future):
        goal.advance(None, None)
    # The next segment has a z of its own.
    assert bool((z - first).norm(dim=1).gt(0).all())
    env.close()


def test_every_episode_is_fresh_and_is_learned(task: Imitation) -> None:
    trainer = task.trainer(threads=1)
    stats = trainer.iterate()
    assert stats.samples == WORLDS * 4 and stats.terms["help/force_n"] >= 0
    trainer.env.close()


def test_z_of_known_motions_is_told(task: Imitation) -> None:
    z = torch.randn(len(task.reference.names), 2, 3)
    known = replace(task, task=dual_task(task.config, task.humanoid, 10, z), goal=None)
    env = known.env(WORLDS, auto_reset=False, threads=1, guard=False)
    clip, where = torch.arange(WORLDS), env.columns["latent"]
    torch.testing.assert_close(env.reset_to(clip, clip * 0)[:, where], z[:WORLDS, 0])
    torch.testing.assert_close(env.reset_to(clip, clip * 0 + 9)[:, where], z[:WORLDS, 0])
    seen = env.step(torch.zeros(WORLDS, env.num_actions)).final_obs
    torch.testing.assert_close(seen[:, where], z[:WORLDS, 1])
    env.close()


def test_a_run_goes_on_and_is_played(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run, small = tmp_path / "run", ["--envs", "4", "--threads", "1"]
    small += ["--set", "ppo.horizon=4", "--set", "ppo.epochs=1", "--set", "segments=1"]
    train = ["train", "dual-policy", "-o", str(run), *small]
    assert main([*train, "--iterations", "1"]) == 0
    assert main([*train, "--iterations", "2", "--resume"]) == 0
    assert main([*train, "--help-limit", "50", "--resume"]) == 2
    assert "other settings (help_limit)" in capsys.readouterr().err
    other = tmp_path / "other.safetensors"
    made = load_generator(None)
    replace(made, about={**made.about, "seed": 9}).save(other)
    assert main(["train", "dual-policy", str(other), *train[2:], "--resume"]) == 2
    assert "another kinematic policy" in capsys.readouterr().err
    page = tmp_path / "play.html"
    assert main(["play", str(run), "-o", str(page), "--clip", "motion 2"]) == 0 and page.exists()
    opened_run = opened(run)
    assert opened_run.task.library.names[:2] == ("motion 1", "motion 2")
    # A motion begins with the last frame of its past.
    assert int(opened_run.task.reference.length[0]) == 1 + SEGMENTS * 60
    for word, args in (("one kinematic", ["a", "b"]), ("no --mass", ["--mass", "70"])):
        assert main(["train", "dual-policy", *args, "-o", str(tmp_path / "no")]) == 2
        assert word in capsys.readouterr().err
    assert not (tmp_path / "no").exists()
