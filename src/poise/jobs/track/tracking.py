"""A trained controller tracks any motion: no training, no help, one episode from its first frame.

tracked = track("kick.bvh")
tracked.card, tracked.clip, tracked.save("out")
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from poise.body.humanoid import make_humanoid
from poise.env import Reference
from poise.errors import PoiseError
from poise.jobs.open import Run, open_run
from poise.jobs.runs import Evaluation, scored
from poise.jobs.track.controllers import RULE, Controller, Show, done_by, led_by
from poise.jobs.track.crowd import places
from poise.jobs.track.missing import needs_of
from poise.jobs.track.parts import Span, cut, parts_of, with_parts
from poise.jobs.track.placement import Placed, place, place_all
from poise.jobs.track.points import fitted, follow, points_of
from poise.jobs.track.rates import rate_notes
from poise.jobs.track.tracked import Clean, Tracked
from poise.jobs.tracker import Tracker
from poise.kin.fit import widen
from poise.metrics import mpjpe_global, success_rule
from poise.motion import Clip, ClipLibrary, read_clip
from poise.motion.io.raw import ReadOptions
from poise.motion.keypoints import Keypoints
from poise.motion.noise import Noise, perturb_clip, perturb_points
from poise.plan import LookaheadConfig, SamplingConfig
from poise.recipes.imitation import Imitation
from poise.recipes.perpetual import task
from poise.settings import changed, validate

#: Characters in one world.
MOST = 64
#: What is tracked.
Motion = Clip | Keypoints | str | Path


@dataclass(frozen=True)
class TrackConfig:
    """How a motion is tracked.

    Attributes:
        noise, seed: what is done to the input first, see `motion.noise`.
        reset_on_fail: a character that failed is put back onto the reference.
        recover: it gets up, comes back and goes on, while the motion waits, see `env.goals.led`; for one
            character.
        smooth_hz: cut-off of a low-pass on keypoints.
        count: characters that do the motion side by side in one world, see `track.crowd`.
        controller: "policy" acts alone, "lookahead" simulates what it may do before it acts
            (`plan.lookahead`), "search" looks for the whole motion (`plan.sampling`), for one character;
            "auto" looks ahead, and searches what is lost so, but for `recover` and several clips.
        lookahead: how it looks ahead; its seed is `seed`.
        search: how it searches; its seed is `seed`.
        threads: cores of lookahead and search, 0 is all of them.
        body: "policy" is the one that it was trained on, onto which motions are retargeted; "own" has
            the same bodies and hinges with the lengths and masses of the skeleton that came in.
    """

    noise: tuple[Noise, ...] = ()
    seed: int = 0
    reset_on_fail: bool = False
    recover: bool = False
    smooth_hz: float | None = None
    count: int = 1
    controller: Controller = "auto"
    lookahead: LookaheadConfig = field(default_factory=LookaheadConfig)
    search: SamplingConfig = field(default_factory=SamplingConfig)
    threads: int = 0
    body: Literal["policy", "own"] = "policy"

    def __post_init__(self) -> None:
        validate(self)
        if not 1 <= self.count <= MOST:
            raise PoiseError(f"there can be 1 to {MOST} characters, got {self.count}")
        if self.recover and (self.reset_on_fail or self.count > 1):
            what = "several characters" if self.count > 1 else "one that is put back onto the motion"
            raise PoiseError(f"only a single character comes back by itself, not {what}")
        if self.controller == "search" and (self.recover or self.reset_on_fail or self.count > 1):
            what = "several characters" if self.count > 1 else "one that comes or is put back"
            raise PoiseError(f"a motion is searched for a single character, not {what}")

        if self.body == "own" and self.recover:
            raise PoiseError("recovery clips are those of the policy's body, so body='own' has none")

    def check(self, clips: int) -> None:
        """Refuses what cannot be done with so many clips one after another.

        Raises:
            PoiseError: no clips, or several with what is for a single one.
        """
        alone = {
            "several characters are": self.count > 1, "noise is": bool(self.noise),
            "putting a character back is": self.reset_on_fail,
            "a search is": self.controller == "search", "a body of its own is": self.body == "own",
        }  # fmt: skip
        if not clips:
            raise PoiseError("there is no clip to track")
        if clips > 1 and any(alone.values()):
            what = next(name for name, asked in alone.items() if asked)
            raise PoiseError(f"{what} for a single clip, and {clips} were given")

    @property
    def looks_ahead(self) -> bool:
        """Whether lookahead is wanted."""
        return self.controller in ("auto", "lookahead")

    @property
    def searches(self) -> bool:
        """Whether what is lost is searched."""
        single = not (self.recover or self.reset_on_fail or self.count > 1)
        return self.controller == "search" or (self.controller == "auto" and single)


def track(
    clip: Motion | Sequence[Motion],
    policy: Tracker | Run | str | Path | None = None,
    config: TrackConfig | None = None,
    *,
    progress: Show | None = None,
    **settings: Any,
) -> Tracked:
    """Lets a trained policy do a motion that it need not know, without help and without training.

    The motion is tracked from its first frame to its last. Keypoints reach a policy with goals of
    keypoints frame by frame (`kin.retarget`); any other policy gets the clip that is fitted to them.

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

    Raises:
        PoiseError: a motion that cannot be read, that no human makes or that is too short, or no such
            policy.
    """
    config = changed(config or TrackConfig(), settings)
    if isinstance(policy, Tracker):
        tracker = policy
    else:
        tracker = (policy if isinstance(policy, Run) else open_run(policy)).tracker
    motions = [clip] if isinstance(clip, Motion) else list(clip)
    config.check(len(motions))
    motions = [read_motion(m) for m in motions]
    motion = motions[0]
    given, points = _input(motion, config)
    several = len(motions) > 1
    if config.recover or several:
        all_placed = place_all([given, *(_input(m, config)[0] for m in motions[1:])], tracker)
    else:
        tracker = tracker.with_bones_of(given) if config.body == "own" else tracker
        all_placed = [place(given, tracker)]
    placed = all_placed[0]
    imitation = imitation_of(tracker, all_placed)
    notes = [f"{p.clip.name}: {n}" if several else n for p in all_placed for n in p.notes]
    if points is not None and not several:
        reference, said = follow(tracker, placed, points, imitation.reference, config.smooth_hz)
        imitation, notes = replace(imitation, reference=reference), [*notes, *said]
    goals = imitation.reference.pose.pos
    if config.count > 1:
        imitation = side_by_side(imitation, config.count)
    losses, replayed, apart, spans = None, None, imitation.reference, list[Span]()
    if config.recover or several:
        led, said = led_by(tracker, all_placed, imitation, config, progress)
        placed, imitation, replayed, losses, spans = led
        notes += said
    done, said = done_by(tracker, imitation, config, replayed, progress)
    notes += said
    if not several:
        notes += rate_notes(
            tracker, given, placed.report.clips[0].flights,
            lambda c: imitation_of(tracker, [place(c, tracker)]), config, bool(done.failures), progress,
        )  # fmt: skip
    rollouts, frames = done.rollouts, done.failures
    about, rate = tracker.about, imitation.reference.rate_hz
    suffix = {"policy": "", "lookahead": ", lookahead", "search": ", searched"}[done.controller]
    scores = cut(rollouts, spans, apart) if several else rollouts
    card = scored(scores, imitation, about, RULE, tracker.config.method + suffix)
    parts = tuple(parts_of(scores, spans, RULE, config.recover)) if several else ()
    if several:
        card = with_parts(card, parts)
    else:
        card = replace(card, needs=tuple(n.to_dict() for n in needs_of(imitation)))
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
    evaluation = Evaluation(card, rollouts, done.recordings)
    times = tuple((character, frame / rate) for character, frame in frames)
    if losses is not None:
        times = tuple((0, t) for t in losses.lost)
    elif several:
        times = tuple((0, p.lost) for p in parts if p.lost is not None)
    return Tracked(
        tracker, imitation, evaluation, placed, times, clean, tuple(notes), losses, done.found,
        done.controller, parts,
    )  # fmt: skip


def imitation_of(tracker: Tracker, placed: Sequence[Placed]) -> Imitation:
    """Motions on the tracker's body as one task; the report is that of the first.

    Where a motion leaves the range of a hinge, the range is widened if no action is measured by it: a
    character that begins beyond a range would be thrown back into it.
    """
    humanoid, config = tracker.humanoid, tracker.config
    motions = [p.qpos for p in placed]
    if config.widens and widen(humanoid.table, motions, 0.0)[1]:
        table, _ = widen(humanoid.table, motions, config.body.margin)
        humanoid = make_humanoid(humanoid.skeleton, table)
        config.sim.apply(humanoid.model)
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
    return points_of(made, ReadOptions()) or made


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
    won = bool((off <= success_rule(RULE).limit_m * 1000.0).all())
    return Clean(float(mpjpe_global(noisy, pos).mean()), float(off[kept].mean()), won)
