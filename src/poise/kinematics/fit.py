"""One humanoid for a library of clips, the clips in its coordinates, and what that took."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from poise.body import BodyConfig, BodyTable, Humanoid, generate_table, make_humanoid
from poise.body.body_table import BodyRow
from poise.kinematics.ground import GroundFit
from poise.kinematics.loops import Cycle
from poise.kinematics.place import calm_library, on_own_body, place_on_body
from poise.kinematics.rate import RateJudgement, judge_rate
from poise.kinematics.repair.estimate import CleanReport, clean_clip
from poise.motion import Clip, ClipLibrary, resample
from poise.motion.rotations import quat_between, quat_mul, quat_to_euler

#: Shapes that overlap deeper than this (m) in a reference frame must not push each other apart.
OVERLAP_M = 0.01
#: Middle Euler angle (rad) beyond which another hinge order is looked for.
GIMBAL = 1.2


@dataclass(frozen=True)
class ClipFit:
    """What was measured and changed of one clip.

    rate: what physics says of its own frame rate. clean: flips and impossible speeds that were
    repaired. cycle: how the ends of a cyclic clip met, None for others.
    ground: how it was set on the floor. joint_error_mm: mean distance between its joints and the
    humanoid's after conversion (turns that a chain cannot make), before a cycle was closed.
    """

    name: str
    rate: RateJudgement
    clean: CleanReport
    cycle: Cycle | None
    ground: GroundFit
    joint_error_mm: float

    def to_dict(self) -> dict[str, Any]:
        """The fit as plain numbers and lists, ready for JSON."""
        return {
            **self.clean.to_dict(),
            "ground": self.ground.to_dict(),
            "cycle": None if self.cycle is None else asdict(self.cycle),
            "fall": self.rate.fall,
            "likely_fps": self.rate.likely,
        }

    def sentences(self) -> list[str]:
        """The fit in words, one line each."""
        out = [f"{self.name}: {sentence}" for sentence in self.clean.sentences()]
        if self.cycle is not None:
            out.append(f"{self.name}: {self.cycle.sentence()}")
        out.append(f"{self.name}: {self.ground.sentence()}")
        error = f"the humanoid's joints lie {self.joint_error_mm:.1f} mm from the clip's on average"
        return [*out, f"{self.name}: {error}."]


@dataclass(frozen=True)
class FitReport:
    """What was measured and changed so that one body can do the motion.

    clips: of each. widened: hinges with a range that had to grow, and the growth in degrees. excluded:
    body pairs that overlap in the reference.
    """

    clips: tuple[ClipFit, ...]
    widened: tuple[tuple[str, float], ...] = ()
    excluded: tuple[tuple[str, str], ...] = ()

    @property
    def cyclic(self) -> tuple[bool, ...]:
        """Which clips can go on from their end to their start, closed to do so."""
        return tuple(c.cycle is not None and c.cycle.closed for c in self.clips)

    def to_dict(self) -> dict[str, Any]:
        """The report as plain numbers and lists, ready for JSON."""
        clips = {c.name: c.to_dict() for c in self.clips}
        return {"clips": clips, "widened_deg": dict(self.widened), "excluded": list(self.excluded)}

    def sentences(self) -> list[str]:
        """The report in words, one line each."""
        out: list[str] = []
        for c in self.clips:
            doubt = c.rate.sentence()
            out += [f"{c.name}: {doubt}"] if doubt else []
        out += [sentence for c in self.clips for sentence in c.sentences()]
        if self.widened:
            worst = max(self.widened, key=lambda w: w[1])
            out.append(
                f"{len(self.widened)} joint ranges were widened to reach the motion, "
                f"most {worst[0]} by {worst[1]:.0f} degrees."
            )
        if self.excluded:
            pairs = ", ".join(f"{a}-{b}" for a, b in self.excluded[:4])
            more = f" and {len(self.excluded) - 4} more" if len(self.excluded) > 4 else ""
            out.append(f"Collisions off where the clip's own limbs overlap: {pairs}{more}.")
        return out


def fit_humanoid(
    library: ClipLibrary | Clip,
    config: BodyConfig | None = None,
    rate_hz: float = 30.0,
    table: BodyTable | None = None,
    widens: bool = True,
    noise: Sequence[CleanReport] | None = None,
) -> tuple[Humanoid, list[np.ndarray], FitReport]:
    """A humanoid that can reach every frame of the library.

    Args:
        library: clips of one hierarchy; the body is made from the first one's bone lengths, or read
            from `config.mjcf`, onto which the clips are then retargeted.
        config: see `BodyConfig`. rate_hz: the control rate at which the clips are sampled.
        table: a body on the library's skeleton that stays as it is but for its hinges' ranges and for
            pairs of bodies that never collide, both of which only grow; by default one is made.
        widens: whether ranges grow to hold the motion.
        noise: what was taken off each clip already (`calm_library`); by default it is taken off here.

    Returns:
        the humanoid, one `qpos (T, 7 + hinges)` per clip at `rate_hz` standing on the floor, and a
        report of every repair. Its `cyclic` says which motions end as they began.
    """
    library = ClipLibrary.of(library) if isinstance(library, Clip) else library
    config = config or BodyConfig()
    if noise is None:
        library, noise = calm_library(library)
    own = None
    if table is None:
        library, own = on_own_body(library, config)
    repaired = [clean_clip(c, raw=True) for c in library]
    clips = [resample(c, rate_hz) for c, _ in repaired]
    # A body that is there already keeps its hinges as they are.
    table = table or own or _choose_orders(generate_table(clips[0].skeleton, config, clips), clips)
    placed = [place_on_body(c, table, clean=False, level=False, join=True) for c in clips]
    motions = [p.qpos for p in placed]
    table, widened = widen(table, motions, config.margin) if widens else (table, ())
    humanoid = make_humanoid(clips[0].skeleton, table)
    overlaps = _overlaps(humanoid, motions)
    if overlaps:
        table = replace(table, contact_exclusions=table.contact_exclusions + overlaps)
        humanoid = make_humanoid(clips[0].skeleton, table)
    fits = (
        ClipFit(
            c.name,
            judge_rate(c, table),
            n.then(found),
            p.cycle,
            p.ground,
            p.joint_error_mm,
        )
        for c, (_, found), n, p in zip(library, repaired, noise, placed, strict=True)
    )
    return humanoid, motions, FitReport(tuple(fits), widened, overlaps)


def _choose_orders(table: BodyTable, clips: list[Clip]) -> BodyTable:
    """Hinge orders with a middle angle that stays far from +-90 degrees, where speeds would explode.

    An order is changed only where the motion comes nearer than `GIMBAL` to the lock.
    """
    worlds = [c.world()[1] for c in clips]
    rows = list(table.rows)
    for i, row in enumerate(rows):
        if len(row.order) != 3:
            continue
        anchor = rows[row.parent].joint
        rest = np.asarray(row.quat, dtype=float)
        frame = np.asarray(row.frame, dtype=float)
        rel = np.concatenate([quat_between(w[:, anchor], w[:, row.joint]) for w in worlds])
        turns = quat_mul(quat_between(quat_mul(rest, frame), rel), frame)
        orders = [row.order, *("".join(p) for p in itertools.permutations("XYZ"))]
        reach = [float(np.abs(quat_to_euler(turns, o)[:, 1]).max()) for o in orders]
        if reach[0] > GIMBAL:
            order = orders[int(np.argmin(np.round(reach, 2)))]
            # An axis keeps its limits when its place in the chain changes.
            ranges = tuple(row.ranges[row.order.index(letter)] for letter in order)
            rows[i] = replace(row, order=order, ranges=ranges)
    return replace(table, rows=tuple(rows))


def widen(
    table: BodyTable, motions: Sequence[np.ndarray], margin: float
) -> tuple[BodyTable, tuple[tuple[str, float], ...]]:
    """Ranges grown to hold motions `qpos (T, 7 + hinges)` plus `margin` rad; and what grew, by how many
    degrees."""
    low = np.min([q[:, 7:].min(0) for q in motions], 0) - margin
    high = np.max([q[:, 7:].max(0) for q in motions], 0) + margin
    rows: list[BodyRow] = []
    widened: list[tuple[str, float]] = []
    at = 0
    for row in table.rows:
        ranges: list[tuple[float, float]] = []
        for name, (a, b) in zip(row.hinge_names(), row.ranges, strict=True):
            grown = max(a - low[at], high[at] - b, 0.0)
            if grown > 0:
                widened.append((name, math.degrees(grown)))
            ranges.append((float(min(a, low[at])), float(max(b, high[at]))))
            at += 1
        rows.append(replace(row, ranges=tuple(ranges)))
    return replace(table, rows=tuple(rows)), tuple(widened)


def _overlaps(humanoid: Humanoid, motions: list[np.ndarray]) -> tuple[tuple[str, str], ...]:
    """Pairs of bodies with shapes that overlap by more than `OVERLAP_M` in some reference frame."""
    import mujoco

    model = humanoid.model
    data = mujoco.MjData(model)
    found: set[tuple[str, str]] = set()
    for q in motions:
        for frame in q:
            data.qpos[:] = frame
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_collision(model, data)
            if not data.ncon:
                continue
            deep = data.contact.dist < -OVERLAP_M
            for g1, g2 in data.contact.geom[deep]:
                a, b = int(model.geom_bodyid[g1]), int(model.geom_bodyid[g2])
                if a and b:
                    found.add((humanoid.bodies[a - 1], humanoid.bodies[b - 1]))
    return tuple(sorted(found))
