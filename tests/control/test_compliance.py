"""Compliance as mechanics: the law's stiffness, both laws against a naive twin, its way back."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch
from torch import Tensor

from poise.control.compliance import (
    PAPER_STEP_S,
    RANK,
    Compliance,
    Stiffness,
    columns,
    compliant_rate,
    moving,
    printed_velocity,
    room,
    settled,
    softening,
)
from poise.kinematics.coords import chain_quat
from poise.motion.rotations import quat_mul, quat_rotate, rotvec_to_quat
from poise.recipes import ResidualForce, build
from poise.sim import CpuBackend, Mechanics, SimConfig
from refusals import refused
from toy_human import swing

POSES = ((0.2, -0.3, 0.5, 0.7, -0.4), (-0.6, 0.4, 0.1, 1.3, 0.5), (0.9, 0.6, -0.8, 0.4, -0.9))
KP = (300.0, 400.0, 500.0, 350.0, 450.0)
AXES = ((0, 0, 1), (0, 1, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1))


def arm(rate_hz: float) -> mujoco.MjModel:
    """Five hinges on a fixed base: three at the shoulder, two at the elbow."""
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    spec.option.gravity = [0, 0, 0]
    parent, at = spec.worldbody, 0
    for name, hinges, pos in (("upper", 3, 0.0), ("lower", 2, 0.35)):
        parent = parent.add_body(name=name, pos=[pos, 0, 0])
        for _ in range(hinges):
            parent.add_joint(
                name=f"hinge {at}", type=mujoco.mjtJoint.mjJNT_HINGE, axis=list(AXES[at]),
                damping=[0.1 * KP[at], 0, 0], armature=0.02,
            )  # fmt: skip
            at += 1
        parent.add_geom(
            type=mujoco.mjtGeom.mjGEOM_CAPSULE, fromto=[0, 0, 0, 0.33, 0, 0], size=[0.04, 0, 0],
            mass=2.0, contype=0, conaffinity=0,
        )  # fmt: skip
    for k, kp in enumerate(KP):
        servo = spec.add_actuator(
            name=f"servo {k}", trntype=mujoco.mjtTrn.mjTRN_JOINT, target=f"hinge {k}",
            gaintype=mujoco.mjtGain.mjGAIN_FIXED, biastype=mujoco.mjtBias.mjBIAS_AFFINE,
        )  # fmt: skip
        servo.gainprm[0], servo.biasprm[1] = kp, -kp
    SimConfig(rate_hz=rate_hz, control_hz=rate_hz).apply(spec)
    return spec.compile()


class Pushed:
    """Worlds of the arm with a force at its tip, of which u is moved before each physics step."""

    def __init__(self, rate_hz: float, poses: Tensor, given: Compliance, level: Tensor):
        self.backend, self.h, self.given, self.level = (
            CpuBackend(arm(rate_hz), len(poses), 1), 1.0 / rate_hz, given, level,
        )  # fmt: skip
        self.mechanics, self.rest = Mechanics(self.backend), poses
        self.backend.write(None, poses, torch.zeros_like(poses))
        self.u, self.rate = torch.zeros_like(poses), torch.zeros_like(poses)
        self.ones = torch.ones(poses.shape[1], dtype=torch.float64)

    def tip(self) -> Tensor:
        state = self.backend.state
        reach = torch.tensor([0.33, 0.0, 0.0], dtype=torch.float64).expand(len(self.u), 3)
        return state.xpos[:, 2] + quat_rotate(state.xquat[:, 2], reach)

    def jacobian(self) -> Tensor:
        return self.mechanics.jacobian(2, self.tip())[0]

    def step(self, force: Tensor | None) -> None:
        drive, jac = self.backend.drive, self.jacobian()
        drive.qfrc_applied.zero_()
        drive.ctrl.copy_(self.rest + self.u)
        if force is None:
            self.u, self.rate = settled(self.u, self.rate, self.given.return_hz, self.h)
        else:
            push = (jac.transpose(1, 2) @ force.unsqueeze(-1)).squeeze(-1)
            if self.given.law == "eq8":
                velocity = (jac @ self.backend.state.qvel.unsqueeze(-1)).squeeze(-1)
            else:
                change = self.mechanics.step_map(push)
                velocity = printed_velocity(jac[:, None], change[:, None], self.h)[:, 0]
            self.rate = compliant_rate(
                jac[:, None], velocity[:, None], self.level, self.ones, self.given, self.ones
            )
            self.u = self.u + self.h * self.rate
            drive.qfrc_applied.copy_(push)
            drive.ctrl.copy_(self.rest + self.u)
        self.backend.step(1)


def hand(state: dict[str, np.ndarray], model: mujoco.MjModel, given: Compliance, force: np.ndarray,
         level: float, rank: float) -> np.ndarray:  # fmt: skip
    """u' of one world by plain NumPy and MuJoCo's own functions."""
    data = mujoco.MjData(model)
    data.qpos, data.qvel, data.ctrl = state["qpos"], state["qvel"], state["ctrl"]
    mujoco.mj_forward(model, data)
    tip = data.xpos[2] + data.xmat[2].reshape(3, 3) @ np.array([0.33, 0, 0])
    jac = np.zeros((3, model.nv))
    mujoco.mj_jac(model, data, jac, None, tip, 2)
    if given.law == "eq8":
        velocity = jac @ data.qvel
    else:
        ends = []
        for scale in (0.0, 1.0):
            other = mujoco.MjData(model)
            other.qpos, other.qvel, other.ctrl = state["qpos"], state["qvel"], state["ctrl"]
            other.qfrc_applied = scale * jac.T @ force
            mujoco.mj_step(model, other)
            ends.append(other.qvel.copy())
        # x' = h J dq'' with the paper's h, dq'' by the simulator's own step.
        velocity = jac @ (ends[1] - ends[0]) / model.opt.timestep * (1.0 / 600.0)
    return level * jac.T @ np.linalg.pinv(jac @ jac.T, rcond=rank, hermitian=True) @ velocity


@pytest.mark.parametrize("law", ["eq8", "algorithm1"])
@pytest.mark.parametrize("rate", [60.0, 600.0])
def test_both_laws_are_those_of_a_naive_twin_in_every_physics_step(law: str, rate: float) -> None:
    poses = torch.tensor(POSES, dtype=torch.float64)
    given = Compliance(law=law)  # type: ignore[arg-type]
    level = torch.tensor([0.04, 0.16, 0.3], dtype=torch.float64)
    arms, u = Pushed(rate, poses, given, level), np.zeros(poses.shape)
    force = torch.tensor([[20.0, -30.0, 10.0], [0.0, 40.0, 5.0], [-25.0, 0.0, 30.0]]).double()
    for _ in range(12):
        now = {k: getattr(arms.backend.state, k).numpy().copy() for k in ("qpos", "qvel")}
        for n in range(len(poses)):
            one = {k: v[n] for k, v in now.items()} | {"ctrl": poses[n].numpy() + u[n]}
            made = hand(one, arms.backend.model, given, force[n].numpy(), float(level[n]), RANK)
            u[n] += made / rate
        arms.step(force)
        np.testing.assert_allclose(arms.u, u, atol=1e-9, rtol=0)
    assert np.abs(u).max() > 1e-4


def test_the_stiffness_is_that_of_the_law() -> None:
    """K = (J Kp^-1 J^T)^-1 at a = 0, and (1 - a) K of it, per axis and in the determinant."""
    levels = (0.0, 0.08, 0.16)
    # Worlds: pose, level, axis, direction.
    rows = [(p, a, k, s) for p in POSES for a in levels for k in range(3) for s in (-2.0, 2.0)]
    poses = torch.tensor([r[0] for r in rows], dtype=torch.float64)
    force = torch.zeros(len(rows), 3, dtype=torch.float64)
    for i, (_, _, k, s) in enumerate(rows):
        force[i, k] = s
    level = torch.tensor([r[1] for r in rows], dtype=torch.float64)
    arms = Pushed(120.0, poses, Compliance(), level)
    before, jac = arms.tip(), arms.jacobian()
    for _ in range(480):
        arms.step(force)
    moved = (arms.tip() - before).view(3, 3, 3, 2, 3)
    # Columns of the compliance: displacement along all axes per newton along one.
    flexible = ((moved[..., 1, :] - moved[..., 0, :]) / 4.0).transpose(-1, -2)
    stiff = torch.linalg.inv(flexible)
    kp = torch.tensor(KP, dtype=torch.float64)
    plain = jac.view(3, 3, 3, 2, 3, 5)[:, 0, 0, 0]
    theory = torch.linalg.inv(plain @ (plain / kp).transpose(-1, -2))
    for p in range(3):
        for i, a in enumerate(levels):
            ratio = stiff[p, i].diagonal() / ((1.0 - a) * theory[p].diagonal())
            assert (ratio - 1.0).abs().max() < 0.02, (p, a, ratio)
            fall = torch.linalg.det(stiff[p, i]) / torch.linalg.det(stiff[p, 0])
            assert abs(float(fall) / (1.0 - a) ** 3 - 1.0) < 0.02, (p, a, fall)


def test_displacement_and_its_way_back_are_the_same_at_any_rate() -> None:
    seen = []
    for rate in (60.0, 120.0, 600.0):
        poses = torch.tensor(POSES, dtype=torch.float64)
        arms = Pushed(rate, poses, Compliance(), torch.full((3,), 0.16, dtype=torch.float64))
        force = torch.tensor([0.0, 50.0, 20.0], dtype=torch.float64).repeat(3, 1)
        kept = []
        for k in range(round(2.5 * rate)):
            seconds = k / rate
            arms.step(force if seconds < 1.0 else None)
            if abs(seconds % 0.25) < 1e-9 or abs(seconds % 0.25 - 0.25) < 1e-9:
                kept.append(arms.u.clone())
        seen.append(torch.stack(kept)[1:])
        for _ in range(round(rate)):
            arms.step(None)
        assert arms.u.abs().max() < 1e-4
    most = seen[2].abs().amax((0, 2))
    assert most.min() > 0.005
    for other in seen[:2]:
        apart = (other - seen[2]).abs().amax((0, 2)) / most
        assert apart.max() < 0.05, apart


def test_the_printed_law_moves_as_much_at_any_rate_and_drifts() -> None:
    """Its h is a constant; without end of the force u has no end (Eq. 8 comes to rest)."""
    force = torch.tensor([0.0, 50.0, 20.0], dtype=torch.float64).repeat(3, 1)
    ways = {}
    for law in ("eq8", "algorithm1"):
        arms = Pushed(600.0, torch.tensor(POSES, dtype=torch.float64), Compliance(law=law),  # type: ignore[arg-type]
                      torch.full((3,), 0.16, dtype=torch.float64))  # fmt: skip
        halves = []
        for k in range(900):
            arms.step(force)
            if k in (299, 599, 899):
                halves.append(arms.u.norm(dim=1))
        ways[law] = torch.stack(halves)
    assert ((ways["eq8"][2] - ways["eq8"][1]) / ways["eq8"][1]).abs().max() < 0.01
    assert (ways["algorithm1"][2] / ways["algorithm1"][1]).min() > 1.25


def pseudo_inverse(jac: torch.Tensor, weights: torch.Tensor, weighting: str = "inverse") -> torch.Tensor:
    ways = torch.eye(3, dtype=jac.dtype).expand(*jac.shape[:-2], 3, 3)
    return torch.stack([moving(jac, way, weights, weighting) for way in ways.unbind(-2)], -1)


def test_a_point_with_fewer_directions_moves_in_those_that_it_has() -> None:
    jac = torch.zeros(2, 3, 4, dtype=torch.float64)
    jac[0, 0, 1], jac[0, 0, 2] = 0.5, 0.2
    jac[1] = torch.eye(3, 4, dtype=torch.float64)
    jac[1, 2, 2] = 1e-3
    ones = torch.ones(4, dtype=torch.float64)
    back = jac @ pseudo_inverse(jac, ones)
    torch.testing.assert_close(back[0], torch.diag(torch.tensor([1.0, 0.0, 0.0]).double()))
    # Nearly locked along Z: the direction is given up, and nothing moves there without bound.
    torch.testing.assert_close(back[1], torch.diag(torch.tensor([1.0, 1.0, 0.0]).double()))
    assert not pseudo_inverse(torch.zeros(1, 3, 4).double(), ones).any()


def test_the_short_inverse_is_that_by_eigenvalues() -> None:
    rng = torch.Generator().manual_seed(0)
    b = torch.randn(60, 3, 9, generator=rng, dtype=torch.float64)
    b[:10, 2] *= 0.1
    b[10:20, 2] *= 1e-4
    b[20:30, :2] = 0.0
    b[30:40] = 0.0
    square = b @ b.transpose(-1, -2)
    values, axes = torch.linalg.eigh(square)
    least = RANK * values[:, -1:]
    inverse = torch.where((values > least) & (values > 0.0), 1.0 / values, 0.0)
    expected = axes @ torch.diag_embed(inverse) @ axes.transpose(-1, -2)
    made = pseudo_inverse(b, torch.ones(9, dtype=torch.float64))
    torch.testing.assert_close(made, b.transpose(-1, -2) @ expected, rtol=1e-9, atol=1e-9)


def test_weights_keep_the_law_as_pseudo_inverse_and_not_as_printed() -> None:
    rng = torch.Generator().manual_seed(0)
    jac = torch.randn(6, 3, 5, generator=rng, dtype=torch.float64)
    weights = torch.tensor([3.0, 1.0, 2.0, 1.0, 1.0], dtype=torch.float64)
    kept = jac @ pseudo_inverse(jac, weights)
    torch.testing.assert_close(kept, torch.eye(3, dtype=torch.float64).expand(6, 3, 3))
    # W J^T (J W J^T)^-1, and A^T (A A^T)^-1 with A = J W.
    w = torch.diag(weights)
    naive = w @ jac.transpose(1, 2) @ torch.linalg.inv(jac @ w @ jac.transpose(1, 2))
    torch.testing.assert_close(pseudo_inverse(jac, weights), naive)
    a = jac @ w
    printed = a.transpose(1, 2) @ torch.linalg.inv(a @ a.transpose(1, 2))
    torch.testing.assert_close(pseudo_inverse(jac, weights, "printed"), printed)
    assert (jac @ printed - torch.eye(3)).abs().max() > 0.1


def test_forces_add_up_and_axes_and_joints_have_shares() -> None:
    rng = torch.Generator().manual_seed(1)
    jac = torch.randn(2, 2, 3, 6, generator=rng, dtype=torch.float64)
    velocity = torch.randn(2, 2, 3, generator=rng, dtype=torch.float64)
    level, ones = torch.tensor([0.1, 0.2]).double(), torch.ones(6, dtype=torch.float64)

    def rate(given: Compliance, shares: Tensor = ones, k: slice = slice(None)) -> Tensor:
        return compliant_rate(jac[:, k], velocity[:, k], level, ones, given, shares)

    both = rate(Compliance())
    torch.testing.assert_close(both, rate(Compliance(), k=slice(1)) + rate(Compliance(), k=slice(1, 2)))
    flat = rate(Compliance(axes=(1.0, 1.0, 0.0)), k=slice(1))
    moved = (jac[:, 0] @ flat.unsqueeze(-1)).squeeze(-1)
    want = level.unsqueeze(1) * velocity[:, 0] * torch.tensor([1.0, 1.0, 0.0])
    torch.testing.assert_close(moved, want)
    shares = torch.tensor([1.0, 0.5, 0.0, 1.0, 1.0, 1.0]).double()
    torch.testing.assert_close(rate(Compliance(), shares), shares * both)


def test_a_hinge_chain_turns_as_a_ball_joint_by_the_quaternion_exponential() -> None:
    """Adding u' dt to hinges against exp(w dt) of a ball joint with w = sum_i axis_i u'_i."""
    frame = torch.tensor([0.5, 0.5, -0.5, 0.5], dtype=torch.float64)
    start, speed = torch.tensor([0.3, -0.5, 0.8]).double(), torch.tensor([0.4, -0.3, 0.6]).double()
    apart = []
    for steps in (100, 200):
        dt, angles = 1.0 / steps, start.clone()
        ball = chain_quat(angles, "ZYX", frame)
        for _ in range(steps):
            # The axes of the chain where it stands, in the parent's frame.
            turn, w = frame.clone(), torch.zeros(3, dtype=torch.float64)
            for k, letter in enumerate("ZYX"):
                axis = torch.eye(3, dtype=torch.float64)["XYZ".index(letter)]
                w += speed[k] * quat_rotate(turn, axis)
                turn = quat_mul(turn, rotvec_to_quat(axis * angles[k]))
            ball = quat_mul(rotvec_to_quat(w * dt), ball)
            angles = angles + speed * dt
        chain = chain_quat(angles, "ZYX", frame)
        apart.append(float(torch.minimum((ball - chain).norm(), (ball + chain).norm())))
    assert apart[0] < 5e-3 and apart[1] < 0.55 * apart[0]


def test_what_is_left_of_a_range_limits_a_step() -> None:
    step = torch.tensor([[0.2, -0.1], [0.2, 0.0], [0.1, -0.4], [0.0, 0.0]]).double()
    low, high = torch.full((4, 2), -0.1).double(), torch.full((4, 2), 0.1).double()
    torch.testing.assert_close(room(step, low, high), torch.tensor([0.5, 0.5, 0.25, 1.0]).double())
    # Out of its range already: no farther.
    assert room(torch.tensor([[0.1]]).double(), torch.tensor([[-1.0]]), torch.tensor([[-0.2]])) == 0


def test_the_way_back_is_a_critically_damped_spring() -> None:
    u, rate = torch.tensor([[0.3, -0.2]]).double(), torch.tensor([[0.5, 0.0]]).double()
    w, x, v = 2 * np.pi, np.array([0.3, -0.2]), np.array([0.5, 0.0])
    for _ in range(20000):
        v = v + 1e-5 * (-w * w * x - 2 * w * v)
        x = x + 1e-5 * v
    once = settled(u, rate, 1.0, 0.2)
    np.testing.assert_allclose(once[0][0], x, atol=2e-5)
    np.testing.assert_allclose(once[1][0], v, atol=2e-4)
    for _ in range(12):
        u, rate = settled(u, rate, 1.0, 0.2 / 12)
    torch.testing.assert_close(u, once[0])
    torch.testing.assert_close(rate, once[1])


def test_a_commanded_stiffness_takes_off_what_the_servos_give() -> None:
    jac = torch.zeros(1, 1, 3, 8, dtype=torch.float64)
    jac[0, 0, 0, 6], jac[0, 0, 0, 7] = 0.5, 0.3
    force, kp = torch.tensor([[[10.0, 0.0, 0.0]]]).double(), torch.tensor([250.0, 300.0]).double()
    soft, own = torch.tensor([100.0]).double(), 0.25 / 250 + 0.09 / 300
    assert float(softening(jac, force, soft, kp, True)) == pytest.approx(0.01 - own)
    assert float(softening(jac, force, soft, kp, False)) == pytest.approx(0.01)
    # Stiffer than the servos: nothing is left to give.
    assert float(softening(jac, force, torch.tensor([5000.0]).double(), kp, True)) == 0.0


def test_columns_of_a_body() -> None:
    table = build(swing(1.5, name="calm"), ResidualForce(expert=False)).humanoid.table
    made = columns(table, (("thigh", 2.0), ("LeftArm", 3.0)), root=True)
    assert made[:6].tolist() == [1.0, 1.0, 0.0, 0.0, 0.0, 0.0]
    assert columns(table, (), root=False)[:6].sum() == 0
    names = [(r.name, r.kind) for r in table.rows for _ in r.hinge_names()]
    for (name, kind), value in zip(names, made[6:].tolist(), strict=True):
        assert value == (3.0 if name == "LeftArm" else 2.0 if kind == "thigh" else 1.0)
    with refused("unknown-body-part", says="wing"):
        columns(table, (("wing", 2.0),), root=True)


@pytest.mark.parametrize(
    ("given", "what"),
    [
        (lambda: Compliance(level=1.2), ("out-of-range", "1.2")),
        (lambda: Compliance(level=-0.1), ("out-of-range", "-0.1")),
        (lambda: Compliance(law="eq9"), ("unknown-choice", "law")),  # type: ignore[arg-type]
        (lambda: Compliance(weighting="both"), ("unknown-choice", "weighting")),  # type: ignore[arg-type]
        (lambda: Compliance(axes=(1.0, 2.0, 1.0)), ("out-of-range", "axes")),
        (lambda: Compliance(weights=(("thigh", 0.0),)), ("out-of-range", "weights")),
        (lambda: Compliance(return_hz=0.0), ("out-of-range", "return_hz")),
        (lambda: Stiffness(0.0), ("out-of-range", "N/m")),
        (lambda: Stiffness(lag_s=0.0), ("out-of-range", "lag_s")),
    ],
)
def test_bad_settings(given: object, what: tuple) -> None:
    with refused(*what):
        given()  # type: ignore[operator]


def test_levels_above_the_plausible_are_noted() -> None:
    assert Compliance(level=0.2).notes == ()
    assert "above 0.2" in Compliance(level=0.25).notes[0]
    assert PAPER_STEP_S == 1 / 600
