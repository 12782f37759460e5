"""Links of a scene, bodies that hold one another, and where each thing stands in the model's arrays."""

# pyright: reportUnknownArgumentType=false, reportUnknownVariableType=false
from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import mujoco
import numpy as np

from poise.errors import PoiseError
from poise.settings import validate

#: m; links of bodies that are farther apart when they are switched on are a mistake.
FAR_M = 0.5
#: Impedance of links where they hold, and where they give way, see MuJoCo's `solimp`.
STIFF = (0.99, 0.999)


@dataclass(frozen=True)
class Link:
    """Two bodies that hold one another while the link is on.

    Attributes:
        name: how the scene calls it.
        a, b: names of bodies, such as "door" or "anna/left_hand".
        kind: "weld" keeps place and turn of `b` as seen from `a`; "ball" keeps a point together about
            which both turn.
        at: m, the point of `b` in its own frame that is held.
        to: m, the point of `a` in its own frame that holds it; None for where `at` is when the link is
            switched on. For a weld always None.
        on: whether it holds from the beginning.
        measured: whether its force is, see `SceneSim.link`; one of the two must not be a character's.
        turn_m: m, of a weld, how much its torques count against its forces: a small number holds the
            place firmly and the turn loosely, as a hand does.
        touch: whether the two bodies touch one another as well; without, the link carries all.
    """

    name: str
    a: str
    b: str
    kind: Literal["weld", "ball"] = "weld"
    at: tuple[float, float, float] = (0.0, 0.0, 0.0)
    to: tuple[float, float, float] | None = None
    on: bool = False
    measured: bool = False
    turn_m: float = 1.0
    touch: bool = True

    def __post_init__(self) -> None:
        validate(self)
        if self.a == self.b:
            raise PoiseError(
                f"a link joins two bodies, got '{self.a}' twice",
                f"Link '{self.name}'",
                code="name-repeated",
            )
        if self.kind == "weld" and self.to is not None:
            raise PoiseError(
                "a weld keeps bodies as they are, it has no `to`",
                f"Link '{self.name}'",
                code="settings-conflict",
            )

    @property
    def hook(self) -> str:
        """The body without a joint that holds in place of `a` or `b` where the force is measured."""
        return f"link {self.name}"

    def add(self, spec: mujoco.MjSpec, hooked: str | None = None) -> None:
        """Adds the constraint to a description.

        hooked: the one of `a` and `b` in place of which a body without a joint holds; its sensors
            measure what it passes on. None measures nothing.
        """
        ends = [self.a, self.b]
        if hooked is not None:
            body = spec.body(hooked).add_body(name=self.hook)
            body.add_site(name=self.hook, pos=list(self.at if hooked == self.b else (0.0, 0.0, 0.0)))
            for kind in ("force", "torque"):
                sensor = getattr(mujoco.mjtSensor, f"mjSENS_{kind.upper()}")
                spec.add_sensor(
                    name=f"{self.hook} {kind}", type=sensor,
                    objtype=mujoco.mjtObj.mjOBJ_SITE, objname=self.hook,
                )  # fmt: skip
            ends[ends.index(hooked)] = self.hook
        kinds = {"weld": mujoco.mjtEq.mjEQ_WELD, "ball": mujoco.mjtEq.mjEQ_CONNECT}
        constraint = spec.add_equality(
            name=self.name, type=kinds[self.kind], objtype=mujoco.mjtObj.mjOBJ_BODY,
            name1=ends[0], name2=ends[1], active=self.on,
        )  # fmt: skip
        if not self.touch:
            spec.add_exclude(bodyname1=self.a, bodyname2=self.b)
        # As stiff as the physics rate permits: at 60 Hz a body that hangs by it sinks 1 cm.
        constraint.solimp[:2] = list(STIFF)
        if self.kind == "weld":
            constraint.data[10] = self.turn_m
        # Equality data: a weld's anchor (on b) and relative pose; a ball joint's anchor (on a), where
        # both ends are set when it is switched on.
        constraint.data[:3] = list(self.at if self.kind == "weld" else self.to or (0.0, 0.0, 0.0))


_FREE = int(mujoco.mjtJoint.mjJNT_FREE)
_BALL = int(mujoco.mjtJoint.mjJNT_BALL)
_JOINT, _SITE = int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_SITE)


@dataclass(frozen=True)
class ModelSlices:
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


def place_of(model: mujoco.MjModel, name: str, body: int) -> ModelSlices:
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
    return ModelSlices(
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
        raise PoiseError(
            f"MuJoCo does not number what belongs to '{name}' side by side", "Scene", code="rows-apart"
        )
    return slice(int(rows[0]), int(rows[-1]) + 1)
