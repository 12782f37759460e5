"""In-betweening: L2Q, L2P and NPSS of the LAFAN1 benchmark, and Skeleton2Humanoid's FP, FQ, JQ, SM."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, cast

from poise.metrics.plausibility import s2h_foot_penetration, smoothness
from poise.motion.vectors import Array, namespace


def l2q(predicted: Array, truth: Array) -> Array:
    """L2Q: mean over windows and frames of ||g_hat - g||_2 over all joints' global quaternions.

    Both `(N, L, J, 4)` wxyz. No sign is searched for (Harvey et al. 2020): a prediction must go on in
    the hemisphere of the last frame that was seen.
    """
    off = predicted - truth
    return cast("Any", ((off * off).sum((-2, -1)) ** 0.5).mean())


def l2p(predicted: Array, truth: Array, std: Array) -> Array:
    """L2P: mean over windows and frames of ||(p_hat - p) / std||_2 over all joints' positions.

    Both `(N, L, J, 3)` in one unit, std `(J, 3)` in the same: the deviations of the train windows (their
    mean cancels).
    """
    off = (predicted - truth) / std
    return cast("Any", ((off * off).sum((-2, -1)) ** 0.5).mean())


def npss(predicted: Array, truth: Array) -> Array:
    """NPSS (Gopalakrishnan et al. 2019) of sequences `(N, T, D)`: one average over the whole set.

        X = Re FFT over time, P = X^2 / sum X^2, EMD = sum over f |cumsum P_hat - cumsum P|,
        NPSS = sum EMD w / sum w over sequences and dims, w the truth's total power

    A dimension that is zero throughout has no spectrum: it weighs nothing in the truth, and counts as
    an empty spectrum in a prediction (the published code divides zero by zero there).
    """
    xp = namespace(truth)
    power_hat, power = (xp.real(xp.fft.fft(x, axis=1)) ** 2 for x in (predicted, truth))
    weight = power.sum(1)
    emd = abs(_cdf(power_hat) - _cdf(power)).sum(1)
    return (emd * weight).sum() / weight.sum()


def _cdf(power: Array) -> Array:
    xp, total = namespace(power), power.sum(1)[:, None]
    share = xp.where(total > 0, power / xp.where(total > 0, total, xp.ones_like(total)), total)
    return xp.cumulative_sum(share, axis=1)


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


def physics(pos: Array, feet: Sequence[int], fps: float = 30.0) -> Physics:
    """Skeleton2Humanoid's FP, FQ, JQ and SM of joint positions `(N, T, J, 3)` m, ground at z = 0.

    The paper gives no formulas. Read from its figures: heights are those of joint centres, FP and FQ run
    over the four foot joints (ankles and toes), JQ over all joints, each a mean over all samples.
    """
    fp, fq = s2h_foot_penetration(pos[..., list(feet), 2])
    _, jq = s2h_foot_penetration(pos[..., 2])
    sm = smoothness(pos, fps)
    return Physics(*(float(x.mean()) for x in (fp, fq, jq, sm)))
