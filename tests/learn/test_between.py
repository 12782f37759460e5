"""The transformer: interpolation at first, blind to place and heading, any keyframes, codes."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from poise.learn.between import Between, BetweenConfig, Dropout, carried, last_before_gap, neighbours
from poise.learn.transition import SkeletonLayout, joint_positions
from poise.motion.rotations import quat_rotate, slerp
from refusals import refused
from toy_windows import SMALL, bank, known, layout, moved


def network(config: BetweenConfig = SMALL, seed: int = 0, awake: bool = True) -> Between:
    """In float64; `awake` gives the last layer weights, so that corrections are not zero."""
    of = bank()
    net = Between(layout(of), config, generator=torch.Generator().manual_seed(seed)).double()
    net.calibrate(of.root[None, :60], of.rot[None, :60], of.offsets[:1])
    if awake:
        with torch.no_grad():
            for encoder in (net.encoder, net.refiner):
                if encoder is not None:
                    weight = encoder.leave.weight
                    weight.normal_(0, 0.02, generator=torch.Generator().manual_seed(1))
    return net


@pytest.mark.parametrize("past", [1, 10])
def test_before_training_it_interpolates(past: int) -> None:
    k = known(bank(), past)
    filled = network(replace(SMALL, speeds=False), awake=False).fill(k, 12)
    t = torch.arange(1, 13, dtype=torch.float64)[:, None] / 13
    line = k.past_root[:, -1:] + t * (k.target_root[:, None] - k.past_root[:, -1:])
    arcs = slerp(k.past_rot[:, -1:], k.target_rot[:, None], t)
    assert torch.allclose(filled.root, line, atol=1e-9)
    assert torch.allclose(filled.rot, arcs, atol=1e-7)
    assert torch.allclose(
        filled.pos, joint_positions(network().layout, k.offsets, line, arcs), atol=1e-7
    )
    quick = network(awake=False).fill(k, 12)
    # A frame alone has no speed to go on in.
    assert torch.allclose(quick.rot, arcs, atol=1e-7) == (past == 1)


def test_interpolation_goes_on_in_the_speed_around_it() -> None:
    seen = torch.tensor([1, 1, 0, 0, 0, 1, 1], dtype=torch.bool)
    near = neighbours(seen)
    # 1 m a frame before the gap, -2 after it; a straight line of 0.5 a frame between.
    x = torch.tensor([0.0, 1.0, 1.5, 2.0, 2.5, 3.0, 1.0], dtype=torch.float64)[None, :, None]
    more = carried(x, seen, near)[0, :, 0]
    assert more[[0, 1, 5, 6]].tolist() == [0.0] * 4
    for frame in (2, 3, 4):
        t, s = frame - 1, (frame - 1) / 4
        here = 0.5 * t * math.exp(-t / 8) * (1 - s) + 2.5 * (4 - t) * math.exp((t - 4) / 8) * s
        assert float(more[frame]) == pytest.approx(here, abs=1e-12)
    # Frames beyond the last known one, and a side with one known frame, gain nothing.
    alone = torch.tensor([0, 1, 0, 0, 0, 1, 0], dtype=torch.bool)
    assert not bool(carried(x, alone, neighbours(alone)).any())


@pytest.mark.parametrize("past, length", [(1, 1), (1, 60), (10, 5), (4, 17), (23, 30)])
def test_any_context_and_any_length(past: int, length: int) -> None:
    of = bank()
    k = known(of, past, min(length, 40))
    filled = network().fill(k, length)
    assert filled.root.shape == (2, length, 3) and filled.contact.shape == (2, length, 4)
    assert torch.allclose(filled.rot.norm(dim=-1), torch.ones(2, length, 19, dtype=torch.float64))
    assert bool((filled.contact > 0).all()) and bool((filled.contact < 1).all())


def test_it_is_blind_to_where_and_in_which_heading() -> None:
    net, k = network(), known(bank())
    other, turn, way = moved(k, 1.9, (3.0, -7.0))
    here, there = net.fill(k, 12), net.fill(other, 12)
    placed = quat_rotate(turn.expand(2, 12, 19, 4), here.pos) + way
    assert torch.allclose(there.pos, placed, atol=1e-9)
    assert torch.allclose(there.contact, here.contact, atol=1e-9)


def test_signs_go_on_from_the_last_frame_seen() -> None:
    net, k = network(), known(bank())
    flipped = k._replace(past_rot=-k.past_rot)
    a, b = net.fill(k, 12).rot, net.fill(flipped, 12).rot
    assert bool(((k.past_rot[:, -1] * a[:, 0]).sum(-1) > 0).all())
    assert torch.allclose(a, -b, atol=1e-9)
    assert bool(((a[:, 1:] * a[:, :-1]).sum(-1) > 0).all())


def test_known_frames_stay_and_hidden_ones_are_not_looked_at() -> None:
    net, of = network(), bank()
    root, rot = of.root[None, :40].clone(), of.rot[None, :40].clone()
    seen = torch.zeros(40, dtype=torch.bool)
    seen[[0, 1, 2, 9, 20, 39]] = True
    filled = net.complete(root, rot, seen, of.offsets[:1])
    assert torch.allclose(filled.root[:, seen], root[:, seen], atol=1e-9)
    assert torch.allclose((filled.rot * rot)[:, seen].sum(-1).abs(), torch.ones(1, 6, 19).double())
    root[:, ~seen] += 5.0
    again = net.complete(root, rot, seen, of.offsets[:1])
    assert torch.equal(again.root, filled.root)


def test_neighbours_of_every_frame() -> None:
    near = neighbours(torch.tensor([False, True, False, False, True, False]))
    assert near.before.tolist() == [1, 1, 1, 1, 4, 4]
    assert near.after.tolist() == [1, 1, 4, 4, 4, 4]
    assert near.share.tolist() == pytest.approx([0.0, 0, 1 / 3, 2 / 3, 0, 0])
    assert last_before_gap(torch.tensor([True, True, False, True, False, True])) == 1
    with refused("no-known-frame"):
        neighbours(torch.zeros(3, dtype=torch.bool))


def test_variants_differ_by_their_seed_and_only_where_asked() -> None:
    net, k = network(), known(bank())

    def drawn(seed: int) -> torch.Tensor:
        return net.fill(k, 12, torch.Generator().manual_seed(seed)).pos

    assert torch.equal(net.fill(k, 12).pos, net.fill(k, 12).pos)
    assert torch.equal(drawn(1), drawn(1)) and not torch.allclose(drawn(1), drawn(2))


def test_the_refiner_starts_from_the_first_result() -> None:
    config = BetweenConfig(width=32, layers=1, heads=2, feedforward=48, refine=1, latent=0)
    net, of = network(config), bank()
    seen = torch.ones(30, dtype=torch.bool)
    seen[10:29] = False
    first, refined = net(of.root[None, :30], of.rot[None, :30], seen, of.offsets[:1])
    assert refined is not None and not torch.allclose(first.root, refined.root)
    # What the refiner is asked for does not change the first stage.
    net.zero_grad()
    refined.root.square().sum().backward()
    assert net.encoder.leave.weight.grad is None
    assert net.refiner is not None and net.refiner.leave.weight.grad is not None


def test_dropout_leaves_channels_out_of_whole_windows() -> None:
    net, of = network(), bank()
    seen = torch.ones(30, dtype=torch.bool)
    seen[10:29] = False

    def filled(seed: int | None) -> torch.Tensor:
        drop = None if seed is None else Dropout(0.5, torch.Generator().manual_seed(seed))
        return net(of.root[None, :30], of.rot[None, :30], seen, of.offsets[:1], drop=drop)[0].root

    assert torch.equal(filled(3), filled(3)) and not torch.allclose(filled(3), filled(4))
    assert not torch.allclose(filled(3), filled(None))
    mask = Dropout(0.25, torch.Generator().manual_seed(0)).mask(torch.zeros(200, 7, 50))
    assert mask.shape == (200, 1, 50) and mask.mean() == pytest.approx(1.0, abs=0.02)
    assert torch.allclose(mask.unique(), torch.tensor([0.0, 4 / 3]))


def test_sizes() -> None:
    chains = SkeletonLayout((-1, *range(21)), (1, 2, 3, 4), (1.0, 0.0, 0.0))
    g = torch.Generator().manual_seed(0)
    weights = sum(p.numel() for p in Between(chains, generator=g).parameters())
    assert 4e6 < weights < 10e6
    with refused("not-a-multiple"):
        BetweenConfig(width=30, heads=8)
