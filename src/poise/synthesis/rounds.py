"""Gaps in which the doctor finds faults are filled anew, and the best that came of each is kept."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch

from poise.kinematics.feet import Motion
from poise.kinematics.repair.faults import KINDS
from poise.kinematics.repair.motion_doctor import examine, heal
from poise.motion import Clip
from poise.motion.rotations import slerp
from poise.motion.smoothing import smoothstep
from poise.motion.vectors import lerp
from poise.synthesis.filler import Filler, Gap
from poise.synthesis.limits import Calmed, Feet, excess

#: Kinds of faults that frames between keyframes can have; the others are of the file or its skeleton.
JUDGED = (
    "missing frames",
    "teleport",
    "flip",
    "speed",
    "jitter",
    "root jitter",
    "float",
    "penetration",
    "foot slide",
)


@dataclass(frozen=True)
class GapFault:
    """A fault of one gap.

    Attributes:
        kind: a key of the doctor's `KINDS`, which states the unit of `size`.
        joint: empty for the whole body.
        start, stop: its frames, inclusive.
        gap: the keyframes on either side of it.
        sample: number of the clip that has it.
    """

    kind: str
    joint: str
    start: int
    stop: int
    size: float
    gap: tuple[int, int]
    sample: int = 0

    def sentence(self) -> str:
        """In words, without a full stop."""
        kind = KINDS[self.kind]
        at = f"{self.joint}: " if self.joint else ""
        size = f"{self.size:.3g} {kind.unit}"
        return f"{at}{kind.title} ({size}), frames {self.start} to {self.stop}"

    def to_dict(self) -> dict[str, Any]:
        """Plain values, with the unit of the size."""
        return {**asdict(self), "gap": list(self.gap), "unit": KINDS[self.kind].unit}


def judged(clip: Clip, gaps: Sequence[Gap], sample: int = 0) -> dict[Gap, tuple[GapFault, ...]]:
    """The faults of each gap of a filled clip that has any.

    A fault counts to every gap with frames in it; one of all frames is of the file, such as its floor.
    """
    out: dict[Gap, tuple[GapFault, ...]] = {}
    for fault in examine(clip).faults:
        if fault.kind not in JUDGED or fault.stop - fault.start + 1 >= clip.frames:
            continue
        for gap in gaps:
            if fault.start < gap.b and fault.stop > gap.a:
                own = GapFault(
                    fault.kind, fault.joint, fault.start, fault.stop, fault.size, (gap.a, gap.b), sample
                )
                out[gap] = (*out.get(gap, ()), own)
    return out


def weight(faults: Iterable[GapFault]) -> tuple[int, float]:
    """How bad faults are, to compare ways to fill the same gap: how many kinds and joints are at fault,
    then how far feet slide, hover or sink, cm, and for how many frames there are others."""
    found = list(faults)
    others = sum(f.stop - f.start + 1 for f in found if KINDS[f.kind].unit != "cm")
    return len({(f.kind, f.joint) for f in found}), distance(found) + others


def distance(faults: Iterable[GapFault]) -> float:
    """How far (cm) feet slide, hover or sink in all."""
    return sum(f.size for f in faults if KINDS[f.kind].unit == "cm")


def told(faults: Sequence[GapFault], most: int = 6) -> str:
    """One sentence, without a full stop, that names faults."""
    words = list(dict.fromkeys(f.sentence() for f in faults))
    more = f"; and {len(words) - most} more" if len(words) > most else ""
    return f"no body can have done what is left in the gaps: {'; '.join(words[:most])}{more}"


#: Shares of the network's motion in the best guess, round by round, the rest being interpolated, and
#: what is done with feet: at last they are led from stand to stand.
ROUNDS: tuple[tuple[float, tuple[Feet, ...]], ...] = (
    (1.0, ("held", "stepped", "free")),
    (0.5, ("held", "stepped", "free")),
    (1.0, ("stepped",)),
    (0.0, ("stepped",)),
)
#: Seconds beside a keyframe over which what the doctor mends fades in.
FADE_S = 0.15
#: Gaps of one clip that are mended so at most: each costs an examination of the whole clip.
MENDED = 12


def best_of_rounds(
    filler: Filler,
    path: Motion,
    gaps: Sequence[Gap],
    sample: int,
    on_gap: Callable[[int], None] | None = None,
) -> tuple[np.ndarray, np.ndarray, tuple[GapFault, ...]]:
    """Root and rotations of one filled clip, and the faults that are left in it.

    In further rounds gaps with faults are filled anew: the best guess (sample 0) with less of the
    network's motion, a variant with another draw. Then the doctor mends what it can, and keyframes
    stay. Of all that each gap keeps what had the fewest faults.

    Args:
        on_gap: is told how many gaps are filled, in the first round.
    """
    root, rot = path[0].copy(), path[1].copy()
    kept: dict[Gap, tuple[tuple[int, float], Motion, Calmed | None, np.ndarray]] = {}
    wanting = list(gaps)
    for round_ in range(max(1, filler.filling.rounds)):
        noise, (most, ways) = None, ROUNDS[min(round_, len(ROUNDS) - 1)]
        if sample:
            most = 1.0
            seed = (filler.filling.seed * 100_003 + sample) * 1_009 + round_
            noise = torch.Generator().manual_seed(seed)
        beside: dict[Gap, np.ndarray] = {}
        for made, gap in enumerate(wanting, 1):
            beside[gap] = rot[max(0, gap.a - 1)].copy()
            filler.fill(root, rot, gap, noise, most, ways)
            if on_gap is not None and not round_:
                on_gap(made)
        found = judged(_clip(filler, root, rot), gaps, sample)
        for gap in wanting:
            bad = weight(found.get(gap, ()))
            if gap not in kept or bad < kept[gap][0]:
                kept[gap] = bad, _cut(root, rot, gap), filler.calmed.get(gap), beside[gap]
        wanting = [gap for gap in wanting if kept[gap][0][0]]
        if not wanting:
            break
    _compose(filler, root, rot, kept)
    if wanting and filler.filling.rounds > 1:
        # First the legs alone, since keyframes say where the hips are.
        for hips in (False, True):
            _mend(filler, root, rot, wanting, gaps, hips)
    left = judged(_clip(filler, root, rot), gaps, sample)
    return root, rot, tuple(dict.fromkeys(f for faults in left.values() for f in faults))


def _compose(
    filler: Filler,
    root: np.ndarray,
    rot: np.ndarray,
    kept: dict[Gap, tuple[tuple[int, float], Motion, Calmed | None, np.ndarray]],
) -> None:
    """The best of each gap, in place, with ends that meet."""
    for gap, (_, motion, calmed, before) in kept.items():
        root[gap.a + 1 : gap.b], rot[gap.a + 1 : gap.b] = motion
        if not np.array_equal(before, rot[max(0, gap.a - 1)]):
            # The gap before it ends in another speed than when this one was filled.
            filler.join(root, rot, gap)
        if calmed is not None:
            filler.calmed[gap] = calmed


def _mend(
    filler: Filler,
    root: np.ndarray,
    rot: np.ndarray,
    wanting: Sequence[Gap],
    gaps: Sequence[Gap],
    hips: bool,
) -> None:
    """What the doctor makes of the gaps with faults, in place, where fewer are left then; it fades in
    from the keyframes. hips: whether their path may change, or legs alone."""
    before = _clip(filler, root, rot)
    healed = heal(before, hips)
    if healed.frames != before.frames:
        return
    tried_root, tried_rot = root.copy(), rot.copy()
    for gap in wanting:
        rows = slice(gap.a + 1, gap.b)
        t = np.arange(1, gap.b - gap.a, dtype=root.dtype)
        near = np.minimum(t, gap.b - gap.a - t) / filler.own.fps
        share = np.minimum(near / FADE_S, 1.0)
        share = smoothstep(share)[:, None]
        tried_root[rows] = lerp(root[rows], healed.root_pos[rows], share)
        other = healed.rot[rows]
        tried_rot[rows] = slerp(rot[rows], other, share)
    fewest = _count(judged(before, gaps))
    able = [g for g in wanting if _speed(filler, tried_root, tried_rot, g) <= 1.0][:MENDED]
    # What is mended in one gap may be a fault in the next: all at once, else one by one.
    for some in (able, *([gap] for gap in able)):
        was = root.copy(), rot.copy()
        for gap in some:
            rows = slice(gap.a + 1, gap.b)
            root[rows], rot[rows] = tried_root[rows], tried_rot[rows]
        for gap in gaps:
            # A gap begins in the speed in which the one before it ends.
            at = max(0, gap.a - 1)
            if gap in some or not np.array_equal(was[1][at], rot[at]):
                filler.join(root, rot, gap)
        now = _count(judged(_clip(filler, root, rot), gaps))
        if now >= fewest:
            root[:], rot[:] = was
        elif some is able:
            return
        else:
            fewest = now


def _count(found: Mapping[Gap, Sequence[GapFault]]) -> tuple[int, float]:
    """How many faults there are, and `distance` of all."""
    each = {(f.kind, f.joint, f.start): f for faults in found.values() for f in faults}
    return len(each), distance(each.values())


def _speed(filler: Filler, root: np.ndarray, rot: np.ndarray, gap: Gap) -> float:
    """The fastest joint of a gap, by its limit."""
    rows = slice(gap.a, gap.b + 1)
    return excess(filler.own.skeleton, filler.limits, (root[rows], rot[rows]), filler.own.fps)[0]


def _cut(root: np.ndarray, rot: np.ndarray, gap: Gap) -> Motion:
    return root[gap.a + 1 : gap.b].copy(), rot[gap.a + 1 : gap.b].copy()


def _clip(filler: Filler, root: np.ndarray, rot: np.ndarray) -> Clip:
    return filler.own.replaced(root_pos=root, rot=rot, contacts=())
