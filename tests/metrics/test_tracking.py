"""Tracking errors against hand-computed values, naive loops and invariances."""

from __future__ import annotations

import math
from itertools import pairwise

import pytest
import torch

from poise.metrics import (
    RULES,
    SuccessRule,
    acceleration_error,
    mpjpe_global,
    mpjpe_pa,
    mpjpe_root,
    success,
    velocity_error,
)
from poise.motion.rotations import normalize, quat_rotate
from refusals import refused

SHAPES = [(4, 2), (7, 5), (3, 6, 4), (2, 3, 5, 3)]
DTYPES = [torch.float32, torch.float64]


def pair(shape, dtype=torch.float64, seed=0):
    g = torch.Generator().manual_seed(seed)
    pos = torch.randn(*shape, 3, generator=g, dtype=torch.float64)
    return pos.to(dtype), (pos + 0.1 * torch.randn(*shape, 3, generator=g, dtype=torch.float64)).to(
        dtype
    )


def rigid(x, scale=1.0, seed=3):
    g = torch.Generator().manual_seed(seed)
    q = normalize(torch.randn(4, generator=g, dtype=torch.float64)).to(x.dtype)
    t = torch.randn(3, generator=g, dtype=torch.float64).to(x.dtype)
    return scale * quat_rotate(q.expand(*x.shape[:-1], 4), x) + t


def test_hand_computed():
    ref = torch.zeros(3, 2, 3)
    pos = ref.clone()
    pos[0, 1, 0] = 0.03  # one of two bodies is 30 mm off in frame 0
    pos[1] += torch.tensor([0.0, 0.04, 0.03])  # both are 50 mm off in frame 1
    assert torch.allclose(mpjpe_global(pos, ref), torch.tensor([15.0, 50.0, 0.0]))
    assert torch.allclose(mpjpe_root(pos, ref), torch.tensor([15.0, 0.0, 0.0]), atol=1e-5)
    # body 0 steps by 50 and back by 50; body 1 by |(-30, 40, 30)| = 58.3095 and back by 50
    step = math.sqrt(30**2 + 40**2 + 30**2)
    assert torch.allclose(velocity_error(pos, ref), torch.tensor([(50 + step) / 2, 50.0]))
    second = math.sqrt(30**2 + 80**2 + 60**2)  # (30,0,0) - 2 (0,40,30) + 0
    assert torch.allclose(acceleration_error(pos, ref), torch.tensor([(100 + second) / 2]))


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("shape", SHAPES)
def test_naive_twins(shape, dtype):
    pos, ref = pair(shape, dtype)
    frames, bodies = shape[-2:]
    flat, flat_ref = pos.reshape(-1, frames, bodies, 3), ref.reshape(-1, frames, bodies, 3)

    def loop(order, rooted=False):
        out = []
        for p, r in zip(flat.tolist(), flat_ref.tolist(), strict=True):
            for t in range(frames - order):
                total = 0.0
                for b in range(bodies):
                    d = [[p[t + k][b][i] - r[t + k][b][i] for i in range(3)] for k in range(order + 1)]
                    if rooted:
                        d = [[p[t][b][i] - p[t][0][i] - r[t][b][i] + r[t][0][i] for i in range(3)]]
                    while len(d) > 1:
                        d = [[y - x for x, y in zip(u, v, strict=True)] for u, v in pairwise(d)]
                    total += math.sqrt(sum(x * x for x in d[0]))
                out.append(1000 * total / bodies)
        return torch.tensor(out, dtype=dtype).reshape(*shape[:-2], frames - order)

    close = {"rtol": 1e-4, "atol": 1e-3}
    assert torch.allclose(mpjpe_global(pos, ref), loop(0), **close)
    assert torch.allclose(mpjpe_root(pos, ref), loop(0, rooted=True), **close)
    assert torch.allclose(velocity_error(pos, ref), loop(1), **close)
    assert torch.allclose(acceleration_error(pos, ref), loop(2), **close)
    assert mpjpe_global(pos, ref).dtype == dtype and mpjpe_pa(pos, ref).dtype == dtype


@pytest.mark.parametrize(
    "error", [mpjpe_global, mpjpe_root, mpjpe_pa, velocity_error, acceleration_error]
)
def test_the_same_rigid_motion_changes_nothing(error):
    pos, ref = pair((2, 5, 6))
    assert torch.allclose(error(rigid(pos), rigid(ref)), error(pos, ref), atol=1e-9)
    assert torch.equal(error(pos, pos), torch.zeros_like(error(pos, pos))) or error is mpjpe_pa


def test_root_error_ignores_travel():
    pos, ref = pair((5, 6))
    travel = torch.randn(5, 1, 3, dtype=pos.dtype)
    assert torch.allclose(mpjpe_root(pos + travel, ref), mpjpe_root(pos, ref))


def test_procrustes_is_zero_under_similarity_but_not_under_reflection():
    ref, _ = pair((2, 5, 6))
    assert mpjpe_pa(rigid(ref, scale=1.7), ref).max() < 1e-9
    assert mpjpe_pa(ref * torch.tensor([1.0, 1.0, -1.0]), ref).min() > 1.0


def test_procrustes_minimises_the_squared_error():
    pos, ref = pair((1, 6))
    # The optimum satisfies the normal equation of the scale and beats small turns about it.
    best = mpjpe_pa(pos, ref)
    assert best < mpjpe_global(pos, ref) + 1e-9
    assert torch.allclose(mpjpe_pa(rigid(pos, 0.3), ref), best, atol=1e-9)


def test_other_rates_are_rescaled_to_30_hz():
    t30, t120 = torch.arange(31) / 30.0, torch.arange(121) / 120.0
    # p = 0.3 t^2 against 0: |v| grows to 0.6 m/s = 20 mm/frame, a = 0.6 m/s^2 = 2/3 mm/frame^2

    def path(t):
        out = torch.zeros(len(t), 1, 3, dtype=torch.float64)
        out[:, 0, 0] = 0.3 * t.double() ** 2
        return out

    for t, fps in ((t30, 30.0), (t120, 120.0)):
        pos = path(t)
        assert velocity_error(pos, pos * 0, fps).mean() == pytest.approx(10.0, abs=1e-3)
        assert acceleration_error(pos, pos * 0, fps).mean() == pytest.approx(0.6 / 900 * 1000, abs=1e-3)


def drifting(offset_at_frame):
    """Two episodes of 6 frames, 4 bodies; body 3 of episode 1 leaves its reference."""
    ref = torch.zeros(2, 6, 4, 3)
    ref[..., 2] = 1.0
    pos = ref.clone()
    for frame, offset in offset_at_frame.items():
        pos[1, frame, 3, 0] = offset
    return pos, ref, torch.tensor([6, 5])


@pytest.mark.parametrize(
    ("rule", "offset", "fails"),
    [
        ("phc", 1.9, False),  # the mean over 4 bodies is 0.475
        ("phc", 2.1, True),
        ("phc_strict", 0.5, False),  # the limit itself passes
        ("phc_strict", 0.51, True),
        ("any_25cm", 0.25, False),
        ("any_25cm", 0.26, True),
    ],
)
def test_distance_rules(rule, offset, fails):
    pos, ref, lengths = drifting({2: offset, 3: offset})
    won, first = success(pos, ref, lengths, rule)
    assert won.tolist() == [True, not fails]
    assert first.tolist() == [-1, 2 if fails else -1]


def test_frames_after_the_end_do_not_count_and_nan_fails():
    pos, ref, lengths = drifting({5: 9.0})
    assert success(pos, ref, lengths, "phc").success.tolist() == [True, True]
    pos, ref, lengths = drifting({1: math.nan})
    assert success(pos, ref, lengths, "phc").first_fail.tolist() == [-1, 1]
    assert success(pos, ref, torch.tensor([0, 5]), "phc").success.tolist() == [False, False]


def test_bodies_can_be_left_out():
    pos, ref, lengths = drifting({2: 9.0})
    assert success(pos, ref, lengths, "phc_strict", bodies=[0, 1, 2]).success.all()


def test_height_rules():
    ref = torch.zeros(1, 4, 2, 3)
    ref[0, :, 0, 2] = torch.tensor([1.0, 0.8, 1.2, 1.5])
    pos = ref.clone()
    pos[0, 2, 0, 2] = 0.71
    lengths = torch.tensor([4])
    assert success(pos, ref, lengths, "rfc_height").success.all()  # above 0.8 - 0.1
    assert success(pos, ref, lengths, "s2h_root").success.all()  # 0.49 below its frame's reference
    pos[0, 2, 0, 2] = 0.69
    assert success(pos, ref, lengths, "rfc_height").first_fail.tolist() == [2]
    assert success(pos, ref, lengths, "rfc_height", ref_min_height=torch.tensor([0.7])).success.all()
    assert success(pos, ref, lengths, "s2h_root").first_fail.tolist() == [2]


def test_success_equals_a_naive_loop():
    g = torch.Generator().manual_seed(5)
    ref = torch.randn(9, 12, 5, 3, generator=g)
    pos = ref + 0.25 * torch.randn(9, 12, 5, 3, generator=g)
    lengths = torch.randint(1, 13, (9,), generator=g)
    for rule in ("phc", "phc_strict", SuccessRule("own", "mean", 0.45, "test")):
        won, first = success(pos, ref, lengths, rule)
        chosen = RULES[rule] if isinstance(rule, str) else rule
        for e in range(9):
            want = -1
            for t in reversed(range(int(lengths[e]))):
                d = (pos[e, t] - ref[e, t]).norm(dim=-1)
                if (d.mean() if chosen.measure == "mean" else d.max()) > chosen.limit_m:
                    want = t
            assert int(first[e]) == want and bool(won[e]) == (want == -1)


def test_mistakes_are_told():
    pos = torch.zeros(3, 2, 3)
    with refused("wrong-shape", says=("3, 2, 3", "3, 1, 3")):
        mpjpe_global(pos, pos[:, :1])
    with refused("unknown-choice", says=("phk", "phc")):
        success(pos[None], pos[None], torch.tensor([3]), "phk")
    with refused("wrong-shape", says="lengths"):
        success(pos[None], pos[None], torch.tensor([3, 3]))
    with refused("rate-out-of-range"):
        velocity_error(pos, pos, 0.0)
