"""Paths: places along them, and motions that are bent to follow them."""

from __future__ import annotations

import math

import pytest
import torch

from poise.env.generator_goal import Footprint, cost_of
from poise.env.walk_path import WalkPath
from refusals import refused

SQUARE = ((0.0, 0.0), (4.0, 0.0), (4.0, 4.0), (0.0, 4.0), (0.0, 0.0))


def test_places_lie_along_it() -> None:
    path, line = WalkPath(SQUARE), WalkPath(((0.0, 0.0), (3.0, 4.0)))
    assert path.closed and not line.closed and line.length == 5.0
    at = path.at(torch.tensor([0.0, 6.0, 17.0]).double())
    torch.testing.assert_close(at, torch.tensor([[0, 0], [4, 2], [1, 0]]).double())
    # An open one goes on straight on.
    torch.testing.assert_close(line.at(torch.tensor(10.0).double()), torch.tensor([6.0, 8.0]).double())
    along, off = line.nearest(torch.tensor([[0.6 - 0.8, 0.8 + 0.6]]).double(), torch.zeros(1).double())
    assert float(along) == pytest.approx(1.0, abs=0.03) and float(off) == pytest.approx(1.0, abs=0.01)
    assert line.over(4.9) and not line.over(2.0) and not path.over(15.9)


def test_what_walks_straight_on_is_bent_onto_it() -> None:
    path = WalkPath(tuple((3 * math.sin(a / 10), 3 - 3 * math.cos(a / 10)) for a in range(40)))
    straight = torch.zeros(1, 60, 9).double()
    straight[..., 0] = torch.arange(1, 61) * 1.2 / 30
    straight[..., 3] = 1.0
    last = torch.zeros(9).double()
    last[3] = 1.0
    bent, along, off = path.bent(straight, last, 0.0, 30.0, 1.0, 0.8)
    assert float(off.max()) < 0.15 and float(along[0, -1]) == pytest.approx(2.4, abs=0.1)
    # It turns as its way does, and its steps are as long as they were.
    turned = 2 * math.atan2(float(bent[0, -1, 6]), float(bent[0, -1, 3]))
    assert turned == pytest.approx(2.4 / 3, abs=0.15)
    steps = bent[0, :, :2].diff(dim=0).norm(dim=-1)
    torch.testing.assert_close(steps, torch.full_like(steps, 0.04), rtol=0, atol=1e-5)
    standing = torch.zeros(1, 60, 9).double()
    standing[..., 3] = 1.0
    torch.testing.assert_close(path.bent(standing, last, 0.0, 30.0, 1.0, 0.8)[0], standing)


def test_boxes_and_others_are_in_the_way() -> None:
    box = Footprint((2.0, 0.0), (1.0, 0.5), math.pi / 2)
    places = torch.tensor([[2.0, 0.0], [2.0, 0.45], [2.3, 0.0], [0.0, 0.0]]).double()
    torch.testing.assert_close(box.depth(places), torch.tensor([0.25, 0.05, 0.0, 0.0]).double())
    ways = torch.zeros(2, 60, 2).double()
    ways[0, :, 0], ways[1, :, 1] = torch.linspace(0, 3, 60), torch.linspace(0, 3, 60)
    assert cost_of(ways, None, [], [box]).argmin() == 1
    # Somebody stands where the second one would go.
    there = torch.tensor([0.0, 2.0]).double().expand(60, 2)
    assert cost_of(ways, None, [there]).argmin() == 0


def test_what_is_no_path_is_said() -> None:
    with refused("out-of-range", says="2"):
        WalkPath(((0.0, 0.0),))
    with refused("out-of-range", says="1 m long"):
        WalkPath(((0.0, 0.0), (0.5, 0.0)))
    with refused("out-of-range", says="0.3 to 3 m/s"):
        WalkPath(SQUARE, speed=5.0)
