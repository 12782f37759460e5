"""The places where a body meets the floor: soles, lowest points, the faults of its stance."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from poise.body import Anatomy, BodyTable, find_anatomy, generate_table
from poise.errors import PoiseError
from poise.kinematics.feet import NEAR_M, soles_of
from poise.kinematics.forward import carried, low_and_com
from poise.kinematics.ground import HOVER_M, GroundFit, fit_heights
from poise.kinematics.repair.faults import Fault, spell_faults
from poise.kinematics.repair.timing import drift_faults
from poise.kinematics.travel import Travel, told_by
from poise.metrics import foot_contacts, foot_slide
from poise.motion import Clip
from poise.motion.smoothing import find_runs

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
    soles: Tensor
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
        world = [torch.tensor(x) for x in clip.world()]
        pos, quat = (x[:, [r.joint for r in table.rows]] for x in world)
        soles = soles_of(table, pos, quat)
        low, margin, names = _low_points(clip, anatomy, *world)
        feet = [table.rows[row].joint for row in soles]
        said = dict(clip.contacts)
        labels = np.concatenate([said[j] for j in feet], 1) if feet and set(feet) <= set(said) else None
        return cls(
            clip.fps,
            torch.cat([sole.ends for sole in soles.values()], 1),
            tuple(j for j in feet for _ in range(2)),
            low,
            margin,
            names,
            *low_and_com(table, pos, quat),
            fit_heights(table, pos, quat, clip.fps),
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
    def contacts(self) -> tuple[Tensor, Tensor]:
        """Horizontal speed (m/s) and contact of every sole point between frames, `(T - 1, F)`.

        Contact as the clip's file says it, from frame to frame; else as in `foot_contacts`, within
        `NEAR_M` of the floor that the soles tell.
        """
        ground = -self.fit.lift_m
        speed, contact = foot_contacts(self.soles, self.fps, height=NEAR_M, ground=ground)
        if self.labels is not None:
            contact = torch.tensor(self.labels[1:] & self.labels[:-1])
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
        table = generate_table(clip.skeleton, None, [clip])
    except PoiseError:
        return None
    return FloorPoints.of(clip, anatomy, table) if anatomy.parts else None


def sole_slide(clip: Clip) -> float | None:
    """How fast (mm/s) the standing soles of a motion travel over the floor: what `poise doctor` says of
    its file. None where no body is told, or none of its soles comes near the floor."""
    support = support_of(clip, anatomy_of(clip))
    return None if support is None else support.sole_slide


def _low_points(
    clip: Clip, anatomy: Anatomy, pos: Tensor, quat: Tensor
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
    return torch.stack(columns, -1).numpy(), np.array(margins), tuple(names)


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
    speed, contact = (x.numpy() for x in support.contacts)
    velocity = (torch.diff(support.soles[..., :2], dim=0) * support.fps).numpy()
    out = []
    for foot in dict.fromkeys(support.feet):
        mine = np.flatnonzero(np.array(support.feet) == foot)
        pick = np.where(contact[:, mine], speed[:, mine], np.inf).argmin(-1)
        chosen = velocity[np.arange(len(velocity)), mine[pick]]
        touching = np.any(contact[:, mine], axis=-1, keepdims=True)
        out.append((foot, np.where(touching, chosen, 0.0), touching[:, 0]))
    return out
