"""Algorithm 1: the control policy sees z and the present frame of fresh segments."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from poise.env.generator_goal import GeneratorGoal
from poise.jobs.endless.model import load_generator
from poise.jobs.open import open_run
from poise.learn import PPOConfig
from poise.papers.residual_force.dual_policy import DualPolicy, build, dual_task
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
    z = torch.randn(WORLDS, 3)
    known = replace(task, task=dual_task(task.config, task.humanoid, 10, z), goal=None)
    env = known.env(WORLDS, auto_reset=False, threads=1, guard=False)
    zero = torch.zeros(WORLDS, dtype=torch.long)
    torch.testing.assert_close(env.reset_to(zero, zero)[:, env.columns["latent"]], z)
    env.close()
