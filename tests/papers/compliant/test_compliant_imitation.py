"""Deep Compliant Control's imitation controller: its state, its reward, and that it trains."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from poise.env import ImitationEnv
from poise.env.yielding import DisplacedGoal
from poise.learn import Amp, AmpConfig, Until
from poise.learn.amp import mixed_reward
from poise.motion import ClipLibrary
from poise.motion.rotations import into_heading
from poise.papers.compliant import imitation_controller as compliant
from poise.papers.compliant.controller_run import begin, train
from poise.papers.compliant.imitation_controller import (
    CompliantImitation,
    build,
    chained,
    config_of,
    trainer,
)
from poise.papers.compliant.scenes.body_scenes import HandInHand, Throws
from poise.papers.opened import opened
from poise.recipes.imitation import Imitation
from poise.settings import to_data
from refusals import refused
from toy_human import swing

SMALL = {"policy_hidden": (24,), "value_hidden": (24,), "horizon": 4, "minibatch": 16, "epochs": 1}


def small(**changes: object) -> CompliantImitation:
    base = CompliantImitation(num_envs=4, seed=3)
    assert base.style is not None
    style = replace(base.style, hidden=(16,), minibatch=8, kept=16, steps=1)
    ppo = replace(base.ppo, **SMALL)  # type: ignore[arg-type]
    return replace(base, **({"style": style, "ppo": ppo} | changes))  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def made() -> Imitation:
    return build(swing(2.0), small())


def env_of(made: Imitation) -> ImitationEnv:
    env = made.env(2, auto_reset=False, threads=1, guard=False)
    zero = torch.zeros(2, dtype=torch.long)
    env.reset_to(zero, zero + 10)
    return env


def moved_goal(env: ImitationEnv) -> DisplacedGoal:
    assert isinstance(env.goal, DisplacedGoal)
    return env.goal


def test_the_state_is_two_poses_without_what_displaces_them(made: Imitation) -> None:
    env = env_of(made)
    one = env.view()
    was = one.sim.pos.clone()
    # In a new episode the earlier pose is what the velocities say.
    assert torch.allclose(one.shifted.before, was - one.sim.linvel / 30.0, atol=2e-3)
    env.step(torch.zeros(2, env.num_actions))
    two = env.view()
    assert torch.allclose(two.shifted.pos, two.sim.pos, atol=1e-5)
    assert torch.allclose(two.shifted.before, was, atol=1e-5)
    now, before = compliant.two_poses(two).unflatten(1, (2, -1, 3)).unbind(1)
    ground = two.sim.pos[:, :1] * torch.tensor([1.0, 1.0, 0.0])
    assert torch.allclose(now, into_heading(two.sim.heading, two.sim.pos - ground), atol=1e-5)
    assert torch.allclose(before, into_heading(two.sim.heading, was - ground), atol=1e-5)
    # A joint that is displaced by as much as it has moved is where it was.
    calm = compliant.posture(two).clone()
    moved_goal(env).offset[:, 8] = 0.3
    env.backend.state.qpos[:, 9] += 0.3
    env.backend.forward()
    moved = env.view()
    assert not torch.allclose(moved.sim.pos, two.sim.pos, atol=1e-3)
    assert torch.allclose(compliant.posture(moved), calm, atol=1e-4)
    assert float(compliant.displacement(moved, "shifted/u")[0, 8]) == pytest.approx(0.3)


def test_what_the_discriminator_sees_of_a_clip_is_what_it_sees_of_a_character_on_it(
    made: Imitation,
) -> None:
    env = env_of(made)
    demos = env.demos(2).at(torch.tensor([0]), torch.tensor([10]))
    assert torch.allclose(demos[:, : demos.shape[1] // 2], compliant.posture(env.view())[:1], atol=1e-3)


def test_the_positional_reward_is_equation_14(made: Imitation) -> None:
    env = env_of(made)
    frame = env.view()
    assert torch.allclose(compliant.root_place(frame), torch.ones(2), atol=1e-6)
    goal = moved_goal(env)
    goal.offset[:, 0] = 0.5
    goal.rate[:, 1] = 2.0
    away = 0.7 * math.exp(-0.5 * 0.25) + 0.3 * math.exp(-1.0 * 4.0)
    assert torch.allclose(compliant.root_place(env.view()), torch.full((2,), away), atol=1e-4)


def test_the_reward_is_a_product(made: Imitation) -> None:
    style = made.config.style
    assert style is not None and style.product
    known = torch.tensor([[0.5, float("nan")]])
    paid, mean = mixed_reward(torch.tensor([[0.4, 1.0]]), known, style)
    assert paid[0].tolist() == pytest.approx([0.2, 0.5]) and float(mean) == 0.5
    trainer = made.trainer(threads=1, style=style)
    trainer.iterate()
    amp = trainer.style
    assert isinstance(amp, Amp)
    again = amp.reward(torch.full_like(amp.style_rewards, 0.4))
    assert torch.equal(again, mixed_reward(torch.tensor(0.4), amp.style_rewards, style)[0])
    with refused("settings-conflict"):
        CompliantImitation(style=AmpConfig())


@pytest.mark.parametrize("changes", [{}, {"style": None}, {"action": "absolute", "level": None}])
def test_it_trains_and_goes_on_bit_for_bit(changes: dict[str, object], tmp_path) -> None:
    made = build(swing(2.0), small(**changes))
    style = made.config.style
    through = made.trainer(threads=1, style=style)
    for _ in range(3):
        through.iterate()
    first = made.trainer(threads=1, style=style)
    first.iterate()
    first.save(tmp_path / "c")
    second = made.trainer(threads=1, style=style)
    second.load(tmp_path / "c")
    for _ in range(2):
        second.iterate()
    a, b = through.state(), second.state()
    assert "env/shifted/before" in a
    for name in a.keys() - {"trainer/counters"}:
        assert torch.equal(a[name].nan_to_num(-1), b[name].nan_to_num(-1)), name


def several() -> ClipLibrary:
    return ClipLibrary((swing(2.0, name="stand"), swing(2.0, speed=1.2, bend=0.5, name="walk")))


def test_a_chain_goes_from_clip_to_clip_without_a_leap() -> None:
    made = build(several(), small(chains=0))
    chains = chained(made.reference, 3, 8.0, seed=5)
    assert chains.length.tolist() == [241] * 3
    way = chains.qvel[:, :2].norm(dim=-1)
    # It stands, and it walks, no faster than its clips; no joint leaps.
    assert way.min() < 0.2 and 1.0 < way.max() < 1.1 * made.reference.qvel[:, :2].norm(dim=-1).max()
    assert chains.qvel[:, 6:].abs().max() < 2.0 * made.reference.qvel[:, 6:].abs().max() + 5.0
    again = chained(made.reference, 3, 8.0, seed=5)
    assert torch.equal(again.qpos, chains.qpos)
    assert not torch.equal(chained(made.reference, 3, 8.0, seed=6).qpos, chains.qpos)


def test_chains_are_learned_and_the_discriminator_is_shown_clips_alone() -> None:
    made = build(several(), small(chains=2))
    assert made.reference.names == ("stand", "walk", "chain-1", "chain-2")
    learner = trainer(made, 1)
    amp = learner.style
    assert isinstance(amp, Amp)
    assert amp.demos.weights().tolist() == [60.0, 60.0, 0.0, 0.0]  # type: ignore[attr-defined]
    learner.iterate()
    learner.close()
    # One clip has no other to go to.
    assert len(build(swing(2.0), small(chains=2)).reference.length) == 1


def test_a_run_goes_on_and_is_led_by_the_hand(tmp_path: Path) -> None:
    config = small(action="absolute", chains=1)
    for count in (1, 2):
        made = begin(tmp_path, several(), config)
        done = train(made, tmp_path, Until(iterations=count), threads=1, tensorboard=False)
        assert done.last is not None and done.last.iteration == count
    with refused("settings-differ"):
        begin(tmp_path, several(), small())
    run = opened(tmp_path)
    assert run.recipe == "compliant-imitation" and run.task.reference.names == ("stand", "walk")
    assert run.episode("walk").rollouts.lengths.tolist() == [61]
    played = run.play(HandInHand(lead=0.5, sway=0.0), count=2, seconds=0.5, threads=1)  # type: ignore[attr-defined]
    assert played.figures["force_mean_n"] > 0.0 and played.figures["goal_moved_m"] > 0.0
    assert played.stiff["goal_moved_m"] == 0.0
    with refused("option-not-applicable"):
        run.play(Throws())  # type: ignore[attr-defined]
    with refused("policy-of-own-clips"):
        _ = run.tracker


def test_what_the_paper_states() -> None:
    paper = CompliantImitation.paper()
    assert paper.num_envs * paper.ppo.horizon == 2048 and paper.ppo.minibatch == 128
    assert paper.ppo.std == pytest.approx(np.radians(6.0)) and paper.ppo.policy_lr == 1e-5
    assert paper.style is not None and (paper.style.shape, paper.style.minibatch) == (0.2, 16)
    assert paper.sim.rate_hz == 600.0 and paper.action == "absolute" and paper.level == 0.16
    assert config_of(to_data(paper)) == paper
