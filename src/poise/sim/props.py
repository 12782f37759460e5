"""Props of a scene: whatever is no character."""

# pyright: reportUnknownArgumentType=false, reportUnknownVariableType=false
from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Protocol

import mujoco
import numpy as np

from poise.errors import PoiseError
from poise.settings import Checked, NotNegative, Positive, Range, validate
from poise.sim.floor import FRICTION

Vector = tuple[float, float, float]


class Prop(Protocol):
    """A thing in a scene: one tree of bodies; the first has the prop's name.

    All names that it gives in a description are its own name, or begin with it and "/".
    """

    @property
    def name(self) -> str:
        """How the scene calls it."""
        ...

    def add(self, spec: mujoco.MjSpec) -> None:
        """Adds its bodies, joints, actuators and assets to a description."""
        ...


def solid(
    body: mujoco.MjsBody,
    name: str,
    kind: str,
    size: Sequence[float],
    touched: bool = True,
    **more: Any,
) -> mujoco.MjsGeom:
    """Adds a geom with the friction of props: "box", "sphere", "capsule", "cylinder" or "mesh".

    touched: whether anything touches it.
    """
    geom = body.add_geom(
        name=name, type=getattr(mujoco.mjtGeom, f"mjGEOM_{kind.upper()}"), condim=3, **more
    )
    geom.size = [*size, *[0.0] * (3 - len(size))]
    geom.friction = list(FRICTION)
    if not touched:
        geom.contype = geom.conaffinity = 0
    return geom


@dataclass(frozen=True)
class Box(Checked):
    """A box.

    Attributes:
        name: how the scene calls it.
        size: m, its full extents.
        pos: m, its centre at first.
        quat: wxyz, box to world at first.
        mass: kg; 0 fixes it to the world.
        soft_s: s, time constant of its contacts (MuJoCo's `solref`, at an impedance of a half), as of
            a cushion or a punching bag; 0 leaves it as hard as everything else.
    """

    name: str = "box"
    size: Annotated[Vector, Range(0, above=True)] = (0.4, 0.4, 0.4)
    pos: Vector = (0.0, 0.0, 0.2)
    quat: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    mass: NotNegative = 0.0
    soft_s: Annotated[float, Range(0, 1, unit="s")] = 0.0

    def add(self, spec: mujoco.MjSpec) -> None:
        """Adds one body."""
        body = spec.worldbody.add_body(name=self.name, pos=list(self.pos), quat=list(self.quat))
        if self.mass:
            body.add_freejoint(name=self.name)
        geom = solid(body, self.name, "box", [s / 2 for s in self.size], mass=self.mass)
        if self.soft_s:
            # Its own softness counts, not a mean with that of what touches it; the half is that of
            # `scene.FLESH`.
            geom.solref, geom.priority = [self.soft_s, 1.0], 1
            geom.solimp[:2] = [0.5, 0.5]


#: kg; what touches it hardly moves it between two control steps.
MASS = 1e5
AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


@dataclass(frozen=True)
class Carrier(Checked):
    """A plate with a motion of its own: a moving walkway, a hand that leads, a vehicle.

    A mocap body of MuJoCo has no velocity, so that it carries nothing and pulls with a lag. This one is
    so heavy that nothing turns it from its way: set its four coordinates (x, y, z in m from `pos`, and
    the turn about Z in rad) and their rates each control step (`SceneSim.place`), and it keeps that
    velocity until the next.

    Attributes:
        name: how the scene calls it.
        size: m, its full extents.
        pos: m, its centre at coordinates 0.
        touched: whether things touch it; a hand that leads by a link need not be touched.
    """

    name: str = "carrier"
    size: Annotated[Vector, Range(0, above=True)] = (1.0, 1.0, 0.1)
    pos: Vector = (0.0, 0.0, 0.05)
    touched: bool = True

    def add(self, spec: mujoco.MjSpec) -> None:
        """Adds one body on three slides and a hinge."""
        body = spec.worldbody.add_body(name=self.name, pos=list(self.pos), gravcomp=1.0)
        for axis, along in AXES.items():
            slide = mujoco.mjtJoint.mjJNT_SLIDE
            body.add_joint(name=f"{self.name}/{axis}", type=slide, axis=list(along))
        hinge = mujoco.mjtJoint.mjJNT_HINGE
        body.add_joint(name=f"{self.name}/turn", type=hinge, axis=[0, 0, 1])
        solid(body, self.name, "box", [s / 2 for s in self.size], self.touched, mass=MASS)
        # The floor would hold it back.
        spec.add_exclude(bodyname1="world", bodyname2=self.name)


#: From the door's free edge to the knobs, their height above its lower edge, and their radius, m.
KNOB_IN, KNOB_UP, KNOB_R = 0.07, 1.0, 0.03


@dataclass(frozen=True)
class Door(Checked):
    """A leaf that turns about the vertical through its hinge; closed it reaches along +Y.

    It has one coordinate, the angle it is open, rad.

    Attributes:
        name: how the scene calls it.
        pos: m, the foot of its hinge.
        width, height, thickness: of the leaf, m.
        mass: kg.
        opens: rad, how far to either side.
        damping: N m s/rad, of the hinge.
        friction: N m, of the hinge.
        knob_up: m, of the knobs above the foot of the hinge.
    """

    name: str = "door"
    pos: Vector = (1.0, -0.45, 0.0)
    width: Positive = 0.9
    height: Positive = 2.0
    thickness: Positive = 0.04
    mass: Positive = 20.0
    opens: Positive = 2.0
    damping: float = 1.0
    friction: float = 0.5
    knob_up: float = KNOB_UP

    @property
    def knob(self) -> Vector:
        """The front knob's centre, m, in the leaf's frame."""
        return -(self.thickness / 2 + KNOB_R), self.width - KNOB_IN, self.knob_up

    def add(self, spec: mujoco.MjSpec) -> None:
        """Adds one body with a hinge; the geoms of the knobs are "NAME/knob_front" (toward -X) and
        "NAME/knob_back"."""
        body = spec.worldbody.add_body(name=self.name, pos=list(self.pos))
        body.add_joint(
            name=self.name,
            type=mujoco.mjtJoint.mjJNT_HINGE,
            axis=[0, 0, 1],
            range=[-self.opens, self.opens],
            limited=True,
            damping=[self.damping, 0, 0],
            frictionloss=self.friction,
        )
        gap = 0.01
        half = [self.thickness / 2, self.width / 2, (self.height - gap) / 2]
        at = [0.0, self.width / 2, gap + half[2]]
        solid(body, f"{self.name}/leaf", "box", half, pos=at, mass=0.97 * self.mass)
        for side, sign in (("front", -1.0), ("back", 1.0)):
            at = [-sign * self.knob[0], *self.knob[1:]]
            name, share = f"{self.name}/knob_{side}", 0.015 * self.mass
            solid(body, name, "sphere", [KNOB_R], pos=at, mass=share)


@dataclass(frozen=True)
class Lift(Checked):
    """A plate on a vertical slide, driven toward a height by a spring and a damper.

    It has one coordinate, the height above `pos`, m, and one control, the height wanted.

    Attributes:
        name: how the scene calls it.
        size: `(x, y)` m.
        pos: m, the middle of its upper face at height 0.
        mass: kg.
        stiffness: N/m.
        damping: N s/m.
        travel: m, how far up and down.
    """

    name: str = "lift"
    size: Annotated[tuple[float, float], Range(0, above=True)] = (1.5, 1.5)
    pos: Vector = (0.0, 0.0, 0.3)
    mass: Positive = 20.0
    stiffness: Positive = 2e4
    damping: Positive = 500.0
    travel: Positive = 0.3

    def add(self, spec: mujoco.MjSpec) -> None:
        """Adds one body with a slide and its actuator."""
        body = spec.worldbody.add_body(name=self.name, pos=list(self.pos), gravcomp=1.0)
        body.add_joint(
            name=self.name,
            type=mujoco.mjtJoint.mjJNT_SLIDE,
            axis=[0, 0, 1],
            limited=True,
            range=[-self.travel, self.travel],
            damping=[self.damping, 0, 0],
        )
        half, x, y = 0.02, *self.size
        at = [0.0, 0.0, -half]
        solid(body, self.name, "box", [x / 2, y / 2, half], pos=at, mass=self.mass)
        servo = spec.add_actuator(
            name=self.name,
            target=self.name,
            trntype=mujoco.mjtTrn.mjTRN_JOINT,
            gaintype=mujoco.mjtGain.mjGAIN_FIXED,
            biastype=mujoco.mjtBias.mjBIAS_AFFINE,
        )
        servo.gainprm[0], servo.biasprm[1] = self.stiffness, -self.stiffness


@dataclass(frozen=True)
class Mesh:
    """A solid with a closed mesh as its surface; contacts see its convex hull.

    Attributes:
        path: an OBJ or STL file, in metres, Z up.
        name: how the scene calls it.
        pos: m, where the file's origin is at first.
        quat: wxyz, file to world at first.
        mass: kg; 0 fixes it to the world.
    """

    path: Path
    name: str = "mesh"
    pos: Vector = (0.0, 0.0, 0.0)
    quat: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    mass: NotNegative = 0.0

    def __post_init__(self) -> None:
        validate(self)
        if not Path(self.path).is_file():
            raise PoiseError("there is no such file", str(self.path), code="file-missing")

    def add(self, spec: mujoco.MjSpec) -> None:
        """Adds the mesh and one body.

        Raises:
            PoiseError: a file that MuJoCo cannot read, or a surface that is not closed.
        """
        alone = mujoco.MjSpec()
        alone.add_mesh(name="mesh", file=str(Path(self.path).resolve()))
        alone.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="mesh")
        try:
            model = alone.compile()
        except ValueError as problem:
            text = " ".join(str(problem).split()).removeprefix("Error: ")
            raise PoiseError(
                f"the mesh cannot be used: {text}", str(self.path), code="mesh-unusable"
            ) from None
        holes = _open_edges(model.mesh_vert, model.mesh_face)
        if holes:
            raise PoiseError(
                f"the mesh is not closed: {holes} of its edges have no two faces",
                str(self.path),
                "Fill its holes, or use a box",
                code="mesh-unusable",
            )
        spec.add_mesh(name=self.name, file=str(Path(self.path).resolve()))
        body = spec.worldbody.add_body(name=self.name, pos=list(self.pos), quat=list(self.quat))
        if self.mass:
            body.add_freejoint(name=self.name)
        solid(body, self.name, "mesh", (), meshname=self.name, mass=self.mass)


def _open_edges(vertices: np.ndarray, faces: np.ndarray) -> int:
    """Edges that do not belong to two faces; vertices at one place are one."""
    _, same = np.unique(np.round(vertices, 6), axis=0, return_inverse=True)
    corners = same.reshape(-1)[faces]
    edges = np.sort(np.concatenate([corners[:, [i, (i + 1) % 3]] for i in range(3)]), axis=1)
    count = Counter(map(tuple, edges.tolist()))
    return sum(n != 2 for n in count.values())


@dataclass(frozen=True)
class Ball(Checked):
    """A free ball.

    Attributes:
        name: how the scene calls it.
        radius: m.
        mass: kg.
        pos: m, its centre at first.
        touched: whether things touch it; what hands hold by links need not be touched.
    """

    name: str = "ball"
    radius: Positive = 0.12
    mass: Positive = 0.6
    pos: Vector = (0.0, 0.0, 0.12)
    touched: bool = True

    def add(self, spec: mujoco.MjSpec) -> None:
        """Adds one body."""
        body = spec.worldbody.add_body(name=self.name, pos=list(self.pos))
        body.add_freejoint(name=self.name)
        solid(body, self.name, "sphere", [self.radius], self.touched, mass=self.mass)
