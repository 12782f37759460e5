"""Forces of events: pushes at the control rate, forces at the physics rate."""

from __future__ import annotations

from dataclasses import replace
from math import inf

import pytest
import torch

from poise.env.events import Event
from poise.env.pushes import Pushes
from poise.jobs.track.pushed import from_the_front
from poise.motion import ClipLibrary
from poise.recipes import ResidualForce, build
from poise.recipes.imitation import Imitation
from poise.sim import Drive, body_com_velocity_w
from refusals import refused
from toy_human import swing


@pytest.fixture(scope="module")
def task() -> Imitation:
    return build(ClipLibrary.of([swing(1.5, name="calm")]), ResidualForce(num_envs=2, expert=False))


def pushed(task: Imitation, *events: object) -> Imitation:
    return replace(task, task=replace(task.task, events=events, dones=()))


class Constant(Event):
    """30 N along +Y on the root, at one of the two rates."""

    def __init__(self) -> None:
        self.calls = 0

    def add(self, drive: Drive) -> None:
        drive.xfrc_applied[:, 1, 1] += 30.0
        self.calls += 1


class Held(Constant):
    def before_step(self, drive: Drive) -> bool:
        self.add(drive)
        return False


class Anew(Constant):
    def before_step(self, drive: Drive) -> bool:
        return True

    def before_substep(self, drive: Drive) -> None:
        self.add(drive)


def test_a_constant_force_is_the_same_at_either_rate(task: Imitation) -> None:
    made = [k() for k in (Held, Anew)]
    envs = [pushed(task, lambda goal, backend, p=p: p).env(3, 1, False, threads=1) for p in made]
    zero = torch.zeros(3, dtype=torch.long)
    rng = torch.Generator().manual_seed(0)
    for env in envs:
        env.reset_to(zero, zero)
    for _ in range(10):
        action = 0.2 * torch.randn(3, envs[0].num_actions, generator=rng)
        a, b = (env.step(action).obs for env in envs)
        torch.testing.assert_close(a, b, rtol=0, atol=1e-6)
    substeps = task.config.sim.substeps
    assert made[0].calls * substeps == made[1].calls == 10 * substeps
    for env in envs:
        env.close()


def test_a_push_is_a_change_of_momentum(task: Imitation) -> None:
    """In free fall nothing else acts along X and Y."""
    lasts = 3 / 30
    pushes = Pushes(newtons=(60.0, 60.0), every_s=(0.1, 0.1), lasts_s=lasts, bodies=(0, 2), seed=3)
    env = pushed(task, pushes).env(4, 1, False, threads=1, help_scale=0.0)
    event = env.event(Pushes)
    assert event is not None
    zero = torch.zeros(4, dtype=torch.long)
    env.reset_to(zero, zero)
    qpos, qvel = env.backend.state.qpos.clone(), torch.zeros_like(env.backend.state.qvel)
    qpos[:, 2] += 10.0
    env.backend.write(None, qpos, qvel)
    model, force = env.backend.model, torch.zeros_like(event.force)
    acted = 0
    for _ in range(6):
        acted += int(event.acting[0])
        force = torch.where(event.acting[:, None], event.force, force)
        env.step(torch.zeros(4, env.num_actions))
    assert acted == 3 and force.norm(dim=-1).allclose(torch.tensor(60.0).double())
    mass = torch.tensor(model.body_mass)[:, None]
    momentum = (body_com_velocity_w(env.backend.state, model) * mass).sum(1)
    torch.testing.assert_close(momentum[:, :2], force[:, :2] * lasts, rtol=5e-3, atol=2e-2)
    env.close()


def test_pushes_are_part_of_what_is_copied_and_resumed(task: Imitation) -> None:
    pushing = pushed(task, Pushes(every_s=(0.1, 0.5), seed=2))
    env, other = (pushing.env(3, 1, True, threads=1) for _ in range(2))
    env.reset()
    actions = torch.zeros(3, env.num_actions)
    for _ in range(7):
        env.step(actions)
    state = env.state()
    other.load_state(state)
    for _ in range(12):
        assert torch.equal(env.step(actions).obs, other.step(actions).obs)
    one = env.snapshot(torch.tensor([1]))
    other.restore(one)
    event = other.event(Pushes)
    assert event is not None and len(event.left.unique()) == 1
    env.close()
    other.close()


def test_long_pushes_are_weaker_and_some_episodes_have_none(task: Imitation) -> None:
    given = Pushes((100.0, 100.0), (0.1, 0.1), (0.1, 2.0), impulse_ns=20.0, share=0.5, seed=4)
    env = pushed(task, given).env(400, 1, False, threads=1)
    event = env.event(Pushes)
    assert event is not None
    env.reset()
    lasts, size = event.lasts / 30, event.force.norm(dim=-1)
    assert float(lasts.min()) >= 0.1 and float(lasts.max()) <= 2.0
    # Evenly in the logarithm: half of them are shorter than the geometric mean.
    assert float((lasts < 0.447).float().mean()) == pytest.approx(0.5, abs=0.1)
    # 20 N s: the whole 100 N for up to 0.2 s.
    assert size[lasts < 0.19].allclose(torch.tensor(100.0).double())
    impulse = (size * lasts)[lasts > 0.3]
    torch.testing.assert_close(impulse, torch.full_like(impulse, 20.0), rtol=0.12, atol=0.0)
    assert float((event.left > 10**6).float().mean()) == pytest.approx(0.5, abs=0.1)
    env.close()


def test_a_push_may_come_once_at_its_time(task: Imitation) -> None:
    once = Pushes((80.0, 80.0), (inf, inf), 0.1, control_hz=30.0, first_s=0.2, direction="front")
    worlds = pushed(task, once)
    env = worlds.env(2, 1, False, threads=1, help_scale=0.0)
    zero = torch.zeros(2, dtype=torch.long)
    env.reset_to(zero, zero)
    event, acted = env.event(Pushes), list[int]()
    assert event is not None
    for step in range(20):
        if bool(event.acting[0]):
            acted.append(step)
        env.step(torch.zeros(2, env.num_actions))
    assert acted == [6, 7, 8]
    assert float(event.left.min()) > 10**6
    # Copies that do not foresee it know of none that has not begun.
    copies = pushed(task, replace(once, foreseen=False)).env(2, 1, False, threads=1, help_scale=0.0)
    copies.reset_to(zero, zero)
    blind = copies.event(Pushes)
    assert blind is not None
    for _ in range(10):
        assert not bool(blind.acting.any())
        copies.step(torch.zeros(2, copies.num_actions))
    env.close()
    copies.close()


def test_a_push_from_the_front_goes_against_where_one_faces(task: Imitation) -> None:
    given = Pushes((80.0, 80.0), (inf, inf), 0.5, first_s=0.1, direction="front")
    env = pushed(task, given).env(1, 1, False, threads=1, help_scale=0.0)
    zero = torch.zeros(1, dtype=torch.long)
    env.reset_to(zero, zero)
    event = env.event(Pushes)
    assert event is not None
    for _ in range(3):
        env.step(torch.zeros(1, env.num_actions))
    before = torch.tensor(from_the_front(env.goal.humanoid, env.backend.state.qpos[0]))
    env.step(torch.zeros(1, env.num_actions))
    torch.testing.assert_close(event.force[0].double(), 80.0 * before.double(), rtol=0, atol=1.0)
    env.close()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"newtons": (5.0, 1.0)}, ("out-of-range", "newtons")),
        ({"every_s": (-1.0, 1.0)}, ("out-of-range", "every_s")),
        ({"lasts_s": 0.0}, ("out-of-range", "lasts_s")),
        ({"bodies": ()}, ("out-of-range", "bodies")),
        ({"lasts_s": (0.5, 0.2)}, ("out-of-range",)),
        ({"share": 1.5}, ("out-of-range", "share")),
    ],
)
def test_mistakes(settings: dict, message: tuple) -> None:
    with refused(*message):
        Pushes(**settings)


class SeenTargets(Event):
    """Keeps the joints' targets of every physics step."""

    def __init__(self) -> None:
        self.seen = list[torch.Tensor]()

    def before_step(self, drive: Drive) -> bool:
        return True

    def before_substep(self, drive: Drive) -> None:
        self.seen.append(drive.ctrl.clone())


def test_targets_go_evenly_from_the_last_to_the_new_ones(task: Imitation) -> None:
    seen = SeenTargets()
    smooth = replace(task, task=replace(task.task, pd=replace(task.task.pd, interpolate=True)))
    env = pushed(smooth, lambda goal, backend: seen).env(2, 1, False, threads=1)
    zero, of = torch.zeros(2, dtype=torch.long), task.config.sim.substeps
    env.reset_to(zero, zero)
    for _ in range(3):
        env.step(torch.randn(2, env.num_actions))
    targets = torch.stack(seen.seen).unflatten(0, (3, of))
    # There are none before the first ones.
    torch.testing.assert_close(targets[0], targets[0, -1].expand(of, -1, -1))
    for k in range(of):
        expected = torch.lerp(targets[:-1, -1], targets[1:, -1], (k + 1) / of)
        torch.testing.assert_close(targets[1:, k], expected)
    env.close()
