"""The smoothest path through two candidates per frame, for many joints at once and without a loop."""

from __future__ import annotations

import numpy as np


def best_path(price: np.ndarray, pull: np.ndarray) -> np.ndarray:
    """The cheaper of two candidates in every frame `(T, R)`, over the whole sequence.

    Args:
        price: `(T - 1, R, 2, 2)`, what the step from candidate i to candidate j costs.
        pull: `(T, R, 2)`, what a candidate costs by itself.

    The sequence of least sum is the shortest path of Viterbi's algorithm. Its costs are products of
    2 x 2 matrices in the algebra of minimum and sum, which is associative, so prefixes and suffixes of
    all frames come in log2(T) passes; a frame takes the candidate through which the best path leads.
    """
    if len(pull) == 1:
        return pull.argmin(-1)
    steps = price + pull[1:, :, None, :]
    first = pull[:1, :, :, None] + np.array([[0.0, np.inf], [np.inf, 0.0]])
    come = _prefix(np.concatenate((first, steps))).min(-2)
    # Suffixes are prefixes of the reversed, transposed steps.
    back = np.swapaxes(steps[::-1], -1, -2)
    go = np.concatenate((_prefix(back).min(-2)[::-1], np.zeros_like(pull[:1])))
    return (come + go).argmin(-1)


def _prefix(m: np.ndarray) -> np.ndarray:
    """All prefix products `(T, R, 2, 2)` in the algebra of minimum and sum (Hillis and Steele 1986)."""
    out, reach = m.copy(), 1
    while reach < len(out):
        a, b = out[:-reach], out[reach:]
        # (a b)_ij = min_k a_ik + b_kj
        joined = np.minimum(
            a[..., :, :1] + b[..., :1, :],
            a[..., :, 1:] + b[..., 1:, :],
        )
        out = np.concatenate((out[:reach], joined))
        reach *= 2
    return out


def wrapped(angle: np.ndarray) -> np.ndarray:
    """Angles (rad) brought into [-pi, pi)."""
    return np.remainder(angle + np.pi, 2 * np.pi) - np.pi


def euler_path(first: np.ndarray, prefer: np.ndarray | None = None) -> np.ndarray:
    """Euler angles `(T, R, 3)` on the smoothest sequence through their two branches, not unwrapped.

    The branches (a, b, c) and (a + pi, pi - b, c + pi) are the same rotation. A slight pull toward
    `prefer (R, 3)` (default 0) breaks ties and chooses the branch of a still clip.
    """
    shift = np.array([np.pi, 0.0, np.pi])
    second = first * np.array([1.0, -1.0, 1.0]) + shift + np.array([0.0, np.pi, 0.0])
    both = np.stack((first, second), -2)  # (T, R, 2, 3)
    step = wrapped(both[1:, :, None, :, :] - both[:-1, :, :, None, :])
    home = wrapped(both - (0.0 if prefer is None else prefer[:, None, :]))
    pick = best_path((step**2).sum(-1), 1e-4 * (home**2).sum(-1))
    return np.take_along_axis(both, pick[..., None, None], -2)[..., 0, :]
