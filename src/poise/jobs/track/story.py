"""What became of a motion, told once: word, sentence and exit code are of what is kept."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Literal, NamedTuple

from poise.jobs.track.best import LOST, SURVIVED
from poise.jobs.track.missing import shortfalls
from poise.view.verdict import percent

if TYPE_CHECKING:
    from poise.eval import ScoreCard
    from poise.jobs.track.tracked import Tracked

#: Failures that are named one by one.
NAMED = 8
Word = Literal["tracked", "found", "came back", "not tracked", "lost"]


class Story(NamedTuple):
    """What became of a motion.

    Attributes:
        word: in a word or two, as `outcome` in JSON.
        sentence: where the character failed, or how it was done, with the help that it had.
    """

    word: Word
    sentence: str

    @property
    def failed(self) -> bool:
        """Whether the motion counts as lost: it was, or the character only survived it."""
        return self.word in ("lost", "not tracked")


def story(tracked: Tracked, reset: bool = False, hint: bool = True) -> Story:
    """What became of a motion, or of several.

    reset: whether a character that failed was put back. hint: whether the option that does so is named.
    """
    t = tracked
    reference = t.imitation.reference
    seconds = (int(reference.length[0]) - 1) / reference.rate_hz
    off = f"{t.card.mpjpe_global_mm:.0f} mm off on average, place included"
    aid = helped(t.card)
    if t.parts:
        done, waits = sum(p.done for p in t.parts), max(p.after or 0.0 for p in t.parts)
        told = (
            f"{done} of {len(t.parts)} clips done one after another in {seconds:.1f} s, {aid} or "
            f"reset, {off}; the longest way to the next took {waits:.1f} s."
        )
        returned: Word = "came back" if t.losses is not None else "tracked"
        return Story(returned if done == len(t.parts) else "lost", told)
    count, fell = len(reference.length), {k for k, _ in t.failures}
    if count > 1:
        first = f", the first lost at {t.failures[0][1]:.1f} s" if fell else ""
        again = f"; they were put back {len(t.failures)} times" if fell and reset else ""
        told = f"{count - len(fell)} of {count} characters tracked all {seconds:.1f} s{first}{again}."
        return Story("lost" if fell else "tracked", told)
    if t.losses is not None:
        gave_up = len(t.losses.back) < len(t.losses.lost)
        return Story("lost" if gave_up else "came back", t.losses.sentence())
    return _single(t, seconds, off, aid, reset, hint)


def helped(card: ScoreCard) -> str:
    """What helped, in newtons and as a share of body weight: "without help"."""
    aid = card.help
    if not aid.force_mean_n and not aid.torque_mean_nm:
        return "without help"
    return (
        f"with help of {aid.force_mean_n:.0f} N on average, {100 * aid.share_of_body_weight:.1f} % of "
        f"body weight, and {aid.torque_mean_nm:.0f} N m"
    )


def _single(t: Tracked, seconds: float, off: str, aid: str, reset: bool, hint: bool) -> Story:
    """Of a single clip and character, that does not come back by itself."""
    more, times = " ".join(("", *shortfalls(t.card))), t.failed_s
    if not times and t.merit.ended == SURVIVED:
        return Story("not tracked", f"Not tracked: within 0.5 m for all {seconds:.1f} s, {off}.{more}")
    if not times and t.merit.ended != LOST:
        starts = ""
        if t.card.episodes > 1:
            share = t.card.tracked if math.isfinite(t.card.tracked) else t.card.succ
            starts = f" The policy does it from {percent(share)} of its start frames."
        if t.controller == "search":
            told = f"Found by a search to its end, {seconds:.1f} s, {aid}, {off}.{starts}"
            return Story("found", told)
        by = "with lookahead" if t.controller == "lookahead" else "by the policy alone"
        return Story("tracked", f"Tracked {by} to its end, {seconds:.1f} s, {aid}, {off}.{starts}")
    if not reset:
        back = " --reset-on-fail puts it back and goes on." if hint else ""
        told = (
            f"Lost: the character failed at {times[0]:.1f} s of {seconds:.1f} s, 0.5 m off; what "
            f"follows is not tracking.{more}{back}"
        )
        return Story("lost", told)
    named = ", ".join(f"{s:.1f}" for s in times[:NAMED]) + (", ..." if len(times) > NAMED else "")
    told = (
        f"Lost: the character failed {len(times)} times in {seconds:.1f} s and was put back, at {named} "
        "s; the score ends at the first failure."
    )
    return Story("lost", told)
