"""Scenes: things in one world, found by name, and forces from first principles."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from torch import Tensor

from poise.body import Humanoid
from poise.body.humanoid import make_humanoid
from poise.jobs.open import open_run
from poise.sim import (
    Character,
    CharacterRows,
    CpuBackend,
    HeightField,
    Link,
    Plane,
    Scene,
    SceneSim,
    SimConfig,
    Steps,
    Touch,
    alone,
)
from poise.sim.props import Ball, Box, Carrier, Door, Lift, Mesh
from refusals import refused

G = 9.81


@pytest.fixture(scope="module")
def humanoid() -> Humanoid:
    return open_run(None).tracker.humanoid


def standing(humanoid: Humanoid, count: int, x: float = 0.0, z: float = 1.0) -> tuple[Tensor, Tensor]:
    """Poses that differ by row, and no velocity."""
    model = humanoid.model
    rng = torch.Generator().manual_seed(3)
    qpos = torch.tensor(model.qpos0).repeat(count, 1)
    qpos[:, 0], qpos[:, 2] = x, z
    qpos[:, 7:] += 0.1 * torch.randn(count, model.nu, generator=rng, dtype=torch.float64)
    return qpos, torch.zeros(count, model.nv, dtype=torch.float64)


@pytest.mark.parametrize("soft_s", [None, 0.05])
def test_bodies_of_soft_characters_meet_softly_and_the_floor_as_ever(
    humanoid: Humanoid, soft_s: float | None
) -> None:
    """A contact of two characters has an impedance of a half, so that a wedged limb is not torn at."""
    if soft_s is not None:
        table = humanoid.table.overridden({"soft_s": soft_s})
        humanoid = make_humanoid(humanoid.skeleton, table)

    def contacts(*characters: Character) -> dict[bool, set[tuple[float, ...]]]:
        model = Scene(characters).compile().model
        data = mujoco.MjData(model)
        for k in range(len(characters)):
            data.qpos[k * model.nq // len(characters) + 2] = 0.3
        mujoco.mj_forward(model, data)
        found: dict[bool, set[tuple[float, ...]]] = {True: set(), False: set()}
        for c in data.contact:
            floor = 0 in model.geom_bodyid[list(c.geom)]
            numbers = (*c.solref.tolist(), *c.solimp.tolist(), *c.friction.tolist(), c.dim)
            found[floor].add(tuple(round(x, 12) for x in numbers))
        return found

    alone_ = contacts(Character(humanoid))
    both = contacts(Character(humanoid, "a"), Character(humanoid, "b", soft=True))
    assert both[True] == alone_[True] and len(both[True]) == 1 and not alone_[False]
    (between,), (under,) = both[False], both[True]
    assert between[2:4] == (0.5, 0.5)
    if soft_s is not None:
        assert between[0] == soft_s and under[0] == pytest.approx(soft_s, rel=0.01)


def free(*rows: tuple[float, ...]) -> tuple[Tensor, Tensor]:
    """Free joints at positions (m) with velocities (m/s), six numbers a row."""
    given = torch.tensor(rows, dtype=torch.float64)
    turn = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64).expand(len(rows), 4)
    return torch.cat((given[:, :3], turn), 1), torch.cat((given[:, 3:], 0 * given[:, :3]), 1)


def run(sim: SceneSim, seconds: float) -> None:
    sim.step(round(seconds * sim.scene.scene.sim.rate_hz))


def test_a_scene_of_one_character_is_its_body_on_a_floor(humanoid: Humanoid) -> None:
    """Compiling it leaves the body as it is, and what a second body is simulated with is its own."""
    before = humanoid.model.opt.timestep
    made, fine = alone(humanoid), alone(humanoid, SimConfig(rate_hz=450.0, integrator="euler"))
    assert humanoid.model.opt.timestep == before and "floor" not in {
        humanoid.model.geom(i).name for i in range(humanoid.model.ngeom)
    }
    assert (made.opt.timestep, fine.opt.timestep) == (1 / 60, 1 / 450)
    assert made.ngeom == humanoid.model.ngeom + 1 and made.geom(0).name == "floor"
    for name in ("body_mass", "body_pos", "jnt_range", "dof_damping", "actuator_gainprm"):
        np.testing.assert_array_equal(getattr(humanoid.model, name), getattr(made, name), err_msg=name)


@pytest.mark.parametrize("worlds", [1, 4])
def test_other_things_before_a_character_change_nothing(humanoid: Humanoid, worlds: int) -> None:
    """Not even the numbers of a second character in the same world."""
    sim = SimConfig()
    things = (
        Ball(pos=(3, 0, 1)),
        Door(pos=(4, 0, 0)),
        Character(humanoid, "x"),
        Character(humanoid, "y"),
    )
    scene = SceneSim(Scene(things, sim=sim), worlds, threads=1)
    single = CpuBackend(alone(humanoid, sim), worlds, 1)
    rows, other = scene.characters("y"), scene.characters("x")
    other.write(None, *standing(humanoid, worlds, -3.0))
    for backend in (rows, single):
        backend.state.bind(("qfrc_actuator", "qacc"))
        backend.write(None, *standing(humanoid, worlds))
        backend.drive.clear()
        backend.drive.ctrl.add_(0.2)
        backend.drive.qfrc_applied[:, 0] += 10.0
        backend.drive.xfrc_applied[:, 3, 1] += 20.0
        for _ in range(20):
            backend.step(2)
    for name in rows.state.names:
        if name not in ("qacc_warmstart", "time"):
            got, want = rows.state[name], single.state[name]
            if got.dim() == 3:
                got, want = got[:, 1:], want[:, 1:]
            torch.testing.assert_close(got, want, rtol=0, atol=1e-10, msg=name)
    torch.testing.assert_close(rows.state.qpos, single.state.qpos, rtol=0, atol=1e-12)


def test_two_characters_in_each_of_many_worlds(humanoid: Humanoid) -> None:
    """Rows are world by world, and each moves as it would alone."""
    things = (Character(humanoid, "a"), Ball(pos=(9, 9, 1)), Character(humanoid, "b"))
    rows = SceneSim(Scene(things), 64, threads=1).characters()
    assert isinstance(rows, CharacterRows) and rows.num_envs == 128
    qpos, qvel = standing(humanoid, 128)
    qpos[1::2, 0] = 3.0
    single = CpuBackend(alone(humanoid), 128, 1)
    for backend in (rows, single):
        backend.write(None, qpos, qvel)
        backend.drive.clear()
        backend.drive.ctrl.add_(qpos[:, 7:] + 0.1)
        backend.step(6)
    torch.testing.assert_close(rows.state.qpos, single.state.qpos, rtol=0, atol=1e-9)
    torch.testing.assert_close(rows.state.xpos[:, 1:], single.state.xpos[:, 1:], rtol=0, atol=1e-9)
    # A partial reset leaves the others, and what drives them, where they are.
    before, target = rows.snapshot(), rows.drive.ctrl.clone()
    some = torch.tensor([5, 8])
    rows.write(some, qpos[some], qvel[some])
    assert torch.equal(rows.state.qpos[some], qpos[some]) and not bool(rows.drive.ctrl[some].any())
    rest = torch.ones(128, dtype=torch.bool).index_fill(0, some, False)
    assert torch.equal(rows.snapshot(False)[rest], before[rest, : rows.snapshot(False).shape[1]])
    assert torch.equal(rows.drive.ctrl[rest], target[rest])
    rows.restore(before)
    rows.step(4), single.step(4)
    torch.testing.assert_close(rows.state.qpos, single.state.qpos, rtol=0, atol=1e-9)


def test_characters_that_meet_push_each_other_alike(humanoid: Humanoid) -> None:
    """Newton's third law, and the sum of momenta, without a floor's help."""
    touches = (Touch("ab", "a", "b"), Touch("ba", "b", "a"))
    sim = SceneSim(
        Scene((Character(humanoid, "a"), Character(humanoid, "b")), touches=touches), 2, threads=1
    )
    qpos, qvel = standing(humanoid, 4, z=5.0)
    qpos[1::2, 0] = 0.5
    qvel[0::2, 0], qvel[1::2, 0] = 1.0, -1.0
    rows = sim.characters()
    rows.write(None, qpos, qvel)
    rows.drive.ctrl.add_(qpos[:, 7:])
    met = torch.zeros(2)
    for _ in range(30):
        rows.step(1)
        ab, ba = sim.touch("ab"), sim.touch("ba")
        torch.testing.assert_close(ab.force, -ba.force)
        met = torch.maximum(met, ab.force.norm(dim=-1).float())
    assert bool((met > 50.0).all())
    # a pushes b along +X.
    assert float(rows.state.qvel[:, 0].view(2, 2).sum()) != 0.0


def test_a_ball_that_is_thrown_and_its_impulse() -> None:
    """Impulse = change of momentum, at the physics rate; and the free flight is a parabola."""
    fine = SimConfig(rate_hz=600.0, integrator="implicitfast")
    wall = Box("wall", (0.2, 4.0, 4.0), (2.0, 0.0, 2.0))
    scene = Scene((Ball(radius=0.1, mass=0.5), wall), touches=(Touch("hit", "ball", "wall"),), sim=fine)
    sim = SceneSim(scene, 2, threads=1)
    sim.place("ball", *free((0, 0, 1.0, 6.0, 0, 3.0)), rows=torch.tensor([1]))
    ball = sim.scene.place("ball")
    run(sim, 0.1)
    at = sim.backend.state.xpos[1, ball.body]
    assert float(at[0]) == pytest.approx(0.6, abs=1e-6)
    assert float(at[2]) == pytest.approx(1.3 - 0.5 * G * 0.01, abs=5e-3)
    before = sim.backend.state.qvel[1, ball.dofs][0].item()
    impulse = 0.0
    for _ in range(300):
        sim.step()
        impulse += -sim.touch("hit").force[1, 0].item() / 600.0
    after = sim.backend.state.qvel[1, ball.dofs][0].item()
    assert after < -0.1 and impulse == pytest.approx(0.5 * (after - before), rel=1e-3)
    assert float(sim.touch("hit").force[0].norm()) == 0.0


def test_a_soft_box_hits_less_hard_than_a_hard_one() -> None:
    """The same box falls onto the floor: a smaller force for longer, and the same impulse."""
    peaks, impulses = [], []
    for soft in (0.0, 0.1):
        box = Box("bag", (0.3, 0.3, 0.3), (0, 0, 0.35), mass=40.0, soft_s=soft)
        fine = SimConfig(rate_hz=600.0, integrator="implicitfast")
        sim = SceneSim(Scene((box,), touches=(Touch("hit", "bag", "floor"),), sim=fine), 1, threads=1)
        forces = []
        for _ in range(600):
            sim.step()
            forces.append(float(sim.touch("hit").force[0].norm()))
        peaks.append(max(forces))
        impulses.append(sum(forces) / 600.0)
    assert peaks[1] < 0.5 * peaks[0]
    # Both lie still after a second: what was hit is what gravity gave.
    assert impulses == pytest.approx([40.0 * G] * 2, rel=0.05)


def test_a_door_opens_on_its_hinge() -> None:
    sim = SceneSim(Scene((Door(mass=20.0, width=0.9, damping=0.0, friction=0.0),)), 1, threads=1)
    door = sim.scene.place("door")
    assert door.coordinates == 1
    sim.backend.drive.qfrc_applied[:, door.dofs] = 5.0
    run(sim, 0.5)
    # phi = 1/2 M / I t^2 with I near m w^2 / 3.
    want = 0.5 * 5.0 / (20.0 * 0.9**2 / 3) * 0.25
    assert float(sim.backend.state.qpos[0, door.qpos]) == pytest.approx(want, rel=0.1)


def test_a_weld_is_switched_and_carries_the_weight() -> None:
    """A box hangs on a fixed one in the worlds where the weld is on: it pulls with m g."""
    box = Box("box", (0.2, 0.2, 0.2), (0, 0, 1.79), mass=4.0)
    top = Box("top", (0.2, 0.2, 0.2), (0, 0, 2.0))
    sim = SceneSim(Scene((top, box), (Link("hook", "top", "box"),)), 3, threads=1)
    sim.switch("hook", True, torch.tensor([0, 2]))
    sim.backend.state.bind(("qfrc_constraint",))
    run(sim, 1.0)
    at = sim.scene.place("box")
    height = sim.backend.state.xpos[:, at.body, 2]
    assert torch.allclose(height[[0, 2]], torch.full((2,), 1.79).double(), atol=5e-3)
    assert float(height[1]) == pytest.approx(0.1, abs=0.01)
    pull = sim.backend.state["qfrc_constraint"][:, at.dofs][:, 2]
    assert pull[[0, 2]].tolist() == pytest.approx([4.0 * G] * 2, rel=1e-3)
    sim.switch("hook", False)
    run(sim, 1.0)
    assert bool((sim.backend.state.xpos[:, at.body, 2] < 0.11).all())


@pytest.mark.parametrize("kind", ["weld", "ball"])
def test_the_force_of_a_link(kind: str) -> None:
    """A box that hangs is pulled up by m g; hung out of its middle by a weld, with m g times the arm."""
    arm = (0.1, 0.0, 0.0) if kind == "weld" else (0.0, 0.0, 0.1)
    things = (
        Box("top", (0.2, 0.2, 0.2), (0, 0, 2.0)),
        Box("box", (0.2, 0.2, 0.2), (0, 0, 1.79), mass=4.0),
    )
    links = (
        Link("up", "top", "box", kind, at=arm, measured=True),
        Link("down", "box", "top", kind, at=tuple(-x for x in arm), measured=True),
    )
    sim = SceneSim(Scene(things, links), 3, threads=1)
    sim.switch("up", True, torch.tensor([0]))
    sim.switch("down", True, torch.tensor([1]))
    before = sim.backend.state.xpos[:2, sim.scene.place("box").body].clone()
    run(sim, 2.0)
    up, down = sim.link("up"), sim.link("down")
    if kind == "weld":
        # Held out of its middle it stays where it was, but for what the weld gives way.
        after = sim.backend.state.xpos[:2, sim.scene.place("box").body]
        assert float((after - before).norm(dim=-1).max()) < 0.03
    torch.testing.assert_close(up.force[0], torch.tensor([0, 0, 4.0 * G]).double(), rtol=1e-3, atol=0.05)
    torch.testing.assert_close(
        down.force[1], torch.tensor([0, 0, -4.0 * G]).double(), rtol=1e-3, atol=0.05
    )
    assert not up.force[1:].any() and not down.force[2].any()
    if kind == "weld":
        # About its point, which is 0.1 m ahead of the centre of mass.
        assert up.torque[0].tolist() == pytest.approx([0.0, 0.1 * 4.0 * G, 0.0], abs=0.1)
    box = sim.backend.state.xpos[0, sim.scene.place("box").body]
    assert float((up.point[0] - box - torch.tensor(arm)).norm()) < 0.02


def test_which_forces_of_links_are_measured(humanoid: Humanoid) -> None:
    """A character keeps its own bodies: what measures is on the prop."""
    hand = next(n for n in humanoid.bodies if "wrist" in n)
    things = (
        Box("bar", (0.05, 1.0, 0.05), (0, 0, 2.6)),
        Character(humanoid, "h"),
        Character(humanoid, "g"),
    )
    link = Link("grip", f"h/{hand}", "bar", "ball", measured=True)
    sim = SceneSim(Scene(things, (link,)), 1, threads=1)
    assert len(sim.characters("h").state.xpos[0]) == len(humanoid.bodies) + 1
    both = Link("hands", f"h/{hand}", f"g/{hand}", "ball", measured=True)
    with refused("force-not-measured"):
        SceneSim(Scene(things, (both,)), 1, threads=1)
    with refused("unknown-link", says="gri"):
        sim.link("gri")


def test_a_ball_joint_holds_a_point(humanoid: Humanoid) -> None:
    """A body that hangs by its hand, let go of in the other world."""
    hand = next(n for n in humanoid.bodies if "wrist" in n)
    bar = Box("bar", (0.05, 1.0, 0.05), (0, 0, 2.6))
    links = (Link("grip", "bar", f"h/{hand}", "ball"),)
    sim = SceneSim(Scene((bar, Character(humanoid, "h")), links), 2, threads=1)
    rows = sim.characters()
    qpos, qvel = standing(humanoid, 2, z=2.0)
    rows.write(None, qpos, qvel)
    at = rows.state.xpos[:, humanoid.bodies.index(hand) + 1].clone()
    qpos[:, :3] += torch.tensor([0, 0, 2.5]) - at
    rows.write(None, qpos, qvel)
    sim.switch("grip", True, torch.tensor([0]))
    run(sim, 1.0)
    held = rows.state.xpos[:, humanoid.bodies.index(hand) + 1]
    assert float((held[0] - torch.tensor([0, 0, 2.5])).norm()) < 0.02
    assert float(held[1, 2]) < 1.6


def test_a_carrier_takes_a_box_along() -> None:
    things = (Carrier(pos=(0, 0, 0.05)), Box("box", (0.2, 0.2, 0.2), (0, 0, 0.2), mass=3.0))
    sim = SceneSim(Scene(things), 1, threads=1)
    zero = torch.zeros(1, 4, dtype=torch.float64)
    run(sim, 0.2)
    for k in range(30):
        speed = zero.clone()
        speed[0, 0] = 1.0
        moved = zero.clone()
        moved[0, 0] = k / 30
        sim.place("carrier", moved, speed)
        run(sim, 1 / 30)
    box = sim.scene.place("box")
    assert float(sim.backend.state.xpos[0, box.body, 0]) > 0.8
    assert float(sim.backend.state.xpos[0, box.body, 2]) == pytest.approx(0.2, abs=0.01)


def test_a_lift_lifts() -> None:
    sim = SceneSim(Scene((Lift(), Box("box", (0.3, 0.3, 0.3), (0, 0, 0.45), mass=10.0))), 1, threads=1)
    sim.backend.drive.ctrl[:, sim.scene.place("lift").controls] = 0.2
    run(sim, 2.0)
    # The spring gives way under the box: m g / k.
    height = float(sim.backend.state.qpos[0, sim.scene.place("lift").qpos])
    assert height == pytest.approx(0.2 - 10.0 * G / 2e4, abs=1e-3)


def test_a_stack_of_boxes_stays() -> None:
    boxes = tuple(Box(f"b{k}", (0.3, 0.3, 0.3), (0, 0, 0.15 + 0.3 * k), mass=2.0) for k in range(5))
    sim = SceneSim(Scene(boxes), 1, threads=1)
    run(sim, 5.0)
    top = sim.backend.state.xpos[0, sim.scene.place("b4").body]
    assert top.tolist() == pytest.approx([0.0, 0.0, 1.35], abs=0.02)


@pytest.mark.parametrize(
    ("floor", "x", "height"),
    [
        (Plane(), 0.0, 0.0),
        (Steps(count=3, rise=0.2, tread=0.4, start=1.0), 0.5, 0.0),
        (Steps(count=3, rise=0.2, tread=0.4, start=1.0), 1.2, 0.2),
        (Steps(count=3, rise=0.2, tread=0.4, start=1.0), 2.5, 0.6),
        (HeightField(np.full((3, 3), 0.4), (4.0, 4.0)), 0.3, 0.4),
        (HeightField(np.array([[0.1, 0.3, 0.5]] * 2), (4.0, 4.0)), 1.0, 0.4),
    ],
)
def test_floors(floor: Plane | Steps | HeightField, x: float, height: float) -> None:
    """A ball that is let fall touches where the floor is."""
    sim = SceneSim(Scene((Ball(radius=0.02, mass=0.1),), floor=floor, sim=SimConfig(rate_hz=300.0)), 1)
    sim.place("ball", *free((x, 0, height + 0.1, 0, 0, 0)))
    lowest = 9.0
    for _ in range(60):
        sim.step()
        lowest = min(lowest, float(sim.backend.state.xpos[0, 1, 2]))
    assert lowest == pytest.approx(height + 0.02, abs=0.012)


def test_what_stands_in_something_else(humanoid: Humanoid) -> None:
    sim = SceneSim(Scene((Character(humanoid, "a"), Box("seat", (0.5, 0.5, 0.5), (0, 0, 1.0)))), 1)
    sim.characters().write(None, *standing(humanoid, 1))
    with refused("bodies-overlap", says=("a", "seat")):
        sim.check()
    sim.characters().write(None, *standing(humanoid, 1, x=2.0))
    sim.check()


def test_links_of_bodies_far_apart() -> None:
    things = (Box("a", pos=(0, 0, 1)), Box("b", pos=(3.4, 0, 1), mass=1.0))
    for link in (Link("l", "a", "b"), Link("l", "a", "b", "ball", to=(0.0, 0.0, 0.0))):
        sim = SceneSim(Scene(things, (link,)), 1)
        with refused("too-far", says="l"):
            sim.switch("l", True)


def test_mistakes_get_a_sentence(humanoid: Humanoid, tmp_path: Path) -> None:
    with refused("out-of-range", says=("things", "10000")):
        Scene(tuple(Box(f"b{k}") for k in range(10_000)))
    with refused("name-repeated", says=("things", "box")):
        Scene((Box(), Box()))
    with refused("unknown-body", says="handle"):
        Scene((Box(), Door()), (Link("l", "handle", "box"),)).compile()
    with refused("out-of-range", says=("mass", "-1")):
        Ball(mass=-1.0)
    with refused("bodies-differ"):
        SceneSim(Scene((Box(),)), 1).characters()
    sim = SceneSim(Scene((Ball(), Character(humanoid, "h"))), 2)
    with refused("wrong-shape", says=("ball", "(2, 7)", "(2, 6)")):
        sim.place("ball", torch.zeros(1, 7), torch.zeros(1, 6))
    with refused("unknown-thing", says="bal"):
        sim.scene.place("bal")
    with refused("field-of-world", says="geom_xpos"):
        sim.characters().state.bind(("geom_xpos",))
    open_box = tmp_path / "open.obj"
    open_box.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\n")
    with refused("mesh-unusable", says="3"):
        Scene((Mesh(open_box),)).compile()
    closed = tmp_path / "closed.obj"
    closed.write_text(open_box.read_text() + "f 2 3 4\n")
    Scene((Mesh(closed, mass=1.0),)).compile()
