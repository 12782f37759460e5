"""A motion that is lost: the character gets up and comes back, or a search finds how to do it."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from poise.env import Acts, ImitationEnv, Reference
from poise.env.recovery.recovering import TRACKS, Recovering
from poise.errors import PoiseError
from poise.jobs.track.placement import PlacedMotion
from poise.jobs.tracker import Tracker
from poise.kinematics import FitReport, qpos_to_clip
from poise.kinematics.feet import Levelled
from poise.metrics import success_rule
from poise.motion import Clip, ClipLibrary, resample
from poise.motion.rotations import slerp
from poise.plan import Lookahead, SamplingConfig, SamplingControl, SamplingResult
from poise.recipes.imitation import Imitation
from poise.score import ScoreCard, simulate
from poise.score.rollouts import RolloutSet, judge


@dataclass(eq=False)
class ReplayActions:
    """Actions `(T, A)` one after another, for the one character that they were made for; after them
    acts the policy, if there is one. by: the controller that made them."""

    actions: Tensor
    policy: Acts | None = None
    step: int = 0
    by: str = "policy"

    def act(self, obs: Tensor) -> Tensor:
        """The next one, `(1, A)`; `obs` is looked at by the policy alone."""
        at, self.step = self.step, self.step + 1
        if at >= len(self.actions) and self.policy is not None:
            return self.policy.act(obs)
        return self.actions[at : at + 1]


def helped(imitation: Imitation) -> float:
    """The share of its help's limits that a task has: all of them, or nothing where it has none."""
    return 1.0 if imitation.task.guide is not None else 0.0


def look_for(
    tracker: Tracker,
    imitation: Imitation,
    config: SamplingConfig,
    clip: int = 0,
    threads: int = 0,
    show: Callable[[int, int], None] | None = None,
) -> SamplingResult:
    """Looks for one of a task's motions with the tracker's policy and the task's help.

    threads: of the physics; 0 is all cores. show: is told of the control steps done and of all of them.
    """
    # Worlds that lose the motion may go bad; they are left behind.
    env = imitation.bare(rewards=True).env(
        config.characters, auto_reset=False, threads=threads, help_scale=helped(imitation), guard=False
    )
    try:
        return SamplingControl(env, tracker.policy, config, tracker.value, clip).run(show)
    finally:
        env.close()


def replay(found: SamplingResult, policy: Acts) -> ReplayActions:
    """Does what was found, and from where it was lost what the policy does."""
    return ReplayActions(found.actions[: found.reached].clone(), policy)


#: A clip that is lost more often within so many s of it is given up, and so is one that the character
#: has left for so many s; so many of them in a row that it does not even come to end the motion, as
#: does so many times that time away from a single clip.
LOSSES, WITHIN_S, AWAY_S, VAIN = 8, 10.0, 30.0, 3


@dataclass(frozen=True)
class Losses:
    """When a motion was lost and when it was found again, s of what comes out; `back` is shorter by one
    where it was given up. given_up: when a clip was left for the next one, s."""

    lost: tuple[float, ...]
    back: tuple[float, ...]
    given_up: tuple[float, ...] = ()

    def sentence(self) -> str:
        """What became of the motion."""
        times = "once" if len(self.lost) == 1 else f"{len(self.lost)} times"
        said = f"The character lost the motion {times}, first at {self.lost[0]:.1f} s,"
        if len(self.back) < len(self.lost):
            last = f"the loss at {self.lost[-1]:.1f} s"
            return f"{said} and did not come back after {last}; the result ends where it was given up."
        away = sum(self.back) - sum(self.lost)
        said = f"{said} and came back; the motion waited for it, and is {away:.1f} s longer in all."
        if self.given_up:
            clips = "a clip" if len(self.given_up) == 1 else f"{len(self.given_up)} clips"
            said += f" It left {clips} for the next, first at {self.given_up[0]:.1f} s."
        return said


class RecoveryRun(NamedTuple):
    """What came of motions to which a character was led.

    Attributes:
        placed, imitation: the motions and the recovery motions between them as one motion, as it was
            tracked, and as a task of its own.
        replayed: the actions that track it.
        losses: when a motion was lost; None where none was.
        spans: of each motion the frames at which it began and ended, None where it was not reached or
            did not end.
    """

    placed: PlacedMotion
    imitation: Imitation
    replayed: ReplayActions
    losses: Losses | None
    spans: list[tuple[int | None, int | None]]


def led_along(
    tracker: Tracker,
    placed: Sequence[PlacedMotion],
    imitation: Imitation,
    returns: bool,
    ahead: Lookahead | None = None,
    show: Callable[[int, int], None] | None = None,
) -> RecoveryRun:
    """Tracks motions one after another, a recovery motion from the end of each to the start of the next,
    and one wherever a motion is lost.

    Args:
        placed, imitation: the motions, and the task of them in order.
        returns: whether a motion that is lost is come back to; without, it goes on to its end.
        ahead: looks ahead in place of the policy alone; see `look_ahead`.
        show: is told how many frames of the motions are done, and of how many.

    Raises:
        PoiseError: the policy has not learned to come back.
    """
    if tracker.recovery_clips is None:
        what = ("come back", "Leave --recover out")
        if len(placed) > 1:
            what = ("go from one clip to the next", "Give one clip")
        raise PoiseError(
            f"the policy has not learned to {what[0]}",
            hint=f"{what[1]}, or train one on a library with a clip that gets up",
            code="recovery-not-learned",
        )
    task = replace(imitation.task, help_by="all")
    env = replace(imitation, task=task).env(1, auto_reset=False, threads=1, help_scale=0.0)
    try:
        zero = torch.zeros(1, dtype=torch.long)
        env.reset_to(zero, zero)
        how = tracker.recovery_clips, len(placed) > 1, returns
        goal = Recovering(env.goal.clips, *how)
        led = LedCharacter(goal, env.reference.coordinates(zero, zero)[0], show)
        losses = (LOSSES + 1) * (len(placed) + led.total / (WITHIN_S * led.rate))
        most = led.total + int(losses * VAIN * AWAY_S * led.rate)
        obs = env.set_goal(goal)
        if ahead is not None:
            ahead.copies.set_goal(Recovering(ahead.copies.goal.clips, *how, plans=False))
            ahead.watch(env)
        simulate(env, ahead or tracker.policy, obs, most, led)
    finally:
        env.close()
    replayed = ReplayActions(torch.cat(led.actions))
    losses = Losses(tuple(led.lost), tuple(led.back), tuple(led.given_up)) if led.lost else None
    if losses is None and len(placed) == 1:
        return RecoveryRun(placed[0], imitation, replayed, None, led.spans)
    qpos, body, rate = torch.cat(led.frames).cpu().numpy(), imitation.humanoid, led.rate
    own = _held(imitation.library.clips, rate, led.of)
    clip = qpos_to_clip(qpos, body.table, own.skeleton, rate, own, own.name)
    whole, first = one_after_another(placed, led.of, led.spans, rate), imitation.library.clips[0]
    whole = replace(whole, clip=resample(clip, first.fps, smooth=True), qpos=qpos)
    library = ClipLibrary((whole.clip,), (1.0,))
    reference = Reference(body, [qpos], rate, [own.name])
    out = replace(imitation, library=library, reference=reference)
    return RecoveryRun(whole, out, replayed, losses, led.spans)


class LedCharacter:
    """Observes one character that is led along its motions.

    Attributes:
        frames: coordinates `(1, 7 + n)` that it aimed at, one after another, `start` first.
        of: the motion, and the frame of it, that each of them is of.
        actions: `(1, A)` each.
        lost, back: when it lost a motion and found it again, s.
        given_up: when it left a clip for the next one, s.
        spans: see `RecoveryRun`.
    """

    def __init__(self, goal: Recovering, start: Tensor, show: Callable[[int, int], None] | None = None):
        self.goal, self.rate, self.show = goal, goal.rate_hz, show
        self.last = (goal.clips.reference.length - 1).tolist()
        self.total = sum(self.last)
        self.frames, self.of, self.actions = [start], [(0, 0)], list[Tensor]()
        self.lost, self.back, self.given_up = list[float](), list[float](), list[float]()
        self.spans: list[tuple[int | None, int | None]] = [(None, None)] * len(self.last)
        # Whether it is on a motion, on which, and at which frame of it, before the next step; the s at
        # which it left the last one, how often it lost this one since a frame of it, and how many it did
        # not come to since.
        self._here, self._clip, self._frame, self._left, self._losses = True, 0, 0, 0.0, 0
        self._since, self._vain = 0, 0

    def see(self, env: ImitationEnv, step: int) -> bool:
        """Keeps what the step aimed at; True: the motions are over, or the last one is given up."""
        now, clip = step / self.rate, self._clip
        if step:
            at = self._frame + 1 if self._here else self._frame
            self.actions.append(env.given.clone())
            self.frames.append(self.goal.aimed)
            self.of.append((clip, at))
            if self._here and at >= self.last[clip]:
                self.spans[clip] = self.spans[clip][0], step
                if clip == len(self.last) - 1:
                    return True
        if self.show is not None:
            self.show(sum(self.last[:clip]) + self._frame, self.total)
        was, self._here = self._here, int(self.goal.doing) == TRACKS
        self._clip, self._frame = int(self.goal.clips.clip), int(self.goal.clips.frame)
        if self._clip != clip or self._frame > self._since + WITHIN_S * self.rate:
            self._losses, self._since = 0, self._frame
        self._left = now if was and not self._here else self._left
        if self._here:
            self._vain = 0
            if self.spans[self._clip][0] is None:
                self.spans[self._clip] = step, None
        if len(self.goal.lost) > len(self.lost):
            self.lost.append(now)
            self._losses += 1
        if self._here and len(self.back) < len(self.lost):
            self.back.append(now)
        patience = AWAY_S if self.goal.chained else VAIN * AWAY_S
        if self._losses <= LOSSES and (self._here or now <= self._left + patience):
            return False
        # A clip that begins in full flight is hard to come to; what has fallen for good comes to none.
        self._vain += not self._losses
        if not self.goal.chained or self._clip == len(self.last) - 1 or self._vain >= VAIN:
            return True
        self.goal.leave(torch.zeros(1, dtype=torch.long))
        self.given_up.append(now)
        self._here, self._left, self._losses = False, now, 0
        self._clip, self._frame = int(self.goal.clips.clip), 0
        return False


def one_after_another(
    placed: Sequence[PlacedMotion],
    of: Sequence[tuple[int, int]],
    spans: Sequence[tuple[int | None, int | None]],
    rate: float,
) -> PlacedMotion:
    """What came in as one motion: frames `of` (clip, frame) of all at `rate`, at the first one's rate.

    Feet are turned as in each clip, and in between from one to the other.
    """
    first = placed[0]
    source = resample(_held([p.source for p in placed], rate, of), first.source.fps)
    at = np.minimum(np.round(np.arange(source.frames) * rate / source.fps).astype(int), len(of) - 1)
    share = np.array([float(k) for k, _ in of])
    for (_, end), (begin, _) in itertools.pairwise(spans):
        if end is not None:
            begin = len(of) if begin is None else begin
            share[end : begin + 1] = share[end] + np.linspace(0, 1, begin + 1 - end)[: len(of) - end]
    turns: dict[int, np.ndarray] = {}
    for joint in {j for p in placed for j in p.level.turns}:
        still = np.array([1.0, 0.0, 0.0, 0.0])
        each = np.stack([p.level.turns.get(joint, still) for p in placed])
        low = share[at].astype(int)
        high = np.minimum(low + 1, len(placed) - 1)
        turns[joint] = slerp(each[low], each[high], share[at] - low)
    report = FitReport(tuple(fit for p in placed for fit in p.report.clips))
    return replace(first, source=source, level=Levelled(turns), report=report)


def _held(clips: Sequence[Clip], rate: float, of: Sequence[tuple[int, int]]) -> Clip:
    """Frames `of` (clip, frame) of clips at `rate`, one after another."""
    timed = [resample(clip, rate) for clip in clips]
    rows = [(timed[k], min(t, timed[k].frames - 1)) for k, t in of]
    root, rot = ([getattr(c, name)[t] for c, t in rows] for name in ("root_pos", "rot"))
    name = ", ".join(c.name for c in clips)
    return timed[0].replaced(root_pos=np.stack(root), rot=np.stack(rot), name=name)


#: Frames of what came out at which a clip began and ended; None where it was not reached or did not end.
Span = tuple[int | None, int | None]


@dataclass(frozen=True)
class ChainPart:
    """How one of several clips ended; times are s of what came out.

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
        """A sentence on how it ended."""
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


def parts_of(rollouts: RolloutSet, spans: Sequence[Span], rule: str, returns: bool) -> list[ChainPart]:
    """How each clip ended.

    rollouts: what `cut` gave. returns: whether the character comes back to a clip that it lost.
    """
    failed = judge(rollouts, success_rule(rule)).failed_at.tolist()
    out, before = list[ChainPart](), 0
    for (b, e), name, fail in zip(spans, rollouts.clip_names, failed, strict=True):
        if b is None:
            out.append(ChainPart(name))
            continue
        lost = (b + fail) / rollouts.fps if fail >= 0 else None
        ends = None if e is None else e / rollouts.fps
        back = returns and lost is not None and e is not None
        out.append(ChainPart(name, b / rollouts.fps, ends, (b - before) / rollouts.fps, lost, back))
        before = b if e is None else e
    return out


def with_parts(card: ScoreCard, parts: Sequence[ChainPart]) -> ScoreCard:
    """The score card with the times of each part beside its figures."""
    rows = zip(card.per_clip, parts, strict=True)
    told = tuple(
        {**row, "done": p.done, "begins_s": p.begins, "ends_s": p.ends, "after_s": p.after}
        for row, p in rows
    )
    return replace(card, per_clip=told)
