"""A small ASCII FBX file made by hand: a person who walks along +Z and bends, centimetres, Y up."""

from __future__ import annotations

import math

#: Ticks of FBX in a second.
TICKS = 46186158000
#: Name, parent, and place below it in cm.
BONES = (
    ("Hips", -1, (0.0, 90.0, 0.0)), ("Spine", 0, (0.0, 50.0, 0.0)), ("Head", 1, (0.0, 15.0, 0.0)),
    ("LeftUpLeg", 0, (10.0, -5.0, 0.0)), ("LeftLeg", 3, (0.0, -40.0, 0.0)),
    ("LeftFoot", 4, (0.0, -42.0, 0.0)), ("RightUpLeg", 0, (-10.0, -5.0, 0.0)),
    ("RightLeg", 6, (0.0, -40.0, 0.0)), ("RightFoot", 7, (0.0, -42.0, 0.0)),
)  # fmt: skip


def turns(bone: int, frame: int) -> tuple[float, float, float]:
    """Euler angles of a bone in degrees, about X first, then Y, then Z."""
    return (8.0 * math.sin(0.5 * frame + bone), 5.0 * math.cos(0.3 * frame), float(bone))


def travel(frame: int) -> tuple[float, float, float]:
    """The place of the hips in cm."""
    return (0.0, 90.0 + math.sin(frame), 3.0 * frame)


def fbx_text(frames: int = 8, fps: int = 30, up: int = 1, bones: bool = True, moves: bool = True) -> str:
    """The file. up: 1 for Y, 2 for Z, as FBX counts axes."""
    kind = "LimbNode" if bones else "Null"
    things, links = [], ['C: "OO",1,0', 'C: "OO",3,2']
    for j, (name, parent, place) in enumerate(BONES):
        node, attribute = 100 + j, 200 + j
        shift = ",".join(map(str, place))
        things.append(
            f'Model: {node}, "Model::{name}", "{kind}" {{\nVersion: 232\nProperties70: {{\n'
            f'P: "Lcl Translation", "Lcl Translation", "", "A",{shift}\n}}\n}}'
        )
        links.append(f'C: "OO",{node},{100 + parent if parent >= 0 else 0}')
        if bones:
            flags = 'TypeFlags: "Skeleton"'
            things.append(
                f'NodeAttribute: {attribute}, "NodeAttribute::{name}", "LimbNode" {{\n{flags}\n}}'
            )
            links.append(f'C: "OO",{attribute},{node}')
        tracks = [("R", "Lcl Rotation", [turns(j, t) for t in range(frames)])]
        tracks += [("T", "Lcl Translation", [travel(t) for t in range(frames)])] if parent < 0 else []
        for k, (short, long, rows) in enumerate(tracks if moves else []):
            curves = 1000 + 100 * j + 10 * k
            axes = "".join(f'P: "d|{x}", "Number", "", "A",0\n' for x in "XYZ")
            head = f'AnimationCurveNode: {curves}, "AnimCurveNode::{short}", ""'
            things.append(f"{head} {{\nProperties70: {{\n{axes}}}\n}}")
            links += [f'C: "OO",{curves},3', f'C: "OP",{curves},{node}, "{long}"']
            for axis in range(3):
                things.append(_curve(curves + 1 + axis, [r[axis] for r in rows], fps))
                links.append(f'C: "OP",{curves + 1 + axis},{curves}, "d|{"XYZ"[axis]}"')
    end = (frames - 1) * TICKS // fps
    front, sign = (2, 1) if up == 1 else (1, -1)
    stack = (
        f'AnimationStack: 2, "AnimStack::Walk", "" {{\nProperties70: {{\n'
        f'P: "LocalStart", "KTime", "Time", "",0\n'
        f'P: "LocalStop", "KTime", "Time", "",{end}\n}}\n}}\n'
        'AnimationLayer: 3, "AnimLayer::Base", "" {\n}'
    )
    settings = "".join(
        f'P: "{name}", "int", "Integer", "",{value}\n'
        for name, value in (
            ("UpAxis", up), ("UpAxisSign", 1), ("FrontAxis", front), ("FrontAxisSign", sign),
            ("CoordAxis", 0), ("CoordAxisSign", 1), ("TimeMode", 14),
        )
    )  # fmt: skip
    settings += (
        'P: "UnitScaleFactor", "double", "Number", "",1\n'
        f'P: "CustomFrameRate", "double", "Number", "",{fps}\n'
    )
    return (
        "; FBX 7.4.0 project file\nFBXHeaderExtension: {\nFBXHeaderVersion: 1003\nFBXVersion: 7400\n}\n"
        f"GlobalSettings: {{\nVersion: 1000\nProperties70: {{\n{settings}}}\n}}\n"
        f"Objects: {{\n{chr(10).join(things)}\n{stack if moves else ''}\n}}\n"
        f"Connections: {{\n{chr(10).join(links[2 if not moves else 1 :])}\n}}\n"
    )


def _curve(number: int, values: list[float], fps: int) -> str:
    count = len(values)
    times = ",".join(str(t * TICKS // fps) for t in range(count))
    keys = ",".join(f"{v:.9g}" for v in values)
    return (
        f'AnimationCurve: {number}, "AnimCurve::", "" {{\nDefault: 0\nKeyVer: 4008\n'
        f"KeyTime: *{count} {{\na: {times}\n}}\nKeyValueFloat: *{count} {{\na: {keys}\n}}\n"
        "KeyAttrFlags: *1 {\na: 4\n}\nKeyAttrDataFloat: *4 {\na: 0,0,0,0\n}\n"
        f"KeyAttrRefCount: *1 {{\na: {count}\n}}\n}}"
    )
