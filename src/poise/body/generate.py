"""A skeleton becomes a table of rigid bodies: sizes from bone lengths, masses, hinges, gains."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Literal

import numpy as np

from poise.body import body_table as presets
from poise.body.body_table import (
    PARTS,
    BodyRow,
    BodyTable,
    Strength,
    default_mass,
    floats,
    length_factor,
)
from poise.body.parts import Anatomy, Part, find_anatomy
from poise.body.shapes import Ruler, geoms_of
from poise.errors import PoiseError
from poise.motion import Clip, Skeleton
from poise.motion.clip import remembered
from poise.motion.rotations import euler_to_quat, quat_mul, quat_rotate
from poise.motion.vectors import norm
from poise.settings import Range, validate

_IDENTITY = (1.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class BodyConfig:
    """What a user may state about the body that is generated.

    Stiffness, damping, armature and torque limits follow the body's size (`Strength`).

    Attributes:
        mass_kg: total mass; None is `default_mass`: body mass index 22 at an adult's height.
        preset: "auto" takes "cmu-rfc" (38 DoF, 20 bodies, Residual Force Control) for a CMU ASF
            skeleton and "generic" for all others.
        damping: joint damping kd as a fraction of kp, in seconds. The paper's 0.2 kp stops a jump
            (`kd * speed` exceeds the torque limit); 0.02 is stable at 60 Hz and leaves the strength.
        armature: rotor inertia added to every hinge at `RFC_MASS_KG`, kg m^2.
        friction: sliding friction of the soles.
        margin: rad, how far joint ranges reach beyond the reference motion.
        overrides: ("lfoot.kp", 400.0) pairs, see `BodyTable.overridden`.
        mjcf: a file with a body of the user's own in place of a generated one, see `read_mjcf`.
    """

    mass_kg: Annotated[float, Range(2, 5000, unit="kg")] | None = None
    preset: Literal["auto", "cmu-rfc", "generic"] = "auto"
    damping: float = 0.02
    armature: float = 0.01
    friction: float = 1.0
    margin: float = 0.1745
    overrides: tuple[tuple[str, float], ...] = ()
    mjcf: str | None = None

    def __post_init__(self) -> None:
        validate(self)
        if self.mass_kg is not None and self.mjcf is not None:
            raise PoiseError(
                "a body of your own has its own mass; state one or the other",
                self.mjcf,
                code="settings-conflict",
            )


def generate_table(
    skeleton: Skeleton, config: BodyConfig | None = None, clips: Sequence[Clip] = ()
) -> BodyTable:
    """The parameters of a humanoid that moves like `skeleton`.

    Args:
        skeleton: any human skeleton with hands and feet that can be told by name or shape.
        config: mass, preset, gains, overrides.
        clips: motions of this skeleton; they tell the neutral pose (where identity rotations are no
            pose of a human) and how the soles lie.

    Raises:
        PoiseError: unknown anatomy, zero-length legs, unknown override.
    """
    config = config or BodyConfig()
    anatomy = find_anatomy(skeleton, clips)
    cmu = config.preset == "cmu-rfc" or (config.preset == "auto" and is_cmu(skeleton))
    if cmu:
        kept = (p for p in anatomy.parts if skeleton.names[p.joint] not in presets.CMU_MERGED)
        anatomy = replace(anatomy, parts=tuple(kept))
    neutral = neutral_rotations(skeleton, clips)
    kept = [p.joint for p in anatomy.parts]
    links = {j: _link(skeleton, kept, neutral, j) for j in kept}
    ruler = Ruler.measure(skeleton, anatomy, links, clips)
    mass = config.mass_kg or default_mass(ruler.height)
    fractions = _mass_fractions(anatomy, ruler)
    strength = Strength.of(mass, ruler.height)
    rows: list[BodyRow] = []
    for part in anatomy.parts:
        numbers = PARTS[part.kind]
        anchor, pos, quat = links[part.joint]
        order, frame = ("", _IDENTITY) if part.kind == "pelvis" else _hinges(skeleton, part, cmu)
        rows.append(
            BodyRow(
                name=skeleton.names[part.joint],
                joint=part.joint,
                kind=part.kind,
                side=part.side,
                parent=kept.index(anchor) if part.kind != "pelvis" else -1,
                pos=floats(pos) if part.kind != "pelvis" else (0.0, 0.0, 0.0),
                quat=floats(quat) if part.kind != "pelvis" else _IDENTITY,
                order=order,
                frame=frame,
                ranges=_ranges(skeleton, part, order),
                mass=fractions[part.joint] * mass,
                kp=numbers.kp * strength.torque,
                kd=numbers.kp * strength.torque * config.damping * strength.time,
                torque=numbers.torque * strength.torque,
                armature=config.armature * strength.inertia,
                geoms=geoms_of(part, ruler),
            )
        )
    table = BodyTable(tuple(rows), ruler.height, config.friction, _exclusions(rows))
    return table.overridden(dict(config.overrides))


@remembered
def body_of(clip: Clip) -> BodyTable:
    """The parameters of the body that is made for a clip of its own, see `generate_table`."""
    return generate_table(clip.skeleton, None, [clip])


def is_cmu(skeleton: Skeleton) -> bool:
    """Whether this is the CMU ASF skeleton that Residual Force Control was made for."""
    needed = {"lfemur", "ltibia", "lfoot", "lowerback", "thorax", "lowerneck", "lclavicle", "lradius"}
    return skeleton.source.format == "asf-amc" and needed <= set(skeleton.names)


def neutral_rotations(skeleton: Skeleton, clips: Sequence[Clip]) -> np.ndarray:
    """`(J, 4)` wxyz, a pose near the middle of the motion, in which every hinge is at zero.

    ASF and DeepMimic skeletons stand at identity. Others (LAFAN1, Bandai) lie folded at identity;
    for them each joint's mean rotation over the clips is taken (principal eigenvector of the sum of
    q q^T, Markley et al. 2007).
    """
    out = np.tile(np.array(_IDENTITY), (len(skeleton), 1))
    if skeleton.source.format in ("asf-amc", "deepmimic", "poise") or not clips:
        return out
    for j in range(1, len(skeleton)):
        q = np.concatenate([c.rot[:, j] for c in clips])
        out[j] = np.linalg.eigh(q.T @ q)[1][:, -1]
    return np.where(out[:, :1] < 0, -out, out)


def _link(
    skeleton: Skeleton, kept: list[int], neutral: np.ndarray, joint: int
) -> tuple[int, np.ndarray, np.ndarray]:
    """Nearest kept ancestor, and place (m) and rotation (wxyz) in its frame at the neutral pose."""
    chain = [joint]
    while skeleton.parents[chain[0]] >= 0 and skeleton.parents[chain[0]] not in kept:
        chain.insert(0, skeleton.parents[chain[0]])
    pos, quat = np.zeros(3), np.asarray(_IDENTITY, dtype=float)
    for j in chain:
        pos = pos + quat_rotate(quat, skeleton.offsets[j])
        quat = quat_mul(quat, neutral[j])
    return skeleton.parents[chain[0]], pos, quat


def _hinges(skeleton: Skeleton, part: Part, cmu: bool) -> tuple[str, tuple]:
    """Axis letters, parent side first, and the frame they are stated in (wxyz, body frame)."""
    name = skeleton.names[part.joint]
    if cmu and (part.kind in presets.CMU_RIGID or name in presets.CMU_RIGID_JOINTS):
        return "", _IDENTITY
    if part.kind in ("hand", "head") and not cmu:
        return "", _IDENTITY
    channels = skeleton.source.channels
    if channels and skeleton.source.format == "asf-amc":
        channel = channels[part.joint]
        frame = _IDENTITY
        if channel.axis is not None:
            up = skeleton.source.up_axis
            frame = floats(asf_axis_quat(channel.axis, channel.axis_order, up))
        # ASF lists the first-applied turn first; MuJoCo lists the outermost hinge first.
        letters = [d[1] for d in channel.order if d[0] == "r"]
        return "".join(reversed(letters)).upper(), frame
    if skeleton.source.format == "deepmimic" and part.kind in ("shin", "forearm"):
        # The file turns knees and elbows about its own z alone, which is -y here.
        return "Y", _IDENTITY
    return "ZYX"[: PARTS[part.kind].dofs], _IDENTITY


#: wxyz, not of unit length: the turn that carries a file's vertical to Z, as `vectors_to_z_up` does it.
_TO_Z_UP = {
    "Y": (1.0, 1.0, 0.0, 0.0),
    "Z": (1.0, 0.0, 0.0, 0.0),
    "X": (1.0, -1.0, -1.0, -1.0),
    "-Y": (1.0, -1.0, 0.0, 0.0),
    "-Z": (0.0, 1.0, 0.0, 0.0),
    "-X": (1.0, -1.0, 1.0, 1.0),
}


def asf_axis_quat(axis: tuple[float, float, float], order: str, up_axis: str) -> np.ndarray:
    """wxyz of an ASF bone's own axes in our Z-up rest frame.

    The file states extrinsic turns in `order` (Rz Ry Rx for XYZ) in its own frame; the turn that
    carries its vertical to Z brings them over.
    """
    q = euler_to_quat(np.array([axis[::-1]], dtype=float), order[::-1])
    turn = np.array([_TO_Z_UP[up_axis]], dtype=float)
    return quat_mul(turn / norm(turn), q)[0]


def _ranges(skeleton: Skeleton, part: Part, order: str) -> tuple[tuple[float, float], ...]:
    """Joint ranges in rad per hinge: the file's limits, else +-90 degrees."""
    channels = skeleton.source.channels
    limits = channels[part.joint].limits if channels else ()
    if limits and len(limits) == len(order):
        return tuple(reversed(limits))
    return tuple((-np.pi / 2, np.pi / 2) for _ in order)


def _mass_fractions(anatomy: Anatomy, ruler: Ruler) -> dict[int, float]:
    """Share of the total mass per joint; spine and neck share theirs by bone length."""
    raw: dict[int, float] = {}
    for part in anatomy.parts:
        group = anatomy.of(part.kind) if not part.side else (part.joint,)
        shortest = 0.02 * length_factor(ruler.height)
        lengths = {j: max(float(np.linalg.norm(ruler.tips[j])), shortest) for j in group}
        raw[part.joint] = PARTS[part.kind].mass * lengths[part.joint] / sum(lengths.values())
    if not anatomy.of("head") and anatomy.of("neck"):
        raw[anatomy.of("neck")[-1]] += PARTS["head"].mass
    total = sum(raw.values())
    return {j: f / total for j, f in raw.items()}


def _exclusions(rows: list[BodyRow]) -> tuple[tuple[str, str], ...]:
    """Pairs that never collide: neighbours within two joints, the trunk with itself, the two legs."""

    def line(i: int) -> list[int]:
        out = [i]
        while rows[out[-1]].parent >= 0:
            out.append(rows[out[-1]].parent)
        return out

    trunk = {"pelvis", "spine", "neck", "head", "clavicle"}
    legs = {"thigh", "shin", "foot"}
    pairs: list[tuple[str, str]] = []
    for i, a in enumerate(rows):
        for j in range(i):
            b = rows[j]
            la, lb = line(i), line(j)
            common = next(k for k in la if k in lb)
            hops = la.index(common) + lb.index(common)
            near = hops <= 2
            torso = a.kind in trunk and b.kind in trunk
            shoulders = {a.kind, b.kind} & {"upper_arm"} and {a.kind, b.kind} & trunk
            both_legs = a.kind in legs and b.kind in legs
            if hops > 1 and (near or torso or shoulders or both_legs):
                pairs.append((b.name, a.name))
    return tuple(pairs)
