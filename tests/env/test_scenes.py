"""Scenes of compliance: what stands in them, where it goes, what a body cannot do."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from poise.body.humanoid import make_humanoid
from poise.env.events import InScene, Push
from poise.env.scenes import SCENES, Hands, Pull, Throws
from poise.errors import PoiseError
from poise.jobs.open import open_run
from poise.jobs.track import imitation_of
from poise.jobs.track.placement import place
from poise.motion import read_clip
from poise.recipes.imitation import Imitation
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
    assert set(SCENES) == {"throws", "pull", "hands"}


@pytest.mark.parametrize("scene", [Hands(), Pull()])
def test_a_skeleton_without_hands(task: Imitation, scene: Hands | Pull) -> None:
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
        (lambda: Throws(mass=0.0), "must weigh above 0"),
    ],
)
def test_scenes_that_are_none(made: object, what: str) -> None:
    with pytest.raises(PoiseError, match=what):
        made()  # type: ignore[operator]
