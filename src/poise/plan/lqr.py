"""Feedback along given motions: the linear-quadratic regulator of every step, many motions at once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from poise.errors import PoiseError


@dataclass(frozen=True, eq=False)
class Regulator:
    """What to do at each of F rows when the state is off by d: change the action by k + K d.

    From a row on d^T P d / 2 + p^T d more is to pay than with d = 0 and no change.

    Attributes:
        feedback: `(F, m, n)` float32, K; zero in last rows.
        forward: `(F, m)` float32, k; zero in last rows.
        value: `(F, n, n)` float32, P.
        slope: `(F, n)` float64, p.
    """

    feedback: np.ndarray
    forward: np.ndarray
    value: np.ndarray
    slope: np.ndarray


def regulate(
    a: np.ndarray,
    b: np.ndarray,
    gap: np.ndarray,
    error: np.ndarray,
    effort: np.ndarray,
    state_price: np.ndarray,
    action_price: np.ndarray,
    lengths: np.ndarray,
    damping: np.ndarray | None = None,
) -> Regulator:
    """Solves the affine linear-quadratic problem of each motion backwards from its end.

        d[t + 1] = A d[t] + B c[t] + gap[t]
        min sum_t |error[t] + d[t]|^2_Q + |effort[t] + c[t]|^2_R + damping (|d[t]|^2_Q + |c[t]|^2_R)

    which is the backward pass of iLQR (Li and Todorov 2004) with the gaps of multiple shooting
    (Giftthaler et al. 2018), each over 2; damping keeps a step short where the linear model is poor.

    Args:
        a: `(F, n, n)`, how the next state depends on the state; last rows have none.
        b: `(F, n, m)`, how it depends on the action.
        gap: `(F, n)`, by how much a step misses the next row's state.
        error: `(F, n)`, of the rows' states.
        effort: `(F, m)`, of their actions.
        state_price: `(n)`, diagonal of Q.
        action_price: `(F, m)`, diagonal of R.
        lengths: `(C,)` rows of each motion; the motions follow one another.
        damping: `(F,)`, none by default.

    Raises:
        PoiseError: the lengths do not add up to the rows.
    """
    rows, n, m = b.shape
    if int(np.sum(lengths)) != rows:
        raise PoiseError(
            f"the motions have {int(np.sum(lengths))} rows, and {rows} are given", "regulate"
        )
    damping = np.zeros(rows) if damping is None else damping
    out = Regulator(
        np.zeros((rows, m, n), np.float32), np.zeros((rows, m), np.float32),
        np.zeros((rows, n, n), np.float32), np.zeros((rows, n)),
    )  # fmt: skip
    # Long motions first, so that the motions with a j-th row from the end are the first few.
    order = np.argsort(-lengths, kind="stable")
    size, start = lengths[order], (np.cumsum(lengths) - lengths)[order]
    last = start + size - 1
    value = np.tile(np.diag(state_price), (len(size), 1, 1))
    slope = error[last] * state_price
    out.value[last], out.slope[last] = value, slope
    own_n, own_m = np.arange(n), np.arange(m)
    for j in range(1, int(size.max())):
        here = int((size > j).sum())
        r = last[:here] - j
        at, bt, damp = a[r].astype(np.float64), b[r].astype(np.float64), 1.0 + damping[r, None]
        p_next, s_next = value[:here], slope[:here]
        price = action_price[r]
        ahead = s_next + np.einsum("cij,cj->ci", p_next, gap[r])
        pb = p_next @ bt
        quu, qux = bt.transpose(0, 2, 1) @ pb, pb.transpose(0, 2, 1) @ at
        quu[:, own_m, own_m] += price * damp + 1e-3
        qu = price * effort[r] + np.einsum("cji,cj->ci", bt, ahead)
        both = np.linalg.solve(quu, np.concatenate((qux, qu[:, :, None]), 2))
        feed, step = both[:, :, :n], both[:, :, n]
        out.feedback[r], out.forward[r] = -feed, -step
        new = at.transpose(0, 2, 1) @ (p_next @ at) - qux.transpose(0, 2, 1) @ feed
        new = 0.5 * (new + new.transpose(0, 2, 1))
        new[:, own_n, own_n] += state_price * damp
        slope[:here] = error[r] * state_price + np.einsum("cji,cj->ci", at, ahead)
        slope[:here] -= np.einsum("cji,cj->ci", qux, step)
        value[:here] = new
        out.value[r], out.slope[r] = value[:here], slope[:here]
    return out
