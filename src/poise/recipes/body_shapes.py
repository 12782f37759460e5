"""One policy for bodies of many shapes: the library on variants of its body, which is observed.

PHC (Luo et al. 2023, Sec. 3.1) tells its policy the SMPL shape beta; here `observations.shape` tells
limb lengths and masses, and training goes over S bodies. The first is the library's own. In the others
each part has another size, drawn per group of `GROUPS` and alike on both sides: its length and its girth
are scaled together, so that its mass goes with the cube at equal density. Strength follows mass and
height as everywhere (`body.body_table.Strength`).

Every clip is retargeted onto the bodies that do it, so that feet stand where they stood, and counts as a
clip of its own, "walk@3" on body 3: episodes, hard negatives and evaluations need know nothing of it. A
world takes the body of the clip when it begins an episode of it (`env.reference`).

    imitation = shaped(build(library, config), BodyShapes(count=8), lambda body: task(config, body))
"""

# pyright: reportUnknownMemberType=false
from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, cast

import numpy as np
from torch import Tensor

from poise.body import BodyTable, Humanoid, make_humanoid
from poise.body.body_table import BodyRow, Geom, Strength
from poise.env import Reference, TaskConfig
from poise.env import observations as obs
from poise.errors import PoiseError
from poise.kinematics import clean_clip, place_on_body
from poise.kinematics.fit import widen
from poise.kinematics.retargeting.own_body import own_table
from poise.motion import Clip, ClipLibrary, Skeleton
from poise.settings import Range, validate

if TYPE_CHECKING:
    from poise.recipes.imitation import Imitation

#: Kinds of parts that are scaled together.
GROUPS: tuple[tuple[str, ...], ...] = (
    ("pelvis", "spine", "neck", "head", "clavicle"),
    ("upper_arm",),
    ("forearm", "hand"),
    ("thigh",),
    ("shin", "foot"),
)


#: Skeletons with no bone that differs by more (m) share a body.
SAME_BODY_M = 0.003


@dataclass(frozen=True)
class BodyShapes:
    """The bodies of a training.

    Attributes:
        count: S bodies, of which the first is the library's own; 1 is that alone.
        low, high: between which the sizes of the parts are drawn, 1 being the library's.
        per_clip: on how many bodies each clip is done, the first among them; 0 for all. Memory goes with
            it: about 2 kB a frame.
        seed: of the draws.
        own: in place of draws, each clip is done on the body of its own skeleton, in a library of one
            hierarchy with bones of several lengths; bodies within `SAME_BODY_M` are one.
    """

    count: Annotated[int, Range(1, 1000, unit="bodies")] = 1
    low: Annotated[float, Range(0.5, 2)] = 0.85
    high: Annotated[float, Range(0.5, 2)] = 1.15
    per_clip: Annotated[int, Range(0)] = 0
    seed: int = 0
    own: bool = False

    def __post_init__(self) -> None:
        validate(self)
        if self.own and self.count > 1:
            raise PoiseError(
                "bodies are drawn or the clips' own, not both", "BodyShapes", code="settings-conflict"
            )
        if self.low > self.high:
            raise PoiseError(
                f"sizes must rise from low to high, got {self.low:g} to {self.high:g}",
                "BodyShapes",
                code="not-rising",
            )
        if self.per_clip > self.count:
            raise PoiseError(
                f"a clip can be done on 1 to {self.count} bodies, got {self.per_clip}",
                "BodyShapes",
                code="out-of-range",
            )

    @property
    def several(self) -> bool:
        """Whether there may be more than one body."""
        return self.own or self.count > 1

    def factors(self) -> np.ndarray:
        """`(S, len(GROUPS))` sizes of the parts; the first row is 1."""
        rng = np.random.default_rng((self.seed, 0))
        sizes = rng.uniform(self.low, self.high, (self.count, len(GROUPS)))
        sizes[0] = 1.0
        return sizes

    def bodies_of(self, clips: int) -> list[tuple[int, ...]]:
        """For each of so many clips the bodies that do it, in order."""
        if self.per_clip in (0, self.count):
            return [tuple(range(self.count))] * clips
        rng = np.random.default_rng((self.seed, 1))
        more = (rng.permutation(self.count - 1)[: self.per_clip - 1] + 1 for _ in range(clips))
        return [(0, *sorted(int(k) for k in picks)) for picks in more]


def shaped(
    imitation: Imitation, shapes: BodyShapes, make_task: Callable[[Humanoid], TaskConfig]
) -> Imitation:
    """The same library on several bodies; unchanged for one.

    The humanoid stays that of the first body, with joint ranges that hold all clips on all bodies. Clips
    keep their names on it and are called NAME@K on body K; cyclic clips go on in cycles there alone.

    Args:
        make_task: makes the task for a humanoid; its observation `observations.shape` then is that
            of each world's own body.

    Raises:
        PoiseError: the task does not observe the shape, or a clip that cannot be retargeted.
    """
    if not shapes.several:
        return imitation
    if shapes.own:
        return _finished(imitation, *_own_bodies(imitation), make_task)
    rate, base = imitation.reference.rate_hz, imitation.humanoid
    sizes = shapes.factors()
    tables = [base.table, *(scaled_table(base.table, s) for s in sizes[1:])]
    skeletons = [base.skeleton, *(scaled_skeleton(base.skeleton, base.table, s) for s in sizes[1:])]
    clips, motions = list(imitation.library.clips), motions_of(imitation.reference)
    weights, body = list(imitation.library.weights), [0] * len(clips)
    cyclic = cast("list[bool]", imitation.reference.cyclic.tolist())
    example = clips[0]
    chosen = shapes.bodies_of(len(clips))
    for k in range(1, shapes.count):
        there = example.replaced(skeleton=skeletons[k])
        for c, clip in enumerate(imitation.library.clips):
            if k not in chosen[c]:
                continue
            moved, qpos = _on_body(clip, example, there, tables[k], base, rate)
            clips.append(moved.replaced(name=f"{clip.name}@{k}", cyclic=False))
            motions.append(qpos)
            weights.append(imitation.library.weights[c])
            body.append(k)
            cyclic.append(False)
    library = ClipLibrary(tuple(clips), tuple(weights))
    return _finished(imitation, library, tables, skeletons, motions, cyclic, body, make_task)


def _own_bodies(imitation: Imitation) -> tuple[
    ClipLibrary, list[BodyTable], list[Skeleton], list[np.ndarray], list[bool], list[int]
]:  # fmt: skip
    """The library with each clip on the body of its own bones; tables and skeletons of the bodies,
    coordinates, which clips go on in cycles, and which body each has."""
    base, clips, body = imitation.humanoid, list[Clip](), list[int]()
    tables, skeletons = [base.table], [base.skeleton]
    motions = motions_of(imitation.reference)
    cyclic = cast("list[bool]", imitation.reference.cyclic.tolist())
    example = imitation.library.clips[0]
    for c, clip in enumerate(imitation.library.clips):
        same = (k for k, s in enumerate(skeletons) if clip.skeleton.same_bones(s, SAME_BODY_M))
        k = next(same, len(skeletons))
        if k == len(skeletons):
            skeletons.append(clip.skeleton)
            there = example.replaced(skeleton=clip.skeleton)
            tables.append(own_table(there, base.table, imitation.config.body))
        body.append(k)
        clip = clip.replaced(skeleton=skeletons[k])
        if k:
            there = example.replaced(skeleton=skeletons[k])
            rate = imitation.reference.rate_hz
            clip, motions[c] = _on_body(clip, example, there, tables[k], base, rate)
            cyclic[c] = False
        clips.append(clip)
    library = ClipLibrary(tuple(clips), imitation.library.weights)
    return library, tables, skeletons, motions, cyclic, body


def _finished(
    imitation: Imitation,
    library: ClipLibrary,
    tables: Sequence[BodyTable],
    skeletons: Sequence[Skeleton],
    motions: list[np.ndarray],
    cyclic: list[bool],
    body: list[int],
    make_task: Callable[[Humanoid], TaskConfig],
) -> Imitation:
    """The task of a library on its bodies."""
    rate = imitation.reference.rate_hz
    tables = _widened(tables, motions, imitation.config.body.margin)
    bodies = [make_humanoid(s, t) for s, t in zip(skeletons, tables, strict=True)]
    reference = Reference(bodies[0], motions, rate, library.names, cyclic, bodies, body)
    task = make_task(bodies[0])
    if not any(term.fn is obs.shape for term in task.obs):
        raise PoiseError(
            f"a policy for {len(bodies)} bodies must observe them",
            hint="Set Perpetual(shape=True)",
            code="settings-conflict",
        )
    return replace(imitation, library=library, humanoid=bodies[0], reference=reference, task=task)


def scaled_table(table: BodyTable, sizes: Sequence[float]) -> BodyTable:
    """The body with each part `sizes` times as large, one number per group of `GROUPS`."""
    own = [_size_of(r.kind, sizes) for r in table.rows]
    rows: list[BodyRow] = []
    for row, size in zip(table.rows, own, strict=True):
        # Where a body hangs is a length of the one above it.
        above = own[row.parent] if row.parent >= 0 else 1.0
        geoms = tuple(_scaled_geom(g, size) for g in row.geoms)
        pos = _times(row.pos, above)
        rows.append(replace(row, pos=pos, mass=row.mass * size**3, geoms=geoms))
    height = table.height_m * _leg(rows) / _leg(table.rows)
    new = Strength.of(sum(r.mass for r in rows), height)
    old = Strength.of(table.mass, table.height_m)
    torque, time, inertia = (
        getattr(new, name) / getattr(old, name) for name in ("torque", "time", "inertia")
    )
    strong = tuple(
        replace(
            r, kp=r.kp * torque, kd=r.kd * torque * time, torque=r.torque * torque,
            armature=r.armature * inertia,
        )
        for r in rows
    )  # fmt: skip
    return replace(table, rows=strong, height_m=height)


def scaled_skeleton(skeleton: Skeleton, table: BodyTable, sizes: Sequence[float]) -> Skeleton:
    """The skeleton of `scaled_table`: every bone as long as its part's size says."""
    size = {r.joint: _size_of(r.kind, sizes) for r in table.rows}

    def of(joint: int) -> float:
        """The size of the part that carries a joint: its own, or that of the nearest above it."""
        while joint not in size:
            joint = skeleton.parents[joint]
        return size[joint]

    factor = [1.0 if p < 0 else of(p) for p in skeleton.parents]
    ends = tuple((j, _times(at, of(j))) for j, at in skeleton.ends)
    return replace(skeleton, offsets=skeleton.offsets * np.array(factor)[:, None], ends=ends)


def _size_of(kind: str, sizes: Sequence[float]) -> float:
    return float(next(s for group, s in zip(GROUPS, sizes, strict=True) if kind in group))


def _times(at: tuple[float, float, float], size: float) -> tuple[float, float, float]:
    x, y, z = at
    return (x * size, y * size, z * size)


def _scaled_geom(geom: Geom, size: float) -> Geom:
    return replace(geom, size=tuple(size * x for x in geom.size), pos=_times(geom.pos, size))


def _leg(rows: Sequence[BodyRow]) -> float:
    """Length of shins and feet's bones from the hips down, m, both sides together."""
    return sum(float(np.linalg.norm(r.pos)) for r in rows if r.kind in ("shin", "foot"))


def motions_of(reference: Reference) -> list[np.ndarray]:
    """Coordinates of each clip `(T, 7 + n)`."""
    parts = cast("tuple[Tensor, ...]", reference.qpos.split(reference.length.tolist()))
    return [q.numpy().copy() for q in parts]


def _on_body(
    clip: Clip, example: Clip, there: Clip, table: BodyTable, base: Humanoid, rate: float
) -> tuple[Clip, np.ndarray]:
    """A clip on another body's skeleton, and in its coordinates on the floor.

    example, there: one clip on the library's skeleton, and on that of the body.
    """
    clean = clean_clip(clip.replaced(cyclic=False))[0]
    on = place_on_body(clean, table, there, rate, example=example, clean=False, level=False, near=base)
    return on.clip, on.qpos


def _widened(
    tables: Sequence[BodyTable], motions: Sequence[np.ndarray], margin: float
) -> list[BodyTable]:
    """Tables with the joint ranges of the first, grown to hold all motions and `margin` rad more."""
    rows = widen(tables[0], motions, margin)[0].rows
    return [
        replace(t, rows=tuple(replace(r, ranges=w.ranges) for r, w in zip(t.rows, rows, strict=True)))
        for t in tables
    ]
