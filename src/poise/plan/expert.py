"""A scripted expert: inverse dynamics with contacts, and feedback on the root within the help limit."""

from __future__ import annotations

import copy
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import mujoco
import numpy as np
import torch
from torch import Tensor

from poise.control import ExplicitResidual, Residual
from poise.env.frame import Pose
from poise.env.goal import Goal
from poise.env.reference import Reference
from poise.errors import PoiseError
from poise.motion.rotations import GRAVITY, heading_quat, quat_rotate_inv
from poise.plan.guide import Guide, Spring
from poise.sim import SimState

if TYPE_CHECKING:
    from poise.env.env import ImitationEnv


class TouchPoints:
    """The points at which a body can touch a level floor: corners of boxes, ends of capsules."""

    def __init__(self, model: mujoco.MjModel):
        bodies, centres, radii = [], [], []
        kinds = mujoco.mjtGeom
        for g in range(model.ngeom):
            if model.geom_bodyid[g] == 0 or not (model.geom_contype[g] or model.geom_conaffinity[g]):
                continue
            size, kind = model.geom_size[g], model.geom_type[g]
            turn = np.zeros(9)
            mujoco.mju_quat2Mat(turn, model.geom_quat[g])
            if kind == kinds.mjGEOM_BOX:
                signs = np.array(np.meshgrid((-1, 1), (-1, 1), (-1, 1))).reshape(3, 8).T
                local, radius = signs * size, 0.0
            elif kind == kinds.mjGEOM_CAPSULE:
                local, radius = np.array([[0, 0, -size[1]], [0, 0, size[1]]]), size[0]
            elif kind == kinds.mjGEOM_SPHERE:
                local, radius = np.zeros((1, 3)), size[0]
            else:
                continue
            centres.append(model.geom_pos[g] + local @ turn.reshape(3, 3).T)
            bodies += [model.geom_bodyid[g]] * len(local)
            radii += [radius] * len(local)
        self.body, self.radius = np.array(bodies, dtype=int), np.array(radii)
        self.centre = np.concatenate(centres)
        floor = model.geom_friction[model.geom_bodyid == 0, 0]
        self.friction = float(max(floor.max(initial=0.0), model.geom_friction[:, 0].max()))

    def place(self, data: mujoco.MjData) -> np.ndarray:
        """Lowest point around each centre, `(P, 3)` m, world."""
        turn = data.xmat[self.body].reshape(-1, 3, 3)
        out = data.xpos[self.body] + np.einsum("pij,pj->pi", turn, self.centre)
        out[:, 2] -= self.radius
        return out

    def velocity(self, data: mujoco.MjData, place: np.ndarray) -> np.ndarray:
        """Velocity of the body at each point, `(P, 3)` m/s, world."""
        spin, linear = data.cvel[self.body, :3], data.cvel[self.body, 3:]
        return linear + np.cross(spin, place - data.subtree_com[1])


@dataclass(frozen=True)
class ClearanceRule:
    """How far moving parts are lifted off the floor.

    Attributes:
        height_m: m, the lowest a moving point may be.
        slow: m/s over the floor; a slower point stands and is left alone.
        fast: m/s over the floor; a faster point gets the whole height, with a ramp between.
        smooth: half width, in frames, of the window over which the lift is blended.
        sweeps: repetitions of the solution.
    """

    height_m: float = 0.03
    slow: float = 0.1
    fast: float = 0.5
    smooth: int = 2
    sweeps: int = 3


def clearance(
    model: mujoco.MjModel, qpos: np.ndarray, qvel: np.ndarray, rule: ClearanceRule | None = None
) -> np.ndarray:
    """Changes `(T, n)` rad of the hinge angles that lift swinging parts over the floor.

    A mocap foot bends where a rigid one drags its toes through the floor, and a foot that catches on
    it throws the whole body. For the lowest point of each body, with J the hinge columns of the
    Jacobian of its height, dq = J^T (J J^T + e)^-1 dz, repeated `sweeps` times.

    Args:
        qpos `(T, nq)`, qvel `(T, nv)`: MuJoCo's conventions; the speeds tell what swings.
    """
    rule = rule or ClearanceRule()
    points, data = TouchPoints(model), mujoco.MjData(model)
    groups = [np.flatnonzero(points.body == b) for b in np.unique(points.body)]
    change, jacobian = np.zeros((len(qpos), model.nv - 6)), np.zeros((3, model.nv))
    for t in range(len(qpos)):
        for _ in range(rule.sweeps):
            data.qpos[:], data.qvel[:] = qpos[t], qvel[t]
            data.qpos[7:] += change[t]
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_comVel(model, data)
            place = points.place(data)
            speed = np.linalg.norm(points.velocity(data, place)[:, :2], axis=-1)
            swings = np.clip((speed - rule.slow) / (rule.fast - rule.slow), 0.0, 1.0)
            lift = (rule.height_m - place[:, 2]) * swings
            for group in groups:
                k = group[lift[group].argmax()]
                if lift[k] > _ENOUGH_M:
                    mujoco.mj_jac(model, data, jacobian, None, place[k], int(points.body[k]))
                    row = jacobian[2, 6:]
                    change[t] += row * (lift[k] / (row @ row + _DAMPING))
    window = np.hanning(2 * rule.smooth + 3)[1:-1]
    padded = np.pad(change, ((rule.smooth, rule.smooth), (0, 0)), mode="edge")
    slices = np.lib.stride_tricks.sliding_window_view(padded, len(window), axis=0)
    return slices @ (window / window.sum())


_ENOUGH_M = 0.001  # A lift below a millimetre changes nothing.
_DAMPING = 1e-3  # m^2/rad^2, keeps dq small where no hinge can lift the point.


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

    The equations of motion M q'' + c - passive = S^T tau + J^T f + S_r^T w leave open how the floor's
    forces f and a wrench w on the root share the load. Here f carries as much as its friction cones
    allow, so that w, which no body can produce by itself, is as small as possible:

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
                f"{name} must be ({frames}, {width}), got {value.shape}",
                "inverse dynamics",
                code="wrong-shape",
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


@dataclass(frozen=True)
class ExpertConfig:
    """How the expert acts.

    Attributes:
        spring: by which the root is pulled.
        lead: place in a control step from which the joint targets are taken, 0 its begin, 1 its end.
        contacts: which points may carry weight in the inverse dynamics.
        clear: how swinging feet are lifted.
    """

    spring: Spring = field(default_factory=Spring)
    lead: float = 0.5
    contacts: ContactRule = field(default_factory=ContactRule)
    clear: ClearanceRule = field(default_factory=ClearanceRule)


@dataclass(frozen=True, eq=False)
class Plan:
    """Inverse dynamics of every step of a reference; row r leads from frame r to the next.

    Attributes:
        torque: `(F, n)` N m per hinge.
        force_h: `(F, 3)` N, root residual in the reference root's heading frame at the step's begin.
        torque_b: `(F, 3)` N m, in the root's axes.
        lift: `(F, n)` rad, added to the frame's hinge angles so that swinging feet clear the floor;
            float32.
        parts: what was solved, clip by clip.
    """

    torque: Tensor
    force_h: Tensor
    torque_b: Tensor
    lift: Tensor
    parts: tuple[InverseDynamics, ...]


def make_plan(reference: Reference, config: ExpertConfig | None = None) -> Plan:
    """Solves all steps of all clips; a last frame, which no step leaves, repeats the one before."""
    config = config or ExpertConfig()
    parts: list[InverseDynamics] = []
    torque, force, turn, lift = [], [], [], []
    of_clips = (reference.start.tolist(), reference.length.tolist(), reference.body.tolist())
    for start, length, body in zip(*of_clips, strict=True):
        model = reference.bodies[body].model
        rows = slice(start, start + length)
        qpos, qvel = reference.qpos[rows].numpy(), reference.qvel[rows].numpy()
        steps = step_midpoints(model, qpos, qvel, reference.rate_hz)
        part = inverse_dynamics(model, *steps, config.contacts)
        lift.append(torch.tensor(clearance(model, qpos, qvel, config.clear)).float())
        parts.append(part)
        for rows_, value in ((torque, part.torque), (force, part.root_force), (turn, part.root_torque)):
            rows_.append(torch.tensor(np.concatenate((value, value[-1:]))).float())
    force_h = quat_rotate_inv(heading_quat(reference.qpos[:, 3:7].float()), torch.cat(force))
    return Plan(torch.cat(torque), force_h, torch.cat(turn), torch.cat(lift), tuple(parts))


#: Steps of motions whose inverse dynamics is remembered: copies of a world ask for the same ones.
REMEMBERED = 512


class GoalGuide(Guide):
    """A hand (`Guide`) along goals that are no clips, such as a generator's: inverse dynamics of each
    step is solved as the goal tells it, from its frame now and the next one.

    Args:
        reference: any motion of the body. residual: see `Guide`.
    """

    def __init__(self, reference: Reference, residual: Residual):
        none = torch.zeros(0, 3)
        super().__init__(reference, residual, none, none)
        self._model, self._solved = reference.humanoid.model, dict[bytes, tuple[Tensor, Tensor]]()

    def __call__(self, state: SimState, goal: Goal) -> Tensor:
        """Residual actions `(N, dims)` for the worlds as they stand."""
        now, ahead = (goal.layout.unpacked(x) for x in (goal.now(), goal.ahead()))
        found = [self._step(now, ahead, i, goal.rate_hz) for i in range(len(now.qpos))]
        force, torque = (torch.stack(x) for x in zip(*found, strict=True))
        self.force_h, self.torque_b = force.to(now.qpos), torque.to(now.qpos)
        rows = torch.arange(len(found), device=now.qpos.device)
        return self.action(state.qpos, state.qvel, now, rows)

    def _step(self, now: Pose, ahead: Pose, i: int, rate_hz: float) -> tuple[Tensor, Tensor]:
        """Force in the root's heading and torque in its axes, `(3)` N and N m, that a step needs."""
        qpos, qvel = (
            torch.stack((a[i], b[i])).double().cpu().numpy()
            for a, b in ((now.qpos, ahead.qpos), (now.qvel, ahead.qvel))
        )
        key = qpos.tobytes() + qvel.tobytes()
        if key not in self._solved:
            if len(self._solved) >= REMEMBERED:
                self._solved.pop(next(iter(self._solved)))
            steps = step_midpoints(self._model, qpos, qvel, rate_hz)
            part = inverse_dynamics(self._model, *steps)
            turn = heading_quat(torch.tensor(qpos[:1, 3:7]))
            force = quat_rotate_inv(turn, torch.tensor(part.root_force))[0]
            self._solved[key] = force.float(), torch.tensor(part.root_torque[0]).float()
        return self._solved[key]


class Expert:
    """Acts in one `ImitationEnv` with full knowledge of its state, whatever its observation is.

    The expert needs no learning and follows most clips. It is a teacher for `poise.learn.clone`, and a
    policy that `poise.score` can score.

    Raises:
        PoiseError: explicit residual forces that do not reach the root.
    """

    def __init__(self, env: ImitationEnv, config: ExpertConfig | None = None, plan: Plan | None = None):
        self.env, self.config = env, config or ExpertConfig()
        self.plan = plan or make_plan(env.reference, self.config)
        self._residual = env.task.residual
        if isinstance(self._residual, ExplicitResidual) and 0 not in self._residual.bodies:
            raise PoiseError(
                "the expert needs a residual force on the root, body row 0",
                code="residual-force-missing",
            )
        model = env.backend.model
        # The servos of each body, `(S, n)`.
        models = [model, *(h.model for h in env.reference.bodies[1:])]
        self._kp = torch.stack([torch.tensor(m.actuator_gainprm[:, 0]).float() for m in models])
        self._most = torch.stack([torch.tensor(m.actuator_forcerange[:, 1]).float() for m in models])
        self._guide = None
        if self._residual is not None:
            path = self.plan.force_h, self.plan.torque_b
            self._guide = Guide(env.reference, self._residual, *path, self.config.spring)

    @torch.no_grad()
    def act(self, obs: Tensor) -> Tensor:
        """Actions `(N, A)` for the worlds as they stand now; `obs` is not looked at."""
        env = self.env
        rows = env.reference.rows(env.clip, env.frame)
        joints = self._joints(rows)
        if self._guide is not None:
            qpos, qvel = env.backend.state.qpos, env.backend.state.qvel
            joints = torch.cat((joints, self._guide.action(qpos, qvel, env.goal_pose(), rows)), -1)
        return env.unfiltered(joints)

    def _joints(self, rows: Tensor) -> Tensor:
        """Targets u = q_ref + tau / kp, with kp (u - q) inside the torque limits, as actions."""
        env, reference = self.env, self.env.reference
        ahead = reference.rows(env.clip, env.frame + 1)
        now, then = reference.qpos[rows, 7:].float(), reference.qpos[ahead, 7:].float()
        plan, lead = self.plan, self.config.lead
        path = torch.lerp(now + plan.lift[rows], then + plan.lift[ahead], lead)
        body = reference.body[env.clip]
        kp = self._kp[body]
        target = path + plan.torque[rows] / kp
        q, reach = env.backend.state.qpos[:, 7:].float(), self._most[body] / kp
        target = torch.maximum(torch.minimum(target, q + reach), q - reach)
        return env.task.pd.action(target, then)
