"""The help audit: exact zeros, hand-computed work, sums over bodies."""

from __future__ import annotations

import pytest
import torch

from poise.metrics import help_audit, masked_mean, masked_quantile, span_mask
from refusals import refused


def test_no_help_is_exactly_zero():
    z = torch.zeros(2, 50, 3, 3)
    audit = help_audit(z, z, torch.randn_like(z), torch.randn_like(z), 70.0)
    figures = (
        audit.force_mean_n, audit.force_p95_n, audit.torque_mean_nm, audit.torque_p95_nm,
        audit.work_j_per_s, audit.share_of_body_weight,
    )  # fmt: skip
    assert figures == (0.0,) * 6
    assert not audit.power_w.any()


def test_hand_computed_wrench():
    force = torch.tensor([[3.0, 4.0, 0.0], [0.0, 0.0, 98.1]])
    torque = torch.tensor([[0.0, 2.0, 0.0], [0.0, 0.0, 0.0]])
    vel = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, -0.5]])
    omega = torch.tensor([[0.0, -3.0, 0.0], [1.0, 1.0, 1.0]])
    audit = help_audit(force, torque, vel, omega, mass=10.0)
    assert audit.force_mean_n == pytest.approx((5 + 98.1) / 2)
    assert audit.share_of_body_weight == pytest.approx((5 + 98.1) / 2 / 98.1)
    assert audit.force_p95_n == pytest.approx(5 + 0.95 * 93.1)
    assert audit.torque_mean_nm == pytest.approx(1.0)
    # |3*1 - 2*3| = 3 and |-49.05|
    assert audit.power_w.tolist() == pytest.approx([3.0, 49.05])
    assert audit.work_j_per_s == pytest.approx(26.025)


def test_opposite_pushes_do_not_cancel():
    force = torch.tensor([[[10.0, 0, 0], [-10.0, 0, 0]]])
    vel = torch.ones_like(force)
    audit = help_audit(force, torch.zeros_like(force), vel, vel, 50.0)
    assert audit.force_mean_n == 20.0 and audit.work_j_per_s == 20.0


def test_naive_twin_and_mask():
    g = torch.Generator().manual_seed(1)
    f, t, v, w = (torch.randn(3, 11, 4, 3, generator=g, dtype=torch.float64) for _ in range(4))
    mask = torch.rand(3, 11, generator=g) > 0.4
    forces, work = [], []
    for e in range(3):
        for k in range(11):
            if mask[e, k]:
                forces.append(sum(float(f[e, k, m].norm()) for m in range(4)))
                work.append(
                    sum(abs(float(f[e, k, m] @ v[e, k, m] + t[e, k, m] @ w[e, k, m])) for m in range(4))
                )
    f = torch.where(mask[..., None, None], f, torch.nan)  # padding may hold anything
    audit = help_audit(f, t, v, w, 60.0, mask=mask)
    assert audit.force_mean_n == pytest.approx(sum(forces) / len(forces))
    assert audit.work_j_per_s == pytest.approx(sum(work) / len(work))
    assert audit.force_p95_n == pytest.approx(
        float(torch.quantile(torch.tensor(forces, dtype=torch.float64), 0.95))
    )


def test_frames_with_all_bodies_turned_give_the_same_figures():
    g = torch.Generator().manual_seed(2)
    f, t, v, w = (torch.randn(6, 3, generator=g, dtype=torch.float64) for _ in range(4))
    turn = torch.linalg.qr(torch.randn(3, 3, generator=g, dtype=torch.float64)).Q
    a = help_audit(f, t, v, w, 60.0)
    b = help_audit(f @ turn, t @ turn, v @ turn, w @ turn, 60.0)
    assert a.work_j_per_s == pytest.approx(b.work_j_per_s)
    assert a.torque_p95_nm == pytest.approx(b.torque_p95_nm)


def test_mistakes_are_told():
    z = torch.zeros(4, 3)
    with refused("wrong-shape"):
        help_audit(z, z, z[:3], z, 60.0)
    with refused("out-of-range", says=("mass", "0")):
        help_audit(z, z, z, z, 0.0)


def test_masked_means_and_spans():
    x = torch.tensor([[1.0, 2.0, torch.nan], [4.0, 6.0, 8.0]])
    mask = torch.tensor([[True, True, False], [False, False, False]])
    assert masked_mean(x, mask) == 1.5
    assert masked_mean(x, mask, 1)[0] == 1.5 and masked_mean(x, mask, 1)[1].isnan()
    assert masked_quantile(x, 0.5, torch.zeros_like(mask)).isnan()
    m = torch.tensor([True, True, False, True, True, True])
    assert span_mask(m, 1).tolist() == [True, False, False, True, True]
    assert span_mask(m, 2).tolist() == [False, False, False, True]
    assert span_mask(m, 9).shape == (0,)
