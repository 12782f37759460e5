"""A table of bodies becomes a MuJoCo model, through `MjSpec`."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from poise.body.body_table import HARD_S, BodyTable
from poise.errors import PoiseError
from poise.motion import Skeleton

if TYPE_CHECKING:
    import mujoco


@dataclass(frozen=True, eq=False)
class Humanoid:
    """A skeleton with a body.

    Attributes:
        table: the parameters; row i is MuJoCo body `i + 1`.
        model: compiled alone, with a free root and one position actuator per hinge (`ctrl` is its target
            angle in rad). It has no floor and MuJoCo's own physics settings: what is simulated is a
            `sim.Scene`, or `sim.alone(humanoid)`. Nothing changes it.
    """

    skeleton: Skeleton
    table: BodyTable
    model: mujoco.MjModel

    @property
    def bodies(self) -> tuple[str, ...]:
        """Body names in the model's order, without the world."""
        return tuple(r.name for r in self.table.rows)

    @property
    def hinges(self) -> tuple[str, ...]:
        """Hinge names in the order of `qpos[7:]`, `qvel[6:]` and `ctrl`."""
        return tuple(name for r in self.table.rows for name in r.hinge_names())

    @property
    def mass(self) -> float:
        """Total mass, kg."""
        return self.table.mass

    def rows_of(self, *kinds: str) -> tuple[int, ...]:
        """Row indices of the parts of the given kinds."""
        return tuple(i for i, r in enumerate(self.table.rows) if r.kind in kinds)

    @property
    def feet(self) -> tuple[int, ...]:
        """Row indices of the feet, left first."""
        rows = self.table.rows
        return tuple(sorted(self.rows_of("foot"), key=lambda i: rows[i].side))

    @property
    def head(self) -> int | None:
        """Row of the head, of the last neck where there is no head, None without either."""
        return next(iter(self.rows_of("head") or self.rows_of("neck")[-1:]), None)

    @property
    def end_effectors(self) -> tuple[int, ...]:
        """Rows of feet, hands and head: the paper's five."""
        head = () if self.head is None else (self.head,)
        return (*self.rows_of("foot"), *self.rows_of("hand"), *head)

    @property
    def left(self) -> tuple[float, float, float]:
        """Unit axis in the root's frame from the right hip to the left one, at zero angles.

        Raises:
            PoiseError: the body has no thigh on either side.
        """
        rows = self.table.rows
        sides = {rows[i].side: i + 1 for i in self.rows_of("thigh")}
        if not {"left", "right"} <= sides.keys():
            raise PoiseError(
                "the body has no two thighs, between which its left is", "Humanoid", code="role-missing"
            )
        import mujoco

        data = mujoco.MjData(self.model)
        data.qpos[:], data.qpos[3] = 0.0, 1.0
        mujoco.mj_kinematics(self.model, data)
        axis = data.xpos[sides["left"]] - data.xpos[sides["right"]]
        x, y, z = (float(a) for a in axis / np.linalg.norm(axis))
        return x, y, z

    @property
    def identity(self) -> str:
        """A short hash of names, hinges and sizes: checkpoints carry it and refuse another body."""
        text = repr([(r.name, r.order, r.parent, np.round(r.pos, 6).tolist()) for r in self.table.rows])
        text += f"{self.mass:.3f}"
        return hashlib.sha256(text.encode()).hexdigest()[:16]


#: Weight of a softer body where contacts of two things are mixed (MuJoCo's `solmix`).
SOFTER = 100.0


def make_spec(table: BodyTable, count: int = 1) -> mujoco.MjSpec:
    """The `MjSpec` of a humanoid with nothing around it, see `add_humanoid`; or of `count` of them, with
    names that begin with `0/`, `1/`, ..."""
    import mujoco

    spec = mujoco.MjSpec()
    spec.modelname = "poise"
    spec.compiler.degree = False
    spec.compiler.autolimits = True
    for k in range(count):
        add_humanoid(spec, table, f"{k}/" if count > 1 else "")
    return spec


def add_humanoid(spec: mujoco.MjSpec, table: BodyTable, prefix: str = "") -> None:
    """Adds a body to a description, with names that begin with `prefix`; damping sits in the joints, the
    torque limit on the actuator's proportional part alone (so that saturation never removes damping)."""
    import mujoco

    kinds = mujoco.mjtGeom
    geoms = {
        "capsule": kinds.mjGEOM_CAPSULE, "box": kinds.mjGEOM_BOX, "sphere": kinds.mjGEOM_SPHERE
    }  # fmt: skip
    made: list[mujoco.MjsBody] = []
    for row in table.rows:
        parent = spec.worldbody if row.parent < 0 else made[row.parent]
        body = parent.add_body(name=prefix + row.name, pos=list(row.pos), quat=list(row.quat))
        made.append(body)
        if row.parent < 0:
            body.add_freejoint(name=f"{prefix}root")
        turn = np.zeros((3, 3))
        mujoco.mju_quat2Mat(turn.reshape(-1), np.array(row.frame))
        for letter, name, limits in zip(row.order, row.hinge_names(), row.ranges, strict=True):
            body.add_joint(
                name=prefix + name,
                type=mujoco.mjtJoint.mjJNT_HINGE,
                axis=turn[:, "XYZ".index(letter)].tolist(),
                range=list(limits),
                armature=row.armature,
                damping=[row.kd, 0.0, 0.0],
            )
        for i, geom in enumerate(row.geoms):
            solid = body.add_geom(
                name=prefix + (f"{row.name}_{i}" if i else row.name),
                type=geoms[geom.kind],
                size=list(geom.size),
                pos=list(geom.pos),
                quat=list(geom.quat),
                mass=row.mass / len(row.geoms),
                condim=1,
                friction=[table.friction, 0.1, 0.1],
            )
            if table.soft_s != HARD_S:
                # It is as soft on whatever it touches, but for what is softer by itself.
                solid.solref, solid.solmix = [table.soft_s, 1.0], SOFTER
    for a, b in table.contact_exclusions:
        spec.add_exclude(bodyname1=prefix + a, bodyname2=prefix + b)
    for row in table.rows:
        for name in row.hinge_names():
            actuator = spec.add_actuator(
                name=prefix + name,
                trntype=mujoco.mjtTrn.mjTRN_JOINT,
                target=prefix + name,
                gaintype=mujoco.mjtGain.mjGAIN_FIXED,
                biastype=mujoco.mjtBias.mjBIAS_AFFINE,
                forcerange=[-row.torque, row.torque],
            )
            actuator.gainprm[0] = row.kp
            actuator.biasprm[1] = -row.kp


def make_humanoid(skeleton: Skeleton, table: BodyTable) -> Humanoid:
    """Compiles a table into a model.

    Raises:
        PoiseError: rows that are not depth first, since MuJoCo would number the bodies otherwise.
    """
    model = make_spec(table).compile()
    for i, row in enumerate(table.rows):
        if model.body(i + 1).name != row.name:
            raise PoiseError(
                f"row {i} of the body table is '{row.name}', but MuJoCo's body {i + 1} is "
                f"'{model.body(i + 1).name}'",
                hint="Order the rows depth first",
                code="body-table-order",
            )
    return Humanoid(skeleton, table, model)
