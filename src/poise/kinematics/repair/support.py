"""The places where a body meets the floor: soles, lowest points, the faults of its stance."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from poise.body import Anatomy, BodyTable, body_of, find_anatomy
from poise.errors import PoiseError
from poise.kinematics.feet import NEAR_M, soles_of
from poise.kinematics.forward import carried, low_and_com
from poise.kinematics.ground import HOVER_M, GroundFit, fit_heights
from poise.kinematics.repair.faults import Fault, spell_faults
from poise.kinematics.repair.timing import drift_faults
from poise.kinematics.travel import Travel, told_by
from poise.metrics import foot_contacts, foot_slide
from poise.motion import Clip
from poise.motion.smoothing import find_runs, gaussian

#: How far (m) the estimated soles of a clip may be off the floor before the whole clip is: the file
#: tells where ankles and toes are, not how thick the soles below them.
SOLE_M = 0.045
#: The same for soles under the floor, where points are below it by `UNDER_M` in this share of frames.
SUNK_M, UNDER_M, UNDER_SHARE = 0.02, 0.005, 0.1
#: Depth (m) to which joints may be under the floor, and bone tips (toes bend, their tips are guessed).
JOINT_M, TIP_M = 0.01, 0.03
#: A standing foot slides if it is faster than this on average (m/s), gets this far (m), and for so long
#: (s); a shorter touch belongs to a foot that swings through.
SLIDE_SPEED, SLIDE_M, SLIDE_S = 0.15, 0.04, 0.06
#: Hovering (m beyond `HOVER_M`) and gaps between spells (s).
HOVER_MORE_M, GAP_S = 0.005, 0.1


@dataclass(frozen=True, eq=False)
class FloorPoints:
    """Points of one clip that may touch the floor; metres, world, Z up.

    soles: `(T, F, 3)` heel and toe end of every sole. feet: `(F,)` the foot joint of each.
    low: `(T, P)` heights of the body's joints and of its bone tips, each with its `margin (P,)`;
    names: `(P,)` the joint that each belongs to. sole_low: `(T,)` lowest point of the body's shapes.
    com: `(T, 3)` centre of mass. fit: how the clip would be set on the floor. table: its body. travel:
    what was taken out of a clip in place. labels: `(T, F)` bool, when each end touches, where the clip's
    file says so of all feet.
    """

    fps: float
    soles: np.ndarray
    feet: tuple[int, ...]
    low: np.ndarray
    margin: np.ndarray
    names: tuple[str, ...]
    sole_low: np.ndarray
    com: np.ndarray
    fit: GroundFit
    table: BodyTable
    travel: Travel | None = None
    labels: np.ndarray | None = None

    @classmethod
    def of(cls, clip: Clip, anatomy: Anatomy, table: BodyTable) -> FloorPoints:
        """The support of a clip with the body `table`, which was made from it."""
        world = [x for x in clip.world()]
        pos, quat = (x[:, [r.joint for r in table.rows]] for x in world)
        soles = soles_of(table, pos, quat)
        low, margin, names = _low_points(clip, anatomy, *world)
        feet = [table.rows[row].joint for row in soles]
        said = dict(clip.contacts)
        measured = low_and_com(table, pos, quat)
        labels = np.concatenate([said[j] for j in feet], 1) if feet and set(feet) <= set(said) else None
        return cls(
            clip.fps,
            np.concatenate([sole.ends for sole in soles.values()], 1),
            tuple(j for j in feet for _ in range(2)),
            low,
            margin,
            names,
            *measured,
            fit_heights(table, pos, quat, clip.fps, measured=measured),
            table,
            told_by(table, pos, quat, clip.fps),
            labels,
        )

    @property
    def flying(self) -> np.ndarray:
        """`(T)` bool, where the body falls freely."""
        out = np.zeros(len(self.sole_low), dtype=bool)
        for flight in self.fit.flights:
            out[flight.start : flight.stop + 1] = True
        return out

    @property
    def off_m(self) -> float:
        """How far (m) the whole clip is above (below: negative) its floor, 0 where that is not sure.

        The soles must say so by more than `SOLE_M`, or by more than `SUNK_M` downwards if the joints and
        tips, of which the places are known, are under the floor as well.
        """
        lift = self.fit.lift_m
        under = float((self.low.min(-1) < -UNDER_M).mean())
        return -lift if abs(lift) > SOLE_M or (lift > SUNK_M and under > UNDER_SHARE) else 0.0

    @cached_property
    def depth(self) -> np.ndarray:
        """`(T, P)` m, how deep each point is under the floor beyond its margin, 0 above it."""
        return np.maximum(self.off_m - self.margin - self.low, 0.0)

    @property
    def sole_slide(self) -> float | None:
        """Mean horizontal speed (mm/s) of the soles' ends while in contact, None without any."""
        ground = -self.fit.lift_m
        found = float(foot_slide(self.soles, self.fps, height=NEAR_M, ground=ground))
        return found if math.isfinite(found) else None

    @cached_property
    def contacts(self) -> tuple[np.ndarray, np.ndarray]:
        """Horizontal speed (m/s) and contact of every sole point between frames, `(T - 1, F)`.

        Contact as the clip's file says it, from frame to frame; else as in `foot_contacts`, within
        `NEAR_M` of the floor that the soles tell.
        """
        ground = -self.fit.lift_m
        speed, contact = foot_contacts(self.soles, self.fps, height=NEAR_M, ground=ground)
        if self.labels is not None:
            contact = self.labels[1:] & self.labels[:-1]
        return speed / 1000.0, contact


def anatomy_of(clip: Clip) -> Anatomy:
    """The parts of the clip's body; empty where it is no human's."""
    try:
        return find_anatomy(clip.skeleton)
    except PoiseError:
        return Anatomy((), ())


def support_of(clip: Clip, anatomy: Anatomy) -> FloorPoints | None:
    """The support of a clip, None where no body can be made for its skeleton."""
    try:
        table = body_of(clip)
    except PoiseError:
        return None
    return FloorPoints.of(clip, anatomy, table) if anatomy.parts else None


def sole_slide(clip: Clip) -> float | None:
    """How fast (mm/s) the standing soles of a motion travel over the floor: what `poise doctor` says of
    its file. None where no body is told, or none of its soles comes near the floor."""
    support = support_of(clip, anatomy_of(clip))
    return None if support is None else support.sole_slide


def _low_points(
    clip: Clip, anatomy: Anatomy, pos: np.ndarray, quat: np.ndarray
) -> tuple[np.ndarray, np.ndarray, tuple[str, ...]]:
    """Heights of the body's joints and of the tips of its hands, feet and toes; helpers are left out."""
    skeleton = clip.skeleton
    joints = list(dict.fromkeys([p.joint for p in anatomy.parts] + [j for _, j in anatomy.toes]))
    columns, margins = [pos[:, j, 2] for j in joints], [JOINT_M] * len(joints)
    names = [skeleton.names[j] for j in joints]
    for j, tip in skeleton.tips:
        if j in joints:
            columns.append(carried(pos[:, j], quat[:, j], tip)[:, 2])
            margins.append(TIP_M)
            names.append(skeleton.names[j])
    return np.stack(columns, -1), np.array(margins), tuple(names)


def height_faults(clip: Clip, support: FloorPoints) -> list[Fault]:
    """Where the body is above or under the floor; the whole clip once, then what differs from it."""
    last, off = clip.frames - 1, support.off_m
    out = drift_faults(support.sole_low, clip.fps, support.flying)
    if off:
        kind = "float" if off > 0 else "penetration"
        where = "above" if off > 0 else "below"
        detail = f"the soles of the whole clip stand {abs(off) * 100:.1f} cm {where} the floor"
        out.append(Fault(kind, "", 0, last, abs(off) * 100, detail))
    gap = round(GAP_S * clip.fps)
    settle = support.fit.settle_m
    hover = spell_faults("float", "", (settle + HOVER_M) * 100, settle > HOVER_MORE_M, gap)
    out += [f for f in hover if f.stop - f.start >= 2 * gap]
    depth = support.depth
    for first, stop in find_runs(depth.max(-1) > 0.0, gap):
        here = depth[first : stop + 1].max(0) + support.margin * (depth[first : stop + 1].max(0) > 0)
        out.append(
            Fault("penetration", support.names[here.argmax()], first, stop, float(here.max()) * 100)
        )
    return out


def slide_faults(clip: Clip, support: FloorPoints) -> list[Fault]:
    """Spells in which a standing foot travels over the floor, in cm between the ends of its way."""
    out = []
    for foot, slip, contact in foot_slips(support):
        for first, last in find_runs(contact, 1):
            run = slip[first : last + 1] / clip.fps
            way = np.concatenate((np.zeros((1, 2)), np.cumsum(run, axis=0)))
            distance = float(np.linalg.norm(np.ptp(way, axis=0)))
            speed = float(np.linalg.norm(run, axis=-1).mean()) * clip.fps
            lasting = last - first + 1 >= SLIDE_S * clip.fps
            if lasting and distance > SLIDE_M and speed > SLIDE_SPEED:
                name, detail = clip.skeleton.names[foot], f"at {speed:.2f} m/s"
                out.append(Fault("foot slide", name, first, last + 1, distance * 100, detail))
    return sorted(out, key=lambda f: f.start)


def foot_slips(support: FloorPoints) -> list[tuple[int, np.ndarray, np.ndarray]]:
    """Per foot joint: velocity `(T - 1, 2)` m/s of its slowest point in contact, contact `(T - 1)`.

    The sole of a rolling foot has one point that rests; where none is in contact the velocity is zero.
    """
    speed, contact = (x for x in support.contacts)
    velocity = np.diff(support.soles[..., :2], axis=0) * support.fps
    out = []
    for foot in dict.fromkeys(support.feet):
        mine = np.flatnonzero(np.array(support.feet) == foot)
        pick = np.where(contact[:, mine], speed[:, mine], np.inf).argmin(-1)
        chosen = velocity[np.arange(len(velocity)), mine[pick]]
        touching = np.any(contact[:, mine], axis=-1, keepdims=True)
        out.append((foot, np.where(touching, chosen, 0.0), touching[:, 0]))
    return out


#: Deviation (s) of the Gaussian over which the common slip of standing feet is averaged, and the slip
#: (m/s) that a rolling sole has anyway and that is left.
COMMON_S, ROLL_SPEED = 0.4, 0.04
#: The path drifts only where soles lie flat for so long (s) and slip with no more than this share of
#: unsteadiness, each foot for this time (s) in all, and one foot tells this share of the other's slips.
FLAT_S, STEADY, TOLD_S, EXPLAINED = 0.15, 0.5, 0.3, 0.6


def drifts(support: FloorPoints) -> bool:
    """Whether the path itself drifts: what slips is one motion of the floor, the same for both feet.

    A foot tells where its whole sole is down for `FLAT_S` and slips steadily; one that rolls, pivots or
    trembles does not. From the slips of either foot those of the other must follow, so that at least
    `EXPLAINED` of their energy goes.
    """
    contact = support.contacts[1]
    velocity = np.diff(support.soles[..., :2], axis=0) * support.fps
    told = []
    for foot in dict.fromkeys(support.feet):
        mine = np.flatnonzero(np.array(support.feet) == foot)
        slip, weight = velocity[:, mine].mean(1), np.zeros(len(velocity))
        turning = np.linalg.norm(velocity[:, mine] - slip[:, None], axis=-1).max(1)
        for first, last in find_runs(np.all(contact[:, mine], axis=-1), 0):
            run = slice(first, last + 1)
            mean = slip[run].mean(0)
            off = np.linalg.norm(slip[run] - mean, axis=-1) + turning[run]
            size = float(np.linalg.norm(mean))
            if last - first + 1 >= FLAT_S * support.fps and np.sqrt(np.mean(off**2)) <= STEADY * size:
                weight[run] = 1.0
        told.append((slip, weight))
    if len(told) != 2 or min(weight.sum() for _, weight in told) < TOLD_S * support.fps:
        return False
    for (slip, weight), (other, here) in (told, told[::-1]):
        guess, near = mean_near(other, here, support.fps)
        both = (weight > 0) & (near > 0)
        energy = float((slip[both] ** 2).sum())
        left = float(((slip[both] - guess[both]) ** 2).sum())
        if energy < ROLL_SPEED**2 * both.sum() or left > (1 - EXPLAINED) * energy or not both.any():
            return False
    return True


def mean_near(slip: np.ndarray, weight: np.ndarray, fps: float) -> tuple[np.ndarray, np.ndarray]:
    """The mean `(T, 2)` of `slip (T, 2)` by `weight (T)` around every frame, and the weight there."""
    kernel = gaussian(COMMON_S * fps)
    parts = [np.pad(x, len(kernel) // 2) for x in (weight, slip[:, 0] * weight, slip[:, 1] * weight)]
    total, *mean = (np.convolve(x, kernel, "valid") for x in parts)
    return np.stack(mean, -1) / np.maximum(total, 1e-6)[:, None], total


#: What an end of a sole does that stands (deviations): m/s level, by axis, and of its rise; m of height.
LEVEL_SPEED, RISE_SPEED, HEIGHT_M = 0.05, 0.06, 0.012
#: The same of one that swings, at least; and so many times that of one that stands.
SWING = (1.0, 0.5, 0.12)
WIDER = 3.0
#: How long (s) noise lasts, so that frames in it tell one thing, and a foot stands or swings.
ALIKE_S, LASTS_S = 0.1, 0.4
#: How often both are told.
TOLD_ROUNDS = 4


def stance(support: FloorPoints) -> tuple[np.ndarray, float, float]:
    """How likely each end of a sole stands between frames `(T - 1, F)`, and the deviations of its level
    speed (by axis) and of its rise while it does, m/s. Contacts that a file states stay.

    Level velocity, rise and height over the floor, y, are each normal, wider (S) while an end swings:

        log p(y | stands) / p(y | swings) = sum  d ln(S / s) - |y|^2 (1 / s^2 - 1 / S^2) / 2,

    and a chain of two states joins the frames. The s are those of the frames that stand, told again with
    them: the more noise is left, the faster and the higher may an end be that stands.
    """
    soles, fps = support.soles, support.fps
    velocity = np.diff(soles, axis=0) * fps
    height = np.maximum(soles[1:, :, 2], soles[:-1, :, 2]) + support.fit.lift_m
    stands, level, rise = support.contacts[1].astype(float), 0.0, 0.0
    if support.labels is None:
        # Where all that is near the floor is fast, a foot swings through; skating is no tremble.
        stands *= support.contacts[0] <= SWING[0]
    for _ in range(TOLD_ROUNDS):
        total = stands.sum()
        if total < 1.0:
            break
        floor = (stands * height).sum() / total
        # Lower than the floor is on it.
        parts = (velocity[..., :2], velocity[..., 2:], np.maximum(height - floor, 0.0)[..., None])
        ratio, sizes = np.zeros_like(height), list[float]()
        for y, own, least in zip(parts, (LEVEL_SPEED, RISE_SPEED, HEIGHT_M), SWING, strict=True):
            square, count = (y**2).sum(-1), y.shape[-1]
            spread = square if y is not parts[2] else (height - floor) ** 2
            size = float(np.sqrt((stands * spread).sum() / (count * total) + own**2))
            wide = max(least, WIDER * size)
            ratio += count * np.log(wide / size) - 0.5 * square * (size**-2 - wide**-2)
            sizes.append(size)
        level, rise = sizes[:2]
        if support.labels is not None:
            break
        stands = _joined(ratio / max(ALIKE_S * fps, 1.0), min(0.5, 1.0 / (LASTS_S * fps)))
    return stands, level, rise


def lasting(stands: np.ndarray) -> np.ndarray:
    """`(T, F)` frames, how long each end stands around every frame by `stands (T, F)`; 1 elsewhere."""
    out = np.ones_like(stands)
    for k in range(stands.shape[1]):
        for a, b in find_runs(stands[:, k] > 0.5, 0):
            out[a : b + 1, k] = b - a + 1
    return out


def _joined(ratio: np.ndarray, change: float) -> np.ndarray:
    """Probabilities `(T, F)` of the first of two states from their log ratios `(T, F)`, by the forward
    and the backward pass of a chain that changes state with the probability `change` at every step."""

    def passed(x: np.ndarray) -> np.ndarray:
        out, before = np.empty_like(x), np.zeros(x.shape[1])
        for t in range(len(x)):
            share = change + (1.0 - 2.0 * change) / (1.0 + np.exp(-np.clip(before, -40.0, 40.0)))
            out[t] = np.log(share / (1.0 - share))
            before = out[t] + x[t]
        return out

    both = passed(ratio) + passed(ratio[::-1])[::-1] + ratio
    return 1.0 / (1.0 + np.exp(-np.clip(both, -40.0, 40.0)))
