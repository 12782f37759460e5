"""AMC motion with its ASF skeleton (CMU library): which skeleton, which unit, which rate."""

from __future__ import annotations

from array import array
from pathlib import Path

import numpy as np
import torch

from poise.errors import PoiseError, did_you_mean
from poise.motion.clip import Clip
from poise.motion.io.acclaim.asf import ROTATIONS, TRAVEL, AsfFile, fixed_axes_quat, parse_asf
from poise.motion.io.angle_units import check_radians, few_degrees_note
from poise.motion.io.raw import UNSTATED, RawMotion, ReadOptions, assemble
from poise.motion.io.tables import append_numbers, first_bad
from poise.motion.io.text import CUT_OFF, at_line, decode, listed, read_bytes, shown
from poise.motion.skeleton import Channel, triple
from poise.spatial import quat_conj, quat_mul

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
        raise PoiseError("no ASF skeleton lies beside this AMC file", path, _NAME_SKELETON)
    raise PoiseError(
        f"no skeleton is named for subject '{subject}', and several lie beside it: "
        f"{listed(p.name for p in beside)}",
        path,
        _NAME_SKELETON,
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
            rot[:, j] = _local(asf, name, frames[name][:, turns] * scale, order).numpy()
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


def _local(asf: AsfFile, name: str, angles: np.ndarray, order: str) -> torch.Tensor:
    """Local rotations `(T, 4)` in world-aligned rest frames: C R(dof) C^-1, C the bone's axes."""
    bone = asf.bones[name]
    by_axis = np.array([bone.axis["XYZ".index(c)] for c in bone.axis_order])
    c = fixed_axes_quat(by_axis, bone.axis_order)
    r = fixed_axes_quat(angles, order)
    c = c.expand(len(r), 4)
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
                raise PoiseError(f"{shown(head)} stands between frames", at_line(path, i))
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
            raise PoiseError(f"{shown(head)} stands before the first frame number", at_line(path, i))
        if head not in known:
            known[head] = _known_bone(asf, decode(head, path, i), forced, at_line(path, i))
        name, width = known[head]
        if len(words) - 1 != width:
            raise PoiseError(
                f"joint '{name}' at frame {numbers[-1]} has {len(words) - 1} values, but its skeleton "
                f"gives it {width}",
                at_line(path, i),
                "Is it the right skeleton? Name another with --skeleton FILE",
            )
        column = values.setdefault(name, array("d"))
        if len(places.setdefault(name, [])) >= len(numbers):
            raise PoiseError(f"joint '{name}' appears twice in frame {numbers[-1]}", at_line(path, i))
        append_numbers(column, words[1:], at_line(path, i))
        places[name].append(i)
        seen += 1
    if not numbers:
        raise PoiseError("the file has no frames", path, CUT_OFF)
    _close_frame(path, values, numbers, frame_line, seen, first_set)
    out = {n: np.array(v).reshape(len(numbers), -1) for n, v in values.items()}
    if "root" not in out:
        raise PoiseError("no frame lists the root", path)
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
        )
    return name, len(_columns(asf, name, forced))


def _check_next(path: Path, line: int, last: int, head: bytes) -> None:
    now = int(head[:12])
    if now != last + 1:
        raise PoiseError(
            f"frame {now} follows frame {last}, so frames are missing or doubled", at_line(path, line)
        )


def _close_frame(
    path: Path, values: dict[str, array[float]], numbers: list[int], line: int, seen: int, wanted: int
) -> int:
    """Checks that a frame lists as many joints as the first one; returns that count."""
    if len(numbers) == 1:
        if seen == 0:
            raise PoiseError(f"frame {numbers[-1]} lists no joints", at_line(path, line))
        return seen
    if seen < wanted or len(values) > wanted:
        raise PoiseError(
            f"frame {numbers[-1]} lists {seen} joints, but the first frame {wanted}",
            at_line(path, line),
            "The file seems damaged or cut off",
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
        )
