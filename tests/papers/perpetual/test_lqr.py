"""The regulator against the same quadratic problem solved at once as linear equations."""

from __future__ import annotations

import numpy as np
import pytest

from poise.papers.perpetual.lqr import Regulator, regulate
from refusals import refused

N, M = 4, 2


def problem(lengths: tuple[int, ...], seed: int = 0) -> dict[str, np.ndarray]:
    rng, rows = np.random.default_rng(seed), sum(lengths)
    draw = {
        "a": np.eye(N) + 0.2 * rng.normal(size=(rows, N, N)), "b": rng.normal(size=(rows, N, M)),
        "gap": 0.3 * rng.normal(size=(rows, N)), "error": rng.normal(size=(rows, N)),
        "effort": rng.normal(size=(rows, M)),
    }  # fmt: skip
    prices = {"state_price": rng.uniform(0.5, 2, N), "action_price": rng.uniform(0.5, 2, (rows, M))}
    return draw | prices | {"lengths": np.array(lengths)}


def rolled(p: dict[str, np.ndarray], gains: Regulator, first: int, length: int, d: np.ndarray) -> float:
    """What acting by the regulator costs from a deviation `d` of the first row."""
    cost = 0.0
    for t in range(first, first + length):
        error = p["error"][t] + d
        cost += 0.5 * float(error @ (p["state_price"] * error))
        if t < first + length - 1:
            change = gains.forward[t] + gains.feedback[t] @ d
            effort = p["effort"][t] + change
            cost += 0.5 * float(effort @ (p["action_price"][t] * effort))
            d = p["a"][t] @ d + p["b"][t] @ change + p["gap"][t]
    return cost


def solved(p: dict[str, np.ndarray], first: int, length: int, d: np.ndarray) -> float:
    """The least cost of all changes, from the normal equations of the whole motion."""
    steps = length - 1
    free, rule = [d], [np.zeros((N, steps * M))]
    for t in range(steps):
        row, own = first + t, np.zeros((N, steps * M))
        own[:, t * M : (t + 1) * M] = p["b"][row]
        free.append(p["a"][row] @ free[-1] + p["gap"][row])
        rule.append(p["a"][row] @ rule[-1] + own)
    root = np.sqrt(p["state_price"])[:, None]
    parts = [
        (root * r, root[:, 0] * (p["error"][first + t] + f))
        for t, (r, f) in enumerate(zip(rule, free, strict=True))
    ]
    price = np.sqrt(p["action_price"][first : first + steps].ravel())
    left = np.concatenate([r for r, _ in parts] + [np.diag(price)])
    right = np.concatenate([e for _, e in parts] + [price * p["effort"][first : first + steps].ravel()])
    change = np.linalg.lstsq(left, -right, rcond=None)[0]
    return 0.5 * float(np.sum((left @ change + right) ** 2))


def test_no_changes_cost_less() -> None:
    p = problem((6, 3, 9))
    gains = regulate(**p)
    first = 0
    for length in p["lengths"]:
        for d in (np.zeros(N), np.array([1.0, -0.5, 0.2, 0.8])):
            assert rolled(p, gains, first, length, d) == pytest.approx(
                solved(p, first, length, d), rel=2e-3
            )
        first += length


def test_the_value_says_what_a_deviation_costs() -> None:
    p = problem((7,))
    gains, d = regulate(**p), np.array([0.5, 1.0, -0.3, 0.1])
    more = rolled(p, gains, 0, 7, d) - rolled(p, gains, 0, 7, np.zeros(N))
    assert 0.5 * d @ gains.value[0] @ d + gains.slope[0] @ d == pytest.approx(more, rel=5e-3)


def test_motions_do_not_see_each_other() -> None:
    both, one = regulate(**problem((5, 8))), problem((5, 8))
    alone = {k: v[:5] if k != "state_price" else v for k, v in one.items()} | {"lengths": np.array([5])}
    np.testing.assert_allclose(both.feedback[:5], regulate(**alone).feedback, atol=1e-6)
    assert not both.feedback[[4, 12]].any() and not both.forward[[4, 12]].any()


def test_damping_shortens_the_step() -> None:
    p = problem((8,))
    size = [np.abs(regulate(**p, damping=np.full(8, x)).forward[:-1]).mean() for x in (0.0, 1.0, 30.0)]
    assert size[0] > size[1] > size[2]


def test_lengths_must_fit() -> None:
    p = problem((5,)) | {"lengths": np.array([4])}
    with refused("count-differs", says=("4", "5")):
        regulate(**p)
