"""A solid from a mesh file, by its convex hull."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from poise.errors import PoiseError
from poise.sim.props.prop import Vector, above_zero, solid


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
    mass: float = 0.0

    def __post_init__(self) -> None:
        if self.mass != 0.0:
            above_zero(f"Mesh '{self.name}'", mass=self.mass)
        if not Path(self.path).is_file():
            raise PoiseError("there is no such file", str(self.path))

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
            raise PoiseError(f"the mesh cannot be used: {text}", str(self.path)) from None
        holes = _open_edges(model.mesh_vert, model.mesh_face)
        if holes:
            raise PoiseError(
                f"the mesh is not closed: {holes} of its edges have no two faces", str(self.path),
                "Fill its holes, or use a box",
            )  # fmt: skip
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
