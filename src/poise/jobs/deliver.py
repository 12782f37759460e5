"""A user's files: the simulated motion on the skeleton that came in, the score, the report."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from poise.env.pushes import HeldThing
from poise.formats import home_suffix
from poise.kinematics import anatomy_of, examine, hold_feet, lowest_height, qpos_to_clip, support_of
from poise.kinematics.feet import stands_higher
from poise.kinematics.hold import FASTEST, mend_slides
from poise.kinematics.repair.faults import Fault
from poise.kinematics.repair.motion_doctor import new_faults
from poise.kinematics.repair.support import SOLE_M, slide_faults
from poise.kinematics.repair.timing import body_steps
from poise.metrics import jerk, success
from poise.motion import Clip, ground_shift, resample
from poise.motion.clip import blended
from poise.recipes.imitation import Imitation
from poise.score import Recording, RolloutSet, ScoreCard, clip_figures
from poise.score.report import Report, Shape, Track
from poise.sim.props import Box
from poise.version import __version__

#: By how much the largest jerk may grow with a foot that is held; s around where it slides that are
#: looked at; how often what is rougher is left out.
ROUGHER, AROUND_S, ROUNDS = 1.25, 0.5, 3


@dataclass(frozen=True, eq=False)
class Evaluation:
    """A policy's episodes: the score card, the padded rollouts, one whole episode per clip.

    together: whether these are characters of one world.
    """

    card: ScoreCard
    rollouts: RolloutSet
    recordings: list[Recording]
    together: bool = False


def as_file(clip: Clip) -> Clip:
    """A motion as it is read from its file: what tells the soles of some formats is lost in BVH."""
    if home_suffix(clip) != ".bvh":
        return clip
    return clip.replaced(skeleton=clip.skeleton.with_source(format="bvh"))


def settled(clip: Clip, source: Clip) -> Clip:
    """The clip with its feet held where `poise doctor` says that they slide and the source's do not.

    Some of what stands by the doctor's rules, which know no physics, does not bear by those of
    `kinematics.hold_feet`. A foot is held only where the leg follows without a jerk.

    Args:
        source: what the clip follows, frame by frame.
    """
    faults, held = _new_slides(clip, source), as_file(clip)
    support = support_of(held, anatomy_of(held)) if faults else None
    for _ in range(ROUNDS):
        if support is None or not faults:
            break
        mended = mend_slides(held, support, faults)
        kept = _smooth(held, mended, faults)
        if len(kept) == len(faults):
            return clip.replaced(rot=mended.rot)
        faults = kept
    return clip


def _new_slides(clip: Clip, source: Clip) -> list[Fault]:
    """Slides of the clip in which that foot of the source does not slide."""
    found = list[list[Fault]]()
    for one in (as_file(clip), source):
        support = support_of(one, anatomy_of(one))
        found.append([] if support is None else slide_faults(one, support))
    mine, theirs = found
    return [
        f
        for f in mine
        if not any(f.joint == g.joint and f.start <= g.stop and g.start <= f.stop for g in theirs)
    ]


def _smooth(before: Clip, after: Clip, faults: list[Fault]) -> list[Fault]:
    """Those faults around which a repair neither jerks the body nor turns a joint too fast."""
    was, now = (body_steps(c).max(-1) * c.fps for c in (before, after))
    shook, shakes = (jerk(torch.tensor(c.positions()), c.fps).numpy() for c in (before, after))
    most, around, out = (
        ROUGHER * float(shook.max(initial=0.0)),
        round(AROUND_S * before.fps),
        list[Fault](),
    )
    for f in faults:
        here = slice(max(0, f.start - around), f.stop + around)
        fast = float(now[here].max(initial=0.0)) > max(FASTEST, float(was[here].max(initial=0.0)))
        if not fast and float(shakes[here].max(initial=0.0)) <= most:
            out.append(f)
    return out


def simulated_clip(imitation: Imitation, evaluation: Evaluation, index: int = 0) -> Clip:
    """The simulated motion of clip `index` on its own skeleton, at the clip's own frame rate.

    The simulation runs at the control rate; the clip is resampled to the source's rate so that it
    drops into the place of the original. Its floor is at z = 0, see `as_high_as_source`.
    """
    recording = evaluation.recordings[index]
    source = imitation.library.clips[recording.clip]
    rate = imitation.reference.rate_hz
    frames = min(len(recording.qpos), int(imitation.reference.length[recording.clip]))
    template = resample(source, rate)
    motion = qpos_to_clip(
        recording.qpos[:frames],
        imitation.humanoid.table,
        source.skeleton,
        rate,
        template if template.frames == frames else None,
        source.name,
    )
    out = resample(motion, source.fps, smooth=True)
    missing = source.frames - out.frames
    if not 0 < missing <= np.ceil(source.fps / rate):
        return out
    # The source may end between two control steps; in its last moment the motion goes on as it was.
    out = resample(_going_on(motion), source.fps, smooth=True)
    tail = np.minimum(np.arange(source.frames), out.frames - 1)
    return out.replaced(root_pos=out.root_pos[tail], rot=out.rot[tail])


def _going_on(motion: Clip) -> Clip:
    """A motion with one more frame, to which it goes on as in its last step."""
    low = np.minimum(np.arange(motion.frames + 1), motion.frames - 2)
    return blended(motion, low, np.arange(motion.frames + 1.0) - low)


def floor_of(imitation: Imitation, index: int = 0) -> float:
    """z (m) of the floor that clip `index` stands on in its own file, as it was found."""
    fits = imitation.report.clips
    return -fits[index].ground.lift_m if index < len(fits) else 0.0


def as_high_as_source(clip: Clip, imitation: Imitation, index: int = 0) -> Clip:
    """A simulated motion, which stands on z = 0, as high as clip `index` does in its own file.

    Feet that stand are as high as there; files tell joints and no soles, so that the floor that was
    found may be off by some centimetres. Where a motion rests on something as well, its floor counts.
    """
    floor, rows = floor_of(imitation, index), imitation.humanoid.table.rows
    source = imitation.library.clips[index]
    higher = None
    if not imitation.props and clip.skeleton.same_bones(source.skeleton):
        feet = [row.joint for row in rows if row.kind == "foot"]
        higher = stands_higher(clip, source, feet)
    if higher is None:
        return ground_shift(clip, floor)
    return ground_shift(clip, min(max(-higher, floor - SOLE_M), floor + SOLE_M))


@dataclass(frozen=True, eq=False)
class Delivery:
    """What an evaluation gives a user.

    Attributes:
        clips: the simulated motions by the names of their files, on the body's skeletons.
        home: the same on the skeletons that came in.
        card: the score card with what holding the feet did.
        notes: what was done to the motions beyond simulating them, in sentences.
        paths: of what was written, by name; empty before anything is.
    """

    clips: dict[str, Clip]
    home: dict[str, Clip]
    card: ScoreCard
    notes: tuple[str, ...]
    paths: dict[str, Path] = field(default_factory=dict)


#: Figures of a motion that are those of `poise doctor` for its file.
AS_THE_DOCTOR = ("sole_slide_mm_per_s", "penetration_mm")
#: Puts a motion of the body onto the skeleton that came in; the second says whether feet are held, which
#: is its part, too.
Home = Callable[[Clip, bool], Clip]


def finished(
    imitation: Imitation,
    evaluation: Evaluation,
    hold: bool = True,
    source: Clip | None = None,
    home: Home | None = None,
    undirected: Clip | None = None,
) -> Delivery:
    """The simulated motion of every clip, its standing feet held to the spot, as high as its source; see
    `Result.write`.

    Args:
        undirected: the motion before pins and touch points led it, beside which the doctor's findings
            are new.
    """
    clips, homes = dict[str, Clip](), dict[str, Clip]()
    figures, notes = [], []
    for k, recording in enumerate(evaluation.recordings):
        single = len(evaluation.recordings) == 1
        name = "simulated" if single else f"simulated_{imitation.library.names[recording.clip]}"
        raw = clip = simulated_clip(imitation, evaluation, k)
        found: dict[str, Any] = {}
        if hold:
            clip, found = _held(imitation, evaluation, recording.clip, clip)
        before = source or imitation.library.clips[recording.clip]
        clips[name] = high = as_high_as_source(clip, imitation, recording.clip)
        if home is None:
            homes[name] = settled(high, before) if hold else high
        else:
            homes[name] = home(high, hold)
        if homes[name].skeleton.same_bones(high.skeleton):
            clips[name] = homes[name]
        if hold:
            between = as_high_as_source(raw, imitation, recording.clip)
            between = between if home is None else home(between, False)
            of = {
                "source": undirected or before,
                "simulated": as_file(between),
                "delivered": as_file(homes[name]),
            }
            seen = {stage: examine(motion) for stage, motion in of.items()}
            for stage, one in seen.items():
                found.setdefault(stage, {}).update({key: one.figures[key] for key in AS_THE_DOCTOR})
            figures.append(found)
            notes += _sentences(found)
            notes += new_faults(found["clip"], seen["source"], seen["delivered"])
        raised = float(high.root_pos[0, 2] - clip.root_pos[0, 2])
        notes += _floor_told(clip.name, raised)
    return Delivery(clips, homes, replace(evaluation.card, delivered=tuple(figures)), tuple(notes))


def _held(
    imitation: Imitation, evaluation: Evaluation, index: int, clip: Clip
) -> tuple[Clip, dict[str, Any]]:
    """The clip with its feet held, and figures of the source, the simulation and of what is delivered.

    The source is judged on the floor that its soles tell. What the doctor says of files comes later.
    """
    table, r = imitation.humanoid.table, evaluation.rollouts
    joints = tuple(row.joint for row in table.rows)
    held, moved = hold_feet(clip, table)
    source = imitation.library.clips[index]
    found: dict[str, Any] = {"clip": source.name}
    found |= {"held_mean_mm": moved.mean_mm, "held_max_mm": moved.max_mm, "left": list(moved.left)}
    if r.shapes is not None and r.feet:
        ground = floor_of(imitation, index)
        of = (("source", source, ground), ("simulated", clip, 0.0), ("delivered", held, 0.0))
        found |= {name: clip_figures(c, joints, r.shapes, r.feet, floor) for name, c, floor in of}
    return held, found


def _floor_told(name: str, floor_m: float) -> list[str]:
    floor = round(floor_m * 1000)
    if not floor:
        return []
    return [
        f"{name}: it was moved by {-floor:+d} mm to stand on the floor of the simulation; the written "
        "motion is as high as the source again."
    ]


def _sentences(found: dict[str, Any]) -> list[str]:
    name, left = found["clip"], found["left"]
    out = [
        f"{name}: {foot} is not held in the written motion: its leg would turn faster than joints do."
        for foot in left
    ]
    if not found["held_max_mm"] > 0.05:
        return out

    def three(key: str, digits: int) -> str | None:
        each = [found[k].get(key) for k in ("source", "simulated", "delivered")]
        if any(x is None for x in each):
            return None
        before, between, after = (f"{x:.{digits}f}" for x in each)
        return f"{after} (simulated {between}, the clip {before})"

    slide, depth = three("sole_slide_mm_per_s", 0), three("penetration_mm", 1)
    told = [f"soles slide at {slide} mm/s"] if slide else []
    told += [f"the body sinks by {depth} mm"] if depth else []
    told += [
        f"ankles moved by {found['held_mean_mm']:.0f} mm on average, {found['held_max_mm']:.0f} at most"
    ]
    return [*out, f"{name}: standing feet are held in the written motion: {'; '.join(told)}."]


def make_report(
    imitation: Imitation,
    evaluation: Evaluation,
    curve: dict[str, np.ndarray],
    source: Clip | None = None,
) -> Report:
    """The report page of the first clip's episode from its first frame.

    source: the clip as its file holds it, where the library's is one that was moved onto another body.
    """
    recording, r = evaluation.recordings[0], evaluation.rollouts
    row, frames = recording.row, len(recording.qpos)
    pos, ref = r.pos[row, :frames].numpy(), r.ref_pos[row, :frames].numpy()
    table, source = imitation.humanoid.table, source or imitation.library.clips[recording.clip]
    card = evaluation.card
    error = np.linalg.norm((pos - pos[:, :1]) - (ref - ref[:, :1]), axis=-1).mean(-1) * 1000
    low = lowest_height(table, r.pos[row, :frames], r.quat[row, :frames]).numpy()
    helped = imitation.config.method != "deepmimic"
    pushed = imitation.task.compliance is not None
    holds = any(isinstance(e, HeldThing) for e in imitation.task.events)
    return Report(
        title=f"{source.name}, simulated",
        subtitle=f"{source.seconds:.1f} s on {len(table.rows)} bodies and "
        f"{len(imitation.humanoid.hinges)} hinges, {imitation.humanoid.mass:.0f} kg",
        shapes=tuple(
            Shape(i, g.kind, g.size, g.pos, g.quat) for i, b in enumerate(table.rows) for g in b.geoms
        ),
        bodies=imitation.humanoid.bodies,
        reference=Track("goal" if pushed else "reference", ref, r.ref_quat[row, :frames].numpy()),
        simulated=Track("simulation", pos, r.quat[row, :frames].numpy()),
        fps=r.fps,
        force=r.force[row, :frames].sum(1).numpy() if helped else None,
        torque=r.torque[row, :frames].sum(1).numpy() if helped else None,
        error_mm=error,
        error_global_mm=np.linalg.norm(pos - ref, axis=-1).mean(-1) * 1000,
        contacts=low[:, list(imitation.humanoid.feet)] < 0.015,
        score=card.to_dict(),
        curve=curve,
        notes=(*source.skeleton.source.notes, *imitation.report.sentences()),
        facts={
            "clip": source.name,
            "format": source.skeleton.source.format,
            "frames": f"{source.frames} at {source.fps:.5g} fps",
            "height": f"{table.height_m:.2f} m",
            "mass": f"{imitation.humanoid.mass:.1f} kg",
            "method": card.method,
            "training": f"{card.seconds:.0f} s, {card.samples:,} samples",
            "seed": str(card.seed),
            "version": __version__,
        },
        helps=_helps(r, row, frames) if helped else (),
        others=tuple(
            _lasting(r, other, imitation.library.names[other.clip], frames)
            for other in (evaluation.recordings[1:] if evaluation.together else ())
        ),
        pushed=pushed or holds,
        lost=lost_at(evaluation),
        pushes=recording.contacts if len(recording.contacts) == frames else (),
        things=tuple(
            Shape(0, "box", (p.size[0] / 2, p.size[1] / 2, p.size[2] / 2), p.pos, p.quat)
            for p in imitation.props
            if isinstance(p, Box)
        ),
    )


def lost_at(evaluation: Evaluation, index: int = 0) -> tuple[float, ...]:
    """When an episode that is kept whole left its motion by the score's rule, or ended before it, s; ()
    where it did not."""
    r, recording = evaluation.rollouts, evaluation.recordings[index]
    row, frames = recording.row, len(recording.qpos)
    least = None if r.ref_min_height is None else r.ref_min_height[row : row + 1]
    found = success(
        r.pos[row : row + 1, :frames], r.ref_pos[row : row + 1, :frames], torch.tensor([frames]),
        evaluation.card.succ_rule, root=r.root, ref_min_height=least, bodies=r.rule_bodies,
    )  # fmt: skip
    first = int(found.first_fail[0])
    if first < 0 and not bool(r.reached_end[row]):
        first = frames - 1
    return () if first < 0 else (first / r.fps,)


def _helps(rollouts: RolloutSet, row: int, frames: int) -> tuple[np.ndarray, ...]:
    """The residual forces of several bodies as a report has them; () for one on the root."""
    if rollouts.point is None or rollouts.force.shape[2] == 1:
        return ()
    both = torch.cat((rollouts.point[row, :frames], rollouts.force[row, :frames]), -1).numpy()
    return tuple(frame[np.abs(frame[:, 3:]).max(1) > 0.0] for frame in both)


def _lasting(rollouts: RolloutSet, recording: Recording, name: str, frames: int) -> Track:
    """A character's motion as long as another's; where it ends before, it stays as it was."""
    last = min(len(recording.qpos), frames) - 1
    at = torch.arange(frames).clamp_max(last)
    row = recording.row
    return Track(name, rollouts.pos[row, at].numpy(), rollouts.quat[row, at].numpy())


@dataclass(frozen=True)
class StageMotion:
    """What one stage made.

    Attributes:
        name: of the stage.
        key_mm: mean distance of the joints from the keyframes, mm.
        sole_slide_mm_per_s, penetration_mm, float_mm, jerk_m_per_s3: see `poise doctor`; None where no
            human body is told by the joints' names.
        fastest_m_per_s: of all joints.
    """

    name: str
    key_mm: float
    sole_slide_mm_per_s: float | None
    penetration_mm: float | None
    float_mm: float | None
    jerk_m_per_s3: float | None
    fastest_m_per_s: float

    def sentence(self) -> str:
        """The figures in words."""
        parts = [f"keyframes off by {self.key_mm:.0f} mm"]
        if self.sole_slide_mm_per_s is not None:
            parts.append(f"soles slide at {self.sole_slide_mm_per_s:.0f} mm/s")
        if self.jerk_m_per_s3 is not None:
            parts.append(f"jerk {self.jerk_m_per_s3:.0f} m/s^3")
        return f"{self.name}: {', '.join(parts)}, fastest joint {self.fastest_m_per_s:.1f} m/s."

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self)


def key_errors(made: Clip, source: Clip, keys: Sequence[int], at: Sequence[int]) -> tuple[float, ...]:
    """How far the joints are from each keyframe, mean, mm: of `made` in the frames `at`, of `source` in
    the frames `keys`. A motion that ends before one is where it ended."""
    have, wanted = made.positions(), source.positions()
    return tuple(
        1000 * float(np.linalg.norm(have[min(a, len(have) - 1)] - wanted[k], axis=-1).mean())
        for a, k in zip(at, keys, strict=True)
    )


def stage_of(name: str, made: Clip, key_mm: Sequence[float]) -> StageMotion:
    """The figures of a motion. key_mm: see `key_errors`."""
    figures, pos = examine(made).figures, made.positions()
    names = ("sole_slide_mm_per_s", "penetration_mm", "float_mm", "jerk_m_per_s3")
    speed = np.linalg.norm(np.diff(pos, axis=0), axis=-1).max() * made.fps
    slide, sinks, floats, jerk = (figures.get(n) for n in names)
    return StageMotion(name, float(np.mean(key_mm)), slide, sinks, floats, jerk, float(speed))
