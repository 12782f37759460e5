"""Where a body can touch a level floor, and how its moving parts stay clear of it."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np


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
