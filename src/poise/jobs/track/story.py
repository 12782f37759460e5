"""What became of a motion, told once: done or only survived, and each part of a chain."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import torch
from torch import Tensor

from poise.env import Reference
from poise.jobs.track.controllers import LOST, SURVIVED
from poise.kinematics.repair.needs import Need, find_needs
from poise.kinematics.supports import Support
from poise.metrics import LASTING_S, success_rule
from poise.recipes.imitation import Imitation
from poise.score import ScoreCard
from poise.score.report.verdict import percent
from poise.score.rollouts import RolloutSet, judge

if TYPE_CHECKING:
    from poise.jobs.track.tracked import Tracked


def needs_of(imitation: Imitation, supports: Sequence[Support] = ()) -> tuple[Need, ...]:
    """What a task's first motion needs besides a floor and its supports."""
    reference = imitation.reference
    frames = int(reference.length[0])
    pose = reference.pose
    table, rate = imitation.humanoid.table, reference.rate_hz
    needs = find_needs(table, pose.pos[:frames], pose.quat[:frames], rate)
    return tuple(
        n for n in needs if not any(s.start_s < n.stop_s and n.start_s < s.stop_s for s in supports)
    )


def shortfalls(card: ScoreCard) -> tuple[str, ...]:
    """Why a single motion was not tracked, beside its distance, in sentences.

    Since when the character was down or off its feet, and what the motion lacked by then; empty where
    there is nothing to say.
    """
    one = card.per_clip[0]
    down, off = one["fallen_s"], one["off_feet_s"]
    out: list[str] = []
    if math.isfinite(down) and not off < down:
        out.append(f"The character is down from {down:.1f} s on, where the motion is upright.")
    elif math.isfinite(off):
        out.append(f"The character is off its feet from {off:.1f} s on, where the motion is on them.")
    times = [t for t in (one["first_fail_s"], down, off) if math.isfinite(t)]
    by = min(times, default=-math.inf) + LASTING_S
    lacked = "; ".join(n.clause() for n in (Need(**n) for n in card.needs) if n.start_s <= by)
    return (*out, f"{lacked[0].upper()}{lacked[1:]}.") if lacked else tuple(out)


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


#: Frames of what came out at which a clip began and ended; None where it was not reached or did not end.
Span = tuple[int | None, int | None]


@dataclass(frozen=True)
class Part:
    """What became of one of several clips; times are s of what came out.

    Attributes:
        clip: its name.
        begins, ends: when it was done; None where it was not reached, or did not come to its end.
        after: s from the end of the clip before to its beginning; None where it was not reached.
        lost: when the character first lost it; None where it did not.
        came_back: whether the character came back to it then.
    """

    clip: str
    begins: float | None = None
    ends: float | None = None
    after: float | None = None
    lost: float | None = None
    came_back: bool = False

    @property
    def done(self) -> bool:
        """Whether it was done to its end, if need be after the character came back to it."""
        return self.ends is not None and (self.lost is None or self.came_back)

    def sentence(self) -> str:
        """What became of it."""
        if self.begins is None:
            return f"{self.clip}: not reached."
        reached = f"reached {self.after:.1f} s after the clip before, " if self.after else ""
        begun = f"{self.clip}: {reached}begun at {self.begins:.1f} s"
        if self.lost is None:
            return f"{begun}, done at {self.ends:.1f} s."
        lost = f"{begun}, lost at {self.lost:.1f} s"
        return f"{lost}, come back to and done at {self.ends:.1f} s." if self.done else f"{lost}."


def cut(r: RolloutSet, spans: Sequence[Span], reference: Reference) -> RolloutSet:
    """One episode as an episode per clip of `reference`, without what lies between them.

    A clip that was not reached has an episode without frames, and that of one that was given up ends
    where the next one begins.
    """
    rows, end = list[slice](), int(r.lengths[0])
    for b, e in reversed(spans):
        rows.insert(0, slice(0, 0) if b is None else slice(b, end if e is None else e + 1))
        end = end if b is None else b
    lengths = torch.tensor([row.stop - row.start for row in rows])
    most = max(1, int(lengths.max()))

    def each(x: Tensor) -> Tensor:
        out = x.new_zeros(len(rows), most, *x.shape[2:])
        for k, row in enumerate(rows):
            out[k, : int(lengths[k])] = x[0, row]
        return out

    frames = {
        f.name: each(value)
        for f in fields(r)
        if isinstance(value := getattr(r, f.name), Tensor) and value.shape[:2] == r.pos.shape[:2]
    }
    many: dict[str, Any] = {**frames, "alive": torch.arange(most) < lengths[:, None]}
    return replace(
        r,
        **many,
        reward={name: each(x) for name, x in r.reward.items()},
        lengths=lengths,
        reached_end=torch.tensor([e is not None for _, e in spans]),
        clip=torch.arange(len(spans)),
        start=torch.zeros(len(spans), dtype=torch.long),
        clip_names=reference.names,
        ref_min_height=reference.min_height,
    )


def parts_of(rollouts: RolloutSet, spans: Sequence[Span], rule: str, returns: bool) -> list[Part]:
    """What became of each clip.

    rollouts: what `cut` gave. returns: whether the character comes back to a clip that it lost.
    """
    failed = judge(rollouts, success_rule(rule)).failed_at.tolist()
    out, before = list[Part](), 0
    for (b, e), name, fail in zip(spans, rollouts.clip_names, failed, strict=True):
        if b is None:
            out.append(Part(name))
            continue
        lost = (b + fail) / rollouts.fps if fail >= 0 else None
        ends = None if e is None else e / rollouts.fps
        back = returns and lost is not None and e is not None
        out.append(Part(name, b / rollouts.fps, ends, (b - before) / rollouts.fps, lost, back))
        before = b if e is None else e
    return out


def with_parts(card: ScoreCard, parts: Sequence[Part]) -> ScoreCard:
    """The score card with the times of each part beside its figures."""
    rows = zip(card.per_clip, parts, strict=True)
    told = tuple(
        {**row, "done": p.done, "begins_s": p.begins, "ends_s": p.ends, "after_s": p.after}
        for row, p in rows
    )  # fmt: skip
    return replace(card, per_clip=told)
