"""Motion in a mirror: what is left becomes right, twice is nothing, walking stays walking."""

from __future__ import annotations

import pytest
import torch

from poise.errors import PoiseError
from poise.motion.mirror import joined, mirrored, other_sides
from toy_windows import bank


def test_each_side_finds_the_other() -> None:
    of = bank()
    other = other_sides(of.names, of.parents)
    assert torch.equal(other[other], torch.arange(len(of.names)))
    swapped = {of.names[j] for j in range(len(of.names)) if int(other[j]) != j}
    assert swapped and all("left" in n.lower() or "right" in n.lower() for n in swapped)
    with pytest.raises(PoiseError, match="tells left from right"):
        other_sides(("a", "b"), (-1, 0))


def test_places_are_those_of_the_other_side_in_the_mirror() -> None:
    of = bank()
    there, other = mirrored(of), other_sides(of.names, of.parents)
    # The toy's left lies along +Y at rest, so the mirror is the plane y = 0.
    expected = of.positions()[:, other] * torch.tensor([1.0, -1.0, 1.0])
    assert torch.allclose(there.positions(), expected, atol=1e-9)
    assert there.clips == tuple(f"{n}-mirrored" for n in of.clips)


def test_twice_in_the_mirror_is_the_motion_itself() -> None:
    of = bank()
    again = mirrored(mirrored(of, ""), "")
    assert torch.allclose(again.root, of.root) and torch.allclose(again.offsets, of.offsets)
    assert torch.allclose((again.rot * of.rot).sum(-1).abs(), torch.ones_like(of.rot[..., 0]))


def test_both_make_one_bank() -> None:
    of = bank()
    both = joined(of, mirrored(of))
    assert both.frames == 2 * of.frames and len(both.clips) == 2 * len(of.clips)
    assert torch.equal(both.first[len(of.clips) :], of.first + of.frames)
    half = both.only(lambda name: name.endswith("-mirrored"))
    assert torch.equal(half.root, mirrored(of).root)
