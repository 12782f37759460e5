"""In-betweening: L2Q, L2P and NPSS of the LAFAN1 benchmark, and Skeleton2Humanoid's FP, FQ, JQ, SM."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from poise.metrics.plausibility import s2h_foot_penetration, smoothness


def l2q(predicted: Tensor, truth: Tensor) -> Tensor:
    """L2Q: mean over windows and frames of ||g_hat - g||_2 over all joints' global quaternions.

    Both `(N, L, J, 4)` wxyz. No sign is searched for (Harvey et al. 2020): a prediction must go on in
    the hemisphere of the last frame that was seen.
    """
    return (predicted - truth).square().sum((-2, -1)).sqrt().mean()


def l2p(predicted: Tensor, truth: Tensor, std: Tensor) -> Tensor:
    """L2P: mean over windows and frames of ||(p_hat - p) / std||_2 over all joints' positions.

    Both `(N, L, J, 3)` in one unit, std `(J, 3)` in the same: the deviations of the train windows (their
    mean cancels).
    """
    return ((predicted - truth) / std).square().sum((-2, -1)).sqrt().mean()


def npss(predicted: Tensor, truth: Tensor) -> Tensor:
    """NPSS (Gopalakrishnan et al. 2019) of sequences `(N, T, D)`: one average over the whole set.

        X = Re FFT over time, P = X^2 / sum X^2, EMD = sum over f |cumsum P_hat - cumsum P|,
        NPSS = sum EMD w / sum w over sequences and dims, w the truth's total power

    A dimension that is zero throughout has no spectrum: it weighs nothing in the truth, and counts as
    an empty spectrum in a prediction (the published code divides zero by zero there).
    """
    power_hat, power = (torch.fft.fft(x, dim=1).real.square() for x in (predicted, truth))
    weight = power.sum(1)
    emd = (_cdf(power_hat) - _cdf(power)).abs().sum(1)
    return (emd * weight).sum() / weight.sum()


def _cdf(power: Tensor) -> Tensor:
    total = power.sum(1, keepdim=True)
    share = torch.where(total > 0, power / torch.where(total > 0, total, torch.ones_like(total)), total)
    return share.cumsum(1)


class Physics(NamedTuple):
    """Plausibility of filled frames, as Skeleton2Humanoid reports it.

    Attributes:
        fp_mm: mean of min(0, h) of the feet, mm, never above 0.
        fq: share of foot joints below the ground.
        jq: share of all joints below the ground.
        sm_mm: mean joint step, mm per frame at 30 Hz (compare with the truth's).
    """

    fp_mm: float
    fq: float
    jq: float
    sm_mm: float


def physics(pos: Tensor, feet: Sequence[int], fps: float = 30.0) -> Physics:
    """Skeleton2Humanoid's FP, FQ, JQ and SM of joint positions `(N, T, J, 3)` m, ground at z = 0.

    The paper gives no formulas. Read from its figures: heights are those of joint centres, FP and FQ run
    over the four foot joints (ankles and toes), JQ over all joints, each a mean over all samples.
    """
    fp, fq = s2h_foot_penetration(pos[..., list(feet), 2])
    _, jq = s2h_foot_penetration(pos[..., 2])
    sm = smoothness(pos, fps)
    return Physics(*(float(x.mean()) for x in (fp, fq, jq, sm)))
