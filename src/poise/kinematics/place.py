"""A clip on a body: on its skeleton, cleaned, with level feet, in its coordinates, on its floor."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from poise.body import BodyConfig, BodyTable, Humanoid, read_mjcf
from poise.errors import PoiseError
from poise.kinematics.coords import clip_to_qpos, within_turns
from poise.kinematics.feet import Levelled, level_feet
from poise.kinematics.forward import Kinematics, lowest_height
from poise.kinematics.ground import GroundFit, fit_ground
from poise.kinematics.loops import Cycle, join_cycle
from poise.kinematics.repair.estimate import CleanReport, clean_clip
from poise.kinematics.repair.motion_doctor import without_noise
from poise.kinematics.retargeting.retarget_report import RetargetReport
from poise.kinematics.retargeting.transfer import RetargetConfig, retarget
from poise.motion import Clip, ClipLibrary, Skeleton, resample

#: How much deeper (m) than the clip its closed cycle may go; beyond, closing it made another motion.
CYCLE_SINK_M = 0.1


@dataclass(frozen=True, eq=False)
class OnBody:
    """A clip on a body.

    calm: what is followed in the clip's place, on its own skeleton (`without_noise`).
    moved: the same on the body's skeleton, at its own rate, else neither cleaned nor levelled.
    clip: the same, cleaned and levelled as was asked for.
    qpos: `(T, 7 + hinges)`, in the body's coordinates at the rate that was asked for, on the floor.
    retargeting: how it came onto the skeleton, None where its bones are the body's.
    cleaned: its repairs. level: how its feet were turned. ground: how it was set on the floor.
    cycle: how the ends of a cyclic clip met, None where they were not joined.
    joint_error_mm: mean distance between the clip's joints and the body's, as they lie about the root,
        before a cycle was closed: turns that a chain of hinges cannot make.
    """

    calm: Clip
    moved: Clip
    clip: Clip
    qpos: np.ndarray
    retargeting: RetargetReport | None
    cleaned: CleanReport
    level: Levelled
    ground: GroundFit
    cycle: Cycle | None
    joint_error_mm: float


def place_on_body(
    clip: Clip,
    table: BodyTable,
    onto: Skeleton | Clip | None = None,
    rate_hz: float | None = None,
    *,
    example: Clip | None = None,
    how: RetargetConfig | None = None,
    clean: bool = True,
    level: bool = True,
    near: Humanoid | None = None,
    join: bool = False,
    known: bool | None = None,
) -> OnBody:
    """A clip in the coordinates of a body, in this order: retargeted, cleaned, feet levelled, resampled,
    as hinge angles, its cycle joined, set on the floor.

    Args:
        table: the body.
        onto: the body's skeleton, or a clip on it that shows how it stands; by default the clip's own.
        rate_hz: of the coordinates; by default the clip's own.
        example: a clip on the source's skeleton that shows how it stands, see `retarget`.
        how: it is retargeted.
        clean: repair flips and impossible speeds (`clean_clip`), first of all what noise did, unless the
            clip's source is raw (`without_noise`).
        level: turn feet that stand on their edge flat (`level_feet`).
        near: shift hinges by whole turns as near to this humanoid's ranges as can be.
        join: make the ends of a cyclic clip meet (`join_cycle`), unless that sinks it into the floor.
        known: whether the floor is at z = 0; by default where the clip's source says so.

    Raises:
        PoiseError: a skeleton that is no human's, or coordinates that are not finite.
    """
    known = clip.skeleton.source.ground_m is not None if known is None else known
    # Noise goes first: joints without a body ride along as they are in what is moved over.
    calm, noise = without_noise(clip) if clean else (clip, CleanReport())
    moved, retargeting = calm, None
    skeleton = onto.skeleton if isinstance(onto, Clip) else onto
    if onto is not None and skeleton is not None and not clip.skeleton.same_bones(skeleton):
        moved, retargeting = retarget(calm, onto, config=how, example=example)
    made, cleaned = clean_clip(moved, raw=True) if clean else (moved, CleanReport())
    cleaned = noise.then(cleaned)
    turned = level_feet(made, table) if level else Levelled({})
    made = turned.onto(made)
    timed = made if rate_hz is None else resample(made, rate_hz)
    qpos = clip_to_qpos(timed, table)
    if not np.isfinite(qpos).all():
        raise PoiseError("its coordinates are not finite", clip.name, code="not-finite")
    error = joint_error(moved if rate_hz is None else resample(moved, rate_hz), qpos, table)
    qpos = qpos if near is None else within_turns(qpos, near)
    qpos, cycle = _join(qpos, table) if join and clip.cyclic else (qpos, None)
    closed = cycle is not None and cycle.closed
    qpos, ground = fit_ground(qpos, table, timed.fps, closed, known=known)
    return OnBody(calm, moved, made, qpos, retargeting, cleaned, turned, ground, cycle, error)


def calm_library(library: ClipLibrary) -> tuple[ClipLibrary, list[CleanReport]]:
    """The clips without their noise, which is judged once, on the skeleton that came in, so that joints
    without a body lose it too (`without_noise`); and what was taken off each."""
    calm = [without_noise(clip) for clip in library]
    return replace(library, clips=tuple(clip for clip, _ in calm)), [noise for _, noise in calm]


def on_own_body(library: ClipLibrary, config: BodyConfig) -> tuple[ClipLibrary, BodyTable | None]:
    """The clips on the skeleton of `config.mjcf` and its table; without such a file all as it is.

    Clips that are on that skeleton already stay as they are. Others are retargeted by the roles of their
    joints, all with the first one as the example of how their skeleton stands.

    Raises:
        PoiseError: a file or a skeleton that does not fit, see `read_mjcf` and `retarget`.
    """
    if config.mjcf is None:
        return library, None
    own = read_mjcf(config.mjcf, config.damping)
    table = own.table.overridden({"friction": config.friction, **dict(config.overrides)})
    first = library.clips[0]
    if first.skeleton.names == own.skeleton.names:
        return library, table
    moved = tuple(retarget(c, own.skeleton, example=first)[0] for c in library)
    return replace(library, clips=moved), table


def joint_error(clip: Clip, qpos: np.ndarray, table: BodyTable) -> float:
    """Mean distance in mm between the clip's joints and the body's, as they lie about the root."""
    here = Kinematics(table)(qpos).pos
    there = clip.positions()[:, [r.joint for r in table.rows]]
    apart = (here - here[:, :1]) - (there - there[:, :1])
    return float(np.linalg.norm(apart, axis=-1).mean() * 1000)


def _join(qpos: np.ndarray, table: BodyTable) -> tuple[np.ndarray, Cycle]:
    """`join_cycle`, unless closing the gap would bend the motion into the floor."""
    joined, cycle = join_cycle(qpos, [name for row in table.rows for name in row.hinge_names()])
    depths = []
    for q in (qpos, joined):
        state = Kinematics(table)(q)
        low = lowest_height(table, state.pos, state.quat).min(-1)
        depths.append(float(np.quantile(low, 0.1)))
    sunk = depths[0] - depths[1]
    return (qpos, replace(cycle, sunk_m=sunk)) if sunk > CYCLE_SINK_M else (joined, cycle)
