"""Bring your own body: a humanoid in MJCF, checked before MuJoCo opens it."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree
from xml.parsers.expat import ExpatError

import numpy as np

from poise.body import body_table as presets
from poise.body.body_table import PARTS, BodyRow, BodyTable, Geom, PartNumbers, Strength, floats
from poise.body.parts import find_anatomy
from poise.errors import PoiseError, brief
from poise.formats.limited import read_limited
from poise.formats.text import check_file, shown
from poise.motion import Skeleton
from poise.motion.roles import find_roles

if TYPE_CHECKING:
    import mujoco


#: Bytes of all files, files, elements of each of them, and how deep they may lie.
MOST_BYTES, MOST_FILES, MOST_ELEMENTS, MOST_DEEP = 64 << 20, 200, 50_000, 200
#: What one element may make: pixels, points of a height field, copies, numbers of a size.
MOST_MADE = 1 << 24
MOST_COPIES = 1000


def check_mjcf(path: Path) -> int:
    """Refuses a file that opens others outside its folder, loads plug-ins or asks for huge things.

    Returns:
        bytes of all files of which it is made.
    """
    folder = path.resolve().parent
    waiting, roots, dirs = [path], dict[Path, ElementTree.Element](), {""}
    while waiting:
        file = waiting.pop()
        if file.resolve() in roots:
            continue
        if len(roots) == MOST_FILES:
            raise PoiseError(f"it is made of more than {MOST_FILES} files", path, code="over-limit")
        check_file(file, MOST_BYTES)
        root = roots[file.resolve()] = _tree(file)
        for element in root.iter():
            _check_element(element, file)
            named = element.get("file")
            if element.tag in ("include", "model") and named is not None:
                waiting.append(_inside(named, "", file, folder))
            if element.tag == "compiler":
                dirs |= {element.get(k, "") for k in ("meshdir", "texturedir", "assetdir")}
    assets = set[Path]()
    for root in roots.values():
        for named in {x.get("file", "") for x in root.iter()} - {""}:
            assets |= {_inside(named, inner, path, folder) for inner in dirs}
    size = sum(file.stat().st_size for file in assets | set(roots) if file.is_file())
    if size > MOST_BYTES:
        raise PoiseError(
            f"its files have {size / 1e6:.0f} MB, more than {MOST_BYTES / 1e6:.0f}",
            path,
            code="file-too-big",
        )
    return size


def _inside(named: str, inner: str, file: Path, folder: Path) -> Path:
    """A file that is named, refused where it lies outside the folder of the body."""
    try:
        found = (folder / inner / named).resolve()
        outside = not found.is_relative_to(folder)
    except (ValueError, OSError, RuntimeError):
        found, outside = folder, True
    if outside:
        raise PoiseError(
            f"it names a file outside its folder ({shown(Path(inner) / named)})",
            file,
            "Copy what it needs beside it and name it from there",
            code="outside-folder",
        )
    return found


def _check_element(element: ElementTree.Element, file: Path) -> None:
    """Refuses plug-ins and elements that make more than a body needs."""
    if element.tag in ("extension", "plugin"):
        raise PoiseError(
            "it loads plug-ins, which can run any code", file, "Leave them out", code="content-refused"
        )
    for name, most in (("count", MOST_COPIES), ("nkey", MOST_COPIES), ("nuserdata", MOST_MADE)):
        if element.tag in ("replicate", "composite", "size") or name == "count":
            _bound(element, (name,), most, file)
    _bound(element, ("nrow", "ncol"), MOST_MADE, file)
    _bound(element, ("width", "height"), MOST_MADE, file)


def _bound(element: ElementTree.Element, names: tuple[str, ...], most: int, file: Path) -> None:
    made = 1.0
    for word in " ".join(element.get(n, "") for n in names).split():
        try:
            made *= abs(float(word))
        except ValueError:
            return
    if not (math.isfinite(made) and made <= most):
        what = f"its <{shown(element.tag)[1:-1]}> makes {made:.3g} with {' and '.join(names)}"
        raise PoiseError(
            f"{what}, more than the {most} allowed", file, "Leave it out", code="over-limit"
        )


def _tree(file: Path) -> ElementTree.Element:
    depth, count, root = 0, 0, None
    try:
        text = file.read_bytes()
        if re.search(rb"<!(DOCTYPE|ENTITY)", text, re.IGNORECASE):
            raise PoiseError("it declares entities, which no body needs", file, code="content-refused")
        for event, element in ElementTree.iterparse(file, ("start", "end")):
            depth += 1 if event == "start" else -1
            count, root = count + 1, element if root is None else root
            if depth > MOST_DEEP:
                raise PoiseError(
                    f"its elements lie more than {MOST_DEEP} deep", file, code="nested-too-deep"
                )
            if count > 2 * MOST_ELEMENTS:
                raise PoiseError(f"it has more than {MOST_ELEMENTS} elements", file, code="over-limit")
    except (ElementTree.ParseError, ExpatError, ValueError, LookupError, OSError) as problem:
        raise PoiseError(
            f"MuJoCo cannot read it: {shown(problem)}", file, code="mjcf-unreadable"
        ) from None
    if root is None:
        raise PoiseError("it is empty", file, code="file-empty")
    return root


#: MuJoCo's number of free joints.
_FREE = 0
_SCRIPT = Path(__file__).with_name("mjcf_file.py")
#: Shapes that are kept, and those that become the box around them.
_SHAPES, _BOXED = ("sphere", "capsule", "box"), ("mesh", "cylinder", "ellipsoid")
#: How far (m) the hinges of one body may lie apart, and how far (degrees) from right angles, to be set
#: right with a note.
APART_M, SKEW_DEG = 0.06, 35.0
#: Numbers for hinges of bodies that are no known part, such as toes.
_OTHER = PartNumbers(0.0, 0.0, 100.0, 50.0, 3)


@dataclass(frozen=True, eq=False)
class MjcfBody:
    """A body from a file.

    Attributes:
        skeleton: one joint per body, at its hinges' anchor, standing at identity as the file's default
            pose does.
        table: its rows, in the same order and of the same names.
        notes: what was changed or added.
    """

    skeleton: Skeleton
    table: BodyTable
    notes: tuple[str, ...]


def read_mjcf(path: Path | str, damping: float = 0.02) -> MjcfBody:
    """The humanoid in an MJCF file.

    The file's tree, places, hinges, ranges, masses, gains and torque limits are kept; its shapes become
    capsules, boxes and spheres. A sentence refuses what does not fit, and a note tells what was changed.

    Args:
        path: the file; what it includes (meshes) is read as MuJoCo does, from its own folder alone.
            MuJoCo compiles it in a process of its own, under limits of memory and time.
        damping: joint damping as a fraction of kp in seconds where a hinge has none.

    Raises:
        PoiseError: a file that MuJoCo cannot read (its own message with the line), no free root, ball or
            slide joints, hinges of one body far from right angles or from one another, no human tree;
            files outside its folder, plug-ins, elements that make more than a body needs.
    """
    path = Path(path)
    if not path.is_file():
        raise PoiseError("there is no such file", str(path), code="file-missing")
    try:
        made = read_limited(_SCRIPT, path, check_mjcf(path), "MJCF file", "Make it smaller")
    except PoiseError as problem:
        raise brief(problem, path) from None
    import mujoco

    model = mujoco.MjModel.from_binary_path("body.mjb", {"body.mjb": made["model"].tobytes()})
    reader = _Reader(model, str(path))
    skeleton = reader.skeleton()
    return MjcfBody(skeleton, reader.table(skeleton, damping), tuple(reader.notes))


class _Reader:
    """One compiled model in its default pose."""

    def __init__(self, model: mujoco.MjModel, path: str) -> None:
        import mujoco

        self.model, self.path, self.notes = model, path, []
        self.data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, self.data)
        root = self._root()
        self.bodies = [b for b in range(1, model.nbody) if model.body_rootid[b] == root]
        for b in self.bodies:
            self._check_joints(b)

    def _root(self) -> int:
        free = [int(self.model.jnt_bodyid[j]) for j in np.flatnonzero(self.model.jnt_type == _FREE)]
        if not free:
            raise PoiseError(
                "it has no free root",
                self.path,
                "Give the pelvis a <freejoint/> so that it can move",
                code="no-free-root",
            )
        # Of several free bodies (balls, boxes) the character is the one with most bodies below it.
        return max(free, key=lambda b: int((self.model.body_rootid == b).sum()))

    def _joints(self, body: int) -> list[int]:
        first = self.model.body_jntadr[body]
        every = range(first, first + self.model.body_jntnum[body]) if first >= 0 else range(0)
        return [j for j in every if self.model.jnt_type[j] != _FREE]

    def _check_joints(self, body: int) -> None:
        import mujoco

        name, hinges = self._name(body), self._joints(body)
        for j in hinges:
            kind = _kind(mujoco.mjtJoint(self.model.jnt_type[j]))
            if kind != "hinge":
                raise PoiseError(
                    f"joint '{self.model.joint(j).name}' of body '{name}' is a {kind} joint",
                    self.path,
                    "Use up to three hinges at right angles in its place",
                    code="joint-unsupported",
                )
        if len(hinges) > 3:
            raise PoiseError(
                f"body '{name}' has {len(hinges)} hinges, at most 3 can be used",
                self.path,
                code="joint-unsupported",
            )
        if not hinges:
            return
        anchors, axes = self.data.xanchor[hinges], self.data.xaxis[hinges]
        apart = float(np.linalg.norm(anchors - anchors[0], axis=-1).max())
        if apart > APART_M:
            raise PoiseError(
                f"the hinges of body '{name}' lie {apart * 1000:.0f} mm apart and cannot be one joint",
                self.path,
                code="joint-unsupported",
            )
        skew = math.degrees(math.asin(min(1.0, np.abs(axes @ axes.T - np.eye(len(hinges))).max())))
        if skew > SKEW_DEG:
            raise PoiseError(
                f"the hinges of body '{name}' are {skew:.0f} degrees off right angles",
                self.path,
                code="joint-unsupported",
            )
        if apart > 1e-3 or skew > 1.0:
            self.notes.append(
                f"The hinges of body '{name}', {apart * 1000:.0f} mm apart and {skew:.0f} degrees off "
                "right angles, were set at right angles through the first one's place."
            )

    def _name(self, body: int) -> str:
        return self.model.body(body).name or f"body{body}"

    def _origin(self, body: int) -> np.ndarray:
        """Where a body's joint is in the default pose, m."""
        hinges = self._joints(body)
        return self.data.xanchor[hinges[0]] if hinges else self.data.xpos[body]

    def skeleton(self) -> Skeleton:
        """The tree as a skeleton with the world's frames in the default pose."""
        at = {b: i for i, b in enumerate(self.bodies)}
        parents = tuple(at.get(int(self.model.body_parentid[b]), -1) for b in self.bodies)
        origins = np.array([self._origin(b) for b in self.bodies])
        offsets = np.array(
            [o - origins[p] if p >= 0 else 0 * o for o, p in zip(origins, parents, strict=True)]
        )
        names = [self._name(b) for b in self.bodies]
        made = Skeleton(tuple(names), parents, offsets).with_source(path=self.path)
        roles = find_roles(made)
        for side in ("left", "right"):
            forearm = roles.joint(f"{side}_forearm")
            if forearm is None or roles.joint(f"{side}_hand") is not None:
                continue
            # Many bodies end in the forearm; the hand's joint then has no body and marks its tip.
            body = self.bodies[forearm]
            middle = np.mean([np.array(g.pos) for g in self._geoms(body, 1.0)], 0)
            made = replace(
                made,
                names=(*made.names, f"{side}_hand"),
                parents=(*made.parents, forearm),
                offsets=np.concatenate((made.offsets, [2.0 * middle])),
            )
            self.notes.append(f"There is no {side} hand; the end of '{self._name(body)}' stands for it.")
        return made

    def table(self, skeleton: Skeleton, damping: float) -> BodyTable:
        """The rows; `find_anatomy` raises where the tree is no human's."""
        parts = {p.joint: p for p in find_anatomy(skeleton).parts}
        rest = skeleton.rest_positions()
        side = {p.kind: p.joint for p in parts.values() if p.side == "left"}
        leg = sum(
            float(np.linalg.norm(rest[side[a]] - rest[side[b]]))
            for a, b in (("thigh", "shin"), ("shin", "foot"))
        )
        height = leg * presets.HEIGHT_PER_LEG
        mass = float(self.model.body_mass[self.bodies].sum())
        strength = Strength.of(mass, height)
        rows: list[BodyRow] = []
        for i, b in enumerate(self.bodies):
            part, hinges = parts.get(i), self._joints(b)
            numbers = PARTS[part.kind] if part else _OTHER
            if part and part.kind == "pelvis" and i:
                raise PoiseError(
                    f"the pelvis '{self._name(b)}' is not the body with the free joint",
                    self.path,
                    code="no-free-root",
                )
            order, frame = _axes(self.data.xaxis[hinges])
            kp, torque = self._gains(hinges, numbers, strength)
            dofs = self.model.jnt_dofadr[hinges]
            own_damping = float(self.model.dof_damping[dofs].max(initial=0.0))
            armature = float(self.model.dof_armature[dofs].max(initial=0.0))
            rows.append(
                BodyRow(
                    name=skeleton.names[i],
                    joint=i,
                    kind=part.kind if part else "pelvis" if not i else "other",
                    side=part.side if part else "",
                    parent=skeleton.parents[i],
                    pos=floats(skeleton.offsets[i]),
                    quat=(1.0, 0.0, 0.0, 0.0),
                    order=order,
                    frame=frame,
                    ranges=tuple(self._range(j) for j in hinges),
                    mass=float(self.model.body_mass[b]),
                    kp=kp,
                    kd=own_damping or kp * damping * strength.time,
                    torque=torque,
                    armature=armature or 0.01 * strength.inertia,
                    geoms=self._geoms(b, height),
                )
            )
        if self.model.jnt_stiffness[[j for b in self.bodies for j in self._joints(b)]].any():
            self.notes.append("Springs in its joints are left out.")
        if self.model.neq or self.model.ntendon:
            self.notes.append("Tendons and equality constraints are left out.")
        if self._added:
            self.notes.append(f"Position servos were added to {self._added} of the hinges.")
        return BodyTable(tuple(rows), height, contact_exclusions=self._exclusions())

    _added = 0

    def _range(self, joint: int) -> tuple[float, float]:
        if not self.model.jnt_limited[joint]:
            return -math.pi, math.pi
        zero = float(self.model.qpos0[self.model.jnt_qposadr[joint]])
        low, high = (float(v) - zero for v in self.model.jnt_range[joint])
        return low, high

    def _gains(self, hinges: list[int], numbers: PartNumbers, strength: Strength) -> tuple[float, float]:
        """kp and torque limit of a body: the largest among its hinges', else those of its part."""
        import mujoco

        model = self.model
        kps, torques = [], []
        for j in hinges:
            mine = (model.actuator_trntype == int(mujoco.mjtTrn.mjTRN_JOINT)) & (
                model.actuator_trnid[:, 0] == j
            )
            for a in np.flatnonzero(mine):
                gain, gear = float(model.actuator_gainprm[a, 0]), abs(float(model.actuator_gear[a, 0]))
                servo = model.actuator_biasprm[a, 1] < 0
                if servo:
                    kps.append(gain * gear**2)
                limits = model.actuator_forcerange[a] * gear
                if not model.actuator_forcelimited[a] and not servo and model.actuator_ctrllimited[a]:
                    limits = model.actuator_ctrlrange[a] * gain * gear
                if np.abs(limits).max() > 0:
                    torques.append(float(np.abs(limits).max()))
            self._added += not mine.any() or not (model.actuator_biasprm[mine, 1] < 0).any()
        kp = max(kps, default=numbers.kp * strength.torque)
        return kp, max(torques, default=numbers.torque * strength.torque)

    def _geoms(self, body: int, height: float) -> tuple[Geom, ...]:
        """The shapes that collide (all where none does) in the frame of the default pose."""
        import mujoco

        model, data, origin = self.model, self.data, self._origin(body)
        every = [g for g in range(model.ngeom) if model.geom_bodyid[g] == body]
        colliding = [g for g in every if model.geom_contype[g] or model.geom_conaffinity[g]]
        out = []
        for g in colliding or every:
            kind, size = _kind(mujoco.mjtGeom(model.geom_type[g])), model.geom_size[g].copy()
            turn, quat = data.geom_xmat[g].reshape(3, 3), np.zeros(4)
            pos = data.geom_xpos[g] - origin
            if kind in _BOXED:
                self.notes.append(f"The {kind} of body '{self._name(body)}' became the box around it.")
                kind, size = "box", np.maximum(model.geom_aabb[g, 3:], 1e-3)
                pos = pos + turn @ model.geom_aabb[g, :3]
            if kind not in _SHAPES:
                continue
            mujoco.mju_mat2Quat(quat, turn.reshape(-1))
            out.append(Geom(kind, floats(size), floats(pos), floats(quat)))
        if not out:
            out.append(Geom("sphere", (0.01 * height, 0.0, 0.0), floats(data.xipos[body] - origin)))
            self.notes.append(f"Body '{self._name(body)}' has no shape; it got a small sphere.")
        return tuple(out)

    def _exclusions(self) -> tuple[tuple[str, str], ...]:
        pairs = ((int(s) >> 16, int(s) & 0xFFFF) for s in self.model.exclude_signature)
        return tuple(
            (self._name(a), self._name(b)) for a, b in pairs if a in self.bodies and b in self.bodies
        )


def _kind(kind: Any) -> str:
    """What MuJoCo calls a kind of joint or geom: "hinge", "mesh"."""
    return kind.name.split("_")[1].lower()


def _axes(axes: np.ndarray) -> tuple[str, tuple[float, float, float, float]]:
    """Letters of orthogonal hinge axes `(n, 3)` and the frame (wxyz) in which they are letters."""
    if not len(axes):
        return "", (1.0, 0.0, 0.0, 0.0)
    nearest = [int(np.abs(a).argmax()) for a in axes]
    if all(a[i] > 0.9999 for a, i in zip(axes, nearest, strict=True)):
        return "".join("XYZ"[i] for i in nearest), (1.0, 0.0, 0.0, 0.0)
    first = axes[0] / np.linalg.norm(axes[0])
    other = axes[1] if len(axes) > 1 else np.eye(3)[int(np.abs(first).argmin())]
    second = other - (other @ first) * first
    second = second / np.linalg.norm(second)
    third, letters = np.cross(first, second), "XYZ"[: len(axes)]
    matrix = np.stack((first, second, third), 1)
    if len(axes) == 3 and axes[2] @ third < 0:
        # A left-handed triple: its second axis is the frame's Z, its third the frame's Y.
        matrix, letters = np.stack((first, -third, second), 1), "XZY"
    import mujoco

    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, matrix.reshape(-1))
    return letters, floats(quat)
