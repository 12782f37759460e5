"""Several clips that one character did one after another: the part of each, against its clip."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import torch
from torch import Tensor

from poise.env import Reference
from poise.eval import ScoreCard
from poise.eval.rolloutset import RolloutSet, judge
from poise.metrics import success_rule

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
