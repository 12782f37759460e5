"""Lowest points of turned geoms against sampled surfaces, and MuJoCo's conventions."""

from __future__ import annotations

import math

import pytest
import torch

from poise.metrics import KINDS, Shapes, centre_of_mass, foot_points, geom_heights, lowest_points
from poise.motion.rotations import normalize, quat_rotate
from refusals import refused

SIZE = {
    "sphere": (0.1, 0.0, 0.0),
    "capsule": (0.05, 0.2, 0.0),
    "ellipsoid": (0.1, 0.2, 0.05),
    "cylinder": (0.08, 0.15, 0.0),
    "box": (0.1, 0.05, 0.2),
}


def one(kind, pos=(0.0, 0.0, 0.0), quat=(1.0, 0.0, 0.0, 0.0), size=None):
    return Shapes(
        torch.tensor([KINDS[kind]]),
        torch.tensor([size or SIZE[kind]], dtype=torch.float64),
        torch.tensor([pos], dtype=torch.float64),
        torch.tensor([quat], dtype=torch.float64),
        torch.tensor([0]),
    )


def surface(kind, count=40000):
    """Points of the solid's surface, sampled; twin of the support functions."""
    g = torch.Generator().manual_seed(0)
    u = normalize(torch.randn(count, 3, generator=g, dtype=torch.float64))
    s = torch.tensor(SIZE[kind], dtype=torch.float64)
    if kind == "sphere":
        return u * s[0]
    if kind == "ellipsoid":
        return u * s
    if kind == "capsule":
        return (
            u * s[0] + torch.sign(u[:, 2:]) * torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64) * s[1]
        )
    if kind == "cylinder":
        angle = torch.linspace(0, 2 * math.pi, count // 2, dtype=torch.float64).repeat(2)
        z = torch.cat((torch.ones(count // 2), -torch.ones(count // 2))).double() * s[1]
        return torch.stack((angle.cos() * s[0], angle.sin() * s[0], z), -1)
    corners = torch.tensor([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]).double()
    return corners * s


@pytest.mark.parametrize("kind", list(KINDS))
def test_lowest_point_matches_the_sampled_surface(kind):
    g = torch.Generator().manual_seed(7)
    shapes = one(
        kind, pos=(0.1, -0.2, 0.3), quat=normalize(torch.randn(4, generator=g).double()).tolist()
    )
    pos = torch.randn(5, 1, 3, generator=g, dtype=torch.float64)
    quat = normalize(torch.randn(5, 1, 4, generator=g, dtype=torch.float64))
    points = surface(kind)
    for t in range(5):
        local = quat_rotate(shapes.quat.expand(len(points), 4), points) + shapes.pos
        world = quat_rotate(quat[t].expand(len(points), 4), local) + pos[t]
        low = lowest_points(pos[t], quat[t], shapes)
        assert low <= world[:, 2].min() + 1e-9
        assert low == pytest.approx(float(world[:, 2].min()), abs=5e-4)


def test_hand_computed_lying_capsule_and_standing_box():
    lie = (math.cos(math.pi / 4), math.sin(math.pi / 4), 0.0, 0.0)
    pos, quat = torch.tensor([[0.0, 0.0, 1.0]]).double(), torch.tensor([[1.0, 0, 0, 0]]).double()
    assert lowest_points(pos, quat, one("capsule", quat=lie)) == pytest.approx(0.95)
    assert lowest_points(pos, quat, one("capsule")) == pytest.approx(0.75)
    assert lowest_points(pos, quat, one("box")) == pytest.approx(0.8)
    assert lowest_points(pos, quat, one("cylinder", quat=lie)) == pytest.approx(0.92)


@pytest.mark.parametrize("kind", list(KINDS))
def test_foot_points_lie_on_the_surface_and_reach_near_its_lowest_point(kind):
    pos, quat = torch.zeros(1, 3).double(), torch.tensor([[1.0, 0, 0, 0]]).double()
    shapes = one(kind)
    points = foot_points(pos, quat, shapes, [0])
    assert points[:, 2].min() == pytest.approx(float(lowest_points(pos, quat, shapes)), abs=1e-12)
    # Moving the body by a rigid motion moves the points with it.
    g = torch.Generator().manual_seed(3)
    q = normalize(torch.randn(4, 1, 4, generator=g).double())
    p = torch.randn(4, 1, 3, generator=g).double()
    moved = foot_points(p, q, shapes, [0])
    want = quat_rotate(q.expand(4, len(points), 4), points.expand(4, -1, 3)) + p
    assert torch.allclose(moved, want)


def test_bodies_and_centre_of_mass():
    shapes = Shapes(
        torch.tensor([6, 2]),
        torch.tensor([[0.1, 0.1, 0.1], [0.1, 0.0, 0.0]]),
        torch.zeros(2, 3),
        torch.tensor([[1.0, 0, 0, 0]]).expand(2, 4),
        torch.tensor([1, 2]),
    )
    pos = torch.tensor([[5.0, 5, 5], [0, 0, 1], [0, 0, 2]]).expand(4, 3, 3)
    quat = torch.tensor([1.0, 0, 0, 0]).expand(4, 3, 4)
    assert torch.allclose(geom_heights(pos, quat, shapes), torch.tensor([0.9, 1.9]).expand(4, 2))
    box, ball = 8e-3, 4 / 3 * math.pi * 1e-3
    height = centre_of_mass(pos, quat, shapes)[:, 2]
    assert height.tolist() == pytest.approx([(box + 2 * ball) / (box + ball)] * 4)
    heavy = Shapes(
        shapes.kind, shapes.size, shapes.pos, shapes.quat, shapes.body, torch.tensor([1.0, 3.0])
    )
    assert centre_of_mass(pos, quat, heavy)[0, 2] == pytest.approx(1.75)
    assert len(shapes.of_bodies([2])) == 1 and int(shapes.of_bodies([2]).kind[0]) == KINDS["sphere"]


def test_mistakes_are_told():
    with refused("unknown-shape", says=("kind 7", "'capsule': 3")):
        Shapes(
            torch.tensor([7]), torch.ones(1, 3), torch.ones(1, 3), torch.ones(1, 4), torch.tensor([0])
        )
    with refused("wrong-shape", says=("size", "1, 3", "1, 2")):
        Shapes(
            torch.tensor([2]), torch.ones(1, 2), torch.ones(1, 3), torch.ones(1, 4), torch.tensor([0])
        )
    with refused("no-shapes", says="[4]"):
        one("box").of_bodies([4])
    with refused("wrong-shape"):
        lowest_points(torch.zeros(2, 3), torch.zeros(3, 4), one("box"))


def test_heights_agree_with_mujoco():
    mujoco = pytest.importorskip("mujoco")
    xml = """<mujoco><worldbody><geom type="plane" size="5 5 .1"/>
      <body pos="0 0 2"><freejoint/>
        <geom name="c" type="capsule" size=".05 .2" pos=".1 0 .1" quat=".8 .3 .4 .1"/>
        <geom name="b" type="box" size=".1 .05 .2" pos="0 .1 -.1" quat=".5 .3 -.4 .1"/>
        <geom name="e" type="ellipsoid" size=".1 .2 .05" quat=".3 .3 .4 .1"/></body>
    </worldbody></mujoco>"""
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    data.qpos[3:7] = [0.2, -0.5, 0.7, 0.4]
    mujoco.mj_normalizeQuat(model, data.qpos)
    mujoco.mj_forward(model, data)
    shapes = Shapes(
        *(
            torch.tensor(a[1:])
            for a in (model.geom_type, model.geom_size, model.geom_pos, model.geom_quat)
        ),
        torch.tensor(model.geom_bodyid[1:]),
    )
    low = geom_heights(torch.tensor(data.xpos), torch.tensor(data.xquat), shapes)
    want = [mujoco.mj_geomDistance(model, data, 0, g, 10.0, None) for g in (1, 2, 3)]
    assert low.tolist() == pytest.approx(want, abs=1e-4)


def test_long_motions_are_placed_in_pieces(monkeypatch):
    """What an hour needs on the way stays small, and the figures are the same to the last bit."""
    generator = torch.Generator().manual_seed(3)
    pos = torch.randn(2, 25, 2, 3, generator=generator, dtype=torch.float64)
    quat = normalize(torch.randn(2, 25, 2, 4, generator=generator, dtype=torch.float64))
    unit = torch.tensor([[1.0, 0.0, 0.0, 0.0]]).expand(2, 4)
    body = Shapes(
        torch.tensor([6, 3]), torch.full((2, 3), 0.1), torch.zeros(2, 3), unit, torch.tensor([0, 1])
    )
    figures = [
        lambda p, q: geom_heights(p, q, body),
        lambda p, q: foot_points(p, q, body, [1]),
        lambda p, q: centre_of_mass(p, q, body),
    ]
    whole = [figure(pos, quat) for figure in figures]
    monkeypatch.setattr("poise.metrics.shape_points.PIECE", 7)
    assert all(torch.equal(figure(pos, quat), want) for figure, want in zip(figures, whole, strict=True))
