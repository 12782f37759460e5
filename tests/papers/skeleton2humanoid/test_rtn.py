"""The recurrent transition network: its parts by their formulas, warm-up, sizes, place."""

from __future__ import annotations

import math

import pytest
import torch

from poise.learn.transition import SkeletonLayout
from poise.motion.rotations import quat_rotate
from poise.papers.skeleton2humanoid.rtn import (
    PLU,
    RTN,
    Critic,
    RTNConfig,
    arrival_embedding,
    noise_scale,
)
from toy_windows import SMALL_RTN, bank, known, layout, moved


def network(config: RTNConfig = SMALL_RTN, seed: int = 0) -> RTN:
    of = bank()
    net = RTN(layout(of), config, generator=torch.Generator().manual_seed(seed)).double()
    net.calibrate(of.root[None, :60], of.rot[None, :60], of.offsets[:1])
    return net


def test_plu_is_its_formula() -> None:
    x, a, c = torch.linspace(-5, 5, 101), 0.1, 1.0
    formula = torch.maximum(a * (x + c) - c, torch.minimum(a * (x - c) + c, x))
    assert torch.allclose(PLU()(x), formula, atol=1e-6)


def test_the_arrival_embedding_and_the_schedule_of_noise() -> None:
    z = arrival_embedding(torch.tensor([0, 7]), 256)
    assert z.shape == (2, 256)
    assert z[0].tolist() == [0.0, 1.0] * 128
    assert float(z[1, 0]) == pytest.approx(math.sin(7)) and float(z[1, 1]) == pytest.approx(math.cos(7))
    assert float(z[1, 10]) == pytest.approx(math.sin(7 / 10000 ** (10 / 256)), abs=1e-6)
    scale = noise_scale(torch.tensor([2.0, 5.0, 17.5, 30.0, 44.0]))
    assert scale.tolist() == [0.0, 0.0, 0.5, 1.0, 1.0]
    # T_past + P_max - 5
    assert RTNConfig().latest == 35


def test_sizes_are_those_that_follow_from_the_paper() -> None:
    chains = SkeletonLayout((-1, *range(21)), (1, 2, 3, 4), (1.0, 0.0, 0.0))
    g = torch.Generator().manual_seed(0)
    for width, millions in ((512, 3.6), (768, 5.8), (1024, 8.6)):
        net = RTN(chains, RTNConfig(hidden=width), generator=g)
        assert sum(p.numel() for p in net.parameters()) / 1e6 == pytest.approx(millions, abs=0.06)
    # 95 numbers of state, 91 of offset, 88 of target
    widths = [part[0].in_features for part in (net.state, net.offset, net.target)]
    assert widths == [95, 91, 88]


def test_a_decoder_that_says_nothing_stands_still() -> None:
    net, k = network(), known(bank())
    with torch.no_grad():
        net.decoder[-1].weight.zero_()
    filled = net.fill(k, 8)
    assert torch.allclose(filled.root, k.past_root[:, -1:].expand(2, 8, 3), atol=1e-9)
    assert torch.allclose(filled.rot, k.past_rot[:, -1:].expand(2, 8, 19, 4), atol=1e-9)
    assert torch.allclose(filled.contact, torch.full_like(filled.contact, 0.5))


def test_the_past_warms_it_up_and_one_frame_is_enough() -> None:
    net, k = network(), known(bank())
    before = net.fill(k, 8).root
    # The first frames reach the result through the memory alone.
    other = k.past_rot.clone()
    other[:, :5] = other[:, 5:6]
    assert not torch.allclose(net.fill(k._replace(past_rot=other), 8).root, before)
    one = k._replace(past_root=k.past_root[:, -1:], past_rot=k.past_rot[:, -1:])
    assert net.fill(one, 8).root.shape == (2, 8, 3)


def test_it_is_blind_to_where_and_in_which_heading() -> None:
    net, k = network(), known(bank())
    other, turn, way = moved(k, 1.9, (3.0, -7.0))
    here, there = net.fill(k, 8), net.fill(other, 8)
    placed = quat_rotate(turn.expand(2, 8, 19, 4), here.pos) + way
    assert torch.allclose(there.pos, placed, atol=1e-9)


def test_it_is_blind_to_the_signs_of_quaternions() -> None:
    net, k = network(), known(bank())
    flipped = k._replace(past_rot=-k.past_rot, target_rot=-k.target_rot)
    a, b = net.fill(k, 8), net.fill(flipped, 8)
    assert torch.allclose(a.pos, b.pos, atol=1e-9) and torch.allclose(a.rot, -b.rot, atol=1e-9)
    assert bool(((k.past_rot[:, -1] * a.rot[:, 0]).sum(-1) > 0).all())


def test_noise_moves_the_target_only_while_it_is_far() -> None:
    net, k = network(), known(bank(), length=3)

    def drawn(length: int, seed: int) -> torch.Tensor:
        return net.fill(k, length, torch.Generator().manual_seed(seed)).root

    # The first prediction is made length + 1 frames before the target.
    assert not torch.allclose(drawn(30, 0), drawn(30, 1))
    one = k._replace(past_root=k.past_root[:, -1:], past_rot=k.past_rot[:, -1:])
    near = net.fill(one, 3, torch.Generator().manual_seed(0)).root
    assert torch.allclose(near, net.fill(one, 3).root)


def test_a_critic_slides_over_time() -> None:
    critic = Critic(6, 2, generator=torch.Generator().manual_seed(0))
    x = torch.randn(3, 5, 6)
    by_hand = torch.stack([critic(x[:, t : t + 2]) for t in range(4)]).mean(0)
    assert torch.allclose(critic(x), by_hand, atol=1e-6)
