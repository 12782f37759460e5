"""Functions of both worlds: what they make of NumPy arrays they make of tensors, to the last digits."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

from poise.body import generate_table
from poise.kinematics.forward import Kinematics, centre_of_mass, lowest_height, shapes_of
from poise.metrics import (
    acceleration_error,
    ballistic,
    first_lasting,
    foot_contacts,
    foot_points,
    foot_slide,
    has_lost,
    help_audit,
    jerk,
    l2p,
    l2q,
    masked_mean,
    masked_quantile,
    mpjpe_global,
    mpjpe_pa,
    mpjpe_root,
    npss,
    penetration,
    success,
)
from poise.motion import rotations as r
from poise.motion.vectors import constant_like, cross, floored, like, limited, norm, sliding
from toy_human import human

RNG = np.random.default_rng(0)
Q, P = (r.normalize(RNG.normal(size=(12, 7, 4))) for _ in range(2))
V, W = (RNG.normal(size=(12, 7, 3)) for _ in range(2))
A, ONE = RNG.uniform(-3, 3, size=(12, 7)), np.array([0.0, 1.0, 0.0])
NEAR = V + 0.05 * W
LOW = 0.05 * RNG.normal(size=12)
PARENTS = (-1, 0, 1, 1, 0, 4, 5)
LONG = (-1, *range(400))
CALLS: dict[str, tuple[Callable[..., Any], tuple[Any, ...]]] = {
    "normalize": (r.normalize, (V,)),
    "quat_mul": (r.quat_mul, (Q, P)),
    "quat_conj": (r.quat_conj, (Q,)),
    "quat_between": (r.quat_between, (Q, P)),
    "quat_rotate": (r.quat_rotate, (Q, V)),
    "quat_rotate of one": (r.quat_rotate, (Q, ONE)),
    "quat_rotate_inv": (r.quat_rotate_inv, (Q, V)),
    "quat_angle": (r.quat_angle, (Q,)),
    "quat_distance": (r.quat_distance, (Q, P)),
    "axis_angle_to_quat": (r.axis_angle_to_quat, (ONE, A)),
    "rotvec_to_quat": (r.rotvec_to_quat, (np.concatenate((V, 0 * V)),)),
    "quat_to_rotvec": (r.quat_to_rotvec, (Q,)),
    "quat_to_matrix": (r.quat_to_matrix, (Q,)),
    "matrix_to_quat": (r.matrix_to_quat, (r.quat_to_matrix(Q),)),
    "euler_to_quat": (lambda a: r.euler_to_quat(a, "ZXY"), (V,)),
    "quat_to_euler": (lambda q: r.quat_to_euler(q, "YZX"), (Q,)),
    "slerp": (r.slerp, (Q, P, 0.1 + 0.0 * A)),
    "heading_quat": (r.heading_quat, (Q,)),
    "axis_heading": (r.axis_heading, (Q, ONE)),
    "lateral_heading": (r.lateral_heading, (Q, ONE)),
    "into_heading": (r.into_heading, (r.heading_quat(Q[:, 0]), V)),
    "quat_to_sixd": (r.quat_to_sixd, (Q,)),
    "sixd_to_matrix": (r.sixd_to_matrix, (r.quat_to_sixd(Q) + 0.1,)),
    "unwrap_quats": (r.unwrap_quats, (Q,)),
    "across": (r.across, (V,)),
    "rejected": (r.rejected, (V, ONE)),
    "shortest_arc": (r.shortest_arc, (V, W)),
    "shortest_arc of opposites": (r.shortest_arc, (V, -V)),
    "frame_quat": (r.frame_quat, (V, W)),
    "cluster_quat": (r.cluster_quat, (V[0], W, np.arange(1.0, 8.0))),
    "best_rotation": (lambda m: r.best_rotation(m)[0], (RNG.normal(size=(5, 3, 3)),)),
    "turned": (lambda q: r.turned(q, 0.3, q[0, :2], q[1, :2]), (RNG.normal(size=(4, 9)),)),
    "facing": (lambda q: r.facing(q, 0.4), (np.concatenate((V[0, 0], Q[0, 0])),)),
    "yaw_quat": (r.yaw_quat, (A,)),
    "heading_angle": (r.heading_angle, (Q,)),
    "ahead_angle": (r.ahead_angle, (Q[0, 0],)),
    "forward_kinematics": (lambda *a: r.forward_kinematics(PARENTS, *a)[0], (V[0], W[:, 0], Q)),
    "a long chain": (
        lambda *a: r.forward_kinematics(LONG, *a)[0],
        (RNG.normal(size=(401, 3)), V[:1, 0], r.normalize(RNG.normal(size=(1, 401, 4)))),
    ),
    "matrix_kinematics": (
        lambda *a: r.matrix_kinematics(PARENTS, *a)[0],
        (V[0], W[:, 0], r.quat_to_matrix(Q)),
    ),
    "mpjpe_global": (mpjpe_global, (V, NEAR)),
    "mpjpe_root": (mpjpe_root, (V, NEAR)),
    "mpjpe_pa": (mpjpe_pa, (V, NEAR)),
    "has_lost": (has_lost, (V, W)),
    "acceleration_error": (acceleration_error, (V, NEAR)),
    "success": (lambda p, q: success(p[None], q[None], p[None, :, 0, 0].argmax(-1) * 0 + 9)[1], (V, W)),
    "first_lasting": (lambda a: first_lasting(a > 0, 4.0), (np.sin(np.arange(40.0))[None],)),
    "masked_mean": (lambda a: masked_mean(a, a > 0, -1), (A,)),
    "masked_quantile": (lambda a: masked_quantile(a, 0.3, a > 0), (A,)),
    "jerk": (lambda v: jerk(v, 30.0), (V,)),
    "foot_contacts": (lambda v: foot_contacts(v, 30.0)[1], (0.004 * V,)),
    "foot_slide": (lambda v: foot_slide(v, 30.0), (0.004 * V,)),
    "penetration": (lambda h: penetration(h)[0], (LOW,)),
    "ballistic": (lambda h: ballistic(h, 30.0), (1.0 + 3 * np.arange(0, 0.4, 1 / 30) ** 2 * -1.6,)),
    "help_audit": (lambda f: help_audit(f, 2 * f, f, f, 60.0).work_j_per_s, (V,)),
    "l2q": (l2q, (Q, P)),
    "l2p": (lambda a, b, s: l2p(a[None], b[None], abs(s)), (V, W, V[0])),
    "npss": (lambda a, b: npss(a, b), (V, W)),
    "norm": (norm, (V,)),
    "cross": (cross, (V, ONE)),
    "floored": (lambda v: floored(v, 0.2), (V,)),
    "limited": (lambda v: limited(v, -0.2, 0.3), (V,)),
    "sliding": (lambda v: sliding(v, 3), (A,)),
    "like": (lambda v: like(((1, 2, 3),), v), (V,)),
    "constant_like": (lambda v: constant_like((1, 0, 2), v), (V,)),
}


@pytest.mark.parametrize("name", CALLS)
def test_arrays_and_tensors_agree(name: str) -> None:
    call, given = CALLS[name]
    ours, theirs = call(*given), call(*(torch.tensor(x) for x in given))
    assert not isinstance(ours, torch.Tensor)
    if isinstance(theirs, torch.Tensor):
        assert tuple(theirs.shape) == np.shape(ours)
        assert str(theirs.dtype).rpartition(".")[2] == str(np.asarray(ours).dtype)
        theirs = theirs.numpy()
    np.testing.assert_allclose(ours, theirs, rtol=1e-12, atol=1e-12)


def test_bodies_are_posed_alike() -> None:
    table = generate_table(human())
    kinematics, single = Kinematics(table), Kinematics(table, "float32")
    qpos, qvel = RNG.normal(size=(5, 7 + kinematics.hinges)), RNG.normal(size=(5, 6 + kinematics.hinges))
    qpos[:, 3:7] = r.normalize(qpos[:, 3:7])
    here, there = kinematics(qpos, qvel), kinematics(torch.tensor(qpos), torch.tensor(qvel))
    for a, b in zip(here, there, strict=True):
        np.testing.assert_allclose(a, b.numpy(), atol=1e-12)
    for of in (kinematics, single):
        np.testing.assert_allclose(of.local_quats(qpos), of.local_quats(torch.tensor(qpos)), atol=1e-6)
    shapes, feet = shapes_of(table), [i for i, row in enumerate(table.rows) if row.kind == "foot"]
    for what in (
        lambda p, q: lowest_height(table, p, q),
        lambda p, q: centre_of_mass(table, p, q),
        lambda p, q: foot_points(p, q, shapes, feet),
    ):
        np.testing.assert_allclose(what(*here[:2]), what(*there[:2]).numpy(), atol=1e-12)


def test_a_constant_is_made_once_and_cannot_be_written_on() -> None:
    rows = (1.0, 2.0)
    one = constant_like(rows, V)
    assert constant_like(rows, W) is one and constant_like((1.0, 3.0), V) is not one
    with pytest.raises(ValueError, match="read-only"):
        one[0] = 0.0
