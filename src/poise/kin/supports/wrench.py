"""Which force and moment a motion asks of the world, and how well given contacts can give them.

Newton and Euler about the centre of mass c of a body of mass M, with the parts' masses m_i at x_i:

    f = M (c'' + g e_z),    tau = d/dt sum_i m_i (x_i - c) x (x_i' - c')

Contacts at p_k push with forces in their friction cones. The least of |f - sum f_k|, |tau - sum (p_k -
c) x f_k| / `ARM_M` over such forces, in shares of the weight, is what is missing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from torch import Tensor

from poise.body import BodyTable
from poise.kin.balance import SMOOTH_S
from poise.kin.series import gaussian
from poise.kin.solids import centre_of_mass
from poise.spatial import GRAVITY

#: Moments count as forces at this arm, m.
ARM_M = 0.5
#: Friction of what a body rests on; of a wall, which bears little weight.
FRICTION, OF_A_WALL = 0.8, 0.4


@dataclass(frozen=True, eq=False)
class Asked:
    """What a motion asks of the world.

    Attributes:
        com: `(T, 3)` m, centre of mass, smoothed.
        force: `(T, 3)` N; torque: `(T, 3)` N m about it; world axes.
        weight: N.
    """

    com: np.ndarray
    force: np.ndarray
    torque: np.ndarray
    weight: float

    def missing(self, frame: int, points: np.ndarray, normals: np.ndarray) -> tuple[float, np.ndarray]:
        """What contacts cannot give in a frame, as a share of the weight; and their forces `(K, 3)` N.

        points, normals: `(K, 3)` m and unit vectors toward the body, each the axis of a cone of four
        edges with `FRICTION`, or `OF_A_WALL`.
        """
        # It takes a while to import, and few motions need it.
        from scipy.optimize import nnls

        wanted = np.concatenate((self.force[frame], self.torque[frame] / ARM_M)) / self.weight
        if not len(points):
            return float(np.linalg.norm(wanted)), np.zeros((0, 3))
        edges = _edges(normals)
        arms = np.broadcast_to((points - self.com[frame])[:, None], edges.shape)
        columns = np.concatenate((edges, np.cross(arms, edges) / ARM_M), -1).reshape(-1, 6).T
        share, left = nnls(columns, wanted)
        forces = (share.reshape(-1, 4)[..., None] * edges).sum(1) * self.weight
        return float(left), forces


def asked(table: BodyTable, pos: Tensor, quat: Tensor, fps: float) -> Asked:
    """What a motion asks of the world; `pos`, `quat`: `(T, B, 3)` m and `(T, B, 4)`, places of its
    rows."""
    mass = np.array([r.mass for r in table.rows])
    com = _smooth(centre_of_mass(table, pos, quat).numpy(), fps)
    parts = _smooth(pos.numpy().reshape(len(pos), -1), fps).reshape(pos.shape)
    rate = np.gradient(parts, axis=0) * fps
    speed = np.gradient(com, axis=0) * fps
    spin = (np.cross(parts - com[:, None], rate - speed[:, None]) * mass[:, None]).sum(1)
    acc = np.gradient(speed, axis=0) * fps
    force = mass.sum() * (acc + np.array([0.0, 0.0, GRAVITY]))
    return Asked(com, force, np.gradient(spin, axis=0) * fps, float(mass.sum() * GRAVITY))


def _edges(normals: np.ndarray) -> np.ndarray:
    """`(K, 4, 3)` edges of the cones about `normals (K, 3)`."""
    other = np.where(np.abs(normals[:, 2:]) > 0.9, [1.0, 0.0, 0.0], [0.0, 0.0, 1.0])
    a = np.cross(normals, other)
    a /= np.linalg.norm(a, axis=-1, keepdims=True)
    b = np.cross(normals, a)
    rough = np.where(np.abs(normals[:, 2:]) > 0.9, FRICTION, OF_A_WALL)[:, None]
    return normals[:, None] + rough * np.stack((a, b, -a, -b), 1)


def _smooth(path: np.ndarray, fps: float) -> np.ndarray:
    """A path `(T, n)` without jitter, see `balance_point`."""
    reach = min(math.ceil(4 * SMOOTH_S * fps), len(path) - 1)
    padded = np.pad(path, ((reach, reach), (0, 0)), mode="reflect", reflect_type="odd")
    kernel = gaussian(SMOOTH_S * fps, reach)
    return np.stack([np.convolve(x, kernel, "valid") for x in padded.T], -1)
