"""Motion in a mirror: what is left becomes right, twice is nothing, walking stays walking."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from poise.motion.mirror import mirrored_clip, other_sides
from poise.synthesis.windows import joined, mirrored
from refusals import refused
from toy_human import swing
from toy_windows import bank


def test_each_side_finds_the_other() -> None:
    of = bank()
    other = other_sides(of.names, of.parents)
    assert np.array_equal(other[other], np.arange(len(of.names)))
    swapped = {of.names[j] for j in range(len(of.names)) if int(other[j]) != j}
    assert swapped and all("left" in n.lower() or "right" in n.lower() for n in swapped)
    with refused("sides-unknown"):
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


def test_a_clip_in_a_mirror_and_back() -> None:
    clip = swing(1.0, speed=1.0, bend=0.8)
    seen = mirrored_clip(clip)
    other = other_sides(clip.skeleton.names, clip.skeleton.parents)
    expected = clip.positions()[:, other] * [1.0, -1.0, 1.0]
    assert np.allclose(seen.positions(), expected, atol=1e-9)
    # It turns left, its image right.
    assert clip.root_pos[-1, 1] > 0.1 and seen.root_pos[-1, 1] < -0.1
    again = mirrored_clip(seen)
    assert np.allclose(again.positions(), clip.positions())
    assert [j for j, _ in again.skeleton.ends] == [j for j, _ in clip.skeleton.ends]


def test_bones_of_unlike_sides_and_a_rest_that_lies_are_no_hindrance() -> None:
    clip = swing(1.0, speed=1.0)
    offsets = np.array(clip.skeleton.offsets)
    offsets[clip.skeleton.index("LeftArm")] *= 1.2
    odd = clip.replaced(skeleton=replace(clip.skeleton, offsets=offsets))
    other = other_sides(clip.skeleton.names, clip.skeleton.parents)
    assert np.allclose(mirrored_clip(odd).positions(), odd.positions()[:, other] * [1, -1, 1], atol=1e-9)
    # Rest with left above right: the mirror is across y.
    lying = np.array(clip.skeleton.offsets)[:, [0, 2, 1]]
    flat = clip.replaced(skeleton=replace(clip.skeleton, offsets=lying))
    seen = mirrored_clip(flat)
    assert np.allclose(seen.positions(), flat.positions()[:, other] * [1, -1, 1], atol=1e-9)
