"""The result of tracking: the motion, its score, its files, each part of a chain, in a sentence."""

# pyright: reportUnknownArgumentType=false, reportUnknownMemberType=false, reportUnknownVariableType=false
from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor

from poise.env import Reference
from poise.errors import PoiseError
from poise.formats import home_suffix, write_clip
from poise.jobs.deliver import Delivery, as_high_as_source, deliver, finished, settled, simulated_clip
from poise.jobs.result import Result, ResultView
from poise.jobs.runs import Evaluation
from poise.jobs.track.controllers import LOST, SURVIVED, Merit, merit
from poise.jobs.track.placement import PlacedMotion, fitted, home, noise_read, place
from poise.jobs.track.pushed import Pushed
from poise.jobs.track.rates import InPlace
from poise.jobs.track.recovering import Losses
from poise.jobs.track.retaking import changed_s, spliced, written_as
from poise.jobs.track.simulation import FILE, Retake, Simulation
from poise.jobs.track.supports import at_home, write_supports
from poise.jobs.tracker import Tracker
from poise.kinematics.directed import Pin, pinned
from poise.kinematics.forward import Kinematics
from poise.kinematics.repair.faults import Fault
from poise.kinematics.repair.needs import Need, find_needs
from poise.kinematics.supports import Support
from poise.kinematics.travel import travelled
from poise.metrics import LASTING_S, mpjpe_global, mpjpe_root, success_rule
from poise.motion import Clip
from poise.motion.keypoints import Keypoints
from poise.plan import SamplingResult
from poise.recipes.imitation import Imitation
from poise.score import ScoreCard
from poise.score.report.verdict import percent
from poise.score.rollouts import RolloutSet, judge


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
class ChainPart:
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


def parts_of(rollouts: RolloutSet, spans: Sequence[Span], rule: str, returns: bool) -> list[ChainPart]:
    """What became of each clip.

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


@dataclass(frozen=True)
class Clean:
    """An input with noise, and the character that followed it, beside the motion without noise.

    noise_mm: mean distance of the bodies in the input. off_mm: that of the character, up to where it
    failed. succeeded: whether the character stayed within 0.5 m of the motion without noise.
    """

    noise_mm: float
    off_mm: float
    succeeded: bool

    def sentence(self) -> str:
        """The figures in words."""
        return (
            f"The score is that against the input with noise, which moved the bodies by "
            f"{self.noise_mm:.0f} mm on average; the character is {self.off_mm:.0f} mm from the motion "
            "without noise."
        )


@dataclass(frozen=True, eq=False, repr=False)
class Tracked(Result):
    """What came of tracking.

    imitation: the motion as a task of its own. evaluation: score card (help 0), rollouts, the episode.
    placed: the motion on the body. failures: (character, seconds) of each failure in the order of time;
    without `reset_on_fail` and `recover` at most one per character. clean: what the noise changed, None
    without noise. notes: sentences on the input and the noise. losses: with `recover`, when the motion
    was lost and found again; None where it was not. found: what a search came to; None where
    nothing was searched. controller: which did the motion: "policy", "lookahead" or "search". parts:
    what became of each of several clips; none where it was one. supports: what stands in the world for
    the motion to rest on, in the world of the body. pins: limbs that stay put. simulation: the states of
    a single character on a single clip, of which a part can be simulated anew (`Retake`). pushed: what
    came of a push; None without one. undirected: the motion before pins and touch points led it; None
    without any. retake: the part that was simulated anew; None where all was simulated. doubts: the
    notes that say that its frame rate is likely wrong, which come before all else where it is lost.
    """

    tracker: Tracker
    imitation: Imitation
    evaluation: Evaluation
    placed: PlacedMotion
    failures: tuple[tuple[int, float], ...]
    clean: Clean | None
    notes: tuple[str, ...]
    losses: Losses | None = None
    found: SamplingResult | None = None
    controller: str = "policy"
    parts: tuple[ChainPart, ...] = ()
    supports: tuple[Support, ...] = ()
    pins: tuple[Pin, ...] = ()
    simulation: Simulation | None = None
    pushed: Pushed | None = None
    undirected: Clip | None = None
    retake: Retake | None = None
    doubts: tuple[str, ...] = ()
    travel: InPlace | None = None

    @property
    def failed_s(self) -> tuple[float, ...]:
        """Seconds at which the first character failed."""
        return tuple(t for character, t in self.failures if character == 0)

    @cached_property
    def merit(self) -> Merit:
        """How good the motion is that is kept, among other attempts at it."""
        return merit(self.evaluation.rollouts, self.evaluation.recordings[0].row)

    @cached_property
    def card(self) -> ScoreCard:
        """The score of the simulation, help 0, with what holding the feet did."""
        return self.finished.card

    @cached_property
    def finished(self) -> Delivery:
        """What is written, standing feet held: made once, for the card and for the files."""
        return self.as_written(True)

    def as_written(self, hold: bool) -> Delivery:
        """What is written, a clip in place as it came. hold: standing feet are held."""
        source, before = self.placed.source, self.undirected
        done = finished(self.imitation, self.evaluation, hold, source, self.at_home, before)
        if self.travel is None:
            return done
        moved, lost = self.placed.moved, min(self.failed_s, default=None)
        scale = moved.scale if moved else 1.0
        body = {name: self.travel.written(clip, scale, lost) for name, clip in done.clips.items()}
        home = {name: self.travel.written(clip, 1.0, lost) for name, clip in done.home.items()}
        return replace(done, clips=body, home=home)

    @property
    def clip(self) -> Clip:
        """The first character's motion on the skeleton that came in, standing feet held."""
        return self.delivered()

    def delivered(self, character: int = 0, hold: bool = True) -> Clip:
        """A character's motion on the skeleton that came in, as high as there. hold: standing feet are
        held."""
        if hold:
            return tuple(self.finished.home.values())[character]
        motion = self.at_home(as_high_as_source(self.motion(character), self.imitation), False)
        lost = min(self.failed_s, default=None)
        return motion if self.travel is None else self.travel.written(motion, 1.0, lost)

    def at_home(self, motion: Clip, hold: bool) -> Clip:
        """A motion of the body on the skeleton that came in. hold: limbs that stay put are led
        there, and feet that still slide are held, see `settled`. Where a part was simulated anew, all
        else is as it was."""
        if self.placed.moved is not None:
            motion = home(motion, self.placed, self.tracker).replaced(name=motion.name)
        if hold:
            motion = pinned(motion, self.pins) if self.pins else settled(motion, self.placed.calm)
        return motion if self.retake is None else self._as_it_was(motion, self.retake, hold)

    def _as_it_was(self, motion: Clip, retake: Retake, hold: bool) -> Clip:
        """The motion with all that was not simulated anew as it was written, or would be."""
        before, recordings = retake.opened(), self.evaluation.recordings
        assert self.simulation is not None
        span = changed_s(before, self.simulation)
        earlier = None
        if hold and not isinstance(retake.of, Simulation):
            earlier = written_as(Path(retake.of), motion)
            if earlier is not None and self.travel is not None and not self.travel.travels:
                earlier = travelled(earlier, self.travel.travel)
        if earlier is None:
            was = replace(self.evaluation, recordings=[replace(recordings[0], qpos=before.qpos.numpy())])
            earlier = replace(self, evaluation=was, retake=None, travel=None).delivered(0, hold)
        return spliced(earlier, motion, span)

    def _shown(self) -> ResultView:
        source = self.placed.source if self.travel is None else self.travel.beside
        return ResultView(self.clip, source, self.card, self.notes)

    def _save_all(self, folder: Path) -> dict[str, Path]:
        return write(self, folder).paths

    def motion(self, character: int = 0) -> Clip:
        """The simulated motion on the body's skeleton, as it was simulated, on the floor z = 0."""
        return simulated_clip(self.imitation, self.evaluation, character)


def write(
    tracked: Tracked,
    out: Path,
    motion: Path | None = None,
    hold: bool = True,
    curve: dict[str, np.ndarray] | None = None,
    keys: tuple[int, ...] = (),
    said: tuple[str, ...] = (),
) -> Delivery:
    """Writes the motion, `score.json` and `report.html` into `out`, see `deliver`.

    The motion is on the skeleton that came in; where that is not the body's, the motion on the body's
    skeleton lies beside it as `body.bvh`.

    Args:
        motion: the file of the motion, in place of one in `out`. hold: see `deliver`.
        curve: of a training, which the report draws.
        keys: frames of the clip that stay visible in the report. said: sentences that it begins with.
    """
    t, placed, count = tracked, tracked.placed, len(tracked.evaluation.recordings)
    if count > 1 and motion is not None:
        raise PoiseError(
            f"{count} characters make {count} files", motion, "Give a folder as -o", code="folder-needed"
        )
    other = placed.moved is not None
    inner = out / "body.bvh" if other and count == 1 else motion
    failures = tuple(
        f"The character failed at {seconds:.1f} s" + (f" (character {k + 1})." if count > 1 else ".")
        for k, seconds in t.failures
    )
    said += tuple(p.sentence() for p in t.parts) or failures
    said += shortfalls(t.evaluation.card) if count == 1 and not t.parts else ()
    done = deliver(
        t.imitation, t.evaluation, out, curve or {}, inner, hold, placed.source, said, keys, t.failed_s,
        t.at_home, t.finished if hold else t.as_written(False),
    )  # fmt: skip
    (out / FILE).unlink(missing_ok=True)
    if t.simulation is not None:
        t.simulation.save(out / FILE)
        done = replace(done, paths={**done.paths, "simulation": out / FILE})
    if not other:
        return _with_supports(t, done, out, hold)
    paths: dict[str, Path] = {}
    for k, (name, path) in enumerate(done.paths.items()):
        if k >= count:
            paths[name] = path
            continue
        back = done.home[name]
        body = name.replace("simulated", "body", 1)
        paths[body] = path.rename(out / f"{body}{path.suffix}")
        paths[name] = motion or out / f"{name}{home_suffix(back)}"
        write_clip(back, paths[name])
    return _with_supports(t, replace(done, paths=paths), out, hold)


def _with_supports(t: Tracked, done: Delivery, out: Path, hold: bool) -> Delivery:
    """Writes what the motion rests on beside it."""
    if not t.supports:
        return done
    first = next(iter(p for name, p in done.paths.items() if name.startswith("simulated")))
    stands = at_home(t.supports, t.placed)
    return replace(done, paths=done.paths | write_supports(stands, t.delivered(0, hold), out, first))


@dataclass(frozen=True)
class BesideRaw:
    """mpjpe_mm, mpjpe_global_mm: the character's error beside what came in, up to where it failed; NaN
    where that is not known. noise: the largest that was taken off."""

    mpjpe_mm: float
    mpjpe_global_mm: float
    noise: Fault

    @property
    def figures(self) -> dict[str, float]:
        """The score card's `raw`."""
        return {
            "mpjpe_mm": self.mpjpe_mm,
            "mpjpe_global_mm": self.mpjpe_global_mm,
            "noise_mm": self.noise.size,
            "noise_hz": math.nan if self.noise.hz is None else self.noise.hz,
        }

    def sentence(self) -> str:
        """The motion that the score is against, in words."""
        beside = ""
        if math.isfinite(self.mpjpe_mm):
            beside = f"; the character is {self.mpjpe_mm:.0f} mm from the motion with it"
        return f"The score is that against the motion without its tremble{beside}."


def beside_raw(
    tracker: Tracker, motion: Clip | Keypoints, placed: PlacedMotion, sim: Tensor, judged: Tensor
) -> BesideRaw | None:
    """The character `sim (T, B, 3)` m in the frames `judged (T)`, None where no tremble was taken off.

    motion: what was placed, keypoints where it came as such.
    """
    of_clip = [f for f in placed.report.clips[0].clean.noise if f.kind == "tremble"]
    noise = [*noise_read(placed.source), *of_clip]
    if not noise:
        return None
    worst = max(noise, key=lambda f: f.size)
    if isinstance(motion, Keypoints):
        came = fitted(replace(motion, source=replace(motion.source, raw=True)))
    elif of_clip:
        came = motion.replaced(skeleton=motion.skeleton.with_source(raw=True))
    else:
        # The keypoints that a clip was made of are gone.
        return BesideRaw(math.nan, math.nan, worst)
    pos = Kinematics(tracker.humanoid.table)(torch.tensor(place(came, tracker).qpos)).pos.to(sim)
    # Samples that jump at an end of keypoints may have cut some frames off.
    frames = min(len(pos), len(sim))
    here, there, kept = sim[:frames], pos[:frames], judged[:frames]
    local, whole = (float(of(here, there)[kept].mean()) for of in (mpjpe_root, mpjpe_global))
    return BesideRaw(local, whole, worst)
