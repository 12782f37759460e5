"""Controllers that do a motion, and the choice among several attempts."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple, Protocol, runtime_checkable

import numpy as np
import torch
from torch import Tensor

from poise.body import Humanoid
from poise.env import Acts, ImitationEnv
from poise.errors import PoiseError
from poise.jobs.perpetual.evaluation import evaluate_clips
from poise.jobs.result import RULE, merit
from poise.jobs.track.placement import PlacedMotion
from poise.jobs.track.pushed import ForcesSeen, HeldEffect, Pushed, unforeseen
from poise.jobs.track.recovery_run import RecoveryRun, ReplayActions, helped, led_along, look_for, replay
from poise.jobs.track.simulation import Simulation, States
from poise.jobs.track.surroundings import crowd
from poise.jobs.tracker import Tracker
from poise.metrics import has_lost, success_rule
from poise.plan import Lookahead, LookaheadConfig, SamplingConfig, SamplingResult
from poise.recipes.imitation import Imitation
from poise.score import run_episodes
from poise.score.episodes import ContactForces, Recording
from poise.score.rollouts import EpisodeOutcomes, RolloutSet, judge

if TYPE_CHECKING:
    from poise.jobs.track_settings import TrackConfig


#: Is told what is done, and how many control steps of how many are done.
Show = Callable[[str, int, int], None]


@runtime_checkable
class DrawsSteps(Protocol):
    """A `Show` that draws the character as it is simulated."""

    def __call__(self, what: str, done: int, of: int) -> None:
        """See `Show`."""
        ...

    def begin(self, humanoid: Humanoid, placed: PlacedMotion, frames: int, rate_hz: float) -> None:
        """Told of the body, of its motion, and of how many control steps at which rate are to come."""
        ...

    def draw(self, frame: int, qpos: np.ndarray) -> None:
        """Told of a state `(7 + n)`; the frames of a new attempt begin anew."""
        ...


#: What is said where a policy cannot look ahead.
NO_CRITIC = "The policy was saved without its critic, which lookahead needs; it acts without."


class TrackingRun(NamedTuple):
    """How a motion was done.

    Attributes:
        rollouts, recordings: the episode, see `run_episodes`.
        judged: by the field's rule.
        failures: (character, frame) of each failure in the order of time.
        controller: which did it: "policy", "lookahead" or "search".
        found: what the search came to; None where nothing was searched.
        simulation: the states of the episode, of a single character; None of several.
        forces: what came of each push and held thing.
    """

    rollouts: RolloutSet
    recordings: list[Recording]
    judged: EpisodeOutcomes
    failures: list[tuple[int, int]]
    controller: str
    found: SamplingResult | None = None
    simulation: Simulation | None = None
    forces: tuple[Pushed | HeldEffect, ...] = ()


def done_by(
    tracker: Tracker,
    imitation: Imitation,
    config: TrackConfig,
    replayed: ReplayActions | None = None,
    show: Show | None = None,
    prices: Tensor | None = None,
) -> tuple[TrackingRun, Sequence[str]]:
    """Does a task's motion with the controller that is wanted, or whatever it takes.

    Args:
        prices: what counts more, see `Lookahead`.
        replayed: actions that were made already; nothing else is tried then.

    Returns:
        how it was done, and sentences on that.
    """
    notes: list[str] = []
    if replayed is not None:
        return episode(imitation, config, replayed, replayed.by), notes
    if config.looks_ahead and tracker.value is None:
        notes.append(NO_CRITIC)
    if config.looks_ahead and tracker.value is not None:
        ahead = look_ahead(tracker, imitation, config.lookahead, config.threads, config.seed, prices)
        try:
            done = episode(imitation, config, ahead, "lookahead", show)
        finally:
            ahead.copies.close()
        alone = config.count == 1 and not config.forced
        if alone and not done.failures and loses(tracker, imitation):
            notes.append("The policy alone loses the motion.")
    else:
        # It takes moments; only who draws it is told.
        done = episode(imitation, config, tracker.policy, "policy", draws_of(show))
    if config.searches and done.failures:
        how = replace(config.search, seed=config.seed)
        told = show and (lambda made, steps: show("searching", made, steps))
        found = look_for(tracker, imitation, how, 0, config.threads, told)
        # What was found is judged as it is played again, as the score card does.
        again = episode(imitation, config, replay(found, tracker.policy), "search")
        done, earlier = max(done, again, key=lambda x: merit(x.rollouts)), done
        rate_hz, leads = imitation.reference.rate_hz, config.help_limit > 0
        notes.append(searched(again, earlier, done, found, how, rate_hz, leads))
        done = done._replace(found=found)
    return done, notes


def searched(
    again: TrackingRun,
    earlier: TrackingRun,
    kept: TrackingRun,
    found: SamplingResult,
    config: SamplingConfig,
    rate_hz: float,
    helped: bool = False,
) -> str:
    """What a search came to, and what is kept of it.

    Args:
        again: what was found, played again. earlier: what was done before it. kept: one of the two.
        helped: whether a hand led the root.
    """
    said = (
        f"The motion was lost; {config.characters} characters looked for it, {found.tries:,} control "
        f"steps, {'with' if helped else 'without'} help, and"
    )
    if not again.failures:
        return f"{said} found it to its end."
    came, by = (f"{d.failures[0][1] / rate_hz:.1f} s" for d in (again, earlier))
    if kept is again:
        return f"{said} came as far as {came}."
    return f"{said} came as far as {came}; what was done before came to {by} and is kept."


def led_by(
    tracker: Tracker,
    placed: Sequence[PlacedMotion],
    imitation: Imitation,
    config: TrackConfig,
    show: Show | None = None,
) -> tuple[RecoveryRun, Sequence[str]]:
    """Does motions one after another, see `led_along`, with lookahead where that is wanted.

    Returns:
        what came of them, and sentences on that.
    """
    told = show and (lambda made, steps: show("tracking", made, steps))
    if not config.looks_ahead or tracker.value is None:
        led = led_along(tracker, placed, imitation, config.recover, None, told)
        return led, [NO_CRITIC] if config.looks_ahead else []
    ahead = look_ahead(tracker, imitation, config.lookahead, config.threads, config.seed)
    told = show and (lambda made, steps: show("looking ahead", made, steps))
    try:
        led = led_along(tracker, placed, imitation, config.recover, ahead, told)
    finally:
        ahead.copies.close()
    return led._replace(replayed=replace(led.replayed, by="lookahead")), []


def look_ahead(
    tracker: Tracker, imitation: Imitation, config: LookaheadConfig, threads: int = 0, seed: int = 0,
    prices: Tensor | None = None,
) -> Lookahead:  # fmt: skip
    """The tracker's policy with lookahead in copies of a character of a task, without help.

    Args:
        threads: of the physics of the copies; 0 is all cores.
        seed: takes the place of the settings' own.
        prices: see `Lookahead`.

    Raises:
        PoiseError: the policy has no critic.
    """
    if tracker.value is None:
        raise PoiseError(
            "the policy was saved without its critic, which lookahead needs", code="critic-missing"
        )
    # Copies that lose the motion may go bad; they are left behind.
    copies = (
        unforeseen(imitation)
        .bare(rewards=True)
        .env(
            config.candidates,
            auto_reset=False,
            threads=threads,
            help_scale=helped(imitation),
            guard=False,
        )
    )
    return Lookahead(copies, tracker.policy, tracker.value, replace(config, seed=seed), prices)


def loses(tracker: Tracker, imitation: Imitation) -> bool:
    """Whether the policy alone loses a task's first motion."""
    first = torch.zeros(1, dtype=torch.long)
    results = evaluate_clips(imitation, tracker.policy, first, helped(imitation), 1)
    return not bool(results.succeeded)


def episode(
    imitation: Imitation, config: TrackConfig, acts: Acts, controller: str, show: Show | None = None
) -> TrackingRun:
    """One episode of all characters, each from its first frame."""
    count, task = config.count, imitation
    every = torch.arange(count)
    rows = crowd(task.humanoid, task.config.sim, count) if count > 1 else None
    env = task.env(1, None, False, 1, help_scale=helped(task), backend=rows)
    if callable(watch := getattr(acts, "watch", None)):
        watch(env)
    keeper = ResetOnFail(env, acts) if config.reset_on_fail else None
    starts = torch.zeros_like(every)
    what = "tracking" if controller == "policy" else "looking ahead"
    told = [] if show is None else [StepProgress(what, int(task.reference.length[0]) - 1, show)]
    # The report shows one character.
    touched, states = ContactForces(), States()
    forces = ForcesSeen() if config.forced else None
    observers = [*told, *drawing(show), touched, states] if count == 1 else told
    observers += [] if forces is None else [forces]
    rollouts, recordings = run_episodes(
        lambda _: env, keeper or acts, every, starts, config.help_limit, 1, observers
    )
    if count == 1:
        seen = touched.frames if forces is None else forces.arrows
        recordings[0] = replace(recordings[0], contacts=tuple(seen))
    judged = judge(rollouts, success_rule(RULE))
    failed = [(i, t) for i, t in enumerate(judged.failed_at.tolist()) if t >= 0]
    mended = keeper.fallen if keeper is not None else ()
    frames = sorted({*mended, *failed}, key=lambda x: (x[1], x[0]))
    rate, lost = task.reference.rate_hz, frames[0][1] if frames else None
    kept = states.simulation(task.humanoid, rate, lost) if count == 1 else None
    came = () if forces is None else forces.came(task.humanoid, rate)
    return TrackingRun(rollouts, recordings, judged, frames, controller, simulation=kept, forces=came)


class StepProgress:
    """Tells how many control steps of an episode are done."""

    def __init__(self, what: str, steps: int, show: Show):
        self.what, self.steps, self.show = what, steps, show

    def see(self, env: ImitationEnv, step: int) -> bool:
        """Tells of control step `step`; it never needs more of them."""
        self.show(self.what, step, self.steps)
        return True


class StepDrawing:
    """Draws the first character at each control step of an episode that begins at frame `first`."""

    def __init__(self, draws: DrawsSteps, first: int = 0):
        self.draws, self.first = draws, first

    def see(self, env: ImitationEnv, step: int) -> bool:
        """Draws control step `step`; it never needs more of them."""
        self.draws.draw(self.first + step, env.backend.state.qpos[0].detach().cpu().numpy())
        return True


def drawing(show: Show | None, first: int = 0) -> list[StepDrawing]:
    """Who draws an episode from frame `first` on, if anybody does."""
    draws = draws_of(show)
    return [] if draws is None else [StepDrawing(draws, first)]


def draws_of(show: Show | None) -> DrawsSteps | None:
    """Who is told, if it draws."""
    return show if isinstance(show, DrawsSteps) else None


class ResetOnFail:
    """A policy that puts characters back onto the reference before it acts, where they failed.

    Attributes:
        fallen: (world, frame) of every failure that it mended.
    """

    def __init__(self, env: ImitationEnv, policy: Acts):
        self.env, self.policy = env, policy
        sizes = (getattr(policy, name, getattr(env, name)) for name in ("num_obs", "num_actions"))
        self.num_obs, self.num_actions = sizes
        self.fallen: list[tuple[int, int]] = []

    def act(self, obs: Tensor) -> Tensor:
        """Mean actions `(N, A)` for observations `(N, O)` of the worlds as they stand."""
        env = self.env
        failed = has_lost(env.pose().pos, env.goal_pose().pos)
        if bool(failed.any()):
            obs = self._mend(env, failed, obs)
        return self.policy.act(obs)

    def _mend(self, env: ImitationEnv, failed: Tensor, obs: Tensor) -> Tensor:
        rows = failed.nonzero().flatten()
        self.fallen += [(int(i), int(env.frame[i])) for i in rows]
        clip, frame, before = env.clip.clone(), env.frame.clone(), env.backend.snapshot()
        action, age = env.action.clone(), env.age.clone()
        fresh = env.reset_to(clip, frame)
        others = (~failed).nonzero().flatten()
        if len(others):
            # Starting anew is for all worlds at once; the others go on from where they were.
            env.backend.restore(before[others], others)
            env.action[others], env.age[others] = action[others], age[others]
        return torch.where(failed[:, None], fresh, obs)
