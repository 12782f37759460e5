"""The best of two candidates per frame: as good as brute force, for many joints at once."""

from __future__ import annotations

import itertools

import numpy as np

from poise.kinematics.coords import best_path, euler_path, wrapped


def test_the_path_is_that_of_brute_force_for_every_joint():
    rng = np.random.default_rng(0)
    for frames in (1, 2, 3, 7, 8):
        price, pull = rng.random((frames - 1, 5, 2, 2)), rng.random((frames, 5, 2))
        got = best_path(price, pull)
        assert got.shape == (frames, 5)
        for r in range(5):

            def cost(path, price=price[:, r], pull=pull[:, r]):
                own = sum(pull[t, s] for t, s in enumerate(path))
                return own + sum(price[t, a, b] for t, (a, b) in enumerate(itertools.pairwise(path)))

            best = min(itertools.product((0, 1), repeat=frames), key=cost)
            assert tuple(got[:, r]) == best


def test_joints_do_not_touch_each_other():
    angles = np.random.default_rng(1).normal(size=(50, 4, 3))
    together = euler_path(angles)
    apart = np.concatenate([euler_path(angles[:, [r]]) for r in range(4)], 1)
    np.testing.assert_array_equal(together, apart)


def test_wrapped_angles():
    np.testing.assert_allclose(
        wrapped(np.array([0.0, 4.0, -4.0, 20.0])), [0, 4 - 2 * np.pi, 2 * np.pi - 4, 20 - 6 * np.pi]
    )
