"""What a prop is, and what most of them need."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import mujoco

from poise.errors import PoiseError
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
    body: mujoco.MjsBody, name: str, kind: str, size: Sequence[float], **more: Any
) -> mujoco.MjsGeom:
    """Adds a geom with the friction of props: "box", "sphere", "capsule", "cylinder" or "mesh"."""
    geom = body.add_geom(
        name=name, type=getattr(mujoco.mjtGeom, f"mjGEOM_{kind.upper()}"), condim=3, **more
    )
    geom.size = [*size, *[0.0] * (3 - len(size))]
    geom.friction = list(FRICTION)
    return geom


def above_zero(where: str, **values: float | Sequence[float]) -> None:
    """Raises where a number, or one of several, is not finite and above 0."""
    for name, value in values.items():
        numbers = value if isinstance(value, Sequence) else (value,)
        if not all(0.0 < x < float("inf") for x in numbers):
            raise PoiseError(f"{name} must be above 0, got {value}", where)
