"""A snapshot holds all that a world is: restored, it goes on to the bit, wherever it is restored."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from poise.control import SuccessHelp
from poise.env import ImitationEnv
from poise.env.recovery.recovering import Recovering
from poise.env.yielding import DisplacedGoal
from poise.motion import ClipLibrary
from poise.recipes import ResidualForce, build
from poise.recipes.body_shapes import BodyShapes
from poise.recipes.imitation import Imitation
from poise.recipes.perpetual import build as build_perpetual
from poise.recipes.perpetual import stage_task
from refusals import refused
from toy_human import swing
from toy_library import PLAIN, library, lively, tiny

STEPS = 30
CLIPS = (swing(0.7, name="calm"), swing(0.6, speed=2.0, name="quick"))


def imitation(**settings: object) -> Imitation:
    made = build(ClipLibrary.of(CLIPS), ResidualForce(num_envs=8, **settings))  # type: ignore[arg-type]
    return replace(made, task=replace(made.task, help=made.task.help and SuccessHelp(every=4)))


def perpetual(recovers: str | None = None, **settings: object) -> Imitation:
    made = build_perpetual(library(), tiny(num_envs=8, **settings))
    task = stage_task(made.config, made.humanoid, recovers)  # type: ignore[arg-type]
    return replace(made, task=replace(task, horizon=20, adaptive=0.5, first=0.2))


RATES = {"action_rate": 2.0, "torque_rate": 2.0}
#: The tasks of every recipe, as training has them.
TASKS: dict[str, Callable[[], Imitation]] = {
    "imitate": imitation,
    "explicit": lambda: imitation(method="rfc-explicit", reward="local"),
    "paper": lambda: imitation(observation="phase", action="absolute", done="height"),
    "deepmimic": lambda: imitation(method="deepmimic"),
    "perpetual": perpetual,
    "recovery": lambda: perpetual("primitive"),
    "composer": lambda: perpetual("composer"),
    "shapes": lambda: perpetual(shapes=BodyShapes(count=3), recovery=False),
    "keypoints": lambda: perpetual(goal="keypoints"),
    "additive": lambda: perpetual(action="additive", style=None),
    "interpolated": lambda: perpetual(action="additive", style=None, interpolate=True),
    "filtered": lambda: perpetual(filter=0.6, window=(2, 4), root=0.2, foot_slide=0.1, **RATES),
}


def drawn(env: ImitationEnv, seed: int) -> Tensor:
    rng = torch.Generator().manual_seed(seed)
    return 0.2 * torch.randn(STEPS, env.num_envs, env.num_actions, generator=rng)


def played(env: ImitationEnv, actions: Tensor) -> list[Tensor]:
    out: list[Tensor] = []
    for action in actions:
        step = env.step(action)
        out += [step.obs.clone(), step.reward, step.terminated, step.truncated]
        out += [env.backend.state.qpos.clone(), env.age.clone(), env.frame.clone()]
        out.append(torch.tensor([env.help.now]))
    return out


def same(a: list[Tensor], b: list[Tensor]) -> bool:
    return all(torch.equal(x, y) for x, y in zip(a, b, strict=True))


@pytest.mark.parametrize("name", TASKS)
def test_a_restored_environment_goes_on_to_the_bit(name: str) -> None:
    task = TASKS[name]()
    env, other = (task.env(8, seed=s, threads=1) for s in (3, 4))
    env.reset()
    played(env, drawn(env, 1)[:15])
    shot, actions = env.snapshot(), drawn(env, 2)
    first = played(env, actions)
    env.restore(shot)
    assert same(first, played(env, actions))
    # Another environment that has been elsewhere becomes the same one.
    other.reset()
    played(other, drawn(other, 5)[:7])
    other.restore(shot)
    assert same(first, played(other, actions))
    # Episodes ended on the way, so what all worlds share was asked for.
    assert any(bool(x.any()) for x in first[2::8]) or any(bool(x.any()) for x in first[3::8])
    env.close()
    other.close()


def test_one_world_becomes_many_and_the_others_stay() -> None:
    task = perpetual("composer")
    one = task.env(1, seed=3, auto_reset=False, threads=1, guard=False)
    many = task.env(6, seed=4, auto_reset=False, threads=1, guard=False)
    one.reset()
    many.reset()
    played(one, drawn(one, 1)[:9])
    action = drawn(one, 2)
    shot, before = one.snapshot(), many.snapshot(torch.tensor([0, 5]))
    rows = torch.tensor([1, 2, 4])
    obs = many.restore(shot, rows)
    expected = played(one, action)
    found = played(many, action.expand(STEPS, 6, -1))
    for a, b in zip(expected, found, strict=True):
        if len(a) == 1 and len(b) == 6:
            # The copies are alike to the bit; one world and six are not vectorised alike everywhere.
            assert all(torch.equal(b[1], b[i]) for i in rows.tolist())
            torch.testing.assert_close(a[0], b[1], rtol=1e-4, atol=1e-4)
    assert obs.shape == (6, many.num_obs)
    many.restore(before, torch.tensor([0, 5]))
    again = many.snapshot(torch.tensor([0, 5]))
    assert all(torch.equal(again.worlds[k], before.worlds[k]) for k in before.worlds)
    one.close()
    many.close()


def test_a_body_goes_with_its_world() -> None:
    task = perpetual(shapes=BodyShapes(count=3), recovery=False)
    env = task.env(6, auto_reset=False, threads=1, guard=False)
    clips = len(task.reference.length)
    env.reset_to(torch.arange(6) % clips, torch.zeros(6, dtype=torch.long))
    lengths = env.backend.expand("body_pos").clone()
    shot = env.snapshot(torch.tensor([5]))
    env.restore(shot, torch.tensor([0, 1]))
    now = env.backend.expand("body_pos")
    assert torch.equal(now[0], lengths[5]) and torch.equal(now[1], lengths[5])
    assert torch.equal(now[2:], lengths[2:])
    env.close()


def test_what_leads_back_and_what_displaces_are_copied_too() -> None:
    made = build_perpetual(lively(), tiny(recovery=True, **PLAIN))
    assert made.recovery_clips is not None
    env = made.bare().env(3, auto_reset=False, threads=1, help_scale=0.0, guard=False)
    env.reset_to(torch.zeros(3, dtype=torch.long), torch.zeros(3, dtype=torch.long))
    for wrap in (lambda g: Recovering(g, made.recovery_clips), DisplacedGoal):
        goal = wrap(env.goal.clips)
        env.set_goal(goal)
        if isinstance(goal, Recovering):
            goal.lead(torch.tensor([1]), env.backend.state.qpos)
        else:
            goal.offset[2, 1] = 0.3
        actions = drawn(env, 6)
        played(env, actions[:5])
        shot = env.snapshot()
        first = played(env, actions)
        env.restore(shot)
        assert same(first, played(env, actions))
    env.close()


def test_what_does_not_fit_is_refused_in_a_sentence() -> None:
    env = imitation().env(3, threads=1)
    env.reset()
    with refused("count-differs", says=("2", "3")):
        env.restore(env.snapshot(torch.tensor([0, 1])))
    plain = perpetual().env(3, threads=1)
    recovering = perpetual("composer").env(3, threads=1)
    with refused("snapshot-differs", says="recovery"):
        recovering.restore(plain.snapshot())
    for e in (env, plain, recovering):
        e.close()
