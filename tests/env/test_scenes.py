"""Scenes of compliance: what stands in them, where it goes, what a body cannot do."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from poise.body.humanoid import make_humanoid
from poise.env.events import InScene, Push
from poise.env.scenes import SCENES, Doorway, Hands, PlayScene, Pull, Throws, door
from poise.errors import PoiseError
from poise.jobs.open import open_run
from poise.jobs.track import imitation_of
from poise.jobs.track.placement import place
from poise.motion import read_clip
from poise.recipes.imitation import Imitation
from poise.sim import Character, Scene, SceneSim
from poise.sim.props import Door
from toy_policy import WALK


@pytest.fixture(scope="module")
def task() -> Imitation:
    tracker = open_run(None).tracker
    return imitation_of(tracker, [place(read_clip(WALK), tracker)])


def test_a_partner_goes_as_the_motion_goes(task: Imitation) -> None:
    stage = Hands(lead=0.2, sway=0.1).stage(task.humanoid, task.reference)
    (prop,), (link,), (part,) = stage.props, stage.links, stage.plugins
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
    (push,) = Pull(30.0, "right", (0.0, 0.0, -2.0)).stage(task.humanoid, task.reference).plugins
    assert isinstance(push, Push) and push.force == (0.0, 0.0, -30.0) and push.first == 15
    assert task.humanoid.bodies[push.row] == "rwrist"
    stage = Throws(mass=2.0).stage(task.humanoid, task.reference)
    assert stage.props[0].mass == 2.0  # type: ignore[attr-defined]
    assert len(stage.touches) == len(task.humanoid.bodies) + 1
    assert set(SCENES) == {"throws", "pull", "hands", "door"}


def test_doors_of_all_widths_have_their_knob_at_the_hand(task: Imitation) -> None:
    knobs: list[Tensor] = []
    for width in (1.0, 1.7):
        stage = Doorway(width).stage(task.humanoid, task.reference)
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
    stage = Doorway(1.0).stage(task.humanoid, task.reference)
    things = (Character(task.humanoid), *stage.props)
    sim = SceneSim(Scene(things, stage.links, sim=task.config.sim), 2, threads=1)
    sim.place("door", torch.tensor([[0.0], [-0.7]]), torch.zeros(2, 1))
    # Opened by 0.7 rad the knob moves along (cos .7, -sin .7); a force along it is not felt.
    way = door.way(sim)
    torch.testing.assert_close(way[1, :2], torch.tensor([math.cos(0.7), -math.sin(0.7)]).double())
    force = 30.0 * way + torch.tensor([0.0, 0.0, 5.0])
    torch.testing.assert_close(door.across(sim, force), torch.tensor([[0.0, 0.0, 5.0]] * 2).double())

    class Seen:
        def source(self, name: str) -> Tensor:
            return {"door/qpos": torch.tensor([[0.0], [-0.7], [-1.0]])}[name]

    # exp(-1.5 0.7) = 0.34994 closed, 1 from 0.7 rad on.
    expected = torch.tensor([0.34994, 1.0, 1.0])
    torch.testing.assert_close(door.opened(Seen()), expected, atol=1e-5, rtol=0)  # type: ignore[arg-type]


def test_a_door_that_nobody_gets_through(task: Imitation) -> None:
    broad = door.breadth(task.humanoid, task.reference)
    assert 0.25 < broad < 0.6
    with pytest.raises(PoiseError, match=r"is 0\.2 m wide and the body 0\.\d\d m: it cannot pass"):
        Doorway(0.2).stage(task.humanoid, task.reference)


@pytest.mark.parametrize("scene", [Hands(), Pull(), Doorway()])
def test_a_skeleton_without_hands(task: Imitation, scene: PlayScene) -> None:
    table = task.humanoid.table
    rows = tuple(replace(r, kind="forearm" if r.kind == "hand" else r.kind) for r in table.rows)
    body = make_humanoid(task.humanoid.skeleton, replace(table, rows=rows))
    with pytest.raises(PoiseError, match=r"the skeleton has no left hand, which '.*' needs"):
        scene.stage(body, task.reference)


@pytest.mark.parametrize(
    ("made", "what"),
    [
        (lambda: Pull(0.0), "a pull needs a force above 0 N"),
        (lambda: Pull(direction=(0.0, 0.0, 0.0)), "and a direction"),
        (lambda: Pull(lasts_s=0.0), "lasts some time"),
        (lambda: Hands(sway=2.0), "its sway below 1 m"),
        (lambda: Doorway(0.0), "a door is 0 to 10 m wide"),
        (lambda: Throws(mass=0.0), "must weigh above 0"),
    ],
)
def test_scenes_that_are_none(made: object, what: str) -> None:
    with pytest.raises(PoiseError, match=what):
        made()  # type: ignore[operator]
