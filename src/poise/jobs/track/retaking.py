"""A part of a motion simulated anew: from the stored state, and back into the written motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from poise.env import Acts, ImitationEnv, Reference
from poise.env.recovery.get_up import mixed
from poise.errors import PoiseError
from poise.formats import read_clip
from poise.jobs.result import RULE, Result, Way
from poise.jobs.track.controllers import Show, StepProgress, TrackingRun, drawing, episode, look_ahead
from poise.jobs.track.recovery_run import ReplayActions
from poise.jobs.track.simulation import FILE, Retake, Simulation, States
from poise.jobs.track_settings import TrackConfig
from poise.jobs.tracker import Tracker
from poise.kinematics.travel import travelled
from poise.metrics import has_lost, mpjpe_global, success_rule
from poise.motion import Clip
from poise.motion.rotations import slerp
from poise.plan import Lookahead
from poise.plan.lookahead import PAST
from poise.recipes.imitation import Imitation
from poise.score import simulate
from poise.score.rollouts import judge

#: s over which the goal becomes the earlier simulation, for which that is followed at most, and over
#: which the two fade into each other.
LEAD_S, SETTLE_S, FADE_S = 0.3, 1.0, 0.4
#: mm of distance that a second of waiting for a better moment is worth.
PATIENCE_MM = 20.0
#: Cost per metre of distance in a control step that leads back, beside the reward.
PRICE = 120.0
#: Seeds that are tried where a part is lost.
TRIES = 3


class Segment(NamedTuple):
    """What was simulated anew.

    Attributes:
        made: from the part's first frame on.
        first: that frame.
        joined: the frame from which it fades into the earlier simulation; None where it does not.
        apart_mm: mean distance of the two while they fade.
    """

    made: Simulation
    first: int
    joined: int | None
    apart_mm: float


def retaken(
    retake: Retake,
    tracker: Tracker,
    imitation: Imitation,
    config: TrackConfig,
    _: ReplayActions | None = None,
    show: Show | None = None,
    prices: Tensor | None = None,
) -> tuple[TrackingRun, Sequence[str]]:
    """Does a part of a task's motion anew, and the rest as it was done; sentences on that.

    The character begins in the stored state of the part's first frame and follows the motion. Toward the
    part's end its goal becomes the earlier simulation, which the character then follows for a while. The
    new simulation fades into the earlier one where the two are nearest.

    Raises:
        PoiseError: the earlier result is of another motion or body, the part lies outside of it, or no
            seed does it.
    """
    rate, ref = imitation.reference.rate_hz, imitation.reference
    before = retake.opened()
    before.check(imitation.humanoid, int(ref.length[0]), rate)
    first, last = part_of(before, retake)
    goals, taken = _goals(imitation, before, last), 0
    for k in range(TRIES):
        how = replace(config, seed=config.seed + k)
        taken = _take(tracker, goals, how, before, first, last, show, prices)
        if isinstance(taken, Segment):
            break
    if not isinstance(taken, Segment):
        raise PoiseError(
            f"the part from {first / rate:.1f} s on was lost at {taken / rate:.1f} s with {TRIES} seeds",
            hint="Widen --range, raise --budget, or track the whole motion",
            code="motion-lost",
        )
    whole = _joined(before, taken, rate)
    return _played(imitation, config, whole), [_sentence(taken, before, first, last, rate)]


def part_of(before: Simulation, retake: Retake) -> tuple[int, int]:
    """The first and last frame of a part; a motion that was lost is done anew to its end.

    Raises:
        PoiseError: it lies beyond the motion's end, or it begins where the motion was lost.
    """
    rate = before.rate_hz
    first, last = round(retake.first_s * rate), round(retake.last_s * rate)
    end = before.frames - 1
    if first > end - 2:
        raise PoiseError(
            f"the range begins at {retake.first_s:g} s and the motion ends at {end / rate:.2f} s",
            code="range-beyond-end",
        )
    if before.lost is not None and first >= before.lost:
        raise PoiseError(
            f"the range begins at {retake.first_s:g} s, where the motion was already lost, at "
            f"{before.lost / rate:.1f} s",
            hint="Begin the range before that",
            code="range-after-loss",
        )
    return first, (end if before.lost is not None else min(max(last, first + 1), end))


def _goals(imitation: Imitation, before: Simulation, last: int) -> Imitation:
    """The task with a goal that becomes the earlier simulation toward frame `last`."""
    ref = imitation.reference
    lead = max(1, round(LEAD_S * ref.rate_hz))
    share = eased((torch.arange(before.frames).double() - (last - lead)) / lead)
    if before.lost is not None:
        share = torch.zeros_like(share)
    qpos = mixed(ref.qpos[: before.frames], before.qpos, share)
    made = Reference(ref.humanoid, [qpos.numpy()], ref.rate_hz, ref.names)
    return replace(imitation, reference=made)


def _take(
    tracker: Tracker,
    goals: Imitation,
    config: TrackConfig,
    before: Simulation,
    first: int,
    last: int,
    show: Show | None,
    prices: Tensor | None,
) -> Segment | int:
    """Simulates a part; or the frame at which it was lost."""
    rate, end = before.rate_hz, before.frames - 1
    settle, fade = round(SETTLE_S * rate), max(2, round(FADE_S * rate))
    joins = before.lost is None and last + fade < end
    stop = min(last + settle + fade, end) if joins else end
    env = goals.env(1, None, False, 1, help_scale=0.0)
    acts: Acts = tracker.policy
    if config.looks_ahead and tracker.value is not None:
        if joins:
            prices = (
                torch.zeros(*goals.reference.pose.pos.shape[:2]) if prices is None else prices.clone()
            )
            prices[last:] += PRICE / prices.shape[1]
        acts = look_ahead(tracker, goals, config.lookahead, config.threads, config.seed, prices)
        acts.watch(env)
    try:
        obs = _set_down(env, before, first)
        if isinstance(acts, Lookahead):
            acts.remember(0, goals.reference.poser(*_rows(before, max(0, first - PAST), first)).pos)
        seen, lost = States(), _Lost(first)
        told = [] if show is None else [StepProgress("looking ahead", stop - first, show)]
        simulate(env, acts, obs, stop - first, seen, lost, *told, *drawing(show, first))
    finally:
        env.close()
        if isinstance(acts, Lookahead):
            acts.copies.close()
    if lost.frame is not None:
        return lost.frame
    made = seen.simulation(goals.humanoid, rate, None)
    if not joins:
        return Segment(made, first, None, 0.0)
    # The mean distance over each window in which the one may fade into the other.
    pose = goals.reference.poser
    own, old = pose(made.qpos, made.qvel).pos, pose(*_rows(before, first, stop + 1)).pos
    apart = mpjpe_global(own[last - first :], old[last - first :])
    windows = apart.unfold(0, fade + 1, 1).mean(1)
    waits = torch.arange(len(windows)) / rate * PATIENCE_MM
    best = int((windows + waits).argmin())
    return Segment(made, first, last + best, float(windows[best]))


def _rows(before: Simulation, first: int, end: int) -> tuple[Tensor, Tensor]:
    return before.qpos[first:end], before.qvel[first:end]


def _set_down(env: ImitationEnv, before: Simulation, frame: int) -> Tensor:
    """The character as it was at a frame; observations."""
    zero = torch.zeros(1, dtype=torch.long)
    env.reset_to(zero, zero + frame)
    _write(env, before, frame)
    env.age[:] = frame
    if frame:
        env.action[:] = before.action[frame - 1].to(env.action)
    return env.observe()


def _write(env: ImitationEnv, simulation: Simulation, frame: int) -> None:
    state = env.backend.state
    here = (getattr(simulation, name)[frame : frame + 1] for name in ("qpos", "qvel"))
    env.backend.write(None, *(x.to(state.qpos) for x in here))


@dataclass(eq=False)
class _Lost:
    """Observes whether the goal is lost. first: the frame of the first step. frame: where it was."""

    first: int
    frame: int | None = None

    def see(self, env: ImitationEnv, step: int) -> bool:
        """Looks at control step `step`; True: it is lost."""
        lost = has_lost(env.pose().pos, env.goal_pose().pos)
        if self.frame is None and bool(lost.any()):
            self.frame = self.first + step
        return self.frame is not None


def _joined(before: Simulation, taken: Segment, rate: float) -> Simulation:
    """The whole motion, one simulation fading into the other."""
    made, first = taken.made, taken.first
    if taken.joined is None:
        parts = {k: torch.cat((getattr(before, k)[:first], getattr(made, k)))
                 for k in ("qpos", "qvel", "action")}  # fmt: skip
        return replace(before, **parts, lost=None)
    fade = max(2, round(FADE_S * rate))
    end = taken.joined + fade
    share = eased((torch.arange(first, end + 1) - taken.joined).double() / fade)
    rows, own = slice(first, end + 1), slice(0, end + 1 - first)
    qpos, qvel, action = (getattr(before, k).clone() for k in ("qpos", "qvel", "action"))
    # The ends of the part are as they were, to the last bit.
    inner = slice(first + 1, end)
    qpos[inner] = mixed(made.qpos[own], before.qpos[rows], share)[1:-1]
    qvel[rows] = torch.lerp(made.qvel[own], before.qvel[rows], share.unsqueeze(1))
    steps = slice(first, end)
    kept = share[:-1].to(action).unsqueeze(1)
    action[steps] = torch.lerp(made.action[: end - first], before.action[steps], kept)
    return replace(before, qpos=qpos, qvel=qvel, action=action)


def _played(imitation: Imitation, config: TrackConfig, whole: Simulation) -> TrackingRun:
    """One episode in which the character is in every frame as a simulation has it."""
    by = "lookahead" if config.looks_ahead else "policy"
    done = episode(imitation, config, _Player(whole), by)
    pose = imitation.reference.poser(whole.qpos, whole.qvel)
    pos, quat = done.rollouts.pos.clone(), done.rollouts.quat.clone()
    pos[0, : whole.frames], quat[0, : whole.frames] = pose.pos, pose.quat
    rollouts = replace(done.rollouts, pos=pos, quat=quat)
    recording = replace(done.recordings[0], qpos=whole.qpos.numpy().copy())
    judged = judge(rollouts, success_rule(RULE))
    failed = [(i, t) for i, t in enumerate(judged.failed_at.tolist()) if t >= 0]
    lost = failed[0][1] if failed else None
    return done._replace(
        rollouts=rollouts, recordings=[recording], judged=judged, failures=failed,
        simulation=replace(whole, lost=lost),
    )  # fmt: skip


class _Player:
    """Puts the character where it was before each step, and acts as it did then."""

    def __init__(self, whole: Simulation):
        self.whole, self.step = whole, 0
        self.env: ImitationEnv | None = None

    def watch(self, env: ImitationEnv) -> None:
        """Acts in `env` from now on."""
        self.env, self.step = env, 0

    def act(self, obs: Tensor) -> Tensor:
        """The next action `(1, A)`; nothing is observed."""
        assert self.env is not None
        _write(self.env, self.whole, self.step)
        action = self.whole.action[self.step : self.step + 1]
        self.step += 1
        return self.env.unfiltered(action.to(self.env.action))


def eased(share: Tensor) -> Tensor:
    """0 to 1 along a curve that begins and ends with speed and acceleration 0."""
    s = share.clamp(0.0, 1.0)
    return s**3 * (s * (6.0 * s - 15.0) + 10.0)


def _sentence(taken: Segment, before: Simulation, first: int, last: int, rate: float) -> str:
    said = f"From {first / rate:.2f} s to {last / rate:.2f} s the motion was simulated anew"
    if before.lost is not None:
        return f"{said}, since the earlier one was lost at {before.lost / rate:.1f} s."
    if taken.joined is None:
        return f"{said}, to its end."
    begin, fade = taken.joined / rate, max(2, round(FADE_S * rate)) / rate
    return (
        f"{said}; from {begin:.2f} s to {begin + fade:.2f} s it fades into the earlier one, of which it "
        f"is {taken.apart_mm:.0f} mm off there."
    )


#: s over which the part takes over and gives back, within it.
TAKES_S = 0.2


def changed_s(before: Simulation, now: Simulation) -> tuple[float, float]:
    """The last moment before two simulations of a motion differ, and the first after it, s."""
    other = (before.qpos != now.qpos).any(1).nonzero()[:, 0]
    if not len(other):
        return 0.0, 0.0
    return (float(other[0]) - 1.0) / now.rate_hz, (float(other[-1]) + 1.0) / now.rate_hz


def spliced(before: Clip, now: Clip, span: tuple[float, float]) -> Clip:
    """The frames of `before`, and of `now` within a span, s, into which and out of which they pass."""
    if before.frames != now.frames:
        return now
    first, last = span
    t = torch.arange(now.frames, dtype=torch.float64) / now.fps
    takes = max(min(TAKES_S, (last - first) / 3), 1e-9)
    # What is simulated to its end has nothing to give back to.
    ends = torch.full_like(t, torch.inf) if last >= float(t[-1]) else last - t
    share = eased(torch.minimum(t - first, ends) / takes)
    old, new = before.tensors(), now.tensors()
    root = torch.lerp(old[0], new[0], share[:, None])
    rot = slerp(old[1], new[1], share[:, None].expand(-1, len(now.skeleton)))
    kept = share == 0.0
    root[kept], rot[kept] = old[0][kept], old[1][kept]
    return now.replaced(root_pos=root.numpy(), rot=rot.numpy())


def as_it_was(retake: Retake) -> Way:
    """A step of the way home: all that was not simulated anew is as it was written, or would be."""

    def way(result: Result, motion: Clip, hold: bool) -> Clip:
        before, recordings, travel = retake.opened(), result.evaluation.recordings, result.travel
        assert result.simulation is not None
        span = changed_s(before, result.simulation)
        earlier = None
        if hold and not isinstance(retake.of, Simulation):
            earlier = written_as(Path(retake.of), motion)
            if earlier is not None and travel is not None and not travel.travels:
                earlier = travelled(earlier, travel.travel)
        if earlier is None:
            was = [replace(recordings[0], qpos=before.qpos.numpy())]
            ways = tuple(w for w in result.ways if w is not way)
            whole = replace(result.evaluation, recordings=was)
            earlier = replace(result, evaluation=whole, ways=ways, travel=None).delivered(0, hold)
        return spliced(earlier, motion, span)

    return way


def written_as(folder: Path, like: Clip) -> Clip | None:
    """The motion in a result's folder, as it was written; None where there is none with the skeleton
    and the frames of `like`."""
    files = sorted(folder.glob("simulated.*")) if folder.is_dir() else []
    if len(files) != 1:
        return None
    try:
        clip = read_clip(files[0])
    except PoiseError:
        return None
    same = clip.skeleton.same_bones(like.skeleton) and clip.frames == like.frames
    return like.replaced(root_pos=np.array(clip.root_pos), rot=np.array(clip.rot)) if same else None


def write_simulation(result: Result, out: Path, _motion: Path, _hold: bool) -> dict[str, Path]:
    """Writes the states of a result into its folder, where it has some."""
    (out / FILE).unlink(missing_ok=True)
    if result.simulation is None:
        return {}
    result.simulation.save(out / FILE)
    return {"simulation": out / FILE}
