"""Scenes of compliance: what stands in them, where it goes, what a body cannot do."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from torch import Tensor

from poise.body.humanoid import make_humanoid
from poise.control import Compliance, Stiffness
from poise.env.pushes import Push
from poise.env.scene_events import InScene, ScenePart
from poise.env.yielding import DisplacedGoal
from poise.formats import read_clip
from poise.jobs.open import open_run
from poise.jobs.track import imitation_of
from poise.jobs.track.placement import place
from poise.papers.compliant.scenes import (
    SCENES,
    Balance,
    Chicken,
    DoorScene,
    HandInHand,
    PlayScene,
    PullScene,
    Throws,
    TrampolineScene,
    ball,
    door,
)
from poise.papers.compliant.scenes import body_scenes as trampoline
from poise.papers.compliant.scenes.body_scenes import CATCHES_S, LiftedFoot
from poise.papers.compliant.scenes.stage import small_forces
from poise.recipes.imitation import Imitation
from poise.sim import Character, Scene, SceneSim
from poise.sim.props import Door
from refusals import refused
from toy_policy import WALK


@pytest.fixture(scope="module")
def task() -> Imitation:
    tracker = open_run(None).tracker
    return imitation_of(tracker, [place(read_clip(WALK), tracker)])


def test_a_partner_goes_as_the_motion_goes(task: Imitation) -> None:
    stage = HandInHand(lead=0.2, sway=0.1).stage(task.humanoid, task.reference)
    (prop,), (link,), (part,) = stage.props, stage.links, stage.events
    assert isinstance(part, InScene) and part.felt == (link.name,)
    assert (link.a, link.b) == (prop.name, "lwrist")
    path = part.events[0].path  # type: ignore[attr-defined]
    t, h = torch.linspace(0.0, 3.0, 31), 1e-5
    qvel = path(t)[1]
    slope = (path(t.double() + h)[0] - path(t.double() - h)[0]) / (2 * h)
    torch.testing.assert_close(qvel, slope, atol=1e-5, rtol=0)
    # On the whole it is as fast as the walk, and 0.2 m/s faster.
    pose, rate, n = task.reference.pose, task.reference.rate_hz, int(task.reference.length[0])
    walk = float((pose.pos[n - 1, 0, :2] - pose.pos[0, 0, :2]).norm()) * rate / (n - 1)
    seconds = torch.tensor([0.0, 4.0])
    gone = path(seconds)[0]
    assert float((gone[1, :2] - gone[0, :2]).norm()) / 4.0 == pytest.approx(walk + 0.2, abs=1e-5)
    assert gone[0].abs().max() == 0.0


def test_a_pull_and_throws(task: Imitation) -> None:
    (push,) = PullScene(30.0, "right", (0.0, 0.0, -2.0)).stage(task.humanoid, task.reference).events
    assert isinstance(push, Push) and push.force == (0.0, 0.0, -30.0) and push.first == 15
    assert task.humanoid.bodies[push.row] == "rwrist"
    stage = Throws(mass=2.0).stage(task.humanoid, task.reference)
    assert stage.props[0].mass == 2.0  # type: ignore[attr-defined]
    assert len(stage.touches) == len(task.humanoid.bodies) + 1
    assert set(SCENES) == {"throws", "pull", "hands", "door", "trampoline", "ball", "chicken"}


def test_doors_of_all_widths_have_their_knob_at_the_hand(task: Imitation) -> None:
    knobs: list[Tensor] = []
    for width in (1.0, 1.7):
        stage = DoorScene(width).stage(task.humanoid, task.reference)
        (leaf,) = stage.props
        assert isinstance(leaf, Door) and leaf.width == width
        knobs.append(torch.tensor(leaf.pos) + torch.tensor(leaf.knob))
        assert [t.name for t in stage.obs] == ["task/phase", "task/knob"] and stage.from_start
    torch.testing.assert_close(*knobs)
    frame = round(door.GRIPS_S * task.reference.rate_hz)
    row = task.humanoid.bodies.index("lwrist")
    hand = task.reference.pose.pos[min(frame, int(task.reference.length[0]) - 1), row]
    assert float((knobs[0] - hand).norm()) == pytest.approx(door.AHEAD_M, abs=1e-5)


def test_what_a_door_s_knob_does_and_what_the_task_pays(task: Imitation) -> None:
    stage = DoorScene(1.0).stage(task.humanoid, task.reference)
    things = (Character(task.humanoid), *stage.props)
    sim = SceneSim(Scene(things, stage.links, sim=task.config.sim), 2, threads=1)
    sim.place("door", torch.tensor([[0.0], [-0.7]]), torch.zeros(2, 1))
    # Opened by 0.7 rad the knob moves along (cos .7, -sin .7); a force along it is not felt.
    way = door.way(sim)
    torch.testing.assert_close(way[1, :2], torch.tensor([math.cos(0.7), -math.sin(0.7)]).double())
    force = 30.0 * way + torch.tensor([0.0, 0.0, 5.0])
    part = SimpleNamespace(sim=sim)
    torch.testing.assert_close(door.across(part, force), torch.tensor([[0.0, 0.0, 5.0]] * 2).double())  # type: ignore[arg-type]

    class Seen:
        def source(self, name: str) -> Tensor:
            return {"door/qpos": torch.tensor([[0.0], [-0.7], [-1.0]])}[name]

    # exp(-1.5 0.7) = 0.34994 closed, 1 from 0.7 rad on.
    expected = torch.tensor([0.34994, 1.0, 1.0])
    torch.testing.assert_close(door.opened(Seen()), expected, atol=1e-5, rtol=0)  # type: ignore[arg-type]


def test_a_hand_is_paid_for_the_arc_of_its_own_door(task: Imitation) -> None:
    (_, arc) = DoorScene(1.7, made_for=1.0).stage(task.humanoid, task.reference).rewards
    knob = arc.params["knob"]
    # Half open, on the arc of this door, 0.1 m off and dragged onto it; and while nothing is held.
    half = 0.5 * door.OPENS
    middle = 0.5 * (door.GRIPS_S + 0.1 + door.LETS_GO_S - 0.3)
    x, y = float(knob[0]) - door.AHEAD_M, float(knob[1])
    held = [x * math.cos(half) + y * math.sin(half), y * math.cos(half) - x * math.sin(half), knob[2]]
    pos = torch.tensor([held] * 4) + torch.tensor([[0.0], [0.1], [0.0], [9.0]])
    load = torch.tensor([0.0, 0.0, door.ACROSS_N, 9.0])

    class Seen:
        phase = torch.tensor([middle, middle, middle, 0.5]) / door.LASTS_S
        sim = SimpleNamespace(pos=pos.unsqueeze(1).expand(4, len(task.humanoid.bodies), 3))

        def source(self, name: str) -> Tensor:
            return load if name == "load" else torch.zeros(4, 3)

    paid = arc.fn(Seen(), **arc.params)  # type: ignore[arg-type]
    torch.testing.assert_close(paid, torch.tensor([1.0, math.exp(-0.3), math.exp(-1.0), 1.0]))


def test_forces_are_to_stay_small_after_a_blow() -> None:
    class Seen:
        torque = torch.tensor([[-4.0, 0.0], [0.0, 0.0], [8.0, -8.0]])

        def source(self, name: str) -> Tensor:
            told = {
                "load": [50.0, 0.0, 0.0],
                "since": [0.0, 0.4, 0.6],
                "compliance/level": [0.05, 0.2, 0.2],
            }
            return torch.tensor(told[name])

    paid = small_forces(Seen(), newtons=100.0, newton_metres=20.0)  # type: ignore[arg-type]
    expected = 0.5 * (math.exp(-0.5) + math.exp(-0.1))
    torch.testing.assert_close(paid, torch.tensor([expected, 1.0, 1.0]))
    # A quarter of the level pays a quarter of what is lacking.
    paid = small_forces(Seen(), newtons=100.0, newton_metres=20.0, most=0.2)  # type: ignore[arg-type]
    torch.testing.assert_close(paid, torch.tensor([0.75 + 0.25 * expected, 1.0, 1.0]))


def test_a_hand_that_keeps_away_from_the_knob_ends_the_episode(task: Imitation) -> None:
    stage = DoorScene(1.0).stage(task.humanoid, task.reference)
    (end,) = stage.dones
    away = torch.tensor([0.0, 0.3, 0.3, 0.3])

    class Seen:
        # At the knob; away from it before it is due, while it is held, and when it is let go.
        phase = torch.tensor([2.0, 1.5, 2.0, 4.5]) / door.LASTS_S
        sim = SimpleNamespace(
            pos=torch.zeros(4, len(task.humanoid.bodies), 3),
            quat=torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(4, len(task.humanoid.bodies), 4),
        )

        def source(self, name: str) -> Tensor:
            knob = end.params["knob"]
            pos = torch.stack((away, 0 * away, 0 * away), 1) - knob
            turn = torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(4, 4)
            return {"door/quat": turn, "door/pos": pos, "door/qpos": torch.zeros(4, 1)}[name]

    missed = end.fn(Seen(), **end.params)  # type: ignore[arg-type]
    assert missed.tolist() == [False, False, True, False]


def test_a_door_that_nobody_gets_through(task: Imitation) -> None:
    broad = door.breadth(task.humanoid, task.reference)
    assert 0.25 < broad < 0.6
    with refused("too-narrow", says="0.2"):
        DoorScene(0.2).stage(task.humanoid, task.reference)


def test_a_trampoline_rises_every_3_s_and_carries_a_body(task: Imitation) -> None:
    stage = TrampolineScene(0.1).stage(task.humanoid, task.reference)
    (plate,), (part,) = stage.props, stage.events
    # Under the middle of what the motion crosses.
    way = task.reference.pose.pos[:, 0, :2]
    assert plate.pos[:2] == pytest.approx((0.5 * (way.amin(0) + way.amax(0))).tolist(), abs=1e-5)
    assert isinstance(part, InScene) and len(stage.touches) == len(task.humanoid.feet)
    things = (Character(task.humanoid), plate)
    scene = Scene(things, (), stage.touches, stage.floor, task.config.sim)
    sim = SceneSim(scene, 2, threads=1)
    place = sim.scene.place("trampoline")
    assert place.coordinates == 3 and place.controls.stop - place.controls.start == 4
    bounce = part.events[1](sim, 30.0)
    assert isinstance(bounce, trampoline.Bounce)
    ctrl = sim.backend.drive.ctrl[:, place.controls]
    up = list[int]()
    for step in range(150):
        bounce.before_step(sim.backend.drive)
        if bool((ctrl == 0.1).all()):
            up.append(step)
        else:
            assert not ctrl.any()
        bounce.steps += 1
    assert up == [30, 31, 32, 33, 120, 121, 122, 123]
    # At rest it carries itself, and 10 cm of control lift it by 10 cm.
    ctrl[:] = 0.1
    sim.place("", *_far_off(task))
    sim.backend.step(240)
    assert float(sim.backend.state.qpos[0, place.qpos][0]) == pytest.approx(0.1, abs=2e-3)
    assert isinstance(stage.yields(None), Compliance) and not stage.yields(None).root
    # Contacts are felt for a second from the one that follows the air.
    one = torch.ones(2, 3).double()
    part_of = SimpleNamespace(events=[bounce])
    assert not trampoline.after_contact(part_of, one).any()  # type: ignore[arg-type]
    bounce.gives[1] = 5
    assert trampoline.after_contact(part_of, one)[:, 0].tolist() == [0.0, 1.0]  # type: ignore[arg-type]


def _far_off(task: Imitation) -> tuple[Tensor, Tensor]:
    """The motion's first pose, 50 m off."""
    qpos = task.reference.qpos[:1].double().repeat(2, 1)
    qpos[:, 0] += 50.0
    return qpos, torch.zeros(2, qpos.shape[1] - 1).double()


def test_a_ball_on_the_head(task: Imitation) -> None:
    scene = Balance(spread=0.1, gain=0.0, damping=0.0, pushes=50.0)
    stage = scene.stage(task.humanoid, task.reference)
    own = replace(task.task, events=stage.events, compliance=stage.yields(None), dones=())
    made = replace(task, task=own, props=stage.props, links=stage.links, config=task.config)
    env = made.env(3, threads=1, auto_reset=False, help_scale=0.0, guard=False)
    zero = torch.zeros(3, dtype=torch.long)
    env.reset_to(zero, zero)
    forces, part = env.event(ball.FictionalForces), env.event(ScenePart)
    assert forces is not None and part is not None
    cosine = ball.upright_of(part.sim)
    assert bool((cosine > math.cos(0.15)).all()) and bool((cosine < 1.0).any())
    # What a policy asks for is at head and root, in the heading's axes, and bounded.
    forces.asked = torch.zeros(3, 6)
    forces.asked[0, :3] = torch.tensor([0.0, 0.5, 0.0])
    forces.asked[1, 3:] = torch.tensor([0.0, 0.0, 99.0])
    env.step(env.action)
    felt = forces.felt()
    assert felt is not None
    assert felt.force[0].norm(dim=-1).tolist() == pytest.approx([50.0, 0.0], abs=1e-4)
    assert felt.force[1, 1].tolist() == pytest.approx([0.0, 0.0, ball.MOST_N], abs=1e-4)
    assert not felt.driven and felt.body[0].tolist() == [env.goal.humanoid.rows_of("head")[-1] + 1, 1]
    assert isinstance(env.goal, DisplacedGoal)
    assert bool(env.goal.offset[0].any()) and not env.goal.offset[2].any()
    # By the linear law it pushes the goal to where the ball leans.
    forces.asked = None
    env.step(env.action)
    where, moves = ball.tipped(part.sim, scene.length)
    head = env.goal.layout.unpacked(env.goal.goal.now()).pos[:, forces.felt().body[0, 0] - 1]
    assert where.shape == moves.shape == head.shape == (3, 3)
    env.close()
    # The rod stands where it is tied: it does not slip off.
    law = stage.yields(Compliance(0.1))
    assert isinstance(law, Compliance) and law.law == "algorithm1"
    assert isinstance(stage.yields(None), Stiffness)


def test_what_balancing_sees_and_is_paid() -> None:
    class Seen:
        sim = SimpleNamespace(
            pos=torch.tensor([[[0.0, 0.0, 1.5]]]), linvel=torch.zeros(1, 1, 3),
            heading=torch.tensor([[math.cos(math.pi / 4), 0.0, 0.0, math.sin(math.pi / 4)]]),
        )  # fmt: skip

        def source(self, name: str) -> Tensor:
            # A rod of 1 m that leans by 90 degrees along X and turns about Y by 2 rad/s.
            half = math.sqrt(0.5)
            return {
                "rod/pos": torch.tensor([[0.0, 0.0, 1.7]]),
                "rod/quat": torch.tensor([[half, 0.0, half, 0.0]]),
                "rod/qvel": torch.tensor([[0.0, 0.0, 0.0, 0.0, 2.0, 0.0]]),
            }[name]

    paid = ball.above(Seen(), 0, 1.0)  # type: ignore[arg-type]
    torch.testing.assert_close(paid, torch.tensor([math.exp(-2.0)]))
    seen = ball.ball_seen(Seen(), 0, 1.0)[0]  # type: ignore[arg-type]
    # Facing +Y, what is along X lies to the right, -Y; it goes down by 2 m/s.
    expected = [0.0, -1.0, 0.2, 0.0, 0.0, -2.0, 0.0, -0.5, 0.2, 0.0, 0.0, -1.0]
    torch.testing.assert_close(seen, torch.tensor(expected), atol=1e-5, rtol=0)


@pytest.mark.parametrize("length", [0.8, 1.0, 1.2])
def test_upright_rods_look_alike_whatever_their_length(length: float) -> None:
    class Seen:
        sim = SimpleNamespace(
            pos=torch.tensor([[[0.0, 0.0, 1.5]]]),
            linvel=torch.zeros(1, 1, 3),
            heading=torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        )

        def source(self, name: str) -> Tensor:
            still = {"rod/pos": [0.0, 0.0, 1.7], "rod/quat": [1.0, 0.0, 0.0, 0.0], "rod/qvel": [0.0] * 6}
            return torch.tensor([still[name]])

    seen = ball.ball_seen(Seen(), 0, length)[0]  # type: ignore[arg-type]
    expected = [0.0, 0.0, 1.2, 0.0, 0.0, 0.0, 0.0, 0.0, 0.7, 0.0, 0.0, 0.0]
    torch.testing.assert_close(seen, torch.tensor(expected), atol=1e-5, rtol=0)


@pytest.mark.parametrize("scene", [HandInHand(), PullScene(), DoorScene()])
def test_a_skeleton_without_hands(task: Imitation, scene: PlayScene) -> None:
    table = task.humanoid.table
    rows = tuple(replace(r, kind="forearm" if r.kind == "hand" else r.kind) for r in table.rows)
    body = make_humanoid(task.humanoid.skeleton, replace(table, rows=rows))
    with refused("body-part-missing", says="left"):
        scene.stage(body, task.reference)


def test_a_skeleton_without_a_head(task: Imitation) -> None:
    table = task.humanoid.table
    rows = tuple(replace(r, kind="neck" if r.kind == "head" else r.kind) for r in table.rows)
    body = make_humanoid(task.humanoid.skeleton, replace(table, rows=rows))
    with refused("body-part-missing"):
        Balance().stage(body, task.reference)


@pytest.mark.parametrize(
    ("made", "what"),
    [
        (lambda: PullScene(0.0), "pull: newtons must be above 0"),
        (lambda: PullScene(direction=(0.0, 0.0, 0.0)), "a pull needs a direction"),
        (lambda: PullScene(lasts_s=0.0), "lasts_s must be above 0"),
        (lambda: HandInHand(sway=2.0), "sway must be at least 0 and below 1 m"),
        (lambda: DoorScene(0.0), "width must be above 0 and below 10 m"),
        (lambda: DoorScene(made_for=9.0), "made_for must lie in 0.5 to 3 m"),
        (lambda: Throws(mass=0.0), "mass must be above 0 and below 100 kg"),
        (lambda: TrampolineScene(2.0), "height must lie in 0 to 1 m"),
        (lambda: TrampolineScene(first=3.0), "first must be at least 0 and below 3 s"),
        (lambda: Balance(length=0.0), "length must lie in 0.1 to 5 m"),
        (lambda: Balance(pushes=-1.0), "pushes must be at least 0"),
    ],
)
def test_scenes_that_are_none(made: object, what: str) -> None:
    with refused("out-of-range", says=what):
        made()  # type: ignore[operator]


def test_a_foot_that_is_put_down_loses(task: Imitation) -> None:
    foot = LiftedFoot(task.humanoid)
    pose = task.reference.pose
    pos, quat = pose.pos[:1].float(), pose.quat[:1].float()
    # It stands, or hangs as high as the character is lifted.
    stands = foot.height(pos, quat)
    assert abs(float(stands)) < 0.02
    up = pos + torch.tensor([0.0, 0.0, 0.1])
    torch.testing.assert_close(foot.height(up, quat), stands + 0.1)
    (end,) = Chicken().stage(task.humanoid, task.reference).dones

    class Seen:
        phase = torch.tensor([0.0, 1.0, 1.0, 1.0])
        sim = SimpleNamespace(pos=torch.cat((pos, pos, up, pos)), quat=quat.expand(4, -1, -1))

        def source(self, name: str) -> torch.Tensor:
            return {"since": torch.tensor([9.0, 9.0, 9.0, CATCHES_S / 2])}[name]

    ends = end.fn(Seen(), **{**end.params, "share": 0.5})  # type: ignore[arg-type]
    # Not at first, not in the air, and not where the player catches itself after a blow.
    assert ends.tolist() == [False, True, False, False]
