"""What the motion doctor says of filled gaps: faults that no body can have done, by gap."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from poise.kin.doctor.doctor import examine
from poise.kin.doctor.faults import KINDS
from poise.motion import Clip
from poise.synth.gaps import Gap

#: Kinds of faults that frames between keyframes can have; the others are of the file or its skeleton.
JUDGED = (
    "missing frames", "teleport", "flip", "speed", "jitter", "root jitter", "float", "penetration",
    "foot slide",
)  # fmt: skip


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
