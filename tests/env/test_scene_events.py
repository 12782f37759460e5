"""Events in scenes, what terms see of them, and environments that share worlds."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from poise.env import ImitationEnv, ObsTerm
from poise.env.frame import Frame
from poise.env.scene_events import InScene, Move, ScenePart, SetDown, Switch, Throw, Varied, near
from poise.motion import ClipLibrary
from poise.papers.compliant.opponents import Teams
from poise.recipes import ResidualForce, build
from poise.recipes.imitation import Imitation
from poise.sim import Character, Link, Scene, SceneSim, Touch
from poise.sim.props import Ball, Box, Carrier, Door
from refusals import refused
from toy_human import swing


def made(scale: float = 1.0) -> Imitation:
    clip = swing(1.5, name="calm", scale=scale)
    return build(ClipLibrary.of([clip]), ResidualForce(num_envs=2, expert=False))


@pytest.fixture(scope="module")
def task() -> Imitation:
    return made()


def seen(frame: Frame, name: str) -> Tensor:
    value = frame.source(name)
    return value.reshape(len(value), -1)


def env_in(
    task: Imitation, sim: SceneSim, part: InScene, *names: str, dones: bool = False, reset: bool = False
) -> ImitationEnv:
    """The characters follow the clip with nothing that ends their episodes."""
    terms = tuple(ObsTerm(f"scene {n}", seen, {"name": n}) for n in _sources(part))
    own = replace(task.task, events=(part,), obs=(*task.task.obs, *terms))
    own = own if dones else replace(own, dones=())
    rows = sim.characters(*names)
    return replace(task, task=own).env(seed=1, auto_reset=reset, backend=rows, guard=False)


def _sources(part: InScene) -> list[str]:
    fields = ("qpos", "qvel", "pos", "quat")
    own = [f"{name}/{f}" for name in part.sees if name != "others" for f in fields]
    others = [f"others/{f}" for f in ("qpos", "qvel")] if "others" in part.sees else []
    metered = [f"{k}/{n}" for n in part.metered for k in ("impulse", "peak")]
    return own + others + metered + [f"touch/{n}" for n in part.touches]


def start(env: ImitationEnv, apart: float = 0.0) -> None:
    zero = torch.zeros(env.num_envs, dtype=torch.long)
    env.reset_to(zero, zero)


def still(env: ImitationEnv) -> Tensor:
    return torch.zeros(env.num_envs, env.num_actions)


def test_worlds_have_different_makes_of_a_thing_and_go_back_with_a_snapshot(task: Imitation) -> None:
    doors = tuple(Door(pos=(3.0, 0.0, 0.0), width=w) for w in (0.8, 1.0, 1.4))
    wide = Varied(tuple((door,) for door in doors), {"width": torch.tensor([0.8, 1.0, 1.4])}, seed=3)
    scene = Scene((doors[0], Character(task.humanoid)), sim=task.config.sim)
    sim = SceneSim(scene, num_envs=6, threads=1)
    env = env_in(task, sim, InScene(events=(wide,)), reset=True)

    def widths() -> list[float]:
        return [
            round(2.0 * float(env.backend.get_model(k).geom("door/leaf").size[1]), 6) for k in range(6)
        ]

    env.reset()
    part = env.event(ScenePart)
    assert part is not None
    told = part.tells()["width"]
    first = widths()
    assert set(first) == {0.8, 1.0, 1.4} and told.tolist() == pytest.approx(first)
    held, state = env.snapshot(), env.state()
    while widths() == first:
        env.reset()
    env.restore(held)
    assert widths() == first == pytest.approx(told.tolist())
    env.reset()
    env.load_state(state)
    assert widths() == first == pytest.approx(told.tolist())
    # Every world as the last one.
    env.restore(env.snapshot(torch.tensor([5])).repeated(6))
    assert widths() == [first[5]] * 6
    env.close()


def test_a_thing_is_set_down_seen_and_goes_back_with_a_snapshot(task: Imitation) -> None:
    sim = SceneSim(Scene((Ball(), Character(task.humanoid)), sim=task.config.sim), num_envs=3, threads=1)
    down = SetDown("ball", (5.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0), spread=0.2)
    env = env_in(task, sim, InScene(sees=("ball",), events=(down,)))
    start(env)
    qpos = sim.backend.state.qpos[:, sim.scene.place("ball").qpos]
    first = qpos.clone()
    assert (first[:, :3] - torch.tensor([5.0, 0.0, 1.0])).abs().max() <= 0.2
    assert len(first[:, 0].unique()) == 3
    assert torch.equal(first[:, 3:], torch.tensor([[1.0, 0, 0, 0]]).expand(3, 4).double())
    step = env.step(still(env))
    own = step.obs[:, -20:]
    torch.testing.assert_close(own[:, :7], qpos.float())
    torch.testing.assert_close(own[:, 13:16], qpos[:, :3].float())
    # The ball is part of a world with one character, and goes where the snapshot has it.
    shot, place = env.snapshot(), qpos.clone()
    path = [env.step(still(env)).obs.clone() for _ in range(8)]
    assert bool((qpos[:, 2] < place[:, 2] - 0.1).all())
    obs = env.restore(shot)
    torch.testing.assert_close(obs, step.obs)
    assert torch.equal(qpos, place)
    assert all(torch.equal(a, env.step(still(env)).obs) for a in path)
    one = env.snapshot(torch.tensor([2]))
    env.restore(one)
    assert torch.equal(qpos, qpos[2:].expand(3, -1))
    env.close()


def test_a_ball_is_thrown_and_its_impulse_is_measured(task: Imitation) -> None:
    """The impulse is what the ball's momentum loses; it is summed over the physics steps."""
    scene = Scene(
        (Ball(pos=(9, 0, 0.2), radius=0.1, mass=1.0), Character(task.humanoid, "anna")),
        touches=(Touch("hit", "ball", "anna"),),
        sim=task.config.sim,
    )
    sim = SceneSim(scene, num_envs=16, threads=1)
    throw = Throw("ball", "anna/Chest", every_s=(0.8, 0.9), distance=1.2, seed=3)
    env = env_in(task, sim, InScene(metered=("hit",), events=(throw,)))
    start(env)
    part = env.event(ScenePart)
    assert part is not None
    place, source = sim.scene.place("ball"), part.tells()
    velocity = sim.backend.state.qvel[:, place.dofs][:, :3]
    hits, dt = 0, 1 / task.config.sim.control_hz
    for _ in range(80):
        before, thrown = velocity.clone(), part.events[0].rows()["thrown"].clone()
        env.step(still(env))
        impulse, peak = source["impulse/hit"], source["peak/hit"]
        hit = peak > 1.0
        # Above the floor nothing else touches the ball.
        high = sim.backend.state.xpos[:, place.body, 2] > 0.3
        same = (part.events[0].rows()["thrown"] == thrown) & hit & high
        change = (velocity - before).float()
        change[:, 2] += 9.81 * dt
        torch.testing.assert_close(-impulse[same], change[same], rtol=0.02, atol=0.05)
        # A force of one step alone is its impulse.
        assert bool((peak[hit] * dt >= impulse[hit].norm(dim=-1) * 0.99).all())
        hits += int(same.sum())
    assert hits >= 10
    env.close()


def test_a_link_is_switched_by_a_condition(task: Imitation) -> None:
    """A falling box is caught by the hand that it passes, and let go when the episode begins again."""
    scene = Scene(
        (Character(task.humanoid), Box(pos=(0, 0, 3), size=(0.05, 0.05, 0.05), mass=0.5)),
        links=(Link("grip", "box", "LeftHand", measured=True),),
        sim=task.config.sim,
    )
    sim = SceneSim(scene, num_envs=2, threads=1)
    grip = Switch("grip", near("box", "LeftHand", 0.15))
    env = env_in(task, sim, InScene(sees=("box",), events=(grip,)))
    start(env)
    hand = sim.scene.model.body("LeftHand").id
    above = sim.backend.state.xpos[0, hand] + torch.tensor([0.0, 0.0, 0.5])
    turn = torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64)
    rows = torch.tensor([0])
    sim.place("box", torch.cat((above[None], turn), 1), torch.zeros(1, 6, dtype=torch.float64), rows)
    active = sim.backend.state["eq_active"]
    for _ in range(20):
        env.step(still(env))
    assert active[:, 0].tolist() == [1, 0]
    box = sim.scene.place("box").body
    pos = sim.backend.state.xpos[0]
    assert float((pos[box] - pos[hand]).norm()) < 0.2
    shot = env.snapshot()
    env.reset()
    assert not active.any()
    env.restore(shot)
    assert active[:, 0].tolist() == [1, 0]
    env.close()


def test_a_thing_goes_a_way_of_its_own(task: Imitation) -> None:
    def path(t: Tensor) -> tuple[Tensor, Tensor]:
        zero = torch.zeros_like(t)
        return torch.stack((0.5 * t, zero, zero, zero), 1), torch.stack(
            (zero + 0.5, zero, zero, zero), 1
        )

    things = (Carrier("plate", pos=(4, 0, 0.5)), Character(task.humanoid))
    sim = SceneSim(Scene(things, sim=task.config.sim), num_envs=2, threads=1)
    env = env_in(task, sim, InScene(sees=("plate",), events=(Move("plate", path),)))
    start(env)
    for _ in range(30):
        env.step(still(env))
    place = sim.scene.place("plate")
    torch.testing.assert_close(
        sim.backend.state.xpos[:, place.body, 0], torch.tensor([4.5, 4.5]).double(), atol=2e-3, rtol=0
    )
    env.close()


@pytest.mark.parametrize("ends", ["character", "world"])
def test_episodes_end_per_character_or_for_the_world(task: Imitation, ends: str) -> None:
    things = tuple(Character(task.humanoid, name) for name in ("anna", "ben"))
    sim = SceneSim(Scene(things, sim=task.config.sim), num_envs=6, threads=1)
    part = InScene(sees=("others",), ends=ends)
    env = env_in(task, sim, part, "anna", "ben", dones=True, reset=True)
    env.reset()
    rng, ended, mixed = torch.Generator().manual_seed(0), 0, 0
    for _ in range(25):
        step = env.step(0.8 * torch.randn(12, env.num_actions, generator=rng))
        over = (step.terminated | step.truncated).view(6, 2)
        assert not bool((step.terminated & step.truncated).any())
        ended += int(over.any(1).sum())
        mixed += int((over.any(1) & ~over.all(1)).sum())
        if ends == "world":
            assert torch.equal(over[:, 0], over[:, 1])
        assert torch.equal(env.age.view(6, 2) == 0, over)
        # Each sees the other as it is now.
        qpos = env.backend.state.qpos.float().view(6, 2, -1)
        width = task.humanoid.model.nq + task.humanoid.model.nv
        others = step.obs[:, -width:][:, : qpos.shape[2]].view(6, 2, -1)
        torch.testing.assert_close(others, qpos.flip(1))
    assert ended > 5 and (mixed > 0) == (ends == "character")
    env.close()


def test_two_bodies_in_the_same_worlds(task: Imitation) -> None:
    """Each team moves as it would alone; an episode that ends for the world ends for both."""
    short = made(0.8)
    things = (Character(task.humanoid, "tall"), Door(pos=(9, 9, 0)), Character(short.humanoid, "short"))
    sim = SceneSim(Scene(things, sim=task.config.sim), num_envs=3, threads=1)
    far = 30.0
    envs = {
        "tall": task.env(seed=2, backend=sim.characters("tall"), guard=False),
        "short": short.env(seed=2, backend=sim.characters("short"), guard=False),
    }
    alone = {"tall": task.env(3, 2, threads=1), "short": short.env(3, 2, threads=1)}
    # They would stand in one another.
    for e in (envs["short"], alone["short"]):
        write = e.backend.write

        def aside(ids, qpos, qvel, write=write):
            return write(ids, qpos + far * torch.eye(1, qpos.shape[1]), qvel)

        e.backend.write = aside
    teams = Teams(envs)
    assert teams.num_worlds == 3
    rng, ended = torch.Generator().manual_seed(1), 0
    for name, obs in teams.reset().items():
        torch.testing.assert_close(obs, alone[name].reset(), rtol=0, atol=1e-5)
    for _ in range(30):
        actions = {
            name: 0.4 * torch.randn(3, env.num_actions, generator=rng) for name, env in envs.items()
        }
        got = teams.step(actions)
        for name, step in got.items():
            want = alone[name].step(actions[name])
            torch.testing.assert_close(step.reward, want.reward, rtol=0, atol=1e-3)
            assert torch.equal(step.terminated, want.terminated)
            ended += int(step.terminated.sum())
    assert ended > 3
    teams.ends = "world"
    for _ in range(20):
        actions = {
            name: 0.6 * torch.randn(3, env.num_actions, generator=rng) for name, env in envs.items()
        }
        over = [s.terminated | s.truncated for s in teams.step(actions).values()]
        assert torch.equal(*over)
    with refused("action-missing"):
        teams.step({"tall": actions["tall"]})
    with refused("name-repeated"):
        Teams({"a": envs["tall"], "b": envs["tall"]})
    with refused("scene-needed"):
        Teams(alone)
    teams.close()


def test_mistakes(task: Imitation) -> None:
    scene = Scene((Ball(), Character(task.humanoid, "anna")), sim=task.config.sim)
    sim = SceneSim(scene, num_envs=1, threads=1)
    for event, message in (
        (SetDown("bal", (0.0,)), ("unknown-thing", "bal")),
        (SetDown("ball", (0.0, 1.0)), ("count-differs", ("7", "6", "2", "0"))),
        (Throw("anna", "anna/Chest"), None),
        (Throw("ball", "anna/Ches"), ("unknown-body", "anna/Ches")),
        (Switch("grip", near("ball", "anna/Chest", 1.0)), ("unknown-link", "grip")),
    ):
        if message is None:
            with refused("not-free-to-fly"):
                env_in(task, sim, InScene(events=(event,)))
            continue
        with refused(*message):
            env_in(task, sim, InScene(events=(event,)))
    with refused("no-bodies"):
        env_in(task, sim, InScene(sees=("others",)))
    with refused("out-of-range", says="speed"):
        Throw("ball", "anna/Chest", speed=(3.0, 2.0))
    part = replace(task.task, events=(InScene(),))
    with refused("scene-needed"):
        replace(task, task=part).env(1, threads=1)
    sim.close()
