"""The faults that the motion doctor knows: what each one is, in which unit, and how it is mended."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import numpy as np

from poise.formats.point_noise import RemovedTremble
from poise.motion import Clip
from poise.motion.smoothing import find_runs


class FaultKind(NamedTuple):
    """title: in words. unit: of `Fault.size`. repair: how it is mended; empty where it is not."""

    title: str
    unit: str
    repair: str = ""


#: In the order in which they are mended, then those that are only told.
KINDS = {
    "frozen frames": FaultKind("frames that repeat the one before", "frames", "filled in or left out"),
    "missing frames": FaultKind("a gap of frames", "frames"),
    "teleport": FaultKind("the root jumps", "m", "the path is joined by its usual step"),
    "flip": FaultKind("turned where no joint reaches", "degrees", "turned back"),
    "speed": FaultKind("faster than a human joint", "rad/s", "interpolated, held or smoothed"),
    "spike": FaultKind("leaps away for a frame or two", "degrees", "put on the smoothest curve"),
    "held": FaultKind("stands still, then leaps on", "degrees", "put on the smoothest curve"),
    "tremble": FaultKind("the whole body trembles", "mm", "taken off, and no more than it is"),
    "jitter": FaultKind("trembles from frame to frame", "mm", "smoothed without delay"),
    "root jitter": FaultKind("the root trembles from frame to frame", "mm", "smoothed without delay"),
    "float": FaultKind("hovers without falling", "cm", "lowered to the floor"),
    "penetration": FaultKind("lies under the floor", "cm", "lifted out of the floor"),
    "foot slide": FaultKind("slides while it stands", "cm", "held in place, the leg follows"),
    "joint jump": FaultKind("faster than a human joint, and a repair would jerk the body more", "rad/s"),
    "out of reach": FaultKind("stays where no joint reaches", "frames"),
    "limit": FaultKind("beyond the file's own limits", "degrees"),
    "bone drift": FaultKind("its bone changes its length or place", "mm", "kept rigid when it is read"),
    "quaternion length": FaultKind("quaternions off unit length", "", "normalised when they are read"),
    "rest frame": FaultKind("a rest pose put before the motion", "frames", "left out when it is read"),
    "frame rate": FaultKind("gravity contradicts the frame rate", "frames/s"),
    "sides": FaultKind("left and right are exchanged or mirrored", ""),
}


@dataclass(frozen=True)
class Fault:
    """Something no body can have done, in frames `start` to `stop` (inclusive, from 0, as read).

    kind: a key of `KINDS`, which states the unit of `size`. joint: "" for the whole body.
    detail: what else is to be said, a clause without a full stop. hz: the frequency of a tremble that
    has one, else None.
    """

    kind: str
    joint: str
    start: int
    stop: int
    size: float
    detail: str = ""
    hz: float | None = None

    @classmethod
    def tremble(cls, start: int, stop: int, mm: float, hz: float | None) -> Fault:
        """A tremble of the whole body at a frequency, or from frame to frame."""
        return cls("tremble", "", start, stop, mm, RemovedTremble(mm, hz).how, hz)

    @property
    def repairable(self) -> bool:
        """Whether `heal` mends this kind, or reading did."""
        return bool(KINDS[self.kind].repair)

    def to_dict(self) -> dict[str, Any]:
        """Plain values, with the unit of the size; `hz` for a tremble that has one."""
        own = {k: v for k, v in asdict(self).items() if v is not None}
        return {**own, "unit": KINDS[self.kind].unit, "repairable": self.repairable}


def by_kind(faults: Iterable[Fault]) -> dict[str, list[Fault]]:
    """The faults of each kind that occurs, in the order of `KINDS`."""
    found = list(faults)
    kinds = [k for k in KINDS if any(f.kind == k for f in found)]
    return {k: [f for f in found if f.kind == k] for k in kinds}


def spell_faults(
    kind: str, joint: str, size: np.ndarray, bad: np.ndarray, gap: int, least: int = 1
) -> list[Fault]:
    """One fault for every run of true in `bad (T)`, with the largest `size (T)` in it.

    Runs at most `gap` frames apart are one; runs shorter than `least` frames are left out.
    """
    runs = [(a, b) for a, b in find_runs(bad, gap) if b - a + 1 >= least]
    return [Fault(kind, joint, a, b, float(np.max(size[a : b + 1]))) for a, b in runs]


def read_faults(clip: Clip) -> list[Fault]:
    """What reading mended: bones that drift, quaternions off unit length, inserted frames, keypoints
    that tremble."""
    out: list[Fault] = []
    for kind, joint, a, b, size in clip.skeleton.source.mended:
        stop = clip.frames - 1 if b < 0 else b
        millimetres = size * (1e3 if KINDS[kind].unit == "mm" else 1.0)
        if kind == "tremble":
            # It is the whole body's; its frequency stands in the joint's place.
            out.append(Fault.tremble(a, stop, millimetres, float(joint) if joint else None))
        else:
            out.append(Fault(kind, joint, a, stop, millimetres))
    return out
