"""A policy goes on to learn the one motion that it loses, or is helped as weakly as suffices."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import torch

from poise.env import Reference
from poise.jobs.open import policy_of_run
from poise.jobs.perpetual.evaluation import evaluate_clips
from poise.jobs.perpetual.perpetual_run import PerpetualResult, begin, going_on, train
from poise.jobs.perpetual.stages import Progress
from poise.jobs.result import RULE, Result, needs_of
from poise.jobs.run_file import RUN_FILE, read_run
from poise.jobs.runs import evaluate
from poise.jobs.track.placement import PlacedMotion, place
from poise.jobs.track.surroundings import Wanted, with_supports
from poise.jobs.track.tracking import BESIDE, brought_home, imitation_of, with_guide
from poise.jobs.tracker import Tracker
from poise.jobs.warm_start import widened
from poise.kinematics.repair.estimate import clean_clip
from poise.learn import LATEST, PolicyBundle, Until
from poise.metrics import success_rule
from poise.motion import Clip, ClipLibrary
from poise.motion.rotations import GRAVITY
from poise.recipes.imitation import Imitation
from poise.recipes.perpetual_settings import Perpetual, config_of
from poise.score import ClipResults
from poise.score.rollouts import judge

#: Shares of the body's weight that are tried as help, from the least on.
SHARES = (0.15, 0.3, 0.6, 1.2, 2.4)
#: Start frames from which the help is to suffice.
STARTS = 16
#: Where in the training the help has ended at the latest, and the noise on the residual action beside
#: the hand that leads, in units of the limit.
ENDS, NOISE = 0.6, 0.02


def helped(config: Perpetual, newtons: float) -> Perpetual:
    """The settings with help that begins with so many N and N m, and fades."""
    return replace(config, help_start=newtons, help_share=ENDS, residual_std=NOISE)


def enough(
    imitation: Imitation, policy: PolicyBundle, scales: Sequence[float], starts: int, threads: int = 0
) -> tuple[float, ClipResults] | None:
    """The first of some shares of a task's help with which a policy does its motion from so many start
    frames, and how it does; None where none suffices."""
    first = torch.zeros(1, dtype=torch.long)
    for scale in scales:
        results = evaluate_clips(imitation, policy, first, scale, threads, starts=starts)
        if bool(results.succeeded.all()):
            return scale, results
    return None


#: Worlds, samples of a gradient step, and iterations from one evaluation to the next: a motion of
#: seconds has fewer hard motion bins than a library.
WORLDS, MINIBATCH, EVERY = 512, 2048, 5
#: Step size, which stays: one that follows the KL divergence shrinks where much is to be learned.
STEP = 1e-4
#: Shares of the help that a policy learned with, of which the least is left that suffices.
LEFT = (0.1, 0.2, 0.35, 0.5, 0.75, 1.0)
#: Evaluations without success after which training would end by itself.
NEVER = 1_000_000


class LearnedMotion(NamedTuple):
    """The policy that knows the motion, as far as it came, and how its run ended."""

    tracker: Tracker
    result: PerpetualResult


def settings(policy: Perpetual, seed: int = 0, starts: int = 1) -> Perpetual:
    """The policy's own settings, for one motion; without prices on rough motion, since one that is quick
    or flies is found by rough tries."""
    config = going_on(policy, Perpetual(num_envs=WORLDS, seed=seed, recovery=False))
    ppo = replace(config.ppo, minibatch=MINIBATCH, policy_lr=STEP, kl_target=None, smooth_weight=0.0)
    # One motion is lost or not: that is no curve by which to tell that nothing is gained any more.
    convergence = replace(config.convergence, patience=NEVER)
    config = replace(config, ppo=ppo, convergence=convergence, teacher=None, cooling=0.0)
    return replace(config, acceleration=0.0, evaluate_every=EVERY, starts=starts)


def learn(
    tracker: Tracker,
    placed: PlacedMotion,
    folder: Path,
    until: Until,
    on_iteration: Callable[[Progress], bool | None] | None = None,
    threads: int = 0,
    seed: int = 0,
    starts: int = 1,
    device: str = "cpu",
    supports: Wanted = "auto",
    help_n: float = 0.0,
) -> LearnedMotion:
    """Trains until the motion is tracked from its first frame to its last, or a limit is reached.

    A policy that knows a thousand motions begins by following most of the next one.

        tracked = track(clip, tracker)
        if tracked.failures:
            until = Until(minutes=10)
            tracker = learn(tracker, tracked.placed, Path("out/learned"), until).tracker

    Args:
        folder: of the run, `perpetual_run`; one that holds a run of this motion is gone on with.
        on_iteration, threads, device: see `perpetual_run.train`.
        starts: the motion is to be tracked from so many frames, evenly spread, see `Perpetual.starts`.
        supports: see `TrackConfig`.
        help_n: N and N m, with which a hand leads the root at first, see `with_guide`; a run that is
            gone on with has its own.

    Raises:
        PoiseError: a policy of primitives, which cannot go on, or a folder with another run.
    """
    # Its noise went before it was placed.
    clip = placed.level.onto(clean_clip(placed.clip, raw=True)[0]).replaced(cyclic=False)
    held = help_of(folder) if (folder / RUN_FILE).exists() else help_n
    config = settings(tracker.config, seed, starts)
    config = helped(config, held) if held else config
    imitation = begin(folder, ClipLibrary.of(clip), config, clip.name, device, tracker)
    # Exactly what `track` will ask of the policy, on the same body.
    body, rate = imitation.humanoid, config.sim.control_hz
    qpos = place(placed.source, replace(tracker, humanoid=body)).qpos
    imitation = replace(imitation, reference=Reference(body, [qpos], rate, imitation.library.names))
    imitation = with_guide(with_supports(imitation, supports, placed)[1])
    # The critic goes on as well: it knows what a state is worth.
    trained = None if (folder / LATEST).exists() else widened(tracker, imitation, 0)
    result = train(imitation, folder, until, on_iteration, threads, False, device, trained=trained)
    # It tracks its recovery motions as before, or nearly; where bones are a clip's own there are none.
    learned = policy_of_run(read_run(folder))
    learned = replace(learned, recovery_clips=tracker.recovery_clips, onto=tracker.onto)
    return LearnedMotion(learned, result)


def help_of(folder: Path) -> float:
    """The help with which the run in a folder began, N and N m; 0 without any."""
    return config_of(read_run(folder).meta["config"], folder).help_start


def help_wanted(tracker: Tracker, placed: PlacedMotion, seed: int = 0, threads: int = 0) -> float | None:
    """The least of some amounts of help, N, with which the policy does a motion from all over; None
    where none suffices."""
    config = settings(tracker.config, seed)
    for share in SHARES:
        newtons = share * GRAVITY * tracker.humanoid.mass
        own = replace(tracker, config=helped(config, newtons), recovery_clips=None)
        task = with_guide(with_supports(imitation_of(own, [placed]), "auto", placed)[1])
        dims = 0 if task.task.residual is None else task.task.residual.dims
        policy = tracker.policy.with_actions(tracker.policy.num_actions + dims)
        if enough(task, policy, (1.0,), STARTS, threads):
            return newtons
    return None


def from_every_start(tracker: Tracker, source: Clip, device: str = "cpu", help_n: float = 0.0) -> Result:
    """A motion as the policy alone does it from every start frame: `Result.card` is that of all.

    The failures are those of the episode from the first frame, which is the motion that is delivered.

    help_n: N and N m that a hand may lead the root with, for a policy that learned with such help.

    Raises:
        PoiseError: see `place`.
    """
    placed = place(source, tracker)
    supports, task = with_supports(imitation_of(tracker, [placed]), "auto", placed)
    task = with_guide(task) if help_n else task
    done = evaluate(task, tracker.policy, {**tracker.about, "help_limit": help_n}, device=device)
    done = replace(
        done, card=replace(done.card, needs=tuple(n.to_dict() for n in needs_of(task, supports)))
    )
    failed = judge(done.rollouts, success_rule(RULE)).failed_at[done.recordings[0].row].item()
    lost = ((0, failed / task.reference.rate_hz),) if failed >= 0 else ()
    notes = (*placed.notes, *(s.sentence() for s in supports))
    return Result(
        task,
        done,
        tracker,
        placed,
        notes,
        failures=lost,
        supports=supports,
        ways=(brought_home(),),
        beside=BESIDE,
    )


def with_help(tracker: Tracker, source: Clip, device: str = "cpu") -> Result | None:
    """The same with the least of some shares of the help that the policy learned with, by which it does
    the motion from its first frame; None where none suffices."""
    placed, most = place(source, tracker), tracker.config.help_start
    task = with_guide(with_supports(imitation_of(tracker, [placed]), "auto", placed)[1])
    found = enough(task, tracker.policy, LEFT, 1)
    return None if found is None else from_every_start(tracker, source, device, found[0] * most)
