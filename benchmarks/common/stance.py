"""The relaxed standing pose of a humanoid: arms down, feet flat, balanced over the soles."""

from __future__ import annotations

import math
from dataclasses import dataclass

import mujoco
import numpy as np
import torch

from poise.body import Humanoid
from poise.body.body_table import BodyRow
from poise.errors import PoiseError
from poise.motion.rotations import quat_to_matrix

#: Angles of the relaxed pose: knees and elbows, rad; arms away from the trunk, degrees (the first of
#: these at which they touch nothing).
KNEE, ELBOW, ARMS_OUT = math.radians(4.0), math.radians(12.0), (8.0, 14.0, 20.0, 30.0)
#: Tilt of a sole (degrees) beyond which a pose is no standing pose.
LEVEL_DEG = 5.0
#: Where the centre of mass stands between the ankles (0) and the middle of the soles (1). A person's is
#: 2 to 5 cm ahead of the ankles; servos give way forward by as much again at 1.
AHEAD = 0.4


@dataclass(frozen=True, eq=False)
class Stance:
    """A standing pose.

    qpos: `(7 + hinges)`, facing +x, the soles' middle at the origin and the lowest sole on z = 0.
    com: `(2)` m, the projected centre of mass. support: `(K, 2)` m, corners of the support polygon,
    counter-clockwise. margin_m: distance of `com` from the polygon's edge, negative outside.
    tilt_deg: the larger tilt of the soles.
    """

    qpos: np.ndarray
    com: np.ndarray
    support: np.ndarray
    margin_m: float
    tilt_deg: float


def relaxed_stance(humanoid: Humanoid) -> Stance:
    """The pose in which this humanoid stands at ease.

    Least squares over the root's turn and all hinges within their ranges: legs straight but for `KNEE`,
    soles level, abreast, as far apart as the hips and pointing ahead, pelvis and shoulders square,
    trunk and head upright, arms hanging, other turns near the neutral pose; and, weighted most, the
    centre of mass over the soles, a little ahead of the ankles (`AHEAD`).

    Raises:
        PoiseError: no foot with a sole, or no such pose within the joint ranges.
    """
    solver = _Solver(humanoid)
    best = solver.solve()
    for out in ARMS_OUT[1:]:
        if not solver.arms_touch():
            break
        solver.arms_out = math.radians(out)
        best = solver.solve()
    if best.margin_m <= 0 or best.tilt_deg > LEVEL_DEG:
        raise PoiseError(
            f"no pose within the joint ranges stands: the soles tilt by {best.tilt_deg:.0f} degrees and "
            f"the centre of mass lies {best.margin_m * 1000:+.0f} mm inside their edge",
            hint="Widen the ranges of the hips, knees and ankles",
            code="no-stance",
        )
    return best


def support_polygon(points: np.ndarray) -> np.ndarray:
    """`(K, 2)` m, the convex hull of `points (N, 2)`, counter-clockwise."""
    # Imported here, since SciPy takes its time.
    from scipy.spatial import ConvexHull, QhullError

    try:
        return points[ConvexHull(points).vertices]
    except QhullError:
        raise PoiseError("the soles span no area to stand on", code="no-stance") from None


def polygon_margin(point: np.ndarray, polygon: np.ndarray) -> float:
    """Distance (m) of `point (2)` from the nearest edge of a convex counter-clockwise polygon; negative
    outside."""
    edge = np.roll(polygon, -1, 0) - polygon
    inward = np.stack((-edge[:, 1], edge[:, 0]), -1) / np.linalg.norm(edge, axis=1, keepdims=True)
    return float(((point - polygon) * inward).sum(1).min())


def sole_corners(row: BodyRow) -> np.ndarray:
    """`(N, 3)` m, corners of the lower faces of a foot's boxes, in the body's frame."""
    out = []
    for geom in row.geoms:
        if geom.kind != "box":
            continue
        x, y, z = geom.size
        face = np.array([[i * x, j * y, -z] for i, j in ((-1, -1), (1, -1), (1, 1), (-1, 1))])
        turn = quat_to_matrix(torch.tensor(geom.quat, dtype=torch.float64)).numpy()
        out.append(face @ turn.T + np.array(geom.pos))
    if not out:
        raise PoiseError(f"the foot '{row.name}' has no box to stand on", code="no-stance")
    return np.concatenate(out)


class _Solver:
    """The least-squares problem of one stance. Unknowns: root rotation vector, then hinges."""

    def __init__(self, humanoid: Humanoid) -> None:
        self.model, self.rows = humanoid.model, humanoid.table.rows
        self.data = mujoco.MjData(self.model)
        self.first: dict[tuple[str, str], int] = {}
        for i, row in enumerate(self.rows):
            self.first.setdefault((row.kind, row.side), i)
        self.height, self.arms_out = humanoid.table.height_m, math.radians(ARMS_OUT[0])
        self.feet = {self.rows[i].side: i for i in humanoid.feet}
        if set(self.feet) != {"left", "right"}:
            raise PoiseError("the body needs a left and a right foot to stand", code="no-stance")
        self.corners = {side: sole_corners(self.rows[i]) for side, i in self.feet.items()}
        boxes = {s: next(g for g in self.rows[i].geoms if g.kind == "box") for s, i in self.feet.items()}
        self.soles = {
            side: quat_to_matrix(torch.tensor(box.quat, dtype=torch.float64)).numpy()
            for side, box in boxes.items()
        }
        limits = [limit for row in self.rows for limit in row.ranges]
        self.low, self.high = np.array(limits).reshape(-1, 2).T
        self.start = self._upright()
        #: The solution, from which the next one starts.
        self.found = np.concatenate((np.zeros(3), np.clip(np.zeros(len(limits)), self.low, self.high)))

    def _one(self, kind: str, side: str = "") -> int | None:
        """The first row of a kind and side."""
        return self.first.get((kind, side))

    def _pose(self, x: np.ndarray) -> None:
        self.data.qpos[:3] = 0.0
        turn, angle = np.zeros(4), float(np.linalg.norm(x[:3]))
        mujoco.mju_axisAngle2Quat(turn, x[:3] / max(angle, 1e-12), angle)
        mujoco.mju_mulQuat(self.data.qpos[3:7], turn, self.start)
        self.data.qpos[7:] = x[3:]
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)

    def _at(self, row: int | None) -> np.ndarray:
        assert row is not None
        return self.data.xpos[row + 1]

    def _to(self, a: int | None, b: int | None) -> np.ndarray:
        """Unit vector from one body to another, world axes."""
        v = self._at(b) - self._at(a)
        return v / max(float(np.linalg.norm(v)), 1e-9)

    def _upright(self) -> np.ndarray:
        """wxyz of the root that sets the neutral pose upright and facing +x."""
        self.data.qpos[:] = 0.0
        self.data.qpos[3] = 1.0
        mujoco.mj_kinematics(self.model, self.data)
        left, right = (self._at(self._one("thigh", s)) for s in ("left", "right"))
        lateral = left - right
        shoulders = [self._at(self._one("upper_arm", s)) for s in ("left", "right")]
        up = np.mean(shoulders, 0) - (left + right) / 2
        y = lateral / np.linalg.norm(lateral)
        z = up - (up @ y) * y
        z = z / np.linalg.norm(z)
        # Rows are the body's axes in the root's frame, so the matrix turns them onto the world's.
        matrix = np.stack((np.cross(y, z), y, z))
        out = np.zeros(4)
        mujoco.mju_mat2Quat(out, matrix.reshape(-1))
        return out

    def _sole_points(self) -> dict[str, np.ndarray]:
        return {
            s: self.corners[s] @ self.data.xmat[i + 1].reshape(3, 3).T + self.data.xpos[i + 1]
            for s, i in self.feet.items()
        }

    def residuals(self, x: np.ndarray) -> np.ndarray:
        """Weighted residuals; directions as differences of unit vectors, lengths over the height."""
        self._pose(x)
        one, to = self._one, self._to
        y, z = np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])
        out = [
            2.0 * (to(one("thigh", "right"), one("thigh", "left")) - y),
            to(one("upper_arm", "right"), one("upper_arm", "left")) - y,
        ]
        hips = (self._at(one("thigh", "left")) + self._at(one("thigh", "right"))) / 2
        chest = (self._at(one("upper_arm", "left")) + self._at(one("upper_arm", "right"))) / 2
        out.append(2.0 * (chest - hips) / np.linalg.norm(chest - hips) - 2.0 * z)
        for side, sign in (("left", 1.0), ("right", -1.0)):
            thigh, shin, foot = (one(k, side) for k in ("thigh", "shin", "foot"))
            # The knee goes forward by as much as the shin comes back.
            bend = _down(-KNEE / 2, 0.0) - _down(KNEE / 2, 0.0)
            out.append(to(thigh, foot) - _down(0.0, 0.0))
            out.append(2.0 * (to(shin, foot) - to(thigh, shin) - bend))
            arm, fore, hand = (one(k, side) for k in ("upper_arm", "forearm", "hand"))
            out.append(to(arm, fore) - _down(0.0, sign * self.arms_out))
            out.append(0.7 * (to(fore, hand) - _down(ELBOW, sign * self.arms_out / 2)))
            turn = self.data.xmat[self.feet[side] + 1].reshape(3, 3) @ self.soles[side]
            out.append(5.0 * (turn[:, 2] - z))
            out.append(0.5 * (turn[:, 0] - np.array([1.0, 0.0, 0.0])))
        neck = one("neck")
        head = one("head")
        if neck is not None and head is not None:
            out.append(0.5 * (to(neck, head) - z))
        points = self._sole_points()
        middle = np.mean([p.mean(0) for p in points.values()], 0)
        ankles = np.mean([self._at(i) for i in self.feet.values()], 0)
        middle[:2] = ankles[:2] + AHEAD * (middle - ankles)[:2]
        apart = points["left"][:, 2].mean() - points["right"][:, 2].mean()
        out.append(np.array([200.0 * apart / self.height]))
        span = self._at(self.feet["left"]) - self._at(self.feet["right"])
        hips_apart = np.linalg.norm(self._at(one("thigh", "left")) - self._at(one("thigh", "right")))
        out.append(np.array([span[0], max(0.0, hips_apart - span[1])]) * 20.0 / self.height)
        out.append(20.0 * (self.data.subtree_com[1] - middle)[:2] / self.height)
        out.append(0.05 * x[3:])
        return np.concatenate([np.atleast_1d(v) for v in out])

    def solve(self) -> Stance:
        from scipy.optimize import least_squares

        count = len(self.low)
        low, high = np.full(3 + count, -np.inf), np.full(3 + count, np.inf)
        low[3:], high[3:] = self.low - 1e-9, self.high + 1e-9
        self.found = least_squares(
            self.residuals, self.found, bounds=(low, high), max_nfev=60, ftol=1e-6, xtol=1e-6
        ).x
        self._pose(self.found)
        points = self._sole_points()
        every = np.concatenate(list(points.values()))
        self.data.qpos[:3] -= (*np.mean([p.mean(0) for p in points.values()], 0)[:2], every[:, 2].min())
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        points = self._sole_points()
        every = np.concatenate(list(points.values()))
        support = support_polygon(every[:, :2])
        com = np.array(self.data.subtree_com[1, :2])
        up = min(
            float((self.data.xmat[i + 1].reshape(3, 3) @ self.soles[s])[2, 2])
            for s, i in self.feet.items()
        )
        return Stance(
            np.array(self.data.qpos),
            com,
            support,
            polygon_margin(com, support),
            math.degrees(math.acos(min(1.0, up))),
        )

    def arms_touch(self) -> bool:
        """Whether an arm or hand touches another part in the pose last solved."""
        mujoco.mj_collision(self.model, self.data)
        arms = {i + 1 for i, r in enumerate(self.rows) if r.kind in ("upper_arm", "forearm", "hand")}
        for geoms in self.data.contact.geom:
            bodies = {int(self.model.geom_bodyid[g]) for g in geoms}
            if 0 not in bodies and bodies & arms:
                return True
        return False


def _down(forward: float, out: float) -> np.ndarray:
    """The unit vector down, turned forward and to the left by angles in rad."""
    v = np.array([math.tan(forward), math.tan(out), -1.0])
    return v / np.linalg.norm(v)
