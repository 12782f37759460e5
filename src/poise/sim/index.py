"""Where each thing of a scene stands in the arrays of its model."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from poise.errors import PoiseError

_FREE = int(mujoco.mjtJoint.mjJNT_FREE)
_BALL = int(mujoco.mjtJoint.mjJNT_BALL)
_JOINT, _SITE = int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_SITE)


@dataclass(frozen=True)
class Place:
    """The rows of one thing; each is one slice of MuJoCo's arrays.

    Attributes:
        name: of the thing.
        bodies: of `xpos`, `xfrc_applied`, ...; the world is body 0 and belongs to no thing.
        qpos: of `qpos`.
        dofs: of `qvel` and `qfrc_applied`.
        controls: of `ctrl` and `actuator_force`.
        geoms: of `geom_xpos`.
    """

    name: str
    bodies: slice
    qpos: slice
    dofs: slice
    controls: slice
    geoms: slice

    @property
    def body(self) -> int:
        """Its first body."""
        return self.bodies.start

    @property
    def coordinates(self) -> int:
        """How many coordinates it has; 0 where it is fixed to the world."""
        return self.qpos.stop - self.qpos.start


def place_of(model: mujoco.MjModel, name: str, body: int) -> Place:
    """The place of the tree of bodies that begins at `body`, a child of the world."""
    bodies = np.flatnonzero(model.body_rootid == body)
    joints = np.flatnonzero(np.isin(model.jnt_bodyid, bodies))
    wide = np.where(model.jnt_type == _FREE, 7, np.where(model.jnt_type == _BALL, 4, 1))
    coordinates = [
        np.arange(n) + at for n, at in zip(wide[joints], model.jnt_qposadr[joints], strict=True)
    ]
    at, by = model.actuator_trnid[:, 0], model.actuator_trntype
    sites = np.flatnonzero(np.isin(model.site_bodyid, bodies))
    driven = (by == _JOINT) & np.isin(at, joints) | (by == _SITE) & np.isin(at, sites)
    return Place(
        name,
        _slice(name, bodies),
        _slice(name, np.concatenate(coordinates) if coordinates else np.array([], int)),
        _slice(name, np.flatnonzero(np.isin(model.dof_bodyid, bodies))),
        _slice(name, np.flatnonzero(driven)),
        _slice(name, np.flatnonzero(np.isin(model.geom_bodyid, bodies))),
    )


def _slice(name: str, rows: np.ndarray) -> slice:
    if not len(rows):
        return slice(0, 0)
    if not (np.diff(rows) == 1).all():
        raise PoiseError(f"MuJoCo does not number what belongs to '{name}' side by side", "Scene")
    return slice(int(rows[0]), int(rows[-1]) + 1)
