"""The judgement on a motion's frame rate: clear evidence, the rate that it vouches for, in words."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from poise.body import BodyTable, generate_table
from poise.errors import PoiseError
from poise.kin.flight import DOUBT, clear_fall
from poise.kin.rate.evidence import PULLED, Moved
from poise.motion import Clip
from poise.spatial import GRAVITY

Kind = Literal["fall", "balance", "gait"]
#: Rates that files have, Hz.
RATES = (24.0, 25.0, 30.0, 50.0, 60.0, 90.0, 100.0, 120.0, 240.0)
#: Where no flight tells the rate itself, the stated one is compared with this share of it, and that with
#: as much of itself again.
SHARE = 0.5
#: Evidence is clear with this weight: one clear kind, or two that hint.
CLEAR, HINT = 1.0, 0.5
#: A body is pulled down in at least this share of the frames; it is out of balance in this share of
#: them, clearly or as a hint. A lower rate, if that is the reason, leaves a third; noise leaves it all.
PULLED_SHARE, UNBALANCED, UNBALANCED_HINT, LEFT = 0.02, 0.5, 0.3, 1 / 3
#: It walks where it vaults by this correlation. In walking people take up to 0.75 steps per
#: sqrt(L / g), twice as many as a leg would swing by itself, and above a Froude number of 0.5 they run:
#: both with room.
VAULTS, STEP_RATE, FROUDE = 0.3, 0.85, 0.6
#: Fewer frames are no evidence. Of a clip of more than so many every second or so is judged, down to
#: this rate (Hz), and of what is left the middle: half a minute tells enough.
LEAST_FRAMES, MANY_FRAMES, MOST_FRAMES, ENOUGH_HZ = 16, 1200, 1800, 60.0
#: Share by which a rate may differ from one that files have; and factor within which a fall tells it: a
#: guessed body's centre of mass, and its size, are no better known.
USUAL, TOLD = 0.02, 1.25


@dataclass(frozen=True)
class Reason:
    """One kind of evidence: its weight (`CLEAR` or `HINT`) and what it is, in words without a stop."""

    kind: Kind
    weight: float
    says: str


@dataclass(frozen=True)
class RateJudgement:
    """What physics says of a frame rate.

    fps: the rate judged, frames/s. likely: the rate that the motion has where the evidence against `fps`
    is clear, else None. reasons: the evidence for it. fall: m/s^2, of bodies in clear flight at `fps`,
    None where there is none.
    """

    fps: float
    likely: float | None = None
    reasons: tuple[Reason, ...] = ()
    fall: float | None = None

    @property
    def vouched(self) -> bool:
        """Whether bodies in flight fall with gravity."""
        return self.fall is not None and self.likely is None

    def why(self) -> str:
        """The reasons in words, without a full stop; empty without any."""
        return ", and ".join(r.says for r in self.reasons)

    def sentence(self) -> str | None:
        """The doubt about the rate, or None."""
        if self.likely is None:
            return None
        why = self.why()
        return (
            f"{why[0].upper()}{why[1:]}: the clip likely has {self.likely:g} frames per second, not "
            f"{self.fps:.4g}; state it with --fps {self.likely:g}."
        )


def usual_rate(fps: float) -> float:
    """The rate (Hz) that files have nearest to `fps`."""
    return min(RATES, key=lambda r: abs(math.log(r / fps)))


def judge_rate(clip: Clip, table: BodyTable | None = None) -> RateJudgement:
    """What a clip's motion says of its frame rate.

    Flights tell the rate itself. Without a clear one the stated rate is compared with half and a quarter
    of it: no floor pulls a body down, its force acts where something touches it, and people do not walk
    as fast as they run. Balance and walking say nothing of motion in place, and none of it that a
    motion is too slow. A motion of no human, or a short one, is not judged.

    table: a body on the clip's skeleton; by default one is made.
    """
    unjudged = RateJudgement(clip.fps)
    if clip.frames < LEAST_FRAMES:
        return unjudged
    try:
        table = table or generate_table(clip.skeleton, None, [clip])
    except PoiseError:
        return unjudged
    return judge_moved(Moved(_part(clip), table), clip.fps)


def judge_moved(moved: Moved, fps: float) -> RateJudgement:
    """The same of a motion that is measured; `fps` is the rate that it is stated to have."""
    fall = clear_fall(moved.flights)
    if fall is not None:
        if GRAVITY / DOUBT < fall < DOUBT * GRAVITY:
            return RateJudgement(fps, None, (), fall)
        says = f"in flight the body falls with {fall:.1f} m/s^2, {fall / GRAVITY:.3g} times gravity"
        says += ", too slow" if fall < GRAVITY else ", too fast"
        rate = _file_rate(fps / math.sqrt(fall / GRAVITY), fps)
        return RateJudgement(fps, rate, (Reason("fall", CLEAR, says),), fall)
    half, quarter = SHARE, SHARE**2
    if reasons := _against(moved, fps, 1.0, half):
        return RateJudgement(fps, _file_rate(fps * half, fps), reasons)
    if (reasons := _against(moved, fps, 1.0, quarter)) and _against(moved, fps, half, quarter):
        return RateJudgement(fps, _file_rate(fps * quarter, fps), reasons)
    return RateJudgement(fps)


def _against(moved: Moved, fps: float, at: float, share: float) -> tuple[Reason, ...]:
    """The evidence that a motion has `share` of its stated rate, and not the share `at`; empty where
    it is not clear."""
    found = (
        _pulled(moved, at, share),
        # Balance and gait need the travel that standing feet tell.
        *((_unbalanced(moved, at, share, fps), _walks(moved, at, share)) if moved.travels else ()),
    )
    reasons = tuple(r for r in found if r is not None)
    return reasons if sum(r.weight for r in reasons) >= CLEAR else ()


def _part(clip: Clip) -> Clip:
    """The frames that are judged, see `MOST_FRAMES`."""
    every = max(1, int(clip.fps / ENOUGH_HZ)) if clip.frames > MANY_FRAMES else 1
    left = -(-clip.frames // every)
    first = max(0, left - MOST_FRAMES) // 2 * every
    part = slice(first, first + MOST_FRAMES * every, every)
    return clip.replaced(
        root_pos=clip.root_pos[part], rot=clip.rot[part], fps=clip.fps / every, cyclic=False
    )


def _file_rate(likely: float, fps: float) -> float:
    """The rate (Hz) near the likely one: a half, a quarter, double or four times of `fps`, since files
    are wrong by those, else the nearest that files have."""
    simple = min((fps * x for x in (0.25, 0.5, 2.0, 4.0)), key=lambda r: abs(math.log(r / likely)))
    rate = simple if abs(math.log(simple / likely)) < math.log(TOLD) else usual_rate(likely)
    usual = usual_rate(rate)
    return usual if abs(usual / rate - 1.0) < USUAL else rate


def _pulled(moved: Moved, at: float, share: float) -> Reason | None:
    part, spells = moved.pulled(at)
    if part < PULLED_SHARE or moved.pulled(share)[0] > LEFT * part:
        return None
    times = "once" if spells == 1 else f"{spells} times"
    says = f"{times} the body falls with more than {PULLED:g} times gravity, as no floor pulls it"
    return Reason("fall", CLEAR if spells > 1 else HINT, says)


def _unbalanced(moved: Moved, at: float, share: float, fps: float) -> Reason | None:
    part = moved.unbalanced(at)
    left = moved.unbalanced(share) if part >= UNBALANCED_HINT else math.inf
    if left > LEFT * part:
        return None
    says = (
        f"in {part:.0%} of the frames the floor's force would act beyond all that touches it "
        f"({left:.0%} at {fps * share:.4g} frames per second)"
    )
    return Reason("balance", CLEAR if part >= UNBALANCED else HINT, says)


def _walks(moved: Moved, at: float, share: float) -> Reason | None:
    gait = moved.gait
    if gait is None or gait.vault < VAULTS or not STEP_RATE / at < gait.rate <= STEP_RATE / share:
        return None
    fast = gait.froude * at**2 > FROUDE
    says = f"the body walks at {gait.speed:.1f} m/s with {gait.steps_s:.1f} steps per second"
    return Reason("gait", CLEAR if fast else HINT, says + ", as fast as people run" * fast)
