"""A trained controller tracks any motion: no training, no help, one episode from its first frame.

tracked = track("kick.bvh", search=True)
tracked.card, tracked.clip, tracked.save("out")
"""

# pyright: reportUnknownMemberType=false
from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from poise.body.humanoid import make_humanoid
from poise.env import Acts, ImitationEnv, Reference
from poise.errors import PoiseError
from poise.eval import run_episodes
from poise.eval.rolloutset import judge
from poise.jobs.open import Run, open_run
from poise.jobs.perpetual.evaluation import evaluate_clips
from poise.jobs.runs import Evaluation, scored
from poise.jobs.track.crowd import Crowd, places
from poise.jobs.track.placement import Placed, place
from poise.jobs.track.points import fitted, follow, points_of
from poise.jobs.track.recovering import look_for, replay, sentence, with_returns
from poise.jobs.track.tracked import Clean, Tracked
from poise.jobs.tracker import Tracker
from poise.kin.fit import widen
from poise.metrics import mpjpe_global, success_rule
from poise.motion import Clip, ClipLibrary, read_clip
from poise.motion.io.raw import ReadOptions
from poise.motion.keypoints import Keypoints
from poise.motion.noise import Noise, perturb_clip, perturb_points
from poise.plan import SamplingConfig
from poise.recipes.imitation import Imitation
from poise.recipes.perpetual import task
from poise.settings import changed

#: Characters in one world.
MOST = 64
#: Which failure ends tracking: a mean distance of 0.5 m.
RULE = "phc"


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
        search: a motion that the policy loses is looked for, see `plan.sampling`; for one character.
        threads: cores of the search, 0 is all of them.
    """

    noise: tuple[Noise, ...] = ()
    seed: int = 0
    reset_on_fail: bool = False
    recover: bool = False
    smooth_hz: float | None = None
    count: int = 1
    search: SamplingConfig | None = None
    threads: int = 0

    def __post_init__(self) -> None:
        if not 1 <= self.count <= MOST:
            raise PoiseError(f"there can be 1 to {MOST} characters, got {self.count}")
        if self.recover and (self.reset_on_fail or self.count > 1):
            what = "several characters" if self.count > 1 else "one that is put back onto the motion"
            raise PoiseError(f"only a single character comes back by itself, not {what}")
        if self.search and (self.recover or self.reset_on_fail or self.count > 1):
            what = "several characters" if self.count > 1 else "one that comes or is put back"
            raise PoiseError(f"a motion is searched for a single character, not {what}")


def track(
    clip: Clip | Keypoints | str | Path,
    policy: Tracker | Run | str | Path | None = None,
    config: TrackConfig | None = None,
    *,
    search: bool | SamplingConfig = False,
    on_search: Callable[[int, int], None] | None = None,
    **settings: Any,
) -> Tracked:
    """Lets a trained policy do a motion that it need not know, without help and without training.

    The motion is tracked from its first frame to its last. Keypoints reach a policy with goals of
    keypoints frame by frame (`kin.retarget`); any other policy gets the clip that is fitted to them.

    Args:
        clip: a clip, keypoints, or a file; keypoints in a file stay keypoints.
        policy: a policy file, the folder of a run of poise train perpetual, or one that is open; by
            default the policy that comes with Poise.
        config: how it is tracked; `settings` are those that differ, such as recover=True or count=4.
        search: a motion that the policy loses is looked for by many characters at once.
        on_search: is told how many control steps of how many are searched.

    Raises:
        PoiseError: a motion that cannot be read, that no human makes or that is too short, or no such
            policy.
    """
    config = changed(config or TrackConfig(), settings)
    if search:
        how = search if isinstance(search, SamplingConfig) else SamplingConfig(seed=config.seed)
        config = replace(config, search=how)
    if isinstance(policy, Tracker):
        tracker = policy
    else:
        tracker = (policy if isinstance(policy, Run) else open_run(policy)).tracker
    motion = read_motion(clip)
    given, points = _input(motion, config)
    placed = place(given, tracker)
    imitation = imitation_of(tracker, [placed])
    notes = list(placed.notes)
    if points is not None:
        reference, said = follow(tracker, placed, points, imitation.reference, config.smooth_hz)
        imitation, notes = replace(imitation, reference=reference), [*notes, *said]
    goals = imitation.reference.pose.pos
    if config.count > 1:
        imitation = side_by_side(imitation, config.count)
    acts, losses, found = tracker.policy, None, None
    if config.search and loses(tracker, imitation):
        found = look_for(tracker, imitation, config.search, 0, config.threads, on_search)
        acts = replay(found, acts)
        notes.append(sentence(found, config.search, imitation.reference.rate_hz))
    if config.recover and (back := with_returns(tracker, placed, imitation)):
        placed, imitation, acts, losses = back
    all_of_them = torch.arange(config.count)
    starts, sim = torch.zeros_like(all_of_them), imitation.config.sim
    crowd = Crowd(imitation.humanoid, sim, config.count) if config.count > 1 else None
    env = imitation.env(1, None, False, 1, help_scale=0.0, guard=crowd is None, backend=crowd)
    if config.reset_on_fail:
        acts = Keeper(env, acts)
    rollouts, recordings = run_episodes(lambda _: env, acts, all_of_them, starts, cycles=1)
    about, rate = tracker.about, imitation.reference.rate_hz
    method = tracker.config.method + (", searched" if found else "")
    card = scored(rollouts, imitation, about, RULE, method)
    judged = judge(rollouts, success_rule(RULE))
    failed_at = cast("list[int]", judged.failed_at.tolist())
    failed = [(i, t) for i, t in enumerate(failed_at) if t >= 0]
    mended = acts.fallen if isinstance(acts, Keeper) else ()
    frames = sorted({*mended, *failed}, key=lambda x: (x[1], x[0]))
    clean = None
    if config.noise:
        seen = rollouts.pos[0], goals
        clean = _beside_clean(tracker, motion, judged.mask[0], *seen, config)
        notes.append(clean.sentence())
    if float(about.get("help_n", 0.0)) > 0:
        notes.append(
            f"The policy is that of an unfinished training that still helped by up to "
            f"{float(about['help_n']):.0f} N; here nothing helps."
        )
    evaluation = Evaluation(card, rollouts, recordings)
    times = tuple((character, frame / rate) for character, frame in frames)
    if losses is not None:
        times = tuple((0, t) for t in losses.lost)
    return Tracked(tracker, imitation, evaluation, placed, times, clean, tuple(notes), losses, found)


def loses(tracker: Tracker, imitation: Imitation) -> bool:
    """Whether the policy alone loses a task's first motion."""
    first = torch.zeros(1, dtype=torch.long)
    results = evaluate_clips(imitation, tracker.policy, first, 0.0, 1)
    return not bool(results.succeeded)


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


class Keeper:
    """A policy that puts characters back onto the reference before it acts, where they failed.

    Attributes:
        fallen: (world, frame) of every failure that it mended.
    """

    def __init__(self, env: ImitationEnv, policy: Acts):
        self.env, self.policy = env, policy
        sizes = (getattr(policy, name, getattr(env, name)) for name in ("num_obs", "num_actions"))
        self.num_obs, self.num_actions = sizes
        self.fallen: list[tuple[int, int]] = []
        self._limit_mm = success_rule(RULE).limit_m * 1000.0

    def act(self, obs: Tensor) -> Tensor:
        """Mean actions `(N, A)` for observations `(N, O)` of the worlds as they stand."""
        env = self.env
        failed = ~(mpjpe_global(env.pose().pos, env.goal_pose().pos) <= self._limit_mm)
        if bool(failed.any()):
            obs = self._mend(env, failed, obs)
        return self.policy.act(obs)

    def _mend(self, env: ImitationEnv, failed: Tensor, obs: Tensor) -> Tensor:
        rows = failed.nonzero().flatten()
        self.fallen += [(int(i), int(env.frame[i])) for i in rows]
        clip, frame, before = env.clip.clone(), env.frame.clone(), env.backend.snapshot()
        fresh = env.reset_to(clip, frame)
        others = (~failed).nonzero().flatten()
        if len(others):
            # Starting anew is for all worlds at once; the others go on from where they were.
            env.backend.restore(before[others], others)
        return torch.where(failed[:, None], fresh, obs)


def read_motion(clip: Clip | Keypoints | str | Path) -> Clip | Keypoints:
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
