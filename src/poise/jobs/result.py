"""The result of every verb: a motion, its score, sentences about it, its files and report.

made.clip, made.card, made.notes, made.save("out")
"""

# pyright: reportUnknownArgumentType=false, reportUnknownMemberType=false, reportUnknownVariableType=false
# A field that is ABSENT is None, though its type says what others have.
# pyright: reportUnnecessaryComparison=false
from __future__ import annotations

import math
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from poise.errors import PoiseError
from poise.formats import check_writable, home_suffix, names_file, write_clip
from poise.jobs.deliver import (
    Delivery,
    Evaluation,
    StageMotion,
    as_high_as_source,
    finished,
    make_report,
    simulated_clip,
)
from poise.jobs.keep import claimed, may_deliver, may_write, refusing
from poise.jobs.run_file import learning_curve
from poise.kinematics.rate import read_clip
from poise.kinematics.repair.needs import Need, find_needs
from poise.metrics import LASTING_S
from poise.motion import Clip
from poise.score import ScoreCard, score_rollouts, write_score
from poise.score import table as rows_of
from poise.score.report import write_report
from poise.score.report.svg import result_html
from poise.score.report.verdict import percent
from poise.score.rollouts import RolloutSet

if TYPE_CHECKING:
    from poise.jobs.track.in_place import InPlace
    from poise.jobs.track.placement import Clean, PlacedMotion
    from poise.jobs.track.pushed import Pushed
    from poise.jobs.track.recovery_run import ChainPart, Losses
    from poise.jobs.track.simulation import Simulation
    from poise.jobs.tracker import Tracker
    from poise.kinematics.supports import Support
    from poise.learn import PolicyBundle
    from poise.plan import SamplingResult
    from poise.recipes.imitation import Imitation
    from poise.score.report import Report
    from poise.synthesis.keyframes import FilledClips, Retiming
    from poise.synthesis.rounds import GapFault

#: What a result does not have, where its type says that others do.
ABSENT: Any = None
#: The run folder in a result folder.
RUN = "run"
#: The rule by which a motion is lost: a mean distance of more than `metrics.LOST`.
RULE = "phc"
#: How an attempt ended.
LOST, SURVIVED, TRACKED = 0, 1, 2
#: Steps within which attempts are alike: mm of error, shares of the reference's jerk, mm/s of slide.
ERROR_MM, JERK, SLIDE = 10.0, 0.1, 10.0
#: Failures that are named one by one.
NAMED = 8


class Merit(NamedTuple):
    """How good an attempt is, as a tuple of which the larger one is better.

    1. An attempt that is tracked (to its end, upright and on its feet where the motion is) comes before
       one that survived to its end, and that before one that is lost.
    2. Of those to their end the one with less help is better, of the others the one that came farther.
    3. Then the smaller error counts, then less jerk, then less slide, each in steps within which
       attempts are alike.

    Attributes:
        ended: `TRACKED`, `SURVIVED` or `LOST`.
        unhelped: less the mean force of help, N; 0 without any, and of what is lost.
        reached: s before it was lost; inf where it was not.
        error, jerk, slide: less the steps that each is.
    """

    ended: int
    unhelped: float
    reached: float
    error: float = 0.0
    jerk: float = 0.0
    slide: float = 0.0

    @staticmethod
    def of(card: ScoreCard) -> Merit:
        """Of the score of a single episode."""
        fails = card.per_clip[0]["first_fail_s"]
        ended = LOST if card.succ < 1.0 else SURVIVED if card.survived else TRACKED
        usual = card.reference.get("jerk", math.nan)
        return Merit(
            ended,
            -card.help.force_mean_n if ended else 0.0,
            math.inf if ended else fails,
            _steps(card.mpjpe_global_mm, ERROR_MM),
            _steps(card.jerk / usual if usual else math.nan, JERK),
            _steps(card.foot_slide_mm_per_s, SLIDE),
        )


def merit(rollouts: RolloutSet, row: int = 0) -> Merit:
    """Of one of some episodes."""
    return Merit.of(score_rollouts(rollouts.episode(row), rule=RULE))


def _steps(value: float, step: float) -> float:
    """Less the whole steps of a figure; one that was not measured is the worst."""
    return -float(math.floor(value / step)) if math.isfinite(value) else -math.inf


@dataclass(frozen=True, eq=False, repr=False)
class Result:
    """The outcome of a verb. Fields that it does not fill, or nobody asked for, are None or empty.

    Attributes:
        imitation, evaluation: the motion on its body as a task; score card, rollouts and episodes.
        tracker, placed: the policy that tracked it, and the motion on its body.
        notes: sentences on the input, and on what was done.
        doubts: those of them that say that its frame rate is likely wrong.
        failures: (character, s) of each failure in the order of time; without `reset_on_fail` and
            `recover` at most one per character.
        controller: what did the motion: "policy", "lookahead" or "search".
        found: what a search came to.
        simulation: the states of a single character on a single clip, see `retake`.
        clean: what noise on the input changed.
        losses: when the motion was lost and found again, with `recover`.
        parts: what became of each of several clips.
        supports: what stands in the world for the motion to rest on, in the world of the body.
        pushed: what came of a push.
        undirected: the motion before pins and touch points led it.
        travel: what was done to a clip in place.
        filled, came: motion between keyframes that was made without a body, and what it is beside.
        keyframes, at: frames of what came in that stay, and where each is in the result.
        met_mm: how far the body's joints are from each keyframe, mean, in the world.
        stages: figures of each stage from keyframes to a body.
        retiming: what was done to the times of keyframes.
        policy, run: the policy that was trained, and its run folder.
        interrupted: whether Ctrl-C ended the training early; it was evaluated all the same.
        sentences: what is said of a training beside `story`.
        said: sentences that the report begins with.
        ways: how a motion of the body comes home, one after another.
        beside: how further files are written.
    """

    imitation: Imitation = ABSENT
    evaluation: Evaluation = ABSENT
    tracker: Tracker = ABSENT
    placed: PlacedMotion = ABSENT
    notes: tuple[str, ...] = ()
    doubts: tuple[str, ...] = ()
    failures: tuple[tuple[int, float], ...] = ()
    controller: str = "policy"
    found: SamplingResult | None = None
    simulation: Simulation | None = None
    clean: Clean | None = None
    losses: Losses | None = None
    parts: tuple[ChainPart, ...] = ()
    supports: tuple[Support, ...] = ()
    pushed: Pushed | None = None
    undirected: Clip | None = None
    travel: InPlace | None = None
    filled: FilledClips = ABSENT
    came: Clip = ABSENT
    keyframes: tuple[int, ...] = ()
    at: tuple[int, ...] = ()
    met_mm: tuple[float, ...] = ()
    stages: tuple[StageMotion, ...] = ()
    retiming: Retiming | None = None
    policy: PolicyBundle = ABSENT
    run: Path = ABSENT
    interrupted: bool = False
    sentences: tuple[str, ...] = ()
    said: tuple[str, ...] = ()
    ways: tuple[Way, ...] = ()
    beside: tuple[Beside, ...] = ()

    @property
    def source(self) -> Clip:
        """The motion that came in, with which the written one is compared."""
        if self.came is not ABSENT:
            return self.came
        if self.travel is not None:
            return self.travel.beside
        return self.imitation.library.clips[0] if self.placed is ABSENT else self.placed.source

    @property
    def failed_s(self) -> tuple[float, ...]:
        """Seconds at which the first character failed."""
        return tuple(t for character, t in self.failures if character == 0)

    @cached_property
    def merit(self) -> Merit:
        """How good the motion is that is kept, among other attempts at it."""
        return merit(self.evaluation.rollouts, self.evaluation.recordings[0].row)

    @property
    def card(self) -> ScoreCard:
        """The score of the simulation, with what holding the feet did; None where nothing is
        simulated."""
        return self.finished.card

    @property
    def clips(self) -> tuple[Clip, ...]:
        """All that was made, on the skeletons that came in, standing feet held."""
        return tuple(self.finished.home.values())

    @property
    def clip(self) -> Clip:
        """The first of them: the motion of the first character or clip, or the best guess."""
        return self.clips[0]

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences on motion between keyframes."""
        return () if self.filled is ABSENT else self.filled.warnings

    @property
    def faults(self) -> tuple[GapFault, ...]:
        """Faults that the doctor finds between keyframes after all that was tried."""
        return () if self.filled is ABSENT else self.filled.faults

    @property
    def sentence(self) -> str:
        """A sentence on how the motion ended."""
        return self.said[0] if self.said else story(self, hint=False).sentence

    @cached_property
    def finished(self) -> Delivery:
        """The motions to write, standing feet held: made once, for the card and for the files."""
        return self.as_written(True)

    def as_written(self, hold: bool) -> Delivery:
        """The motions to write, a clip in place as it came. hold: standing feet are held."""
        if self.evaluation is ABSENT:
            many = len(self.filled.clips) > 1
            clips = {f"filled-{k}" if many else "filled": c for k, c in enumerate(self.filled.clips)}
            return Delivery(clips, clips, ABSENT, ())
        home = self.at_home if self.ways else None
        source = None if self.placed is ABSENT else self.placed.source
        done = finished(self.imitation, self.evaluation, hold, source, home, self.undirected)
        if self.travel is None:
            return done
        moved, lost = self.placed.moved, min(self.failed_s, default=None)
        scale = moved.scale if moved else 1.0
        body = {name: self.travel.written(clip, scale, lost) for name, clip in done.clips.items()}
        back = {name: self.travel.written(clip, 1.0, lost) for name, clip in done.home.items()}
        return replace(done, clips=body, home=back)

    def delivered(self, character: int = 0, hold: bool = True) -> Clip:
        """A character's motion on the skeleton that came in, as high as there. hold: standing feet are
        held."""
        if hold:
            return self.clips[character]
        motion = self.at_home(as_high_as_source(self.motion(character), self.imitation), False)
        lost = min(self.failed_s, default=None)
        return motion if self.travel is None else self.travel.written(motion, 1.0, lost)

    def at_home(self, motion: Clip, hold: bool) -> Clip:
        """A motion of the body on the skeleton that came in. hold: standing feet are held."""
        for way in self.ways:
            motion = way(self, motion, hold)
        return motion

    def motion(self, character: int = 0) -> Clip:
        """The simulated motion on the body's skeleton, as it was simulated, on the floor z = 0."""
        return simulated_clip(self.imitation, self.evaluation, character)

    def write(self, out: Path, motion: Path | None = None, hold: bool = True) -> Delivery:
        """Writes the motion, `score.json` and `report.html` into `out`, and what belongs to it.

        The motion is on the skeleton that came in, as `simulated.bvh` or with the suffix of its source's
        format, see `home_suffix`; where that skeleton is not the body's, the motion of the body lies
        beside it as `body.bvh`. A library gets a file for each clip; the report shows the first one.

        Args:
            motion: the file of a single motion, in the format of its suffix, in place of one in `out`.
            hold: standing feet are held to the spot (`hold_feet`): contacts of a simulation are soft, so
                soles creep, rock and sink by millimetres. Score and report show the simulation itself;
                what holding did stands in them as well.
        """
        done = self.finished if hold else self.as_written(False)
        single = len(done.home) == 1
        if motion is not None and not single:
            raise PoiseError(
                f"{len(done.home)} characters make {len(done.home)} files",
                motion,
                "Give a folder as -o",
                code="folder-needed",
            )
        out.mkdir(parents=True, exist_ok=True)
        other = self.placed is not ABSENT and self.placed.moved is not None
        paths: dict[str, Path] = {}
        for name, clip in done.home.items():
            if other:
                body, own = name.replace("simulated", "body", 1), done.clips[name]
                paths[body] = out / f"{body}{'.bvh' if single else home_suffix(own)}"
                write_clip(own, paths[body])
            paths[name] = motion or out / f"{name}{home_suffix(clip)}"
            write_clip(clip, paths[name])
        if self.evaluation is not ABSENT:
            paths["score"] = write_score(done.card, out / "score.json")
            paths["report"] = out / "report.html"
            write_report(self.report(done), paths["report"])
        first = paths[next(iter(done.home))]
        for more in self.beside:
            paths |= more(self, out, first, hold)
        return replace(done, paths=paths)

    def report(self, done: Delivery | None = None) -> Report:
        """The page of the first motion. done: what is written, by default with feet held."""
        done = done or self.finished
        curve = {} if self.run is ABSENT else learning_curve(self.run)
        source = None if self.placed is ABSENT else self.placed.source
        page = make_report(self.imitation, replace(self.evaluation, card=done.card), curve, source)
        clip = source or self.imitation.library.clips[0]
        said, lost = [*self.said], page.lost
        if self.placed is not ABSENT:
            count, lost = len(self.evaluation.recordings), self.failed_s
            who = [f" (character {k + 1})" if count > 1 else "" for k, _ in self.failures]
            fails = zip(self.failures, who, strict=True)
            said += [p.sentence() for p in self.parts] or [
                f"The character failed at {s:.1f} s{which}." for (_, s), which in fails
            ]
            said += shortfalls(self.evaluation.card) if count == 1 and not self.parts else ()
        return replace(
            page,
            notes=(*said, *page.notes, *done.notes),
            keys=tuple(round(k / clip.fps * page.fps) for k in self.at),
            lost=lost,
        )

    def save(self, path: str | Path, *, force: bool = False) -> dict[str, Path]:
        """Writes the motion into the file `path`, or all there is into the folder `path`; what was
        written, by name.

        Args:
            force: what is there already may be written over.

        Raises:
            PoiseError: a suffix of no motion format, something is there already, or nothing can be
                written there.
        """
        path = Path(path)
        with refusing(path):
            to_file = names_file(path) and not path.is_dir()
            if to_file:
                check_writable(path)
                may_write(path, force, flag="force=True")
            else:
                may_deliver(path, None, force, flag="force=True")
        if to_file:
            write_clip(self.clip, path)
            return {"motion": path}
        with claimed(path):
            paths = self.write(path).paths
            if self.run is not ABSENT:
                paths = {**paths, "run": path / RUN}
                if paths["run"].resolve() != self.run.resolve():
                    shutil.copytree(self.run, paths["run"], dirs_exist_ok=True)
        return paths

    def __repr__(self) -> str:
        said = f"{type(self).__name__}({self.source.name!r}, {self.source.seconds:.1f} s"
        if (card := self.card) is not ABSENT:
            said += f", success {card.succ:.0%}, {card.mpjpe_mm:.0f} mm"
            said += f", help {card.help.force_mean_n:.1f} N"
        return said + ")"

    def _repr_html_(self) -> str:
        """A picture and a table for notebooks, self-contained."""
        source, card = self.source, self.card
        rows = () if card is ABSENT else rows_of(card)
        keys = self.at or self.keyframes
        return result_html(source.name, self.clip, source, rows, self.notes, keys)


#: A step of a motion's way home, and the writing of further files: see `Result`.
Way = Callable[[Result, Clip, bool], Clip]
Beside = Callable[[Result, Path, Path, bool], dict[str, Path]]


def clip_of(motion: Clip | str | Path) -> Clip:
    """A clip as it is, or that in a file.

    Raises:
        PoiseError: the file cannot be read.
    """
    return motion if isinstance(motion, Clip) else read_clip(motion)


def needs_of(imitation: Imitation, supports: Sequence[Support] = ()) -> tuple[Need, ...]:
    """Needs of a task's first motion besides a floor and its supports."""
    reference = imitation.reference
    frames = int(reference.length[0])
    pose = reference.pose
    table, rate = imitation.humanoid.table, reference.rate_hz
    needs = find_needs(table, pose.pos[:frames].numpy(), pose.quat[:frames].numpy(), rate)
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


Word = Literal["tracked", "found", "came back", "not tracked", "lost"]


class Story(NamedTuple):
    """How a motion ended.

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


def story(tracked: Result, reset: bool = False, hint: bool = True) -> Story:
    """How a motion, or several, ended.

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
    """The help, in newtons and as a share of body weight: "without help"."""
    aid = card.help
    if not aid.force_mean_n and not aid.torque_mean_nm:
        return "without help"
    return (
        f"with help of {aid.force_mean_n:.0f} N on average, {100 * aid.share_of_body_weight:.1f} % of "
        f"body weight, and {aid.torque_mean_nm:.0f} N m"
    )


def _single(t: Result, seconds: float, off: str, aid: str, reset: bool, hint: bool) -> Story:
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
