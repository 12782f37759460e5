"""L2Q, L2P, NPSS and Skeleton2Humanoid's figures on numbers worked out by hand."""

from __future__ import annotations

import math

import pytest
import torch

from poise.metrics import l2p, l2q, npss, physics


def test_l2q_is_the_norm_over_all_joints_together_and_knows_signs() -> None:
    truth = torch.zeros(2, 3, 2, 4, dtype=torch.float64)
    truth[..., 0] = 1.0
    wrong = truth.clone()
    wrong[..., 1] = 0.3
    wrong[..., 1, 1] = 0.4
    # sqrt(0.3^2 + 0.4^2) over the joints of a frame, not the mean of 0.3 and 0.4
    assert float(l2q(wrong, truth)) == pytest.approx(0.5)
    # A flipped sign is an error of 2 per joint: sqrt(2^2 + 2^2)
    assert float(l2q(-truth, truth)) == pytest.approx(math.sqrt(8))


def test_l2p_divides_by_the_deviations_and_is_blind_to_the_unit() -> None:
    truth = torch.zeros(1, 2, 2, 3, dtype=torch.float64)
    wrong, std = truth.clone(), torch.full((2, 3), 2.0, dtype=torch.float64)
    wrong[:, 0, 0] = torch.tensor([6.0, 8.0, 0.0])
    # One frame is off by |(3, 4, 0)| = 5, the other by nothing.
    assert float(l2p(wrong, truth, std)) == pytest.approx(2.5)
    assert float(l2p(wrong / 100, truth, std / 100)) == pytest.approx(2.5)


def test_one_centimetre_of_the_published_deviations() -> None:
    # Deviations of hips, left foot and head as published (cm, X Y Z of a Y-up file).
    std = torch.tensor([[47.1, 28.05, 23.88], [54.23, 21.45, 30.82], [48.47, 41.07, 29.5]])
    error = torch.tensor([1.0, 0.0, 0.0]).expand(1, 1, 3, 3)
    by_hand = math.sqrt(1 / 47.1**2 + 1 / 54.23**2 + 1 / 48.47**2)
    assert float(l2p(error, torch.zeros(1, 1, 3, 3), std)) == pytest.approx(by_hand, rel=1e-6)
    # Of all 22 joints it is 0.0946 in the facts, 0.0202 a joint; these three agree within a tenth.
    assert by_hand / math.sqrt(3) == pytest.approx(0.0946 / math.sqrt(22), rel=0.1)


def test_npss_of_four_frames_by_hand() -> None:
    # cos over 4 frames: X = (0, 2, 0, 2), P = (0, 4, 0, 4), shares (0, .5, 0, .5), sums (0, .5, .5, 1)
    truth = torch.tensor([1.0, 0.0, -1.0, 0.0], dtype=torch.float64)[None, :, None]
    # A constant: X = (4, 0, 0, 0), sums (1, 1, 1, 1); the distance is 1 + .5 + .5 + 0
    flat = torch.ones(1, 4, 1, dtype=torch.float64)
    assert float(npss(flat, truth)) == pytest.approx(2.0)
    assert float(npss(truth, truth)) == 0.0
    # Weighted by the truth's power, 8 for the cosine and 16 for the constant: (2 * 8 + 0 * 16) / 24
    both = torch.cat((truth, flat), 2)
    assert float(npss(torch.cat((flat, flat), 2), both)) == pytest.approx(16 / 24)


def test_npss_survives_what_is_zero_throughout() -> None:
    truth = torch.zeros(1, 4, 2, dtype=torch.float64)
    truth[..., 0] = 1.0
    guess = truth.clone()
    guess[..., 1] = 0.5
    assert float(npss(guess, truth)) == 0.0
    # A prediction of nothing where there is a constant: |0 - 1| at each of four frequencies.
    assert float(npss(torch.zeros_like(truth), truth)) == pytest.approx(4.0)


def test_npss_averages_over_the_whole_set_at_once() -> None:
    g = torch.Generator().manual_seed(0)
    a, b = torch.randn(2, 6, 8, 5, generator=g, dtype=torch.float64)
    parts = 0.5 * (npss(a[:3], b[:3]) + npss(a[3:], b[3:]))
    assert abs(float(npss(a, b) - parts)) > 1e-4
    assert float(npss(a[torch.tensor([5, 3, 1, 0, 2, 4])], b[torch.tensor([5, 3, 1, 0, 2, 4])])) == (
        pytest.approx(float(npss(a, b)))
    )


def test_penetration_counts_feet_all_joints_and_steps() -> None:
    pos = torch.zeros(1, 2, 3, 3, dtype=torch.float64)
    pos[..., 2] = 0.1
    pos[0, 0, 1, 2] = -0.02
    pos[0, 1, 2, 2] = -0.01
    pos[0, 1, :, 0] = 0.3
    got = physics(pos, (0, 1))
    # Two feet in two frames: one of four samples 20 mm under the ground.
    assert got.fp_mm == pytest.approx(-5.0) and got.fq == pytest.approx(0.25)
    assert got.jq == pytest.approx(2 / 6)
    step = [math.hypot(0.3, 0.0), math.hypot(0.3, 0.12), math.hypot(0.3, 0.11)]
    assert got.sm_mm == pytest.approx(1000 * sum(step) / 3)
    frozen = physics(pos[:, :1].expand(1, 4, 3, 3), (0, 1))
    assert frozen.sm_mm == 0.0
