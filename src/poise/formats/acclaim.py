"""Acclaim (CMU): AMC motion with the ASF skeleton that it needs; unit and rate."""

from __future__ import annotations

import re
from array import array
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from poise.errors import PoiseError, did_you_mean
from poise.formats.guess import check_radians, few_degrees_note
from poise.formats.raw import UNSTATED, RawMotion, ReadOptions, assemble
from poise.formats.text import (
    CUT_OFF,
    MAX_JOINTS,
    MAX_SKELETON_BYTES,
    append_numbers,
    at_line,
    decode,
    first_bad,
    listed,
    number,
    read_bytes,
    shown,
)
from poise.motion.clip import Clip
from poise.motion.rotations import euler_to_quat, quat_conj, quat_mul
from poise.motion.skeleton import Channel, triple

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
            raise PoiseError(f"the skeleton has no :{name} section", path, CUT_OFF, code="part-missing")
    for line, words in sections.get("units", []):
        _unit(asf, words, at_line(path, line))
    for line, words in sections["root"]:
        _root_entry(asf, root, line, words)
    _bonedata(asf, sections["bonedata"])
    _hierarchy(asf, sections["hierarchy"])
    if not any(np.any(b.direction) and b.length > 0 for b in asf.bones.values()):
        raise PoiseError("no bone of the skeleton has any length", path, code="skeleton-without-length")
    return asf


def _unit(asf: AsfFile, words: list[str], where: str) -> None:
    key, value = words[0].lower(), words[1] if len(words) > 1 else ""
    if key == "length":
        asf.length = number(value, where)
        if not asf.length > 0:
            raise PoiseError(
                f"the unit of length must be above 0, got {value}", where, code="out-of-range"
            )
    elif key == "angle":
        if value.lower()[:3] not in ("deg", "rad"):
            raise PoiseError(
                f"the unit of angles must be deg or rad, got {shown(value)}", where, code="unit-unknown"
            )
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
                code="bad-axis-order",
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
        raise PoiseError(f"three numbers were expected, got {len(words)}", where, code="row-width")
    return number(words[0], where), number(words[1], where), number(words[2], where)


def _order(word: str, where: str) -> str:
    if sorted(word.upper()) != ["X", "Y", "Z"]:
        raise PoiseError(
            f"the order of an axis must be like XYZ, got {shown(word)}", where, code="bad-axis-order"
        )
    return word.upper()


def _bonedata(asf: AsfFile, lines: list[_Line]) -> None:
    bone: Bone | None = None
    limits = False
    for line, words in lines:
        where, key = at_line(asf.path, line), words[0].lower()
        if key == "begin":
            if bone is not None:
                raise PoiseError(
                    f"bone {shown(bone.name)} has no 'end' before the next 'begin'",
                    where,
                    code="section-unclosed",
                )
            bone, limits = Bone("", line), False
        elif bone is None:
            raise PoiseError(
                f"{shown(words[0])} stands outside any begin and end", where, code="line-misplaced"
            )
        elif key == "end":
            _close(asf, bone)
            bone = None
        elif key == "limits" or (limits and words[0].startswith("(")):
            bone.limits += _limit(words[1:] if key == "limits" else words, asf.angle, where)
            limits = True
        else:
            _bone_entry(asf, bone, key, words[1:], where)
    if bone is not None:
        raise PoiseError(
            f"bone {shown(bone.name)} has no 'end'",
            at_line(asf.path, bone.line),
            CUT_OFF,
            code="section-unclosed",
        )


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
                code="unknown-channel",
            )
        if len(set(bone.dof)) != len(bone.dof):
            raise PoiseError(
                f"bone '{bone.name}' names a degree of freedom twice", where, code="channel-repeated"
            )


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
        raise PoiseError(f"limits come in pairs, got {len(values)} numbers", where, code="count-differs")
    return tuple((values[i], values[i + 1]) for i in range(0, len(values), 2))


def _close(asf: AsfFile, bone: Bone) -> None:
    where = at_line(asf.path, bone.line)
    if not bone.name or not bone.name.isprintable():
        what = f"{shown(bone.name)} is no bone name" if bone.name else "a bone has no name"
        raise PoiseError(what, where, code="not-a-name")
    if bone.name in asf.bones:
        raise PoiseError(f"bone name '{bone.name}' appears twice", where, code="name-repeated")
    if len(asf.bones) >= MAX_JOINTS:
        raise PoiseError(f"more than {MAX_JOINTS} bones", where, code="too-many-joints")
    if bone.limits and len(bone.limits) != len(bone.dof):
        raise PoiseError(
            f"bone '{bone.name}' has {len(bone.dof)} degrees of freedom but {len(bone.limits)} limits",
            where,
            code="count-differs",
        )
    if bone.length < 0:
        raise PoiseError(
            f"bone '{bone.name}' has the negative length {bone.length:g}", where, code="out-of-range"
        )
    asf.bones[bone.name] = bone


def _hierarchy(asf: AsfFile, lines: list[_Line]) -> None:
    for line, words in lines:
        if len(words) == 1 and words[0].lower() in ("begin", "end"):
            continue
        where, (parent, *children) = at_line(asf.path, line), words
        for name in words:
            if name not in asf.bones:
                raise PoiseError(
                    f"there is no bone {shown(name)}",
                    where,
                    did_you_mean(name, list(asf.bones)),
                    code="unknown-joint",
                )
        for child in children:
            if child == "root" or child in asf.parents:
                raise PoiseError(
                    f"bone '{child}' is given a second parent, '{parent}'", where, code="second-parent"
                )
            asf.parents[child] = parent
    loose = [name for name in asf.bones if name != "root" and name not in asf.parents]
    if loose:
        raise PoiseError(
            f"bone '{loose[0]}' has no place in the :hierarchy", asf.path, code="joint-loose"
        )
    reached = set(asf.joints())
    for name in asf.bones:
        if name not in reached:
            raise PoiseError(
                f"the :hierarchy runs in a circle at bone '{name}'", asf.path, code="hierarchy-cycle"
            )


def fixed_axes_quat(angles: np.ndarray, order: str) -> np.ndarray:
    """Turns about fixed axes in the given order, first letter first: "XYZ" is Rz Ry Rx."""
    return euler_to_quat(angles[..., ::-1].copy(), order[::-1])


RATES = (120.0, 60.0)
"""The CMU library's rates, frames/s, the usual one first; AMC files state none."""
DEFAULT_FPS = RATES[0]
_NAME_SKELETON = "Name its skeleton with --skeleton FILE"


def find_skeleton(path: Path) -> tuple[Path, str | None]:
    """The ASF beside an AMC, and a note where it is a guess.

    It is sought by the take's own name, by the subject's (`02_01.amc` -> `02.asf`,
    `135_06-x.amc` -> `135-x.asf`), else the only one in the folder.
    """
    beside = sorted(p for p in path.parent.iterdir() if p.suffix.lower() == ".asf" and p.is_file())
    stem = path.stem
    subject, _, rest = stem.partition("_")
    tail = rest.lstrip("0123456789")
    for wanted in (stem, subject, subject + tail):
        same = [p for p in beside if p.stem.lower() == wanted.lower()]
        if len(same) == 1:
            return same[0], None
    if len(beside) == 1:
        return beside[0], f"The skeleton {beside[0].name} was taken, the only one in the folder"
    if not beside:
        raise PoiseError(
            "no ASF skeleton lies beside this AMC file", path, _NAME_SKELETON, code="skeleton-missing"
        )
    raise PoiseError(
        f"no skeleton is named for subject '{subject}', and several lie beside it: "
        f"{listed(p.name for p in beside)}",
        path,
        _NAME_SKELETON,
        code="skeleton-ambiguous",
    )


def read_amc(path: Path, options: ReadOptions) -> Clip:
    """An AMC clip on its ASF skeleton: 120 Hz, Y up, the unit from the ASF's `length`."""
    notes: list[str] = []
    skeleton = options.skeleton
    if skeleton is None:
        skeleton, note = find_skeleton(path)
        notes += [note] if note else []
    asf = parse_asf(Path(skeleton))
    frames, degrees, forced = _frames(path, asf, notes)
    names = asf.joints()
    _check_unit(frames, degrees, path, notes)
    scale = np.pi / 180 if degrees else 1.0
    count = len(next(iter(frames.values())))
    rot = np.zeros((count, len(names), 4))
    rot[..., 0] = 1.0
    for j, name in enumerate(names):
        if name not in frames:
            continue
        columns = list(asf.order) if name == "root" else _columns(asf, name, forced)
        turns = [i for i, c in enumerate(columns) if c in ROTATIONS]
        if turns:
            order = "".join(columns[i][1].upper() for i in turns)
            rot[:, j] = _local(asf, name, frames[name][:, turns] * scale, order)
    root_pos = np.tile(np.array(asf.position), (count, 1))
    for i, c in enumerate(asf.order):
        if c in TRAVEL:
            root_pos[:, TRAVEL.index(c)] += frames["root"][:, i]
    if options.fps is None:
        notes.append(f"AMC files state no frame rate: {DEFAULT_FPS:g} frames per second taken")
    return assemble(_raw(asf, path, names, root_pos, rot, notes), options)


def _check_unit(frames: dict[str, np.ndarray], degrees: bool, path: Path, notes: list[str]) -> None:
    """Refuses angles that cannot be radians, and doubts degrees that look like them."""
    angles = {name: values for name, values in frames.items() if name != "root"}
    if degrees:
        notes += few_degrees_note(angles)
        return
    stated = "the file has, since it says no :DEGREES and its skeleton no `angle deg`"
    check_radians(angles, stated, path, "Write :DEGREES before its first frame")


def read_asf(path: Path) -> Clip:
    """The rest pose of an ASF skeleton, as a clip that stands still; see `read_amc`."""
    asf = parse_asf(path)
    names = asf.joints()
    rot = np.zeros((2, len(names), 4))
    rot[..., 0] = 1.0
    root_pos = np.tile(np.array(asf.position), (2, 1))
    return assemble(_raw(asf, path, names, root_pos, rot, []), UNSTATED)


def _local(asf: AsfFile, name: str, angles: np.ndarray, order: str) -> np.ndarray:
    """Local rotations `(T, 4)` in world-aligned rest frames: C R(dof) C^-1, C the bone's axes."""
    bone = asf.bones[name]
    by_axis = np.array([bone.axis["XYZ".index(c)] for c in bone.axis_order])
    c = fixed_axes_quat(by_axis, bone.axis_order)
    r = fixed_axes_quat(angles, order)
    c = np.broadcast_to(c, (len(r), 4))
    return quat_mul(quat_mul(c, r), quat_conj(c))


def _raw(
    asf: AsfFile, path: Path, names: list[str], root_pos: np.ndarray, rot: np.ndarray, notes: list[str]
) -> RawMotion:
    index = {name: j for j, name in enumerate(names)}
    tip = {n: np.array(b.direction) * b.length for n, b in asf.bones.items()}
    parents = tuple(index[asf.parents[n]] if n != "root" else -1 for n in names)
    offsets = np.array([np.zeros(3) if p < 0 else tip[names[p]] for p in parents])
    channels = tuple(
        Channel(
            order=asf.order if n == "root" else asf.bones[n].dof,
            axis=asf.bones[n].axis,
            axis_order=asf.bones[n].axis_order,
            limits=asf.bones[n].limits,
        )
        for n in names
    )
    leaves = [j for j in range(len(names)) if j not in parents and names[j] != "root"]
    ends = tuple((j, triple(tip[names[j]])) for j in leaves)
    flat = [n for n in names if n != "root" and not tip[n].any()]
    if flat:
        notes.append(f"Bones of no length: {listed(flat)}")
    return RawMotion(
        format="asf-amc",
        path=path,
        names=tuple(names),
        parents=parents,
        offsets=offsets,
        ends=ends,
        root_pos=root_pos,
        rot=rot,
        fps=DEFAULT_FPS,
        rates=RATES,
        channels=channels,
        unit_hint=None if asf.length is None else 0.0254 / asf.length,
        notes=(*asf.notes, *notes),
        extra=(("skeleton", str(asf.path)),),
    )


def _columns(asf: AsfFile, name: str, forced: bool) -> list[str]:
    if name == "root":
        return list(asf.order)
    return list(ROTATIONS) if forced else list(asf.bones[name].dof)


def _frames(path: Path, asf: AsfFile, notes: list[str]) -> tuple[dict[str, np.ndarray], bool, bool]:
    """`(T, dof)` values per bone, whether they are degrees, whether all bones list rx ry rz."""
    lines = read_bytes(path).splitlines()
    degrees, forced = asf.angle != 1.0, False
    values: dict[str, array[float]] = {}
    places: dict[str, list[int]] = {}
    numbers: list[int] = []
    known: dict[bytes, tuple[str, int]] = {}
    frame_line, first_set = 0, 0
    seen = 0
    for i, line in enumerate(lines, 1):
        words = line.split()
        if not words or words[0][:1] == b"#":
            continue
        head = words[0]
        if head[:1] == b":":
            if numbers:
                raise PoiseError(
                    f"{shown(head)} stands between frames", at_line(path, i), code="line-misplaced"
                )
            key = head.upper()
            degrees = key == b":DEGREES" if key in (b":DEGREES", b":RADIANS") else degrees
            forced = forced or key == b":FORCE-ALL-JOINTS-BE-3DOF"
            continue
        if len(words) == 1 and head.isdigit():
            if numbers:
                first_set = _close_frame(path, values, numbers, frame_line, seen, first_set)
                _check_next(path, i, numbers[-1], head)
            numbers.append(int(head[:12]))
            frame_line, seen = i, 0
            continue
        if not numbers:
            raise PoiseError(
                f"{shown(head)} stands before the first frame number",
                at_line(path, i),
                code="line-misplaced",
            )
        if head not in known:
            known[head] = _known_bone(asf, decode(head, path, i), forced, at_line(path, i))
        name, width = known[head]
        if len(words) - 1 != width:
            raise PoiseError(
                f"joint '{name}' at frame {numbers[-1]} has {len(words) - 1} values, but its skeleton "
                f"gives it {width}",
                at_line(path, i),
                "Is it the right skeleton? Name another with --skeleton FILE",
                code="row-width",
            )
        column = values.setdefault(name, array("d"))
        if len(places.setdefault(name, [])) >= len(numbers):
            raise PoiseError(
                f"joint '{name}' appears twice in frame {numbers[-1]}",
                at_line(path, i),
                code="name-repeated",
            )
        append_numbers(column, words[1:], at_line(path, i))
        places[name].append(i)
        seen += 1
    if not numbers:
        raise PoiseError("the file has no frames", path, CUT_OFF, code="no-frames")
    _close_frame(path, values, numbers, frame_line, seen, first_set)
    out = {n: np.array(v).reshape(len(numbers), -1) for n, v in values.items()}
    if "root" not in out:
        raise PoiseError("no frame lists the root", path, code="root-missing")
    _check_values(path, out, places, numbers)
    still = [n for n, b in asf.bones.items() if n not in out and b.dof]
    if still:
        notes.append(f"The motion lists no values for {listed(still)}; they stay at rest")
    return out, degrees, forced


def _known_bone(asf: AsfFile, name: str, forced: bool, where: str) -> tuple[str, int]:
    if name not in asf.bones:
        raise PoiseError(
            f"joint {shown(name)} is not in the skeleton {asf.path.name}",
            where,
            did_you_mean(name, list(asf.bones)),
            code="unknown-joint",
        )
    return name, len(_columns(asf, name, forced))


def _check_next(path: Path, line: int, last: int, head: bytes) -> None:
    now = int(head[:12])
    if now != last + 1:
        raise PoiseError(
            f"frame {now} follows frame {last}, so frames are missing or doubled",
            at_line(path, line),
            code="frames-missing",
        )


def _close_frame(
    path: Path, values: dict[str, array[float]], numbers: list[int], line: int, seen: int, wanted: int
) -> int:
    """Checks that a frame lists as many joints as the first one; returns that count."""
    if len(numbers) == 1:
        if seen == 0:
            raise PoiseError(
                f"frame {numbers[-1]} lists no joints", at_line(path, line), code="frame-incomplete"
            )
        return seen
    if seen < wanted or len(values) > wanted:
        raise PoiseError(
            f"frame {numbers[-1]} lists {seen} joints, but the first frame {wanted}",
            at_line(path, line),
            "The file seems damaged or cut off",
            code="frame-incomplete",
        )
    return wanted


def _check_values(
    path: Path, table: dict[str, np.ndarray], places: dict[str, list[int]], numbers: list[int]
) -> None:
    found = []
    for name, rows in table.items():
        bad = first_bad(rows) if rows.size else None
        if bad is not None:
            found.append((bad[0], places[name][bad[0]], name, rows[bad]))
    if found:
        frame, line, name, value = min(found)
        raise PoiseError(
            f"joint '{name}' at frame {numbers[frame]} has the unusable value {value:g}",
            at_line(path, line),
            code="number-unusable",
        )
