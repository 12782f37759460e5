"""Environments of characters in scenes: the same numbers as alone, whatever else stands there."""

from __future__ import annotations

import pytest
import torch

from poise.env import ImitationEnv
from poise.motion import ClipLibrary
from poise.recipes import ResidualForce, build
from poise.recipes.imitation import Imitation
from poise.sim import Character, CharacterRows, Scene, SceneSim
from poise.sim.props import Ball, Door
from toy_human import swing


@pytest.fixture(scope="module")
def task() -> Imitation:
    return build(ClipLibrary.of([swing(1.5, name="calm")]), ResidualForce(num_envs=2, expert=False))


def rows(task: Imitation, worlds: int, *names: str) -> CharacterRows:
    """Characters in worlds with a ball, a door and a bystander, all compiled before them."""
    body = task.humanoid
    things = (Ball(pos=(0, 30, 0.2)), Door(pos=(0, 40, 0)), Character(body, "bystander"))
    things += tuple(Character(body, n) for n in names)
    sim = SceneSim(Scene(things, sim=task.config.sim), worlds, threads=1)
    away = torch.tensor(body.model.qpos0).repeat(worlds, 1)
    away[:, 0] += 50.0
    sim.characters("bystander").write(None, away, torch.zeros(worlds, body.model.nv))
    return sim.characters(*names)


def compare(env: ImitationEnv, alone: ImitationEnv, steps: int = 60) -> None:
    """Both do the same in episodes that end and begin again by themselves."""
    rng = torch.Generator().manual_seed(1)
    torch.testing.assert_close(env.reset(), alone.reset(), rtol=0, atol=1e-12)
    ended = 0
    for _ in range(steps):
        action = 0.4 * torch.randn(env.num_envs, env.num_actions, generator=rng)
        a, b = env.step(action), alone.step(action)
        for name in ("obs", "reward", "final_obs"):
            torch.testing.assert_close(getattr(a, name), getattr(b, name), rtol=0, atol=1e-12)
        assert torch.equal(a.terminated, b.terminated) and torch.equal(a.failed, b.failed)
        assert env.wrench is not None and alone.wrench is not None
        for got, want in zip(env.wrench[:3], alone.wrench[:3], strict=True):
            torch.testing.assert_close(got, want, rtol=0, atol=1e-9)
        ended += int(a.terminated.sum())
    assert ended > 2


def test_things_compiled_before_a_character_change_nothing(task: Imitation) -> None:
    env = task.env(seed=4, backend=rows(task, 3, "anna"))
    alone = task.env(3, seed=4, threads=1)
    compare(env, alone)
    env.close()
    alone.close()


def test_characters_of_one_world_are_rows_of_an_environment(task: Imitation) -> None:
    """Episodes end and begin again per character, and the snapshot is of them alone."""
    names = ("anna", "ben", "carl", "dora")
    backend = rows(task, 2, *names)
    apart = [20.0 * k for k in range(8)]
    env, alone = task.env(seed=4, backend=backend), task.env(8, seed=4, threads=1)
    assert env.num_envs == 8
    # They would stand in one another: each has its own place along X, which no term sees.
    for e in (env, alone):
        write = e.backend.write

        def aside(ids, qpos, qvel, write=write):
            moved = qpos.clone()
            at = torch.tensor(apart, dtype=torch.float64)
            moved[:, 0] += at if ids is None else at[ids]
            return write(ids, moved, qvel)

        e.backend.write = aside
    snapshot, obs = None, None
    rng = torch.Generator().manual_seed(1)
    torch.testing.assert_close(env.reset(), alone.reset(), rtol=0, atol=1e-4)
    for k in range(30):
        action = 0.3 * torch.randn(8, env.num_actions, generator=rng)
        a, b = env.step(action), alone.step(action)
        assert torch.equal(a.terminated, b.terminated)
        if k == 20:
            snapshot, obs = env.snapshot(), a.obs.clone()
    torch.testing.assert_close(a.reward, b.reward, rtol=0, atol=1e-3)
    assert snapshot is not None and obs is not None
    torch.testing.assert_close(env.restore(snapshot), obs, rtol=0, atol=1e-6)
