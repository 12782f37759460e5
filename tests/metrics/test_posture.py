"""Upright where the reference is, on its feet where that is: hand-made poses of root, head, foot."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from poise.metrics import KINDS, Shapes, fallen, first_lasting, off_feet

STANDS = ((0.0, 0.0, 0.9), (0.0, 0.0, 1.6))


def pose(root: tuple[float, float, float], head: tuple[float, float, float]) -> Tensor:
    """One frame of two bodies."""
    return torch.tensor([[root, head]])


def bent(degrees: float) -> Tensor:
    """A trunk that leans so far about its root."""
    a = math.radians(degrees)
    return pose(STANDS[0], (0.7 * math.sin(a), 0.0, 0.9 + 0.7 * math.cos(a)))


@pytest.mark.parametrize(
    ("own", "down"),
    [
        (pose(*STANDS), False),
        # Crouches a little, leans, turns about, stands elsewhere.
        (pose((0.0, 0.0, 0.75), (0.0, 0.0, 1.4)), False),
        (bent(40.0), False),
        (pose((2.0, 1.0, 0.9), (2.0, 1.0, 1.6)), False),
        # Kneels, sits on the floor, lies on it 0.4 m off on average, bows.
        (pose((0.0, 0.0, 0.45), (0.0, 0.0, 1.12)), True),
        (pose((0.0, 0.0, 0.1), (0.0, 0.0, 0.8)), True),
        (pose((0.0, 0.0, 0.1), (0.6, 0.0, 0.1)), True),
        (bent(61.0), True),
        (bent(180.0), True),
    ],
)
def test_a_character_is_down_where_its_reference_stands(own: Tensor, down: bool) -> None:
    assert fallen(own, pose(*STANDS), 1).tolist() == [down]


def test_where_the_reference_is_not_upright_nothing_is_asked() -> None:
    lies = pose((0.0, 0.0, 0.1), (0.6, 0.0, 0.1))
    for reference in (lies, bent(46.0), bent(120.0)):
        assert fallen(lies, reference, 1).tolist() == [False]
    assert fallen(lies, bent(44.0), 1).tolist() == [True]


def test_who_sits_on_the_floor_as_the_reference_does_is_upright() -> None:
    sits = pose((0.0, 0.0, 0.1), (0.0, 0.0, 0.8))
    assert fallen(sits, sits, 1).tolist() == [False]


def test_feet_on_the_ground_where_the_reference_has_them() -> None:
    one = torch.tensor([[1.0, 0.0, 0.0, 0.0]])
    shapes = Shapes(
        torch.tensor([KINDS["sphere"]]), torch.tensor([[0.05, 0.0, 0.0]]), torch.zeros(1, 3), one,
        torch.tensor([1]),
    )  # fmt: skip

    def at(*heights: float) -> Tensor:
        return torch.tensor([[[0.0, 0.0, 9.0], [0.0, 0.0, h + 0.05]] for h in heights])

    quat = one.expand(4, 2, 4)
    own, ref = at(0.0, 0.09, 0.3, 0.3), at(0.0, 0.04, 0.04, 0.06)
    assert off_feet(own, quat, ref, quat, shapes, (1,)).tolist() == [False, False, True, False]


def test_only_lasting_spells_count() -> None:
    bad = torch.zeros(3, 40, dtype=torch.bool)
    bad[0, 5:19] = bad[0, 20:34] = True
    bad[1, 7:22] = True
    bad[2, 25:] = True
    assert first_lasting(bad, 30.0).tolist() == [-1, 7, 25]
    assert first_lasting(bad[:, :14], 30.0).tolist() == [-1, -1, -1]
