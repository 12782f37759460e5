"""ASF skeletons (Acclaim): bones with directions, lengths, own axes, degrees of freedom, limits."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch

from poise.errors import PoiseError, did_you_mean
from poise.motion.io.tables import number
from poise.motion.io.text import (
    CUT_OFF,
    MAX_JOINTS,
    MAX_SKELETON_BYTES,
    at_line,
    decode,
    read_bytes,
    shown,
)
from poise.spatial import euler_to_quat

ROTATIONS = ("rx", "ry", "rz")
TRAVEL = ("tx", "ty", "tz")
#: What begins a comment; "1.#INF" is how Windows writes an open limit.
_COMMENT = re.compile(r"#(?!inf)", re.IGNORECASE)


@dataclass
class Bone:
    """One bone as written; a bone starts at its parent's tip. axis in radians."""

    name: str
    line: int
    direction: tuple[float, float, float] = (0.0, 0.0, 0.0)
    length: float = 0.0
    axis: tuple[float, float, float] = (0.0, 0.0, 0.0)
    axis_order: str = "XYZ"
    dof: tuple[str, ...] = ()
    limits: tuple[tuple[float, float], ...] = ()


@dataclass
class AsfFile:
    """A parsed skeleton. bones: in file order, the root first. angle: radians per unit of angle."""

    path: Path
    bones: dict[str, Bone] = field(default_factory=dict)
    parents: dict[str, str] = field(default_factory=dict)
    order: tuple[str, ...] = (*TRAVEL, *ROTATIONS)
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    length: float | None = None
    angle: float = float(np.pi / 180)
    notes: list[str] = field(default_factory=list)

    def joints(self) -> list[str]:
        """Names, parents before children, depth first in the order of the hierarchy."""
        children: dict[str, list[str]] = {}
        for child, parent in self.parents.items():
            children.setdefault(parent, []).append(child)
        out, stack = [], ["root"]
        while stack:
            name = stack.pop()
            out.append(name)
            stack += reversed(children.get(name, []))
        return out


_Line = tuple[int, list[str]]


def _lines(path: Path) -> Iterator[_Line]:
    for i, raw in enumerate(read_bytes(path, MAX_SKELETON_BYTES).splitlines(), 1):
        words = _COMMENT.split(decode(raw, path, i), maxsplit=1)[0].split()
        if words:
            yield i, words


def parse_asf(path: Path) -> AsfFile:
    """Reads an ASF file; every refusal names the line."""
    asf = AsfFile(path)
    root = Bone("root", 1, dof=ROTATIONS)
    asf.bones["root"] = root
    sections: dict[str, list[_Line]] = {}
    current: list[_Line] = []
    for line, words in _lines(path):
        if words[0].startswith(":"):
            current = sections.setdefault(words[0][1:].lower(), [])
            words = words[1:]
            if not words:
                continue
        current.append((line, words))
    for name in ("root", "bonedata", "hierarchy"):
        if not sections.get(name):
            raise PoiseError(f"the skeleton has no :{name} section", path, CUT_OFF)
    for line, words in sections.get("units", []):
        _unit(asf, words, at_line(path, line))
    for line, words in sections["root"]:
        _root_entry(asf, root, line, words)
    _bonedata(asf, sections["bonedata"])
    _hierarchy(asf, sections["hierarchy"])
    if not any(np.any(b.direction) and b.length > 0 for b in asf.bones.values()):
        raise PoiseError("no bone of the skeleton has any length", path)
    return asf


def _unit(asf: AsfFile, words: list[str], where: str) -> None:
    key, value = words[0].lower(), words[1] if len(words) > 1 else ""
    if key == "length":
        asf.length = number(value, where)
        if not asf.length > 0:
            raise PoiseError(f"the unit of length must be above 0, got {value}", where)
    elif key == "angle":
        if value.lower()[:3] not in ("deg", "rad"):
            raise PoiseError(f"the unit of angles must be deg or rad, got {shown(value)}", where)
        asf.angle = float(np.pi / 180) if value.lower().startswith("deg") else 1.0


def _root_entry(asf: AsfFile, root: Bone, line: int, words: list[str]) -> None:
    where, key = at_line(asf.path, line), words[0].lower()
    if key == "order":
        asf.order = tuple(w.lower() for w in words[1:])
        unknown = [w for w in asf.order if w not in TRAVEL + ROTATIONS]
        if unknown or len(set(asf.order)) != len(asf.order):
            raise PoiseError(
                f"the root's order must name tx ty tz rx ry rz at most once each, got "
                f"{shown(' '.join(words[1:]))}",
                where,
            )
        root.dof = tuple(w for w in asf.order if w in ROTATIONS)
    elif key == "axis":
        root.axis_order = _order(words[-1], where)
    elif key == "position":
        asf.position = _vector(words[1:], where)
    elif key == "orientation":
        x, y, z = _vector(words[1:], where)
        root.axis = (x * asf.angle, y * asf.angle, z * asf.angle)


def _vector(words: list[str], where: str) -> tuple[float, float, float]:
    if len(words) < 3:
        raise PoiseError(f"three numbers were expected, got {len(words)}", where)
    return number(words[0], where), number(words[1], where), number(words[2], where)


def _order(word: str, where: str) -> str:
    if sorted(word.upper()) != ["X", "Y", "Z"]:
        raise PoiseError(f"the order of an axis must be like XYZ, got {shown(word)}", where)
    return word.upper()


def _bonedata(asf: AsfFile, lines: list[_Line]) -> None:
    bone: Bone | None = None
    limits = False
    for line, words in lines:
        where, key = at_line(asf.path, line), words[0].lower()
        if key == "begin":
            if bone is not None:
                raise PoiseError(f"bone {shown(bone.name)} has no 'end' before the next 'begin'", where)
            bone, limits = Bone("", line), False
        elif bone is None:
            raise PoiseError(f"{shown(words[0])} stands outside any begin and end", where)
        elif key == "end":
            _close(asf, bone)
            bone = None
        elif key == "limits" or (limits and words[0].startswith("(")):
            bone.limits += _limit(words[1:] if key == "limits" else words, asf.angle, where)
            limits = True
        else:
            _bone_entry(asf, bone, key, words[1:], where)
    if bone is not None:
        raise PoiseError(f"bone {shown(bone.name)} has no 'end'", at_line(asf.path, bone.line), CUT_OFF)


def _bone_entry(asf: AsfFile, bone: Bone, key: str, values: list[str], where: str) -> None:
    if key == "name":
        bone.name = " ".join(values)
    elif key == "direction":
        bone.direction = _vector(values, where)
    elif key == "length":
        bone.length = number(values[0] if values else "", where)
    elif key == "axis":
        x, y, z = _vector(values, where)
        bone.axis = (x * asf.angle, y * asf.angle, z * asf.angle)
        bone.axis_order = _order(values[3], where) if len(values) > 3 else "XYZ"
    elif key == "dof":
        bone.dof = tuple(v.lower() for v in values)
        unknown = [v for v in bone.dof if v not in ROTATIONS]
        if unknown:
            raise PoiseError(
                f"bone '{bone.name}' has the degree of freedom {shown(unknown[0])}; only rx, ry and rz "
                "can be read",
                where,
            )
        if len(set(bone.dof)) != len(bone.dof):
            raise PoiseError(f"bone '{bone.name}' names a degree of freedom twice", where)


def _limit(words: list[str], angle: float, where: str) -> tuple[tuple[float, float], ...]:
    text = " ".join(words).replace("(", " ").replace(")", " ").replace(",", " ").split()
    values = []
    for word in text:
        low = word.lower().lstrip("+-")
        # An open limit is a whole turn either way.
        if low in ("inf", "infinity", "1.#inf"):
            values.append(-np.pi if word.startswith("-") else np.pi)
        else:
            values.append(number(word, where) * angle)
    if len(values) % 2:
        raise PoiseError(f"limits come in pairs, got {len(values)} numbers", where)
    return tuple((values[i], values[i + 1]) for i in range(0, len(values), 2))


def _close(asf: AsfFile, bone: Bone) -> None:
    where = at_line(asf.path, bone.line)
    if not bone.name or not bone.name.isprintable():
        what = f"{shown(bone.name)} is no bone name" if bone.name else "a bone has no name"
        raise PoiseError(what, where)
    if bone.name in asf.bones:
        raise PoiseError(f"bone name '{bone.name}' appears twice", where)
    if len(asf.bones) >= MAX_JOINTS:
        raise PoiseError(f"more than {MAX_JOINTS} bones", where)
    if bone.limits and len(bone.limits) != len(bone.dof):
        raise PoiseError(
            f"bone '{bone.name}' has {len(bone.dof)} degrees of freedom but {len(bone.limits)} limits",
            where,
        )
    if bone.length < 0:
        raise PoiseError(f"bone '{bone.name}' has the negative length {bone.length:g}", where)
    asf.bones[bone.name] = bone


def _hierarchy(asf: AsfFile, lines: list[_Line]) -> None:
    for line, words in lines:
        if len(words) == 1 and words[0].lower() in ("begin", "end"):
            continue
        where, (parent, *children) = at_line(asf.path, line), words
        for name in words:
            if name not in asf.bones:
                raise PoiseError(
                    f"there is no bone {shown(name)}", where, did_you_mean(name, list(asf.bones))
                )
        for child in children:
            if child == "root" or child in asf.parents:
                raise PoiseError(f"bone '{child}' is given a second parent, '{parent}'", where)
            asf.parents[child] = parent
    loose = [name for name in asf.bones if name != "root" and name not in asf.parents]
    if loose:
        raise PoiseError(f"bone '{loose[0]}' has no place in the :hierarchy", asf.path)
    reached = set(asf.joints())
    for name in asf.bones:
        if name not in reached:
            raise PoiseError(f"the :hierarchy runs in a circle at bone '{name}'", asf.path)


def fixed_axes_quat(angles: np.ndarray, order: str) -> torch.Tensor:
    """Turns about fixed axes in the given order, first letter first: "XYZ" is Rz Ry Rx."""
    return euler_to_quat(torch.tensor(angles[..., ::-1].copy()), order[::-1])
