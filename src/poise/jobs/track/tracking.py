"""A trained controller tracks any motion: no training, no help, one episode from its first frame.

tracked = track("kick.bvh")
tracked.card, tracked.clip, tracked.save("out")
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from poise.body.humanoid import make_humanoid
from poise.env import Reference
from poise.errors import PoiseError
from poise.formats import read_clip
from poise.formats.raw import ReadOptions
from poise.jobs.open import Run, open_run
from poise.jobs.runs import Evaluation, scored
from poise.jobs.track.controllers import RULE, Show, done_by, led_by
from poise.jobs.track.placement import PlacedMotion, fitted, follow, place, place_all, points_of
from poise.jobs.track.pushed import with_push
from poise.jobs.track.rates import InPlace, rate_doubts, rate_notes, with_travel
from poise.jobs.track.retaking import retaken
from poise.jobs.track.settings import TrackConfig
from poise.jobs.track.supports import places, with_supports
from poise.jobs.track.tracked import (
    Clean,
    Span,
    Tracked,
    beside_raw,
    cut,
    needs_of,
    parts_of,
    with_parts,
)
from poise.jobs.tracker import Tracker
from poise.kinematics.fit import widen
from poise.kinematics.rate import settled
from poise.kinematics.supports import Support
from poise.metrics import detail, deviations, has_lost, mpjpe_global
from poise.motion import Clip, ClipLibrary
from poise.motion.keypoints import Keypoints
from poise.motion.noise import perturb_clip, perturb_points
from poise.recipes.imitation import Imitation
from poise.recipes.perpetual import task
from poise.settings import changed

#: What the score of a motion with a push is against.
GOAL_YIELDS = (
    "The score, and the ghost in the report, are those of the goal, which gives way to the push."
)
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
) -> Tracked:
    """Lets a trained policy do a motion that it need not know, without help and without training.

    The motion is tracked from its first frame to its last. Keypoints reach a policy with goals of
    keypoints frame by frame (`kinematics.retarget`); any other gets the clip that is fitted to them.

    Args:
        clip: a clip, keypoints, or a file; keypoints in a file stay keypoints. Several of them are done
            one after another by one character, each where it stands: between them it walks, turns and
            gets up to the next one's first frame (`Tracked.parts`).
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
    if isinstance(policy, Tracker):
        tracker = policy
    else:
        tracker = (policy if isinstance(policy, Run) else open_run(policy)).tracker
    if not isinstance(clip, Motion | Iterable):  # pyright: ignore[reportUnnecessaryIsInstance]
        raise PoiseError(
            f"a motion is a clip, keypoints, a file or several of them, got {clip!r}", code="wrong-type"
        )
    motions = [clip] if isinstance(clip, Motion) else list(clip)
    config.check(len(motions))
    motions = [read_motion(m) for m in motions]
    several = len(motions) > 1
    travels = [_with_travel(m, config, several) for m in motions]
    motions = [m if t is None else t.clip for m, t in zip(motions, travels, strict=True)]
    motion, travel = motions[0], travels[0]
    given, points = _input(motion, config)
    if travel is not None:
        config = replace(config, direction=travel.moved(config.direction))
    config.direction.check(given, tracker.humanoid.table)
    undirected, (given, directions) = given, config.direction.applied(given)
    if config.recover or several:
        all_placed = place_all([given, *(_input(m, config)[0] for m in motions[1:])], tracker)
    else:
        tracker = tracker.with_bones_of(given) if config.body == "own" else tracker
        all_placed = [place(given, tracker)]
    placed = all_placed[0]
    imitation = imitation_of(tracker, all_placed)
    notes = [f"{p.clip.name}: {n}" if several else n for p in all_placed for n in p.notes]
    notes += directions
    doubts = [*(t.sentence() for t in travels if t is not None), *rate_doubts(all_placed)]
    if warn is not None:
        for doubt in doubts:
            warn(doubt)
    notes += doubts
    if points is not None and not several:
        reference, said = follow(tracker, placed, points, imitation.reference, config.smooth_hz)
        imitation, notes = replace(imitation, reference=reference), [*notes, *said]
    goals = imitation.reference.pose.pos
    supports: tuple[Support, ...] = ()
    if not several and not config.recover and config.count == 1:
        supports, imitation = with_supports(imitation, config.supports, placed)
        notes += [s.sentence() for s in supports]
    imitation = with_push(imitation, config.push)
    if config.count > 1:
        imitation = side_by_side(imitation, config.count)
    losses, replayed, apart, spans = None, None, imitation.reference, list[Span]()
    if config.recover or several:
        led, said = led_by(tracker, all_placed, imitation, config, progress)
        placed, imitation, replayed, losses, spans = led
        notes += said
    ref = imitation.reference
    prices = config.direction.prices(given, imitation.humanoid.table, ref.frames, ref.rate_hz)
    if config.retake is None:
        done, said = done_by(tracker, imitation, config, replayed, progress, prices)
    else:
        done, said = retaken(tracker, imitation, config, config.retake, progress, prices)
    notes += said
    if done.pushed is not None:
        assert config.push is not None
        notes += [done.pushed.sentence(), *config.push.yields.notes, GOAL_YIELDS]
    elif not several and config.retake is None:
        said = rate_notes(
            tracker, given, placed.report.clips[0].rate,
            lambda c: imitation_of(tracker, [place(c, tracker)]), config, bool(done.failures), progress,
        )  # fmt: skip
        notes, doubts = [*notes, *said], [*doubts, *said]
    rollouts, frames = done.rollouts, done.failures
    about, rate = tracker.about, imitation.reference.rate_hz
    suffix = {"policy": "", "lookahead": ", lookahead", "search": ", searched"}[done.controller]
    scores = cut(rollouts, spans, apart) if several else rollouts
    card = scored(scores, imitation, about, RULE, tracker.config.method + suffix)
    parts = tuple(parts_of(scores, spans, RULE, config.recover)) if several else ()
    if several:
        card = with_parts(card, parts)
    else:
        card = replace(card, needs=tuple(n.to_dict() for n in needs_of(imitation, supports)))
        seen = done.judged.mask[0]
        beside = rollouts.pos[0][seen], rollouts.ref_pos[0][seen], imitation.reference.rate_hz
        far = [c.told(imitation.humanoid.bodies) for c in deviations(*beside)]
        card = replace(card, detail=detail(*beside), changed=tuple(far))
        raw = beside_raw(tracker, points or given, placed, rollouts.pos[0], done.judged.mask[0])
        if raw is not None:
            card = replace(card, raw=raw.figures)
            notes.append(raw.sentence())
    clean = None
    if config.noise:
        seen = rollouts.pos[0], goals
        clean = _beside_clean(tracker, motion, done.judged.mask[0], *seen, config)
        notes.append(clean.sentence())
    if float(about.get("help_n", 0.0)) > 0:
        notes.append(
            f"The policy is that of an unfinished training that still helped by up to "
            f"{float(about['help_n']):.0f} N; here nothing helps."
        )
    evaluation = Evaluation(card, rollouts, done.recordings, config.count > 1)
    times = tuple((character, frame / rate) for character, frame in frames)
    if losses is not None:
        times = tuple((0, t) for t in losses.lost)
    elif several:
        times = tuple((0, p.lost) for p in parts if p.lost is not None)
    return Tracked(
        tracker, imitation, evaluation, placed, times, clean, tuple(notes), losses, done.found,
        done.controller, parts, supports, config.direction.pins,
        None if several or config.recover else done.simulation, done.pushed,
        undirected if config.direction else None, config.retake, tuple(doubts),
        None if several else travel,
    )  # fmt: skip


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
    timed = bool(config.direction) or config.push is not None
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


def _beside_clean(
    tracker: Tracker, motion: Clip | Keypoints, judged: Tensor, sim: Tensor, noisy: Tensor,
    config: TrackConfig,
) -> Clean:  # fmt: skip
    """The character `sim (T, B, 3)` beside the motion without noise, in the frames `judged (T)`."""
    clean, _ = _input(motion, replace(config, noise=()))
    pos = imitation_of(tracker, [place(clean, tracker)]).reference.pose.pos
    # A gap at an end of noisy keypoints may have cut some frames off.
    frames = min(len(pos), len(sim), len(noisy))
    pos, sim, noisy, kept = pos[:frames], sim[:frames], noisy[:frames], judged[:frames]
    off = mpjpe_global(sim, pos)
    won = not bool(has_lost(sim, pos).any())
    return Clean(float(mpjpe_global(noisy, pos).mean()), float(off[kept].mean()), won)
