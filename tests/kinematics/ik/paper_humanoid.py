"""Skeleton2Humanoid's humanoid: a skeleton's bones in a T-pose, all frames along the world's axes; and
what is measured of a solution on it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from poise.body import BodyConfig, BodyTable, generate_table
from poise.kinematics.ik_bodies import IkBody, ik_body, rotate
from poise.motion import Skeleton
from poise.motion.rotations import matrix_to_quat

#: Directions (left, up, forward) along which bones of a T-pose point. A foot points forward and down.
_ALONG = {
    "spine": (0.0, 1.0, 0.0),
    "clavicle": (1.0, 0.0, 0.0),
    "upper_arm": (1.0, 0.0, 0.0),
    "forearm": (1.0, 0.0, 0.0),
    "thigh": (0.0, -1.0, 0.0),
    "shin": (0.0, -1.0, 0.0),
    "foot": (0.0, -0.3, 1.0),
}
#: The paper's axes x left, y up, z forward in a world where a T-pose faces +x: columns of a matrix.
AXES = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
#: Elbows bend about forward, knees about left; elbows to opposite sides (Eqs. 10 and 13).
_ONE_HINGE = {
    ("forearm", "left"): ("Z", (-2.8, 0.0)),
    ("forearm", "right"): ("Z", (0.0, 2.8)),
    ("shin", "left"): ("X", (0.0, 2.8)),
    ("shin", "right"): ("X", (0.0, 2.8)),
}


def paper_humanoid(
    table: BodyTable, skeleton: Skeleton, one_hinge: bool = False
) -> tuple[Skeleton, BodyTable]:
    """The paper's kind of humanoid for a skeleton: its bone lengths and names in another rest pose.

    It stands in a T-pose facing +x with all body frames along the world's axes, without neck and head;
    hinges turn about z, y, x of the paper (forward, up, left) in this order.

    Args:
        table: the generated humanoid of `skeleton`, which tells the shape of its pelvis and chest.
        one_hinge: elbows and knees with one hinge instead of three.
    """
    body = ik_body(table, skeleton)
    rows = [i for i, r in enumerate(table.rows) if r.kind not in ("neck", "head")]
    points = rows + [p for p in range(len(table.rows), len(body.points))]
    place = {p: k for k, p in enumerate(points)}
    parents, offsets = [], []
    above = {**{i: table.rows[i].parent for i in rows}, **{t: f for f, t in body.toes.items()}}
    for p in points:
        parent = above[p]
        parents.append(place[parent] if parent >= 0 else -1)
        offsets.append(AXES @ _offset(body, p, parent) if parent >= 0 else np.zeros(3))
    made = Skeleton(tuple(body.points[p] for p in points), tuple(parents), np.array(offsets))
    out = generate_table(made, BodyConfig(preset="generic"))
    quat = tuple(float(x) for x in matrix_to_quat(AXES))
    changed = [replace(r, frame=quat) if r.order else r for r in out.rows]
    if one_hinge:
        for i, r in enumerate(changed):
            if (r.kind, r.side) in _ONE_HINGE:
                order, limits = _ONE_HINGE[r.kind, r.side]
                changed[i] = replace(r, order=order, ranges=(limits,))
    return made, replace(out, rows=tuple(changed))


def _offset(body: IkBody, point: int, parent: int) -> np.ndarray:
    """Place of a point in its parent, T-pose, as (left, up, forward) m."""
    bone = body.rest_pos[point] - body.rest_pos[parent]
    if parent in body.clusters:
        # Pelvis and chest keep the shape that they have.
        return body.trunk.T @ bone
    along = np.array(_ALONG[body.table.rows[parent].kind])
    if body.table.rows[parent].side == "right":
        along[0] = -along[0]
    return along / np.linalg.norm(along) * np.linalg.norm(bone)


def body_points(body: IkBody, pos: np.ndarray, rot: np.ndarray) -> np.ndarray:
    """World positions `(T, P, 3)` of points; bodies at `pos (T, R, 3)` turned by `rot (T, R, 3, 3)`."""
    out = [pos]
    for foot, toe in sorted(body.toes.items(), key=lambda item: item[1]):
        local = body.rest_rot[foot].T @ (body.rest_pos[toe] - body.rest_pos[foot])
        out.append((pos[:, foot] + rotate(rot[:, foot], local))[:, None])
    return np.concatenate(out, 1)


def count_jumps(angles: np.ndarray, limit: float = math.pi / 2) -> np.ndarray:
    """How often each angle `(T, n)` steps by more than `limit` rad from one frame to the next: `(n)`."""
    return (np.abs(np.diff(angles, axis=0)) > limit).sum(0)
