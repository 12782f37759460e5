"""PHC's goal, reward and motion prior trained end to end on the clip that comes with Poise."""

from __future__ import annotations

import math
from dataclasses import replace
from importlib.resources import as_file, files

import pytest
import torch

from poise.control import PDTargets, range_scale
from poise.env import DoneTerm, ObsTerm
from poise.env import observations as obs
from poise.env import rewards as reward
from poise.formats import read_clip
from poise.learn import Amp, AmpConfig, PPOConfig
from poise.recipes import ResidualForce, build
from poise.recipes.imitation import Imitation
from refusals import refused

PPO = PPOConfig(
    std=0.055, horizon=12, epochs=2, minibatch=48, policy_hidden=(24,), value_hidden=(24,), norm_warmup=3
)
AMP = AmpConfig(
    frames=10, hidden=(16,), minibatch=32, kept=48, replay=64, demos=80, fresh_demos=8, steps=2
)


@pytest.fixture(scope="module")
def walk() -> Imitation:
    with as_file(files("poise").joinpath("data/walk.bvh")) as path:
        built = build(read_clip(path), ResidualForce(num_envs=8, method="deepmimic", ppo=PPO, seed=4))
    humanoid = built.humanoid
    apart = {"bodies": reward.all_but_feet(humanoid), "grace": 1}
    task = replace(
        built.task,
        obs=(ObsTerm("self", obs.self_state), ObsTerm("goal", obs.rotation_goal)),
        rewards=(*reward.imitation_terms("code"), reward.energy_term(AMP.task_weight)),
        dones=(DoneTerm("any_body_too_far", reward.any_body_too_far, apart),),
        pd=PDTargets("absolute", range_scale(torch.tensor(humanoid.model.jnt_range[1:]))),
        style=obs.style_terms(humanoid),
        horizon=20,
    )
    return replace(built, task=task)


def test_it_trains_and_goes_on_bit_for_bit(walk, tmp_path):
    through = walk.trainer(threads=1, style=AMP)
    whole = [through.iterate().row() for _ in range(5)]
    first = walk.trainer(threads=1, style=AMP)
    parts = [first.iterate().row() for _ in range(2)]
    first.save(tmp_path / "c")
    # Another seed, so that nothing agrees by itself.
    second = replace(walk, config=replace(walk.config, seed=9)).trainer(threads=1, style=AMP)
    second.load(tmp_path / "c")
    parts += [second.iterate().row() for _ in range(3)]
    a, b = through.state(), second.state()
    assert a.keys() == b.keys() and "env/weights" in a and "style/own/history/frames" in a
    for name in a.keys() - {"trainer/counters"}:
        assert torch.equal(a[name].nan_to_num(-1), b[name].nan_to_num(-1)), name
    for x, y in zip(whole, parts, strict=True):
        for name in x:
            assert name.startswith("time/") or same(x[name], y[name]), name
    # Rewards and the discriminator are finite, and episodes ended on the way.
    for row in whole:
        assert all(math.isfinite(v) for k, v in row.items() if "episode" not in k and "failure" not in k)
        assert row["env/reward/energy"] > 0 and 0 < row["env/imitation"] < 1
    assert sum(row["episodes"] for row in whole) > 0 and whole[-1]["update/style_reward"] > 0
    for trainer in (through, first, second):
        trainer.env.close()


def same(x: float, y: float) -> bool:
    return x == y or (math.isnan(x) and math.isnan(y))


def test_the_style_fills_from_the_clip_where_an_episode_begins(walk):
    env = walk.env(8, threads=1)
    env.reset_to(torch.zeros(8, dtype=torch.long), torch.full((8,), int(env.reference.length[0]) - 2))
    style = Amp(env, env.demos(10), AMP, 4)
    style.begin(1)
    step = env.step(torch.zeros(8, env.num_actions))
    assert bool((step.terminated | step.truncated).all())
    env.frame.copy_(torch.tensor([0, 3, 8, 9, 10, 12, 20, 30]))
    style.step(step.terminated | step.truncated)
    assert style.history.full().tolist() == [3, 4, 5, 6, 7]
    env.close()


def test_a_style_of_your_own_comes_with_its_environment(walk):
    env = walk.env(4, threads=1)
    style = Amp(env, env.demos(AMP.frames), AMP, 4)
    with refused("settings-conflict"):
        walk.trainer(style=style)
    trainer = walk.trainer(threads=1, env=env, style=style)
    assert trainer.env is env and trainer.style is style
    assert trainer.iterate().style["style_loss"] > 0
    env.close()
    plain = replace(walk, task=replace(walk.task, style=()))
    with refused("settings-conflict"):
        plain.trainer(threads=1, style=AMP)
