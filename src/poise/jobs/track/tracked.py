"""What came of tracking: the motion on the skeleton that came in, its score, its report, its files."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from poise.errors import PoiseError
from poise.eval import ScoreCard
from poise.jobs.deliver import Delivery, as_high_as_source, deliver, finished, simulated_clip
from poise.jobs.result import Result, Shown
from poise.jobs.runs import Evaluation
from poise.jobs.settled import settled
from poise.jobs.track.best import Merit, merit
from poise.jobs.track.in_place import InPlace
from poise.jobs.track.missing import shortfalls
from poise.jobs.track.parts import Part
from poise.jobs.track.placement import Placed, home
from poise.jobs.track.pushed import Pushed
from poise.jobs.track.recovering import Losses
from poise.jobs.track.simulation import FILE, Retake, Simulation
from poise.jobs.track.splice import changed_s, spliced, written_as
from poise.jobs.track.supports import at_home, write_supports
from poise.jobs.tracker import Tracker
from poise.kin.directed import Pin, pinned
from poise.kin.supports import Support
from poise.kin.travel import travelled
from poise.motion import Clip
from poise.motion.io import home_suffix, write_clip
from poise.plan import SamplingResult
from poise.recipes.imitation import Imitation


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
    placed: Placed
    failures: tuple[tuple[int, float], ...]
    clean: Clean | None
    notes: tuple[str, ...]
    losses: Losses | None = None
    found: SamplingResult | None = None
    controller: str = "policy"
    parts: tuple[Part, ...] = ()
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

    def _shown(self) -> Shown:
        source = self.placed.source if self.travel is None else self.travel.beside
        return Shown(self.clip, source, self.card, self.notes)

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
        raise PoiseError(f"{count} characters make {count} files", motion, "Give a folder as -o")
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
