"""Faults of a captured motion that no body can do: found, repaired, and told in numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from poise.body import Anatomy, find_anatomy, generate_table
from poise.errors import PoiseError
from poise.kin.doctor.estimate import denoise, noise_faults
from poise.kin.doctor.faults import Fault
from poise.kin.doctor.flips import Flip, out_of_reach, unflip
from poise.kin.doctor.speeds import TRUNK_SPEED, SpeedRepair, limit_speeds, without_rougher
from poise.kin.rate.judge import judge_rate
from poise.kin.travel import Travel, find_travel
from poise.motion import Clip


@dataclass(frozen=True)
class CleanReport:
    """What was repaired in one clip; empty for a clean one. Frames are the file's.

    flips: feet and hands that were turned back. speeds: turns faster than a human joint. left: (joint,
    frames) of feet and hands that are still where none reaches, since no repair was sure enough. kept:
    turns too fast that stay, since the body would jerk more without, see `without_rougher`. noise: what
    was taken off, and joints that were lost (`estimate.noise_faults`).
    """

    flips: tuple[Flip, ...] = ()
    speeds: tuple[SpeedRepair, ...] = ()
    left: tuple[tuple[str, int], ...] = ()
    kept: tuple[SpeedRepair, ...] = ()
    noise: tuple[Fault, ...] = ()

    def __bool__(self) -> bool:
        return bool(self.flips or self.speeds or self.left or self.kept or self.noise)

    def then(self, later: CleanReport) -> CleanReport:
        """The repairs of a clip that was repaired once more: both, and what is left after that."""
        both = self.flips + later.flips, self.speeds + later.speeds
        return CleanReport(*both, later.left, later.kept, self.noise + later.noise)

    def sentences(self) -> list[str]:
        """The repairs in words, one line for each kind."""
        out = self.noise_sentences()
        if self.flips:
            parts = [
                f"{joint} {_frames(mine)} (by up to {max(f.angle_deg for f in mine):.0f} degrees)"
                for joint, mine in _by_joint(self.flips)
            ]
            out.append(f"Turned back from where no joint reaches: {', '.join(parts)}.")
        if self.speeds:
            groups = sorted(_by_joint(self.speeds), key=lambda g: -max(s.before for s in g[1]))
            parts = []
            for joint, mine in groups[:4]:
                before, after = max(s.before for s in mine), max(s.after for s in mine)
                parts.append(f"{joint} {_frames(mine)} ({before:.0f} rad/s, now {after:.0f})")
            more = f" and {len(groups) - 4} more joints" if len(groups) > 4 else ""
            out.append(f"Faster than a human joint, so interpolated: {', '.join(parts)}{more}.")
        if self.left:
            parts = [f"{joint} in {frames} frames" for joint, frames in self.left]
            out.append(f"Left where no joint reaches: {', '.join(parts)}.")
        if self.kept:
            told = ", ".join(f"{joint} {_frames(mine)}" for joint, mine in _by_joint(self.kept))
            out.append(f"Left faster than a human joint, since mending jerks the body more: {told}.")
        return out

    def noise_sentences(self) -> list[str]:
        """The noise that was taken off and the joints that were filled in, in words."""
        out = [
            f"The motion trembles by {f.size:.0f} mm {f.detail}: the tremble is taken off."
            for f in self.noise
            if f.kind == "tremble"
        ]
        lost = [f for f in self.noise if f.kind != "tremble"]
        if lost:
            parts = [f"{joint} {_frames(mine)}" for joint, mine in _by_joint(lost)]
            more = f" and {len(parts) - 4} more joints" if len(parts) > 4 else ""
            told = ", ".join(parts[:4])
            out.append(f"Joints that were lost for a moment are interpolated: {told}{more}.")
        return out

    def to_dict(self) -> dict[str, Any]:
        """The repairs as plain lists and numbers."""
        return asdict(self)


def _by_joint(found: Sequence[Any]) -> list[tuple[str, list[Any]]]:
    return [(j, [f for f in found if f.joint == j]) for j in dict.fromkeys(f.joint for f in found)]


def _frames(found: Sequence[Any]) -> str:
    count = sum(f.stop - f.start + 1 for f in found)
    return f"{count} frame{'' if count == 1 else 's'}"


def clean_clip(
    clip: Clip, anatomy: Anatomy | None = None, rougher: bool = True, raw: bool | None = None
) -> tuple[Clip, CleanReport]:
    """The clip with its faults repaired, and every repair; a clean clip comes back as it is.

    First joints that were lost for a moment are filled in (`refill`), then feet and hands are turned
    back (`unflip`), speeds that no human joint reaches are interpolated (`limit_speeds`), so that what
    remains of the jumps goes too, and at last noise is taken off (`denoise`).

    rougher: also where that jerks the body more, see `without_rougher`. A body with joints that cannot
    turn so fast wants it; a file that stays a file does not. raw: joints stay lost and noise stays, by
    default where the clip's source says so.
    """
    anatomy = anatomy or find_anatomy(clip.skeleton, [clip])
    raw = clip.skeleton.source.raw if raw is None else raw
    found, whole = ([], clip) if raw else noise_faults(clip)
    turned, flips = unflip(whole, anatomy, TRUNK_SPEED)
    slowed, speeds = limit_speeds(turned, anatomy)
    kept: tuple[SpeedRepair, ...] = ()
    if not rougher:
        slowed, speeds, kept = without_rougher(turned, slowed, speeds)
    if any(f.kind == "tremble" for f in found):
        slowed = denoise(slowed)
    return slowed, CleanReport(flips, speeds, out_of_reach(slowed, anatomy), kept, tuple(found))


@dataclass(frozen=True)
class Faults:
    """What a clip's fit will repair or doubt: in words, and as numbers (`CleanReport.to_dict` and
    `likely_fps`, the frame rate that physics vouches for where it is far from the file's); and what was
    taken out of a clip in place."""

    sentences: tuple[str, ...]
    numbers: dict[str, Any]
    travel: Travel | None = None


def find_faults(clip: Clip) -> Faults | None:
    """The faults of a clip, before a body is fitted; None where its joints are no human's."""
    try:
        _, report = clean_clip(clip)
        table = generate_table(clip.skeleton, None, [clip])
        judged = judge_rate(clip, table)
    except PoiseError:
        return None
    doubt = judged.sentence()
    numbers = {**report.to_dict(), "likely_fps": judged.likely}
    return Faults((*([doubt] if doubt else []), *report.sentences()), numbers, find_travel(clip, table))
