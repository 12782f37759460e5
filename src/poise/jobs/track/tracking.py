"""A trained controller tracks any motion: no training, no help, one episode from its first frame.

tracked = track("kick.bvh")
tracked.card, tracked.clip, tracked.save("out")

Features change what is tracked and what is made of it, in the order of `FEATURES`; `settings.RULES` say
which of them are not combined.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from poise.body.humanoid import make_humanoid
from poise.control import ImplicitResidual
from poise.env import Reference
from poise.errors import PoiseError
from poise.formats import read_clip
from poise.formats.raw import ReadOptions
from poise.jobs.deliver import Evaluation
from poise.jobs.deliver import settled as feet_settled
from poise.jobs.open import Run, open_run
from poise.jobs.result import RULE, Result, Way, needs_of
from poise.jobs.runs import scored
from poise.jobs.track.controllers import Show, TrackingRun, done_by, draws_of, led_by
from poise.jobs.track.in_place import InPlace, with_travel
from poise.jobs.track.placement import (
    Clean,
    PlacedMotion,
    beside_raw,
    fitted,
    follow,
    home,
    place,
    place_all,
    points_of,
)
from poise.jobs.track.pushed import ForceEffect, Pushed, with_forces, without_forces
from poise.jobs.track.rates import rate_doubts, rate_notes
from poise.jobs.track.recovery_run import RecoveryRun, cut, parts_of, with_parts
from poise.jobs.track.retaking import as_it_was, retaken, write_simulation
from poise.jobs.track.surroundings import places, with_supports, write_supports
from poise.jobs.track_settings import TrackConfig
from poise.jobs.tracker import Tracker
from poise.kinematics.directed import Pin, pinned
from poise.kinematics.fit import widen
from poise.kinematics.rate import settled
from poise.kinematics.supports import Support
from poise.metrics import detail, deviations, has_lost, mpjpe_global
from poise.motion import Clip, ClipLibrary
from poise.motion.keypoints import Keypoints
from poise.motion.noise import perturb_clip, perturb_points
from poise.plan import Guide, make_plan
from poise.recipes.imitation import Imitation
from poise.recipes.perpetual import task
from poise.settings import changed

#: What the score of a motion with a push is against.
GOAL_YIELDS = (
    "The score, and the ghost in the report, are those of the goal, which gives way to the push."
)
#: What lies beside the motion of a character that tracked it.
BESIDE = (write_simulation, write_supports)
#: What is tracked.
Motion = Clip | Keypoints | str | Path


def track(
    clip: Motion | Sequence[Motion],
    policy: Tracker | Run | str | Path | None = None,
    config: TrackConfig | None = None,
    *,
    progress: Show | None = None,
    warn: Callable[[str], None] | None = None,
    **settings: Any,
) -> Result:
    """Lets a trained policy do a motion that it need not know, without help and without training.

    The motion is tracked from its first frame to its last. Keypoints reach a policy with goals of
    keypoints frame by frame (`kinematics.retarget`); any other gets the clip that is fitted to them.

    Args:
        clip: a clip, keypoints, or a file; keypoints in a file stay keypoints. Several of them are done
            one after another by one character, each where it stands: between them it walks, turns and
            gets up to the next one's first frame (`Result.parts`).
        policy: a policy file, the folder of a run of poise train perpetual, or one that is open; by
            default the policy that comes with Poise.
        config: how it is tracked; `settings` are those that differ, such as recover=True, count=4 or
            controller="policy".
        progress: is told what is done ("looking ahead", "searching"), and how many control steps of how
            many are done.
        warn: is told, before anything is simulated, what speaks against the motion: a frame rate that is
            likely wrong. The same sentences are among the notes.

    Raises:
        PoiseError: a motion that cannot be read, that no human makes or that is too short, or no such
            policy.
    """
    config = changed(config or TrackConfig(), settings)
    if not isinstance(policy, Tracker):
        policy = (policy if isinstance(policy, Run) else open_run(policy)).tracker
    motions = _motions(clip)
    config.check(len(motions))
    session = TrackSession(policy, config, [read_motion(m) for m in motions], progress, warn)
    features = [feature for feature in FEATURES if feature.asked(session)]
    for feature in features:
        feature.prepare(session)
    result = session.run()
    for feature in features:
        result = feature.finish(session, result)
    return result


def _motions(clip: Motion | Sequence[Motion]) -> list[Motion]:
    if not isinstance(clip, Motion | Iterable):  # pyright: ignore[reportUnnecessaryIsInstance]
        raise PoiseError(
            f"a motion is a clip, keypoints, a file or several of them, got {clip!r}", code="wrong-type"
        )
    return [clip] if isinstance(clip, Motion) else list(clip)


@dataclass(eq=False)
class TrackSession:
    """A motion on its way from what came in to the result, which features change.

    Attributes:
        tracker, config: the policy, and how it tracks.
        motions: what came in, in place with its travel.
        show, warn: see `track`.
        given, points: the same as clips, and the first one as keypoints where it is.
        clean: the first motion as it came, before noise.
        travel: what was done to a clip in place.
        undirected: the motion before a director's wishes.
        placed, imitation: the motions on the body, and as a task.
        goals: `(T, B, 3)` m, where the bodies are to be, before anything pushes or leads.
        supports: what the motion rests on.
        led, apart: a character that was led along its motions, and the motions each for itself.
        actor: the policy as it acts in the task, where that is not the tracker.
        prices: what counts more in each control step, see `Direction.prices`.
        do: how the task is done; by default `done_by`.
        done: how it was done.
    """

    tracker: Tracker
    config: TrackConfig
    motions: list[Clip | Keypoints]
    show: Show | None = None
    warn: Callable[[str], None] | None = None
    given: list[Clip] = field(init=False)
    points: Keypoints | None = None
    travel: InPlace | None = None
    undirected: Clip | None = None
    placed: list[PlacedMotion] = field(init=False)
    imitation: Imitation = field(init=False)
    goals: torch.Tensor = field(init=False)
    supports: tuple[Support, ...] = ()
    led: RecoveryRun | None = None
    apart: Reference = field(init=False)
    actor: Tracker | None = None
    prices: torch.Tensor | None = None
    do: Callable[..., tuple[TrackingRun, Sequence[str]]] | None = None
    done: TrackingRun = field(init=False)
    notes: list[str] = field(default_factory=list[str])
    doubts: list[str] = field(default_factory=list[str])

    @property
    def several(self) -> bool:
        """Whether motions are done one after another."""
        return len(self.motions) > 1

    @property
    def leads(self) -> bool:
        """Whether recovery motions lead the character to its motions."""
        return self.several or self.config.recover

    def run(self) -> Result:
        """Simulates and scores."""
        tracker, config, imitation, led = self.tracker, self.config, self.imitation, self.led
        ref, hold = imitation.reference, led.replayed if led else None
        self.prices = config.direction.prices(
            self.given[0], imitation.humanoid.table, ref.frames, ref.rate_hz
        )
        if (draws := draws_of(self.show)) is not None:
            draws.begin(imitation.humanoid, self.placed[0], int(ref.length[0]), ref.rate_hz)
        do = self.do or done_by
        self.done, said = do(self.actor or tracker, imitation, config, hold, self.show, self.prices)
        notes, about, done = [*self.notes, *said], tracker.about, self.done
        suffix = {"policy": "", "lookahead": ", lookahead", "search": ", searched"}[done.controller]
        rollouts = done.rollouts
        scores = cut(rollouts, led.spans, self.apart) if led and self.several else rollouts
        card = scored(scores, imitation, about, RULE, tracker.config.method + suffix)
        if float(about.get("help_n", 0.0)) > 0:
            notes.append(
                f"The policy is that of an unfinished training that still helped by up to "
                f"{float(about['help_n']):.0f} N; here nothing helps."
            )
        return Result(
            imitation,
            Evaluation(card, rollouts, done.recordings, config.count > 1),
            tracker,
            led.placed if led else self.placed[0],
            tuple(notes),
            tuple(self.doubts),
            tuple((character, frame / ref.rate_hz) for character, frame in done.failures),
            done.controller,
            found=done.found,
            simulation=None if self.leads else done.simulation,
            ways=(brought_home(config.direction.pins),),
            beside=BESIDE,
        )


def _nothing(session: TrackSession) -> None: ...


def _same(session: TrackSession, result: Result) -> Result:
    return result


@dataclass(frozen=True)
class Feature:
    """A feature: something that may be done to a motion beside tracking it.

    Attributes:
        asked: whether a session asks for it.
        prepare: changes the session before anything is simulated.
        finish: the result with what the feature found.
    """

    asked: Callable[[TrackSession], bool]
    prepare: Callable[[TrackSession], None] = _nothing
    finish: Callable[[TrackSession, Result], Result] = _same


def _travel(s: TrackSession) -> None:
    """Motions in place get their travel; a director's wishes are where that is."""
    made = [_with_travel(m, s.config, s.several) for m in s.motions]
    s.motions = [m if t is None else t.clip for m, t in zip(s.motions, made, strict=True)]
    s.doubts += [t.sentence() for t in made if t is not None]
    s.travel = None if s.several else made[0]
    if s.travel is not None:
        s.config = replace(s.config, direction=s.travel.moved(s.config.direction))


def _read_input(s: TrackSession) -> None:
    """The motions as clips, with noise."""
    read = [_input(m, s.config) for m in s.motions]
    s.given, s.points = [clip for clip, _ in read], read[0][1]


def _direct(s: TrackSession) -> None:
    """The motion as a director wants it."""
    s.config.direction.check(s.given[0], s.tracker.humanoid.table)
    s.undirected = s.given[0]
    s.given[0], said = s.config.direction.applied(s.given[0])
    s.notes += said


def _place(s: TrackSession) -> None:
    """The motions on the body, as a task."""
    if s.leads:
        s.placed = place_all(s.given, s.tracker)
    else:
        s.tracker = s.tracker.with_bones_of(s.given[0]) if s.config.body == "own" else s.tracker
        s.placed = [place(s.given[0], s.tracker)]
    s.imitation = imitation_of(s.tracker, s.placed)
    s.notes += [f"{p.clip.name}: {n}" if s.several else n for p in s.placed for n in p.notes]
    s.doubts += rate_doubts(s.placed)
    if s.warn is not None:
        for doubt in s.doubts:
            s.warn(doubt)
    s.notes += s.doubts
    if s.points is not None and not s.several:
        ref = s.imitation.reference
        ref, said = follow(s.tracker, s.placed[0], s.points, ref, s.config.smooth_hz)
        s.imitation = replace(s.imitation, reference=ref)
        s.notes += said
    s.apart = s.imitation.reference
    s.goals = s.apart.pose.pos


def _support(s: TrackSession) -> None:
    """Supports of a single motion."""
    s.supports, s.imitation = with_supports(s.imitation, s.config.supports, s.placed[0])
    s.notes += [one.sentence() for one in s.supports]


def _help(s: TrackSession) -> None:
    """A hand leads the root; the policy's own actions have no part in it. Elsewhere, such as at another
    frame rate, the policy goes without."""
    residual = ImplicitResidual(s.config.help_limit, s.config.help_limit)
    hinges = len(s.imitation.humanoid.hinges)
    policy = s.tracker.policy.with_actions(hinges).with_actions(hinges + residual.dims)
    s.actor = replace(s.tracker, policy=policy)
    own = replace(s.imitation.task, residual=residual, help_by="all")
    s.imitation = with_guide(replace(s.imitation, task=own))


def _helped(s: TrackSession, result: Result) -> Result:
    used = result.evaluation.card.help
    said = (
        f"Helped: a hand that no real person has led the root with up to {used.limit_n:g} N, "
        f"{used.force_mean_n:.0f} N on average, {used.share_of_body_weight:.0%} of the body's weight, "
        f"{used.work_j_per_s:.0f} J a second."
    )
    return replace(result, notes=(*result.notes, said))


def _force(s: TrackSession) -> None:
    """Pushes and held things, at their frames."""
    fps, rate = s.given[0].fps, s.imitation.reference.rate_hz
    pushes, held = s.config.direction.forces_of(fps)
    asked = (*(() if s.config.push is None else (s.config.push,)), *pushes)
    s.imitation = with_forces(s.imitation, asked, held, s.config.direction.yields(fps, rate))


def _forced(s: TrackSession, result: Result) -> Result:
    """Sentences on pushes; of those at frames, and of held things, also how near the body is without."""
    came, law = s.done.forces, s.imitation.task.compliance
    notes = result.notes
    if s.config.direction.forces:
        plain = without_forces(s.imitation)
        config = replace(s.config, push=None, direction=replace(s.config.direction, pushes=(), held=()))
        other, _ = (s.do or done_by)(s.actor or s.tracker, plain, config, None, s.show, s.prices)
        pos, without = result.evaluation.rollouts.pos[0], other.rollouts.pos[0]
        rate = s.imitation.reference.rate_hz
        effects = [ForceEffect.between(c, pos, without, s.goals, rate) for c in came]
        notes = (*notes, *(e.sentence() for e in effects))
        card = replace(result.evaluation.card, forces=tuple(e.to_dict() for e in effects))
        result = replace(result, evaluation=replace(result.evaluation, card=card))
    else:
        notes = (*notes, *(c.sentence() for c in came))
    if law is not None:
        notes = (*notes, *law.notes, GOAL_YIELDS)
    first = next((c for c in came if isinstance(c, Pushed)), None)
    return replace(result, notes=notes, pushed=first)


def _crowd(s: TrackSession) -> None:
    s.imitation = side_by_side(s.imitation, s.config.count)


def _lead(s: TrackSession) -> None:
    """Recovery motions between motions, and wherever one is lost, are a part of what is tracked."""
    s.led, said = led_by(s.tracker, s.placed, s.imitation, s.config, s.show)
    s.imitation = s.led.imitation
    s.notes += said


def _led(s: TrackSession, result: Result) -> Result:
    led = s.led
    assert led is not None
    lost = led.losses.lost if led.losses else None
    if not s.several:
        failures = result.failures if lost is None else tuple((0, t) for t in lost)
        return replace(result, losses=led.losses, failures=failures)
    scores = cut(s.done.rollouts, led.spans, s.apart)
    parts = tuple(parts_of(scores, led.spans, RULE, s.config.recover))
    evaluation = replace(result.evaluation, card=with_parts(result.evaluation.card, parts))
    lost = [p.lost for p in parts if p.lost is not None] if lost is None else lost
    failures = tuple((0, t) for t in lost)
    return replace(result, evaluation=evaluation, losses=led.losses, failures=failures, parts=parts)


def _retake(s: TrackSession) -> None:
    assert s.config.retake is not None
    s.do = partial(retaken, s.config.retake)


def _retaken(s: TrackSession, result: Result) -> Result:
    assert s.config.retake is not None
    return replace(result, ways=(*result.ways, as_it_was(s.config.retake)))


def _tried_rates(s: TrackSession, result: Result) -> Result:
    """Sentences on the frame rate at which a lost motion is done."""
    judged, lost = s.placed[0].report.clips[0].rate, bool(s.done.failures)

    def on_body(clip: Clip) -> Imitation:
        return imitation_of(s.tracker, [place(clip, s.tracker)])

    said = rate_notes(s.tracker, s.given[0], judged, on_body, s.config, lost, s.show)
    return replace(result, notes=(*result.notes, *said), doubts=(*result.doubts, *said))


def _compared(s: TrackSession, result: Result) -> Result:
    """The score of a single motion with what it needs, and where the character is far from it."""
    imitation, seen, notes = result.imitation, s.done.judged.mask[0], result.notes
    rollouts, rate = result.evaluation.rollouts, imitation.reference.rate_hz
    near = rollouts.pos[0][seen], rollouts.ref_pos[0][seen], rate
    far = [c.told(imitation.humanoid.bodies) for c in deviations(*near)]
    needs = tuple(n.to_dict() for n in needs_of(imitation, s.supports))
    card = replace(result.evaluation.card, needs=needs, detail=detail(*near), changed=tuple(far))
    raw = beside_raw(result.tracker, s.points or s.given[0], result.placed, rollouts.pos[0], seen)
    if raw is not None:
        card, notes = replace(card, raw=raw.figures), (*notes, raw.sentence())
    more: dict[str, Any] = {"supports": s.supports, "undirected": s.undirected, "travel": s.travel}
    return replace(result, evaluation=replace(result.evaluation, card=card), notes=notes, **more)


def _without_noise(s: TrackSession, result: Result) -> Result:
    """The character beside the motion without noise."""
    clean, _ = _input(s.motions[0], replace(s.config, noise=()))
    pos = imitation_of(s.tracker, [place(clean, s.tracker)]).reference.pose.pos
    sim, noisy = result.evaluation.rollouts.pos[0], s.goals
    # A gap at an end of noisy keypoints may have cut some frames off.
    frames = min(len(pos), len(sim), len(noisy))
    pos, sim, noisy, kept = pos[:frames], sim[:frames], noisy[:frames], s.done.judged.mask[0][:frames]
    off = mpjpe_global(sim, pos)
    won = not bool(has_lost(sim, pos).any())
    came = Clean(float(mpjpe_global(noisy, pos).mean()), float(off[kept].mean()), won)
    return replace(result, clean=came, notes=(*result.notes, came.sentence()))


#: What is done to a motion, in this order.
FEATURES = (
    Feature(lambda _: True, _travel),
    Feature(lambda _: True, _read_input),
    Feature(lambda s: bool(s.config.direction), _direct),
    Feature(lambda _: True, _place),
    Feature(lambda s: not s.leads and s.config.count == 1, _support),
    Feature(lambda s: s.config.help_limit > 0, _help, _helped),
    Feature(lambda s: s.config.forced, _force, _forced),
    Feature(lambda s: s.config.count > 1, _crowd),
    Feature(lambda s: s.leads, _lead, _led),
    Feature(lambda s: s.config.retake is not None, _retake, _retaken),
    Feature(
        lambda s: not s.several and not s.config.forced and s.config.retake is None,
        finish=_tried_rates,
    ),
    Feature(lambda s: not s.several, finish=_compared),
    Feature(lambda s: bool(s.config.noise), finish=_without_noise),
)


def brought_home(pins: Sequence[Pin] = ()) -> Way:
    """How a motion of a placed motion's body comes onto the skeleton that came in: limbs that stay put
    are led there, and feet that still slide are held, see `settled`."""

    def way(result: Result, motion: Clip, hold: bool) -> Clip:
        placed = result.placed
        if placed.moved is not None:
            motion = home(motion, placed, result.tracker).replaced(name=motion.name)
        if not hold:
            return motion
        return pinned(motion, pins) if pins else feet_settled(motion, placed.calm)

    return way


def imitation_of(tracker: Tracker, placed: Sequence[PlacedMotion]) -> Imitation:
    """Motions on the tracker's body as one task; the report is that of the first.

    Where a motion leaves the range of a hinge, the range is widened if no action is measured by it: a
    character that begins beyond a range would be thrown back into it.
    """
    humanoid, config = tracker.humanoid, tracker.config
    motions = [p.qpos for p in placed]
    if config.widens and widen(humanoid.table, motions, 0.0)[1]:
        table, _ = widen(humanoid.table, motions, config.body.margin)
        humanoid = make_humanoid(humanoid.skeleton, table)
    library = ClipLibrary(tuple(p.clip for p in placed), (1.0,) * len(placed))
    names = [p.clip.name for p in placed]
    reference = Reference(humanoid, [p.qpos for p in placed], config.sim.control_hz, names)
    own = task(config, humanoid, guided=tracker.recovery_clips is not None)
    return Imitation(library, humanoid, reference, placed[0].report, config, own, tracker.recovery_clips)


def with_guide(imitation: Imitation) -> Imitation:
    """A task with help in which a hand leads the root, as far as the help's limit goes."""
    residual = imitation.task.residual
    if residual is None:
        return imitation
    plan = make_plan(imitation.reference)
    guide = Guide(imitation.reference, residual, plan.force_h, plan.torque_b)
    return replace(imitation, task=replace(imitation.task, guide=guide))


def side_by_side(imitation: Imitation, count: int) -> Imitation:
    """The first motion `count` times, each some metres from the others; clips are called NAME-1, ..."""
    clip, reference = imitation.library.clips[0], imitation.reference
    names = [f"{clip.name}-{k + 1}" for k in range(count)]
    moves = np.pad(places(count), ((0, 0), (0, 1)))
    motions: list[np.ndarray] = []
    for move in moves:
        qpos = reference.qpos.numpy().copy()
        qpos[:, :3] += move
        motions.append(qpos)
    made = Reference(reference.humanoid, motions, reference.rate_hz, names)
    # Goals that came from keypoints are no function of the coordinates.
    pose = reference.pose
    many = {f.name: torch.cat([getattr(pose, f.name)] * count) for f in fields(pose)}
    shift = torch.tensor(moves).repeat_interleave(len(reference.qpos), 0).to(pose.pos)
    many["pos"] = many["pos"] + shift[:, None]
    many["com"] = many["com"] + shift
    many["qpos"] = made.pose.qpos
    made = made.with_pose(replace(pose, **many))
    fits = tuple(replace(imitation.report.clips[0], name=n) for n in names)
    report = replace(imitation.report, clips=fits)
    clips = ClipLibrary(tuple(clip.replaced(name=n) for n in names), (1.0,) * count)
    return replace(imitation, library=clips, reference=made, report=report)


def read_motion(clip: Motion) -> Clip | Keypoints:
    """A motion as it is, or that in a file, keypoints where it holds keypoints.

    Raises:
        PoiseError: the file cannot be read.
    """
    if isinstance(clip, Clip | Keypoints):
        return clip
    made = read_clip(clip)
    return points_of(made, ReadOptions()) or settled(made)


def _with_travel(motion: Clip | Keypoints, config: TrackConfig, several: bool) -> InPlace | None:
    """A motion in place with its travel, if it is one.

    A loop is repeated for a single character that has nothing to do at a certain time. Several clips in
    a row, and a motion that waits for its character, are written with their travel.
    """
    if isinstance(motion, Keypoints):
        return None
    single = config.count == 1 and not config.recover and not several
    timed = bool(config.direction) or config.forced
    made = with_travel(motion, config.in_place, repeats=single and not timed, returns=single)
    if made is not None and made.overlap is not None and config.retake is not None:
        what = "it is a loop in place, of which several periods were simulated and one is written"
        raise PoiseError(what, motion.name, "Leave the range out", code="range-of-loop")
    return made


def _input(motion: Clip | Keypoints, config: TrackConfig) -> tuple[Clip, Keypoints | None]:
    """The motion with noise as a clip, and as keypoints where it is."""
    if isinstance(motion, Keypoints):
        points = perturb_points(motion, config.noise, config.seed) if config.noise else motion
        return fitted(points, config.smooth_hz), points
    return (perturb_clip(motion, config.noise, config.seed) if config.noise else motion), None
