"""Rigs that walk, made by hand with their own forward kinematics, and written in four formats.

Metres, Y up, facing +Z; rotations as SciPy's. Nothing of Poise is used.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from handmade_fbx_files import TICKS, _curve
from handmade_gltf_files import Gltf
from scipy.spatial.transform import Rotation

FPS = 30
PERSON = (
    ("pelvis", None, (0.0, 0.95, 0.0)),
    ("spine", "pelvis", (0.0, 0.15, 0.0)),
    ("neck", "spine", (0.0, 0.35, 0.0)),
    ("head", "neck", (0.0, 0.12, 0.01)),
    ("upperarm_l", "spine", (0.18, 0.28, 0.0)),
    ("forearm_l", "upperarm_l", (0.28, 0.0, 0.0)),
    ("hand_l", "forearm_l", (0.25, 0.0, 0.0)),
    ("upperarm_r", "spine", (-0.18, 0.28, 0.0)),
    ("forearm_r", "upperarm_r", (-0.28, 0.0, 0.0)),
    ("hand_r", "forearm_r", (-0.25, 0.0, 0.0)),
    ("thigh_l", "pelvis", (0.09, -0.05, 0.0)),
    ("calf_l", "thigh_l", (0.0, -0.42, 0.0)),
    ("foot_l", "calf_l", (0.0, -0.41, 0.0)),
    ("ball_l", "foot_l", (0.0, -0.05, 0.13)),
    ("thigh_r", "pelvis", (-0.09, -0.05, 0.0)),
    ("calf_r", "thigh_r", (0.0, -0.42, 0.0)),
    ("foot_r", "calf_r", (0.0, -0.41, 0.0)),
    ("ball_r", "foot_r", (0.0, -0.05, 0.13)),
)
"""Name, parent and place below it."""


@dataclass(frozen=True)
class Rig:
    """Joints, each with its place `(T, 3)` m and rotation (T of them) in its parent's frame."""

    names: tuple[str, ...]
    parents: tuple[int, ...]
    place: tuple[np.ndarray, ...]
    turn: tuple[Rotation, ...]

    @property
    def frames(self) -> int:
        return len(self.place[0])

    def world(self) -> np.ndarray:
        """`(T, J, 3)` m, where each joint stands, Z up."""
        at: list[np.ndarray] = []
        turned: list[Rotation] = []
        for j, up in enumerate(self.parents):
            at.append(self.place[j] if up < 0 else at[up] + turned[up].apply(self.place[j]))
            turned.append(self.turn[j] if up < 0 else turned[up] * self.turn[j])
        x, y, z = np.moveaxis(np.stack(at, 1), -1, 0)
        return np.stack((x, -z, y), -1)

    def index(self, name: str) -> int:
        return self.names.index(name)

    def moved(self, name: str, place: object) -> Rig:
        """The rig with other places of a joint, `(T, 3)` or `(3,)`."""
        new = list(self.place)
        new[self.index(name)] = np.array(np.broadcast_to(place, (self.frames, 3)), dtype=float)
        return replace(self, place=tuple(new))

    def turned(self, name: str, turn: Rotation) -> Rig:
        new = list(self.turn)
        new[self.index(name)] = turn
        return replace(self, turn=tuple(new))

    def with_joint(self, name: str, parent: str, place: object) -> Rig:
        """The rig with one more joint, which does not turn."""
        t = self.frames
        at = np.array(np.broadcast_to(place, (t, 3)), dtype=float)
        return Rig(
            (*self.names, name),
            (*self.parents, self.index(parent)),
            (*self.place, at),
            (*self.turn, Rotation.identity(t)),
        )

    def below(self, *above: tuple[str, object]) -> Rig:
        """The rig below joints of those names and places, outermost first, which do not turn."""
        k, t = len(above), self.frames
        places = [np.array(np.broadcast_to(p, (t, 3)), dtype=float) for _, p in above]
        return Rig(
            (*(n for n, _ in above), *self.names),
            (*range(-1, k - 1), *(p + k for p in self.parents)),
            (*places, *self.place),
            (*[Rotation.identity(t)] * k, *self.turn),
        )


def walker(frames: int = 31, speed: float = 1.1, prefix: str = "") -> Rig:
    """A person whose pelvis travels along +Z, with legs and arms that swing."""
    t = np.arange(frames) / FPS
    swing = np.sin(2 * np.pi * t)
    degrees = {
        "thigh_l": -25 * swing, "thigh_r": 25 * swing,
        "calf_l": 25 + 20 * swing, "calf_r": 25 - 20 * swing,
        "upperarm_l": 20 * swing, "upperarm_r": -20 * swing, "spine": 4 * swing, "pelvis": 3 + 0 * t,
        "forearm_l": 10 + 5 * swing, "forearm_r": 10 - 5 * swing,
    }  # fmt: skip
    names = [n for n, _, _ in PERSON]
    rig = Rig(
        tuple(prefix + n for n in names),
        tuple(-1 if p is None else names.index(p) for _, p, _ in PERSON),
        tuple(np.tile(np.array(at), (frames, 1)) for _, _, at in PERSON),
        tuple(
            Rotation.from_rotvec(np.outer(np.radians(degrees.get(n, 0 * t)), (1, 0, 0))) for n in names
        ),
    )
    path = np.stack((0 * t, 0.95 + 0.02 * np.cos(4 * np.pi * t), speed * t), -1)
    return rig.moved(prefix + "pelvis", path)


def bvh_of(rig: Rig, *others: Rig) -> str:
    """BVH in centimetres; joints whose places vary have position channels. More rigs are more ROOTs."""
    lines, columns = ["HIERARCHY"], []
    for one in (rig, *others):
        _bvh_joint(one, 0, lines, columns)
    rows = np.concatenate(columns, 1)
    lines += ["MOTION", f"Frames: {len(rows)}", f"Frame Time: {1 / FPS:.9f}"]
    return "\n".join([*lines, *(" ".join(f"{x:.6f}" for x in row) for row in rows)]) + "\n"


def _bvh_joint(rig: Rig, top: int, lines: list[str], columns: list[np.ndarray]) -> None:
    stack: list[int | None] = [top]
    while stack:
        j = stack.pop()
        if j is None:
            lines.append("}")
            continue
        at = rig.place[j] * 100
        moves = rig.parents[j] < 0 or np.ptp(at, axis=0).max() > 0
        lines += [f"{'ROOT' if rig.parents[j] < 0 else 'JOINT'} {rig.names[j]}", "{"]
        lines.append("OFFSET " + " ".join(f"{x:.6f}" for x in at[0]))
        channels = ["Xposition", "Yposition", "Zposition"] if moves else []
        channels += ["Zrotation", "Xrotation", "Yrotation"]
        lines.append(f"CHANNELS {len(channels)} {' '.join(channels)}")
        columns += [at] if moves else []
        columns.append(rig.turn[j].as_euler("ZXY", degrees=True))
        stack += [None, *(c for c in reversed(range(len(rig.names))) if rig.parents[c] == j)]


def gltf_of(
    rig: Rig,
    skins: Sequence[Sequence[str]] | None = None,
    parts: Sequence[Sequence[str]] | None = None,
    file: Gltf | None = None,
) -> Gltf:
    """A document with the rig as nodes.

    skins: names of the joints of each; None for one skin of all. parts: names of the nodes that each
    animation moves; None for one animation of all.
    """
    file = file or Gltf()
    at: dict[str, int] = {}
    for j, name in enumerate(rig.names):
        up = rig.parents[j]
        at[name] = file.node(
            name,
            None if up < 0 else at[rig.names[up]],
            translation=rig.place[j][0].tolist(),
            rotation=rig.turn[j].as_quat()[0].tolist(),
        )
    file.doc.setdefault("skins", []).extend(
        {"joints": [at[n] for n in skin]} for skin in ([rig.names] if skins is None else skins)
    )
    times = np.arange(rig.frames) / FPS
    for k, part in enumerate([rig.names] if parts is None else parts):
        animation = file.animation(f"part {k}" if parts else "walk")
        for name in part:
            j = rig.index(name)
            file.channel(animation, at[name], "rotation", times, rig.turn[j].as_quat())
            if rig.parents[j] < 0 or np.ptp(rig.place[j], axis=0).max() > 0:
                file.channel(animation, at[name], "translation", times, rig.place[j])
    return file


def skeleton_of(rig: Rig, name: str = "Skel", step: float = 1.0, binding: bool = True) -> str:
    """A USD Skeleton prim with its SkelAnimation inside, keys every `step` time codes."""
    paths: list[str] = []
    for j, up in enumerate(rig.parents):
        paths.append(rig.names[j] if up < 0 else f"{paths[up]}/{rig.names[j]}")
    joints = ", ".join(f'"{p}"' for p in paths)

    def matrix(x: np.ndarray) -> str:
        return f"((1,0,0,0),(0,1,0,0),(0,0,1,0),({x[0]:.7f},{x[1]:.7f},{x[2]:.7f},1))"

    rest = ", ".join(matrix(p[0]) for p in rig.place)
    turns, places = [], []
    for t in range(rig.frames):
        quats = (q.as_quat()[t] for q in rig.turn)
        turns.append(
            f"{t * step}: ["
            + ", ".join(f"({w:.8f},{x:.8f},{y:.8f},{z:.8f})" for x, y, z, w in quats)
            + "]"
        )
        rows = (p[t] for p in rig.place)
        places.append(
            f"{t * step}: [" + ", ".join(f"({x:.7f},{y:.7f},{z:.7f})" for x, y, z in rows) + "]"
        )
    api = '(prepend apiSchemas = ["SkelBindingAPI"])' if binding else ""
    ones = ", ".join(["(1,1,1)"] * len(paths))
    return f"""def Skeleton "{name}" {api}
{{
    uniform token[] joints = [{joints}]
    uniform matrix4d[] bindTransforms = [{rest}]
    uniform matrix4d[] restTransforms = [{rest}]
    rel skel:animationSource = <Anim>
    def SkelAnimation "Anim"
    {{
        uniform token[] joints = [{joints}]
        half3[] scales = [{ones}]
        quatf[] rotations.timeSamples = {{ {", ".join(turns)} }}
        float3[] translations.timeSamples = {{ {", ".join(places)} }}
    }}
}}
"""


def usda_of(
    inside: str, xforms: Mapping[float, Sequence[float]] | None = None, rate: float = FPS
) -> str:
    """A stage in metres, Y up, with a SkelRoot; xforms: its translation at time codes."""
    keys = ", ".join(f"{t}: ({x}, {y}, {z})" for t, (x, y, z) in (xforms or {}).items())
    op = (
        f"double3 xformOp:translate.timeSamples = {{ {keys} }}\n"
        'uniform token[] xformOpOrder = ["xformOp:translate"]'
        if xforms
        else ""
    )
    return (
        f'#usda 1.0\n(\n upAxis = "Y"\n metersPerUnit = 1\n timeCodesPerSecond = {rate}\n)\n'
        f'def SkelRoot "Model"\n{{\n{op}\n{inside}}}\n'
    )


def fbx_of(rig: Rig, bones: Sequence[str] | None = None) -> str:
    """ASCII FBX in centimetres, Y up; bones: names of those that are bones, None for all."""
    things, links = [], []
    for j, name in enumerate(rig.names):
        node, attribute, up = 10000 + j, 20000 + j, rig.parents[j]
        bone = bones is None or name in bones
        shift = ",".join(f"{x:.6f}" for x in rig.place[j][0] * 100)
        things.append(
            f'Model: {node}, "Model::{name}", "{"LimbNode" if bone else "Null"}" {{\nVersion: 232\n'
            f'Properties70: {{\nP: "Lcl Translation", "Lcl Translation", "", "A",{shift}\n}}\n}}'
        )
        links.append(f'C: "OO",{node},{10000 + up if up >= 0 else 0}')
        if bone:
            kind = '"LimbNode" {\nTypeFlags: "Skeleton"\n}'
            things.append(f'NodeAttribute: {attribute}, "NodeAttribute::{name}", {kind}')
            links.append(f'C: "OO",{attribute},{node}')
        # FBX turns about X first, then Y, then Z: intrinsic Z, Y, X.
        angles = rig.turn[j].as_euler("ZYX", degrees=True)[:, ::-1]
        tracks = [("R", "Lcl Rotation", angles), ("T", "Lcl Translation", rig.place[j] * 100)]
        for k, (short, long, rows) in enumerate(tracks):
            number = 100000 + 100 * j + 10 * k
            axes = "".join(f'P: "d|{x}", "Number", "", "A",0\n' for x in "XYZ")
            head = f'AnimationCurveNode: {number}, "AnimCurveNode::{short}", ""'
            things.append(f"{head} {{\nProperties70: {{\n{axes}}}\n}}")
            links += [f'C: "OO",{number},3', f'C: "OP",{number},{node}, "{long}"']
            for axis in range(3):
                things.append(_curve(number + 1 + axis, rows[:, axis].tolist(), FPS))
                links.append(f'C: "OP",{number + 1 + axis},{number}, "d|{"XYZ"[axis]}"')
    end = (rig.frames - 1) * TICKS // FPS
    stack = (
        'AnimationStack: 2, "AnimStack::Walk", "" {\nProperties70: {\n'
        'P: "LocalStart", "KTime", "Time", "",0\n'
        f'P: "LocalStop", "KTime", "Time", "",{end}\n}}\n}}\n'
        'AnimationLayer: 3, "AnimLayer::Base", "" {\n}'
    )
    settings = "".join(
        f'P: "{name}", "int", "Integer", "",{value}\n'
        for name, value in (
            ("UpAxis", 1), ("UpAxisSign", 1), ("FrontAxis", 2), ("FrontAxisSign", 1), ("CoordAxis", 0),
            ("CoordAxisSign", 1), ("TimeMode", 14),
        )
    )  # fmt: skip
    settings += (
        'P: "UnitScaleFactor", "double", "Number", "",1\n'
        f'P: "CustomFrameRate", "double", "Number", "",{FPS}\n'
    )
    return (
        "; FBX 7.4.0 project file\nFBXHeaderExtension: {\nFBXHeaderVersion: 1003\nFBXVersion: 7400\n}\n"
        f"GlobalSettings: {{\nVersion: 1000\nProperties70: {{\n{settings}}}\n}}\n"
        f"Objects: {{\n{chr(10).join(things)}\n{stack}\n}}\n"
        f'Connections: {{\nC: "OO",3,2\n{chr(10).join(links)}\n}}\n'
    )
