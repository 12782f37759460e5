"""Rotations against SciPy, their own identities and hand-computed cases."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from poise.motion import rotations as spatial

ORDERS = ["".join(p) for p in itertools.permutations("XYZ")]
DTYPES = [(torch.float64, 1e-12), (torch.float32, 2e-6)]
SHAPES = [(), (5,), (2, 3), (0,)]


def quats(*shape: int, dtype: torch.dtype = torch.float64, seed: int = 0) -> torch.Tensor:
    q = torch.randn(*shape, 4, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return spatial.normalize(q).to(dtype)


def vectors(*shape: int, dtype: torch.dtype = torch.float64, seed: int = 1) -> torch.Tensor:
    return torch.randn(*shape, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).to(
        dtype
    )


def scipy_of(q: torch.Tensor) -> Rotation:
    return Rotation.from_quat(q.double().numpy(), scalar_first=True)


def same_rotation(a: torch.Tensor, b: torch.Tensor, tol: float) -> None:
    assert a.shape == b.shape and a.dtype == b.dtype
    sign = torch.where((a * b).sum(-1, keepdim=True) < 0, -1.0, 1.0)
    torch.testing.assert_close(a, b * sign.to(b.dtype), atol=tol, rtol=0)


@pytest.mark.parametrize(("dtype", "tol"), DTYPES)
def test_products_and_rotated_vectors_equal_scipy(dtype, tol):
    a, b, v = quats(200, dtype=dtype), quats(200, dtype=dtype, seed=2), vectors(200, dtype=dtype)
    both = (scipy_of(a) * scipy_of(b)).as_quat(scalar_first=True)
    same_rotation(spatial.quat_mul(a, b), torch.tensor(both).to(dtype), tol)
    ours, theirs = spatial.quat_rotate(a, v), scipy_of(a).apply(v.double().numpy())
    np.testing.assert_allclose(ours.numpy(), theirs, atol=10 * tol)
    np.testing.assert_allclose(
        spatial.quat_rotate_inv(a, v).numpy(), scipy_of(a).inv().apply(v.double().numpy()), atol=10 * tol
    )
    np.testing.assert_allclose(spatial.quat_to_matrix(a).numpy(), scipy_of(a).as_matrix(), atol=10 * tol)
    np.testing.assert_allclose(
        spatial.quat_angle(a).numpy(), scipy_of(a).magnitude(), atol=10 * tol, rtol=1e-6
    )


@pytest.mark.parametrize("shape", SHAPES)
def test_any_leading_dimensions(shape):
    q, v = quats(*shape), vectors(*shape)
    assert spatial.quat_rotate(q, v).shape == (*shape, 3)
    assert spatial.quat_to_matrix(q).shape == (*shape, 3, 3)
    assert spatial.quat_to_sixd(q).shape == (*shape, 6)
    assert spatial.quat_angle(q).shape == shape
    same_rotation(spatial.matrix_to_quat(spatial.quat_to_matrix(q)), q, 1e-12)
    same_rotation(spatial.rotvec_to_quat(spatial.quat_to_rotvec(q)), q, 1e-12)
    for order in ORDERS:
        same_rotation(spatial.euler_to_quat(spatial.quat_to_euler(q, order), order), q, 1e-12)
    same_rotation(spatial.slerp(q, q, torch.zeros(shape, dtype=q.dtype)), q, 1e-12)
    assert spatial.heading_quat(q).shape == q.shape


@pytest.mark.parametrize(("dtype", "tol"), DTYPES)
@pytest.mark.parametrize("order", ORDERS)
def test_euler_angles_equal_scipys_intrinsic_ones(order, dtype, tol):
    q = quats(500, dtype=dtype)
    angles = spatial.quat_to_euler(q, order)
    np.testing.assert_allclose(angles.numpy(), scipy_of(q).as_euler(order), atol=2e4 * tol)
    assert angles[:, 1].abs().max() <= math.pi / 2 + 1e-6
    same_rotation(spatial.euler_to_quat(angles, order), q, 20 * tol)
    twin = Rotation.from_euler(order, angles.double().numpy()).as_quat(scalar_first=True)
    same_rotation(spatial.euler_to_quat(angles, order), torch.tensor(twin).to(dtype), 20 * tol)


angle = st.floats(-3.1, 3.1)


@settings(max_examples=150, deadline=None)
@given(st.tuples(angle, angle, angle), st.sampled_from(ORDERS))
def test_euler_round_trip_keeps_the_rotation(angles, order):
    q = spatial.euler_to_quat(torch.tensor(angles, dtype=torch.float64), order)
    back = spatial.euler_to_quat(spatial.quat_to_euler(q, order), order)
    same_rotation(back, q, 1e-7)


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_gimbal_lock_gives_the_whole_turn_to_the_first_angle(order, sign):
    angles = torch.tensor([[0.7, sign * math.pi / 2, -0.4]], dtype=torch.float64)
    q = spatial.euler_to_quat(angles, order)
    locked = spatial.quat_to_euler(q, order)
    assert float(locked[0, 2]) == 0.0
    assert abs(float(locked[0, 1])) == pytest.approx(math.pi / 2, abs=1e-7)
    same_rotation(spatial.euler_to_quat(locked, order), q, 1e-7)


def test_euler_orders_of_one_two_and_no_letters():
    q = spatial.euler_to_quat(torch.tensor([math.pi / 2]), "Z")
    x, y, z = torch.eye(3)
    torch.testing.assert_close(spatial.quat_rotate(q, x), y)
    # "ZX" is Rz Rx: x first, then z. The vector y goes to z by Rx, where Rz leaves it.
    q = spatial.euler_to_quat(torch.tensor([math.pi / 2, math.pi / 2]), "ZX")
    torch.testing.assert_close(spatial.quat_rotate(q, y), z)
    assert spatial.euler_to_quat(torch.zeros(3, 0), "").tolist() == [[1.0, 0, 0, 0]] * 3
    with pytest.raises(ValueError, match="three different axes"):
        spatial.quat_to_euler(q, "XYX")


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_matrix_to_quat_at_half_turns(axis):
    # The trace is -1 there: a single-pivot formula would divide by zero.
    m = -torch.eye(3, dtype=torch.float64)
    m[axis, axis] = 1.0
    expected = torch.zeros(4, dtype=torch.float64)
    expected[1 + axis] = 1.0
    same_rotation(spatial.matrix_to_quat(m), expected, 1e-12)


@pytest.mark.parametrize(("dtype", "tol"), DTYPES)
def test_exp_and_log_equal_scipy(dtype, tol):
    v = vectors(300, dtype=dtype)
    twin = Rotation.from_rotvec(v.double().numpy()).as_quat(scalar_first=True)
    same_rotation(spatial.rotvec_to_quat(v), torch.tensor(twin).to(dtype), 10 * tol)
    q = quats(300, dtype=dtype)
    np.testing.assert_allclose(spatial.quat_to_rotvec(q).numpy(), scipy_of(q).as_rotvec(), atol=50 * tol)


@pytest.mark.parametrize("size", [0.0, 1e-12, 1e-9, 1e-7, 1e-6, 1e-3, math.pi - 1e-6])
def test_log_inverts_exp_at_every_size(size):
    v = spatial.normalize(vectors(20)) * size
    back = spatial.quat_to_rotvec(spatial.rotvec_to_quat(v))
    torch.testing.assert_close(back, v, atol=1e-13, rtol=1e-9)


def test_exp_has_finite_gradients_at_zero():
    v = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    spatial.rotvec_to_quat(v)[1:].sum().backward()
    assert v.grad is not None
    torch.testing.assert_close(v.grad, torch.full((3,), 0.5, dtype=torch.float64))


def test_slerp_equals_scipy_and_takes_the_short_way():
    a, b = quats(50), quats(50, seed=4)
    for t in (0.0, 0.25, 0.5, 1.0):
        ours = spatial.slerp(a, b, torch.full((50,), t, dtype=torch.float64))
        twin = [
            Slerp([0, 1], Rotation.concatenate([scipy_of(x), scipy_of(y)]))(t).as_quat(scalar_first=True)
            for x, y in zip(a, b, strict=True)
        ]
        same_rotation(ours, torch.tensor(np.array(twin)), 1e-9)
        same_rotation(spatial.slerp(a, -b, torch.full((50,), t, dtype=torch.float64)), ours, 1e-12)


@pytest.mark.parametrize("gap", [0.0, 1e-9, 1e-7, 1e-5])
def test_slerp_of_near_neighbours_stays_unit_and_between(gap):
    a = quats(10)
    b = spatial.quat_mul(a, spatial.rotvec_to_quat(torch.tensor([[gap, 0.0, 0.0]], dtype=torch.float64)))
    mid = spatial.slerp(a, b, torch.full((10,), 0.5, dtype=torch.float64))
    torch.testing.assert_close(mid.norm(dim=-1), torch.ones(10, dtype=torch.float64))
    half = spatial.quat_mul(
        a, spatial.rotvec_to_quat(torch.tensor([[gap / 2, 0.0, 0.0]], dtype=torch.float64))
    )
    same_rotation(mid, half, 1e-12)


@pytest.mark.parametrize("left", [(0.0, 1.0, 0.0), (0.6, 0.7, 0.2)])
def test_the_lateral_heading_is_steady_upside_down(left):
    axis = torch.tensor(left, dtype=torch.float64)
    axis = axis / axis.norm()
    flat = torch.tensor([axis[0], axis[1], 0.0]).double() / axis[:2].norm()
    turn = spatial.axis_angle_to_quat
    up = torch.tensor([0.0, 0, 1]).double()
    pure = turn(up, torch.tensor(0.7).double())
    angles = torch.linspace(0, 2 * math.pi, 37).double()
    # A somersault about the level axis leaves it where it is.
    over = turn(flat.expand(37, 3), angles)
    level = spatial.lateral_heading(spatial.quat_mul(pure.expand(37, 4), over), flat)
    same_rotation(level, pure.expand(37, 4), 1e-9)
    # Upright both headings are the same, and a turn of the world turns it by as much.
    same_rotation(spatial.lateral_heading(pure[None], axis), pure[None], 1e-12)
    more = turn(up, torch.tensor(2.0).double())[None].expand(37, 4)
    again = spatial.lateral_heading(spatial.quat_mul(more, over), axis)
    same_rotation(again, spatial.quat_mul(more, spatial.lateral_heading(over, axis)), 1e-9)
    assert spatial.lateral_heading(over, torch.tensor([0.0, 0.0, 1.0]).double()).isfinite().all()


@settings(max_examples=100, deadline=None)
@given(st.floats(-3.0, 3.0), st.floats(-1.5, 1.5))
def test_heading_is_the_turn_about_z(yaw, tilt):
    z = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    y = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    pure = spatial.axis_angle_to_quat(z, torch.tensor(yaw, dtype=torch.float64))
    lean = spatial.axis_angle_to_quat(y, torch.tensor(tilt, dtype=torch.float64))
    same_rotation(spatial.heading_quat(spatial.quat_mul(pure, lean)), pure, 1e-12)
    # A turn of the world turns the heading by as much.
    q, more = quats(1, seed=9)[0], pure
    turned = spatial.heading_quat(spatial.quat_mul(more, q))
    same_rotation(turned, spatial.quat_mul(more, spatial.heading_quat(q)), 1e-10)


def test_heading_of_an_upside_down_root_is_defined():
    flipped = torch.tensor([0.0, 1.0, 0.0, 0.0])
    assert spatial.heading_quat(flipped).tolist() == [1.0, 0.0, 0.0, 0.0]


def test_sixd_is_the_first_two_columns():
    q = quats(4)
    m = spatial.quat_to_matrix(q)
    columns = torch.cat((m[:, :, 0], m[:, :, 1]), -1)
    torch.testing.assert_close(spatial.quat_to_sixd(q), columns, atol=1e-12, rtol=0)


def test_the_short_ways_equal_the_long_ones():
    a, b, v = quats(50), quats(50, seed=3), vectors(50, 7)
    apart = spatial.quat_angle(spatial.quat_mul(a, spatial.quat_conj(b)))
    torch.testing.assert_close(spatial.quat_distance(a, b), apart)
    torch.testing.assert_close(spatial.quat_distance(a, -b), apart)
    assert not spatial.quat_distance(a.float(), -a.float()).any()
    near = spatial.quat_mul(a, spatial.rotvec_to_quat(torch.tensor([1e-5, 0, 0]).double())).float()
    assert float(spatial.quat_distance(a.float(), near).max()) < 2e-5
    between = spatial.quat_mul(spatial.quat_conj(a), b)
    torch.testing.assert_close(spatial.quat_between(a, b), between)
    heading = spatial.heading_quat(a)
    turned = spatial.quat_rotate_inv(heading[:, None].expand(50, 7, 4), v)
    torch.testing.assert_close(spatial.into_heading(heading, v), turned)


def test_unwrap_flips_signs_only():
    angles = torch.linspace(0, 20, 200, dtype=torch.float64)
    z = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand(200, 3)
    q = spatial.axis_angle_to_quat(z, angles)
    signs = torch.where(torch.rand(200, generator=torch.Generator().manual_seed(0)) < 0.5, -1.0, 1.0)
    signs[0] = 1.0
    torch.testing.assert_close(spatial.unwrap_quats(q * signs[:, None].double()), q)


def test_normalize_leaves_zero():
    assert spatial.normalize(torch.zeros(2, 3)).tolist() == [[0, 0, 0], [0, 0, 0]]


def test_the_best_rotation_is_the_one_that_was_applied():
    rng = torch.Generator().manual_seed(3)
    turns = spatial.quat_to_matrix(
        spatial.normalize(torch.randn(5, 4, dtype=torch.float64, generator=rng))
    )
    points = torch.randn(4, 3, dtype=torch.float64, generator=rng)
    for cloud in (points, points * torch.tensor([1.0, 1.0, 0.0])):
        moved = cloud @ turns.mT
        found, values = spatial.best_rotation(moved.mT @ cloud)
        torch.testing.assert_close(found, turns)
        # tr(R^T M) is the sum of the values, and that of the squares of the points.
        torch.testing.assert_close(values.sum(-1), cloud.square().sum().expand(5))
    # A mirror image is no rotation.
    found, values = spatial.best_rotation(-torch.eye(3, dtype=torch.float64))
    torch.testing.assert_close(torch.linalg.det(found), torch.ones((), dtype=torch.float64))
    torch.testing.assert_close(values.sum(), torch.tensor(1.0, dtype=torch.float64))
