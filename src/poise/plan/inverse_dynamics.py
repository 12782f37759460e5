"""Inverse dynamics with contacts: which torques and floor forces a motion needs.

The equations of motion M q'' + c - passive = S^T tau + J^T f + S_r^T w leave the split between the
floor's forces f and a wrench w on the root open. Here f carries as much as its friction cones allow,
so that w, which no body can produce by itself, is as small as possible.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass

import mujoco
import numpy as np

from poise.errors import PoiseError
from poise.plan.clearance import TouchPoints
from poise.spatial import GRAVITY


@dataclass(frozen=True)
class ContactRule:
    """Which points of the body may press against the floor, and how willingly.

    Attributes:
        height_m: a point below it may be in contact.
        speed: m/s, a faster point is not (it slides or is about to leave).
        friction: sliding coefficient, None for the model's own.
        effort: price of a contact force against a root residual of the same size, both in body weights;
            it chooses among equal answers the one that spreads the load on the lowest and slowest
            points.
        lever_m: a residual of 1 N m counts as much as one of `1 / lever_m` N.
    """

    height_m: float = 0.06
    speed: float = 1.2
    friction: float | None = None
    effort: float = 0.03
    lever_m: float = 0.3


@dataclass(frozen=True, eq=False)
class InverseDynamics:
    """What T instants of a motion need; float64.

    Root force and torque are the part that neither joint torques nor the floor can give.

    Attributes:
        torque: `(T, n)` N m of each hinge's actuator, on top of the joints' own damping.
        root_force: `(T, 3)` N, world axes, at the root's origin.
        root_torque: `(T, 3)` N m, in the root's axes.
        contact_force: `(T, P, 3)` N on the body, world axes; zero where a point is free.
        contact_point: `(T, P, 3)` m, world, where the forces act.
        contact_body: `(P,)`, rows of the humanoid's table.
    """

    torque: np.ndarray
    root_force: np.ndarray
    root_torque: np.ndarray
    contact_force: np.ndarray
    contact_point: np.ndarray
    contact_body: np.ndarray


def step_midpoints(
    model: mujoco.MjModel, qpos: np.ndarray, qvel: np.ndarray, rate_hz: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """`qpos, qvel, qacc`, one row fewer, in the middle of each step of a motion at `rate_hz`.

    The acceleration of step t is (q'[t + 1] - q'[t]) rate: held over the step, it carries the velocity
    of frame t to that of frame t + 1.
    """
    mid = np.empty((len(qpos) - 1, model.nq))
    speed, half = 0.5 * (qvel[1:] + qvel[:-1]), 0.5 / rate_hz
    for t in range(len(mid)):
        way = np.empty(model.nv)
        mujoco.mj_differentiatePos(model, way, 2 * half, qpos[t], qpos[t + 1])
        mid[t] = qpos[t]
        mujoco.mj_integratePos(model, mid[t], way, half)
    return mid, speed, (qvel[1:] - qvel[:-1]) * rate_hz


def inverse_dynamics(
    model: mujoco.MjModel,
    qpos: np.ndarray,
    qvel: np.ndarray,
    qacc: np.ndarray,
    rule: ContactRule | None = None,
) -> InverseDynamics:
    """Torques, floor forces and the remaining root wrench of T instants, each on its own.

        b = M q'' + c - passive;   min |b_root - (J^T f)_root|^2 + effort^2 |f|^2
        over f in the pyramids |f_x| + |f_y| <= mu f_z;   tau = b_hinges - (J^T f)_hinges

    Args:
        model: a free root first, hinges after it, and a floor at z = 0.
        qpos `(T, nq)`, qvel `(T, nv)`, qacc `(T, nv)`: MuJoCo's conventions, float64.
        rule: which points may touch the floor.

    Raises:
        PoiseError: shapes that do not fit the model.
    """
    rule = rule or ContactRule()
    frames = len(qpos)
    for name, value, width in (
        ("qpos", qpos, model.nq),
        ("qvel", qvel, model.nv),
        ("qacc", qacc, model.nv),
    ):
        if value.shape != (frames, width):
            raise PoiseError(
                f"{name} must be ({frames}, {width}), got {value.shape}", "inverse dynamics"
            )
    model = copy.deepcopy(model)
    # Contact and limit forces of the simulator would be a second answer to the same question.
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    points, data = TouchPoints(model), mujoco.MjData(model)
    mu = points.friction if rule.friction is None else rule.friction
    out = InverseDynamics(
        torque=np.zeros((frames, model.nv - 6)),
        root_force=np.zeros((frames, 3)),
        root_torque=np.zeros((frames, 3)),
        contact_force=np.zeros((frames, len(points.body), 3)),
        contact_point=np.zeros((frames, len(points.body), 3)),
        contact_body=points.body - 1,
    )
    for t in range(frames):
        data.qpos[:], data.qvel[:], data.qacc[:] = qpos[t], qvel[t], qacc[t]
        mujoco.mj_inverse(model, data)
        rest = data.qfrc_inverse.copy()
        place, velocity = points.place(data), None
        low = np.flatnonzero(place[:, 2] < rule.height_m)
        if len(low):
            velocity = np.linalg.norm(points.velocity(data, place), axis=-1)
            low = low[velocity[low] < rule.speed]
        if velocity is not None and len(low):
            height = np.maximum(place[low, 2], 0.0) / rule.height_m
            dear = 1.0 + 30.0 * height**2 + 4.0 * (velocity[low] / rule.speed) ** 2
            force = _contact_forces(model, data, rest, place[low], dear, mu, rule)
            out.contact_force[t, low] = force
            for p, f in zip(low, force, strict=True):
                moved = np.zeros(model.nv)
                mujoco.mj_applyFT(model, data, f, np.zeros(3), place[p], int(points.body[p]), moved)
                rest -= moved
        out.contact_point[t] = place
        out.root_force[t], out.root_torque[t], out.torque[t] = rest[:3], rest[3:6], rest[6:]
    return out


def _contact_forces(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    needed: np.ndarray,
    place: np.ndarray,
    dear: np.ndarray,
    mu: float,
    rule: ContactRule,
) -> np.ndarray:
    """Forces `(K, 3)` N at the points `place (K, 3)` that leave the least of the root's `needed`.

    Every force is a sum of the four edges of its friction pyramid with weights of at least 0, so the
    cones become the bounds of a small quadratic programme, min |A s - goal|^2 + s^T P s, s >= 0.
    """
    edges = np.array([[mu, 0, 1], [-mu, 0, 1], [0, mu, 1], [0, -mu, 1.0]])
    weight = float(model.body_subtreemass[1]) * GRAVITY
    root, turn = data.qpos[:3], data.xmat[1].reshape(3, 3)
    k = len(place)
    push = np.tile(edges, (k, 1))
    moment = np.cross(np.repeat(place - root, 4, axis=0), push)
    goal = np.concatenate((needed[:3], turn @ needed[3:6] / rule.lever_m)) / weight
    columns = np.concatenate((push, moment / rule.lever_m), 1)
    hessian = columns @ columns.T + np.diag(np.repeat(rule.effort**2 * dear, 4))
    share, n = np.zeros(4 * k), 4 * k
    mujoco.mju_boxQP(share, np.zeros(n * (n + 7)), None, hessian, -columns @ goal, np.zeros(n), None)
    return (share.reshape(k, 4) @ edges) * weight
