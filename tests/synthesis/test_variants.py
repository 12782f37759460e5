"""Variants of a transition: their middle is elsewhere, and everything that is known stays."""

from __future__ import annotations

import numpy as np
import torch
from test_inbetween_fill import model

from poise.learn.between import Between
from poise.learn.inbetween_model import make_net
from poise.synthesis.filler import ASIDE_M, TURNED, Detour, Filling, drawn, through
from poise.synthesis.keyframes import fill_keyframes
from poise.synthesis.windows import FrameBank
from toy_human import swing
from toy_windows import SMALL, bank, layout

SEEN = torch.ones(41, dtype=torch.bool)
SEEN[10:40] = False


def network(of: FrameBank) -> Between:
    net = make_net("transformer", layout(of), SMALL, 0)
    assert isinstance(net, Between)
    net.calibrate(of.root[None, :60].float(), of.rot[None, :60].float(), of.offsets[:1].float())
    return net.eval()


def test_a_detour_is_never_small_and_never_in_a_short_gap() -> None:
    g = torch.Generator().manual_seed(0)
    assert drawn(7, 30.0, g) is None
    found = [drawn(30, 30.0, g) for _ in range(200)]
    for d in found:
        assert d is not None and 0 <= d.pose < 30 and 11 <= d.frame <= 18
        assert 0.5 * ASIDE_M - 1e-9 <= abs(d.aside) <= ASIDE_M
        assert 0.5 * TURNED - 1e-9 <= abs(d.turn) <= TURNED
        assert 3 <= abs(d.pose - d.frame) <= 6
    assert len({(d.aside > 0, d.turn > 0, d.pose > d.frame) for d in found if d}) == 8
    # In half the time a quarter of the way.
    half = drawn(15, 30.0, torch.Generator().manual_seed(3))
    whole = drawn(30, 30.0, torch.Generator().manual_seed(3))
    assert half is not None and whole is not None and abs(half.aside / whole.aside - 0.25) < 1e-9


@torch.no_grad()
def test_the_middle_goes_aside_across_the_way_and_known_frames_stay() -> None:
    of = bank()
    root, rot = of.root[None, :41].float(), of.rot[None, :41].float()
    net, bones = network(of), of.offsets[:1].float()
    guess = net.complete(root, rot, SEEN, bones)
    detour = Detour(15, 12, 0.2, 0.3)
    made = through(
        net, root, rot, SEEN, bones, guess, detour, torch.Generator().manual_seed(0)
    )  # fmt: skip
    assert torch.allclose(made.root[:, SEEN], root[:, SEEN], atol=1e-5)
    moved = (made.root[0, 25] - guess.root[0, 25])[:2]
    assert abs(float(moved.norm()) - 0.2) < 1e-5
    way = (guess.root[0, 39] - guess.root[0, 10])[:2]
    if float(way.norm()) > 0.05:
        assert abs(float(moved @ way)) < 1e-4
    # The height and the pose are those of another time.
    assert abs(float(made.root[0, 25, 2] - guess.root[0, 22, 2])) < 1e-5
    dots = (made.rot[0, 25, 1:] * guess.rot[0, 22, 1:]).sum(-1).abs()
    assert torch.allclose(dots, torch.ones_like(dots), atol=1e-4)
    assert torch.allclose(made.contact[0, 25], 0.5 * (made.contact[0, 24] + made.contact[0, 26]))


def test_variants_of_a_gap_of_a_second_can_be_told_apart() -> None:
    clip, how = swing(2.0), Filling(samples=3, rounds=1)
    made = fill_keyframes(clip, (15, 45), model(), how).clips
    again = fill_keyframes(clip, (15, 45), model(), how).clips
    assert all(np.array_equal(a.rot, b.rot) for a, b in zip(made, again, strict=True))
    apart = [
        np.linalg.norm(c.root_pos[:, :2] - made[0].root_pos[:, :2], axis=-1).max() for c in made[1:]
    ]
    assert min(apart) > 0.08
    for c in made:
        assert np.allclose(c.positions()[[15, 45]], clip.positions()[[15, 45]], atol=1e-9)
