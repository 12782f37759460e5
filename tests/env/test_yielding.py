"""Compliance in an environment: forces displace goals, at the physics rate, for any policy."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch

from poise.control import Compliance, Stiffness
from poise.control.compliance import columns
from poise.env import ImitationEnv
from poise.env.pushes import Pushes
from poise.env.scene_events import InScene, SetDown, touches_of
from poise.env.yielding import DisplacedGoal, Yielding
from poise.learn import PPOConfig
from poise.motion import ClipLibrary
from poise.recipes import ResidualForce, build
from poise.recipes.imitation import Imitation
from poise.sim import Character, Drive, Link, Scene, SceneSim, Touch
from poise.sim.props import Ball, Carrier
from refusals import refused
from toy_human import swing

PUSH = Pushes(newtons=(40.0, 60.0), every_s=(0.05, 0.05), lasts_s=0.5, bodies=(0,), seed=2)


@pytest.fixture(scope="module")
def task() -> Imitation:
    return build(ClipLibrary.of([swing(1.5, name="calm")]), ResidualForce(num_envs=2, expert=False))


def hand(task: Imitation) -> int:
    return (task.humanoid.rows_of("hand") or task.humanoid.rows_of("forearm"))[0]


def yielding(task: Imitation, given: Compliance | Stiffness | None, worlds: int = 3) -> ImitationEnv:
    pushes = replace(PUSH, bodies=(hand(task),))
    own = replace(task.task, events=(pushes,), compliance=given, dones=(), help=None)
    return replace(task, task=own).env(worlds, 1, False, threads=1, help_scale=0.0)


def begun(env: ImitationEnv) -> ImitationEnv:
    zero = torch.zeros(env.num_envs, dtype=torch.long)
    env.reset_to(zero, zero)
    return env


def part(env: ImitationEnv) -> Yielding:
    found = env.event(Yielding)
    assert found is not None and isinstance(env.goal, DisplacedGoal)
    return found


def still(env: ImitationEnv) -> torch.Tensor:
    return torch.zeros(env.num_envs, env.num_actions)


@pytest.mark.parametrize("law", ["eq8", "algorithm1"])
def test_u_is_that_of_a_naive_twin_in_every_physics_step(task: Imitation, law: str) -> None:
    env = begun(yielding(task, Compliance(level=0.3, law=law)))  # type: ignore[arg-type]
    event, goal, model = part(env), env.goal, env.backend.model
    assert isinstance(goal, DisplacedGoal)
    body, h, seen = hand(task) + 1, float(model.opt.timestep), 0
    substeps = task.config.sim.substeps
    weights = columns(task.humanoid.table, event.given.weights, event.given.root).numpy()
    move, pushes, count = event.before_substep, env.event(Pushes), 0
    assert pushes is not None

    def watched(drive: Drive) -> None:
        nonlocal seen, count
        before, rate = goal.offset.clone().numpy(), goal.rate.clone().numpy()
        want, moves = before.copy(), []
        refs = [goal.goal.layout.unpacked(p) for p in (goal.goal.now(), goal.goal.ahead())]
        at, told = count % substeps / substeps, pushes.felt()
        count += 1
        for n in range(env.num_envs):
            force = told.force[n, 0].numpy()
            if np.linalg.norm(force) < 1.0:
                w = 2 * np.pi * event.given.return_hz
                slope = rate[n] + w * before[n]
                want[n] = np.exp(-w * h) * (before[n] + slope * h)
                continue
            data = env.backend.get_data(n)
            mujoco.mj_forward(model, data)
            jac, point = np.zeros((3, model.nv)), data.xipos[body].copy()
            mujoco.mj_jac(model, data, jac, None, point, body)
            if law == "eq8":
                arm = data.xmat[body].reshape(3, 3).T @ (point - data.xpos[body])
                velocity = jac @ data.qvel
                for pose, share in zip(refs, (1 - at, at), strict=True):
                    turn = np.zeros(9)
                    mujoco.mju_quat2Mat(turn, pose.quat[n, body - 1].double().numpy())
                    spin = pose.angvel[n, body - 1].double().numpy()
                    way = pose.linvel[n, body - 1].double().numpy()
                    velocity -= share * (way + np.cross(spin, turn.reshape(3, 3) @ arm))
            else:
                ends = []
                for sign in (1.0, 0.0):
                    other = env.backend.get_data(n)
                    # The push is in the drive; without it is what is asked.
                    other.qfrc_applied[:] += (sign - 1.0) * jac.T @ force
                    mujoco.mj_step(model, other)
                    ends.append(other.qvel.copy())
                velocity = jac @ (ends[0] - ends[1]) / h / 600.0
            w = np.diag(weights)
            inverse = np.linalg.pinv(jac @ w @ jac.T, rcond=1e-4, hermitian=True)
            want[n] = before[n] + h * 0.3 * w @ jac.T @ inverse @ velocity
            moves.append(n)
        move(drive)
        free = event.share.numpy() == 1.0
        for n in range(env.num_envs):
            if free[n] or n not in moves:
                np.testing.assert_allclose(goal.offset[n].numpy(), want[n], atol=1e-9, rtol=0)
                seen += n in moves

    event.before_substep = watched  # type: ignore[method-assign]
    for _ in range(8):
        env.step(still(env))
    assert seen > 20 and float(goal.offset.abs().max()) > 1e-3
    assert not goal.offset[:, 2:6].any()
    env.close()


def test_level_0_is_no_compliance(task: Imitation) -> None:
    a, b = begun(yielding(task, Compliance(level=0.0))), begun(yielding(task, None))
    rng = torch.Generator().manual_seed(0)
    for _ in range(12):
        action = 0.2 * torch.randn(3, a.num_actions, generator=rng)
        x, y = a.step(action), b.step(action)
        torch.testing.assert_close(x.obs, y.obs, rtol=0, atol=1e-9)
    a.close()
    b.close()


def test_physics_steps_are_made_at_once_where_nothing_yields(task: Imitation) -> None:
    """At level 0, and at any level while nothing pushes; a push makes them single."""
    made = list[int]()
    for level, least in ((0.0, 0), (0.5, 1)):
        env = begun(yielding(task, Compliance(level=level)))
        step = env.backend.step
        env.backend.step = lambda n, step=step: (made.append(n), step(n))[1]  # type: ignore[method-assign]
        singles = 0
        for k in range(30):
            made.clear()
            env.step(still(env))
            singles += made == [1] * env.substeps
            assert made in ([env.substeps], [1] * env.substeps)
            if k == 0:
                # No push comes within the first 0.05 s.
                assert made == [env.substeps]
        assert singles >= least and (level > 0 or singles == 0)
        env.close()


@pytest.mark.parametrize("given", [Compliance(level=0.5), Stiffness(150.0)])
def test_copies_of_a_world_yield_alike(task: Imitation, given: Compliance | Stiffness) -> None:
    env = begun(yielding(task, given))
    for _ in range(6):
        env.step(still(env))
    part(env).turn(0.3 if isinstance(given, Compliance) else 80.0, torch.tensor([1]))
    copies, row = yielding(task, given, 4), torch.tensor([1])
    assert env.goal.offset[1].abs().max() > 1e-3  # type: ignore[attr-defined]
    copies.restore(env.snapshot(row))
    assert part(copies).level.tolist() == [float(part(env).level[1])] * 4
    rng = torch.Generator().manual_seed(3)
    for _ in range(5):
        action = 0.1 * torch.randn(1, env.num_actions, generator=rng)
        a, b = env.step(action.expand(3, -1)), copies.step(action.expand(4, -1))
        torch.testing.assert_close(a.obs[1].expand(4, -1), b.obs, rtol=0, atol=1e-6)
    env.close()
    copies.close()


@pytest.mark.parametrize("given", [Compliance(level=1.0, root=False), Stiffness(20.0)])
def test_the_range_of_motion_holds_by_itself(task: Imitation, given: Compliance | Stiffness) -> None:
    own = replace(PUSH, newtons=(300.0, 300.0), lasts_s=3.0, bodies=(hand(task),))
    made = replace(task.task, events=(own,), compliance=given, dones=(), help=None)
    env = begun(replace(task, task=made).env(3, 1, False, threads=1, help_scale=0.0, guard=False))
    event, lowered = part(env), False
    low, high = torch.from_numpy(env.backend.model.jnt_range[1:]).unbind(1)
    for _ in range(30):
        env.step(still(env))
        # Nothing is added to the goal's angles by the actions.
        hinges = env.backend.drive.ctrl
        assert (hinges <= high + 1e-9).all() and (hinges >= low - 1e-9).all()
        lowered |= bool((event.share < 1.0).any())
    assert lowered and not event.outside.any()
    # Where nothing holds it, the goal goes on beyond.
    event.within = False
    for _ in range(10):
        env.step(still(env))
    assert event.outside.any()
    env.close()


def test_a_goal_yields_along_the_force_and_comes_back(task: Imitation) -> None:
    """Pushed for 0.5 s; after that the goal is where it was."""
    pushes = replace(PUSH, every_s=(0.1, 0.1), bodies=(hand(task),), seed=1)
    own = replace(task.task, events=(pushes,), compliance=Stiffness(100.0), dones=(), help=None)
    env = begun(replace(task, task=own).env(2, 1, False, threads=1, help_scale=0.0))
    push = env.events[-2]
    most = torch.zeros(2, dtype=torch.float64)
    for _ in range(18):
        env.step(still(env))
        felt = push.felt()
        assert felt is not None
        now, was = env.goal.now(), env.goal.goal.now()  # type: ignore[attr-defined]
        place = env.goal.layout.unpacked
        way = (place(now).pos - place(was).pos)[:, hand(task)].double()
        force = felt.force[:, 0]
        along = (way * force).sum(-1) / force.norm(dim=-1).clamp_min(1.0)
        most = torch.maximum(most, along)
    assert most.min() > 0.05
    push.left.fill_(10_000)  # type: ignore[attr-defined]
    env.backend.write(None, *env.goal.start(None))
    for _ in range(60):
        env.step(still(env))
    assert env.goal.offset.abs().max() < 1e-3  # type: ignore[attr-defined]
    env.close()


def scene_of(task: Imitation) -> Scene:
    names = task.humanoid.bodies
    touches = touches_of("hit", "ball", names, "anna/")
    link = Link("grip", "plate", "anna/" + names[hand(task)], "ball", measured=True)
    plate = Carrier("plate", (0.1, 0.1, 0.05))
    things = (Ball(mass=5.0), plate, Character(task.humanoid, "anna"))
    return Scene(things, (link,), (*touches, Touch("all", "ball", "anna")), sim=task.config.sim)


def test_contacts_and_links_are_felt(task: Imitation) -> None:
    scene = scene_of(task)
    sim = SceneSim(scene, 2, threads=1)
    names = tuple(t.name for t in scene.touches[:-1])
    ball = SetDown("ball", (0.0, 0.0, 3.0, 1.0, 0.0, 0.0, 0.0))
    given = InScene(touches=("all",), felt=(*names, "grip"), events=(ball,))
    own = replace(task.task, events=(given,), compliance=Compliance(), dones=(), help=None)
    env = replace(task, task=own).env(backend=sim.characters(), auto_reset=False, help_scale=0.0)
    begun(env)
    head = env.pose().pos[:, :, 2].argmax(1)[0]
    place = env.pose().pos[0, head].double() + torch.tensor([0.0, 0.0, 0.45]).double()
    qpos = torch.cat((place, torch.tensor([1.0, 0, 0, 0]).double())).expand(2, 7)
    down = torch.zeros(2, 6).double()
    down[:, 2] = -3.0
    sim.place("ball", qpos, down)
    scene_part, hits = env.events[-2], 0
    for _ in range(20):
        env.step(still(env))
        felt = scene_part.felt()
        assert felt is not None and not felt.driven
        whole = sim.touch("all").force
        torch.testing.assert_close(felt.force[:, :-1].sum(1), whole, atol=1e-9, rtol=0)
        hits += int((whole.norm(dim=-1) > 1.0).sum())
    assert hits and env.goal.offset.abs().max() > 0  # type: ignore[attr-defined]
    # The hand hangs on the plate: the link pulls it as it says.
    state, body = sim.backend.state, sim.scene.model.body("anna/" + task.humanoid.bodies[hand(task)]).id
    away = torch.tensor([[0.0, 0.0, 3.0, 1.0, 0.0, 0.0, 0.0]]).double().expand(2, 7)
    sim.place("ball", away + torch.tensor([9.0, 0, 0, 0, 0, 0, 0]).double(), torch.zeros(2, 6).double())
    at = state.xpos[:, body].double() + torch.tensor([0.0, 0.0, 0.15]).double()
    sim.place("plate", torch.cat((at, 0 * at[:, :1]), 1), torch.zeros(2, 4).double())
    sim.switch("grip", True)
    for _ in range(3):
        env.step(still(env))
    felt = scene_part.felt()
    assert felt is not None
    torch.testing.assert_close(felt.force[:, -1], sim.link("grip").force)
    assert felt.body[0, -1] == hand(task) + 1 and felt.force[:, -1].norm(dim=-1).min() > 1.0
    env.close()


def test_two_characters_of_one_world_yield_for_themselves(task: Imitation) -> None:
    both = (Character(task.humanoid, "anna"), Character(task.humanoid, "ben"))
    sim = SceneSim(Scene(both, sim=task.config.sim), 2, threads=1)
    pushes = replace(PUSH, bodies=(hand(task),))
    own = replace(task.task, events=(pushes,), compliance=Compliance(), dones=(), help=None)
    env = replace(task, task=own).env(1, auto_reset=False, backend=sim.characters(), help_scale=0.0)
    alone = replace(task, task=own).env(4, 1, False, threads=1, help_scale=0.0)
    zero = torch.zeros(4, dtype=torch.long)
    for e in (env, alone):
        write = e.backend.write

        def apart(ids, qpos, qvel, write=write):  # type: ignore[no-untyped-def]
            rows = torch.arange(4) if ids is None else ids
            qpos = qpos.clone()
            qpos[:, 0] += 20.0 * rows
            write(ids, qpos, qvel)

        e.backend.write = apart  # type: ignore[method-assign]
        e.reset_to(zero, zero)
    for _ in range(8):
        env.step(still(env))
        alone.step(still(alone))
    torch.testing.assert_close(env.goal.offset, alone.goal.offset, atol=1e-7, rtol=0)  # type: ignore[attr-defined]
    assert env.goal.offset.abs().max() > 1e-3  # type: ignore[attr-defined]
    printed = replace(own, compliance=Compliance(law="algorithm1"))
    with refused("settings-conflict"):
        replace(task, task=printed).env(1, backend=sim.characters())
    alone.close()
    env.close()


def test_the_dial_is_checked(task: Imitation) -> None:
    env = yielding(task, Compliance())
    part(env).turn(torch.tensor([0.0, 0.1, 0.2]))
    with refused("out-of-range", says="1.5"):
        part(env).turn(1.5)
    env.close()


@pytest.mark.parametrize(
    ("felt", "what"),
    [
        (("bump",), ("unknown-link", "bump")),
        (("all",), ("touch-ambiguous", "all")),
    ],
)
def test_what_cannot_be_felt(task: Imitation, felt: tuple[str, ...], what: tuple) -> None:
    sim = SceneSim(scene_of(task), 1, threads=1)
    own = replace(task.task, events=(InScene(felt=felt),), compliance=Compliance())
    with refused(*what):
        replace(task, task=own).env(backend=sim.characters())
    sim.close()


def test_in_hindsight_the_goal_that_is_seen_lies_beyond_what_is_to_be_reached(task: Imitation) -> None:
    """It lies by -f / K from where the hand should be, as a spring's anchor does; rewards stay."""
    ways = {}
    for hindsight in (False, True):
        given = Stiffness(400.0, 0.02, series=False, hindsight=hindsight)
        own = replace(
            PUSH, newtons=(20.0, 20.0), every_s=(0.05, 0.05), lasts_s=3.0, bodies=(hand(task),)
        )
        made = replace(task.task, events=(own,), compliance=given, dones=(), help=None)
        env = begun(replace(task, task=made).env(2, 1, False, threads=1, help_scale=0.0))
        for _ in range(10):
            env.step(still(env))
        goal, place, row = env.goal, env.goal.layout.unpacked, hand(task)
        assert isinstance(goal, DisplacedGoal)
        felt = env.events[-2].felt()
        assert felt is not None
        now, ahead = (
            (place(a).pos - place(b).pos)[:, row].double()
            for a, b in ((goal.now(), goal.goal.now()), (goal.ahead(), goal.goal.ahead()))
        )
        ways[hindsight] = ahead, felt.force[:, 0] / 400.0
        assert bool(now.any()) is not hindsight
        told = goal.goal.targets()
        torch.testing.assert_close(
            goal.targets()[0], told[0][told[1]] + goal.offset[:, 6:], atol=0, rtol=0
        )
        env.close()
    for hindsight, sign in ((False, 1.0), (True, -1.0)):
        moved, want = ways[hindsight]
        # The Jacobian is that of the character, which has moved off by then.
        assert (moved - sign * want).norm(dim=1).max() < 0.35 * want.norm(dim=1).min()


def test_a_tracker_is_trained_in_hindsight_the_same_every_time(task: Imitation) -> None:
    ppo = PPOConfig(horizon=8, epochs=2, minibatch=16, policy_hidden=(16,), value_hidden=(16,))
    pushes = replace(PUSH, newtons=(5.0, 20.0), every_s=(0.05, 0.2), bodies=(hand(task),))
    own = replace(task.task, events=(pushes,), compliance=Stiffness(300.0, hindsight=True))
    rows, offset = list[list[float]](), torch.zeros(1)
    for _ in range(2):
        trainer = replace(task, task=own).trainer(threads=1, ppo=ppo)
        rows.append([trainer.iterate().row()["reward"] for _ in range(3)])
        offset = trainer.env.goal.offset  # type: ignore[attr-defined]
        trainer.close()
    assert rows[0] == rows[1] and all(r > 0.0 for r in rows[0]) and offset.any()
