"""What became of every file of a library, in numbers and sentences."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

State = Literal["kept", "cut", "left out"]


@dataclass(frozen=True)
class ClipNote:
    """One file of a library.

    Attributes:
        name, subject: see `MotionFile`.
        path: of the file.
        state: taken whole, in part, or not at all.
        reason: why it was cut or left out, a clause.
        rule: that rule's name: unreadable, not human, short, word, held, leaning, below, leap, rate,
            unlike, by hand.
        seconds: of the file's motion.
        kept_s: what the library has of it, (0, 0) for none.
        retargeted: it came from another skeleton.
        scale: of its steps.
        direction_deg, slide_mm_s: see `RetargetReport`.
        lift_m: how far it was lifted onto the floor.
        repairs: what was cleaned.
        notes: what its reader guessed.
    """

    name: str
    subject: str
    path: str
    state: State
    reason: str = ""
    rule: str = ""
    seconds: float = 0.0
    kept_s: tuple[float, float] = (0.0, 0.0)
    frames: int = 0
    retargeted: bool = False
    scale: float = 1.0
    direction_deg: float = 0.0
    slide_mm_s: float = 0.0
    lift_m: float = 0.0
    repairs: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    def sentence(self) -> str:
        """The note in one sentence."""
        if self.state == "kept":
            return f"{self.name}: {self.frames} frames."
        if self.state == "cut":
            a, b = self.kept_s
            return (
                f"{self.name}: cut to {a:.1f} to {b:.1f} s of {self.seconds:.1f} s, since {self.reason}."
            )
        return f"{self.name}: left out, since {self.reason}."


@dataclass(frozen=True)
class LibraryReport:
    """A library in short. onto: what the skeleton is. fps: of all clips. cached: it was not made now."""

    clips: tuple[ClipNote, ...]
    onto: str
    fps: float
    cached: bool = False

    def count(self, state: State) -> int:
        """How many files had this fate."""
        return sum(c.state == state for c in self.clips)

    def of(self, name: str) -> ClipNote:
        """The note of the clip of that name."""
        return next(c for c in self.clips if c.name == name)

    @property
    def subjects(self) -> tuple[str, ...]:
        """The performers of the library, in order."""
        return tuple(sorted({c.subject for c in self.clips if c.state != "left out"}))

    def sentences(self) -> list[str]:
        """The report in words, with a line for each clip that was not taken whole."""
        kept = [c for c in self.clips if c.state != "left out"]
        seconds = sum(c.kept_s[1] - c.kept_s[0] for c in kept)
        out = [
            f"{len(kept)} of {len(self.clips)} clips, {seconds / 60:.1f} minutes at {self.fps:g} frames "
            f"per second, {self.count('cut')} of them cut, on {self.onto}."
        ]
        moved = [c for c in kept if c.retargeted]
        if moved:
            worst = max(moved, key=lambda c: c.direction_deg)
            out.append(
                f"{len(moved)} came from other skeletons; their limbs point "
                f"{sum(c.direction_deg for c in moved) / len(moved):.1f} degrees away on average, most "
                f"in {worst.name} ({worst.direction_deg:.1f})."
            )
        repaired = sum(bool(c.repairs) for c in kept)
        if repaired:
            out.append(f"{repaired} had impossible speeds or flipped joints, which were repaired.")
        return out + [c.sentence() for c in self.clips if c.state != "kept"]

    def to_dict(self) -> dict[str, Any]:
        """Plain values, ready for JSON."""
        return {"onto": self.onto, "fps": self.fps, "clips": [asdict(c) for c in self.clips]}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any], cached: bool = False) -> LibraryReport:
        """What `to_dict` gave."""
        clips = tuple(ClipNote(**_lists_to_tuples(c)) for c in data["clips"])
        return cls(clips, data["onto"], data["fps"], cached)


def _lists_to_tuples(entry: Mapping[str, Any]) -> dict[str, Any]:
    return {
        k: tuple(v) if isinstance(v, Sequence) and not isinstance(v, str) else v
        for k, v in entry.items()
    }
