"""Floors of a scene: a plane, steps, a height field."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Protocol

import mujoco
import numpy as np

from poise.errors import PoiseError
from poise.settings import Checked, Range, validate

#: Coefficients of sliding, torsional and rolling friction of floors and props.
FRICTION = (1.0, 0.1, 0.1)


class Floor(Protocol):
    """What characters and props stand on."""

    def add(self, spec: mujoco.MjSpec, friction: float) -> None:
        """Adds its geoms, with names that begin with "floor", to a description.

        friction: coefficient of sliding friction.
        """
        ...


@dataclass(frozen=True)
class Plane:
    """A level plane.

    Attributes:
        height: m, where it is.
    """

    height: float = 0.0

    def add(self, spec: mujoco.MjSpec, friction: float) -> None:
        """Adds one geom "floor"."""
        plane = mujoco.mjtGeom.mjGEOM_PLANE
        geom = spec.worldbody.add_geom(name="floor", type=plane, size=[0, 0, 1], condim=3)
        geom.pos = [0.0, 0.0, self.height]
        geom.friction = [friction, *FRICTION[1:]]


@dataclass(frozen=True)
class Steps(Checked):
    """Stairs that rise along +X, between a plane z = 0 and a landing.

    Attributes:
        count: of steps.
        rise, tread: height and depth of a step, m.
        start: x of the first riser, m.
        width: along Y, centred on y = 0, m.
        landing: depth of the last step, m.
    """

    count: Annotated[int, Range(1, 100)] = 4
    rise: Annotated[float, Range(0, 100, above=True, below=True, unit="m")] = 0.17
    tread: Annotated[float, Range(0, 100, above=True, below=True, unit="m")] = 0.29
    start: float = 1.0
    width: Annotated[float, Range(0, 100, above=True, below=True, unit="m")] = 2.0
    landing: Annotated[float, Range(0, 100, above=True, below=True, unit="m")] = 2.0

    def add(self, spec: mujoco.MjSpec, friction: float) -> None:
        """Adds the plane "floor" and boxes "floor_1", "floor_2", ..., from the lowest up."""
        Plane().add(spec, friction)
        box, end = (
            mujoco.mjtGeom.mjGEOM_BOX,
            self.start + self.count * self.tread - self.tread + self.landing,
        )
        for k in range(self.count):
            # Each reaches to the end, so that there is nothing to fall into below a tread.
            begin, height = self.start + k * self.tread, (k + 1) * self.rise
            geom = spec.worldbody.add_geom(
                name=f"floor_{k + 1}", type=box, condim=3,
                pos=[(begin + end) / 2, 0.0, height / 2],
                size=[(end - begin) / 2, self.width / 2, height / 2],
            )  # fmt: skip
            geom.friction = [friction, *FRICTION[1:]]


@dataclass(frozen=True, eq=False)
class HeightField:
    """A ground of heights on a grid, centred on the origin.

    Attributes:
        heights: `(rows, columns)` m of at least 0; rows go along +Y, columns along +X.
        size: `(x, y)` m, the extent of the grid.
    """

    heights: np.ndarray
    size: Annotated[tuple[float, float], Range(0, above=True, unit="m")]

    def __post_init__(self) -> None:
        validate(self)
        h = self.heights
        if h.ndim != 2 or min(h.shape) < 2:
            raise PoiseError(
                f"heights must be a grid of at least 2 by 2, got {h.shape}",
                "HeightField",
                code="wrong-shape",
            )
        if not np.isfinite(h).all() or h.min() < 0.0:
            raise PoiseError(
                "heights must be finite and at least 0 m", "HeightField", code="out-of-range"
            )

    def add(self, spec: mujoco.MjSpec, friction: float) -> None:
        """Adds one geom "floor"."""
        low, top = float(self.heights.min()), float(self.heights.max())
        if top == low:
            Plane().add(spec, friction)
            spec.geom("floor").pos = [0.0, 0.0, low]
            return
        x, y = self.size
        # MuJoCo takes heights from 0 to 1 of the elevation, and puts the lowest at the geom's place.
        spec.add_hfield(
            name="floor", size=[x / 2, y / 2, top - low, 0.5],
            nrow=self.heights.shape[0], ncol=self.heights.shape[1],
            userdata=((self.heights - low) / (top - low)).astype(np.float32).ravel().tolist(),
        )  # fmt: skip
        field = mujoco.mjtGeom.mjGEOM_HFIELD
        geom = spec.worldbody.add_geom(
            name="floor", type=field, hfieldname="floor", condim=3, pos=[0.0, 0.0, low]
        )
        geom.friction = [friction, *FRICTION[1:]]
