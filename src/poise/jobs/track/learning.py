"""A policy goes on to learn the one motion that it loses.

    tracked = track(clip, tracker)
    if tracked.failures:
        tracker = learn(tracker, tracked.placed, Path("out/learned"), minutes=10)

What a policy knows of a thousand motions makes the next one cheap: it begins by following most of it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from poise.env import Reference
from poise.jobs.perpetual.result import PerpetualResult
from poise.jobs.perpetual.run import begin, going_on, train
from poise.jobs.perpetual.stage_order import Progress
from poise.jobs.run_file import read_run
from poise.jobs.track.placement import Placed, place
from poise.jobs.tracker import Tracker, policy_of_run
from poise.kin.doctor.clean import clean_clip
from poise.learn import Until
from poise.motion import ClipLibrary
from poise.recipes.perpetual import Perpetual

#: Worlds, samples of a gradient step, and iterations from one evaluation to the next: a motion of
#: seconds has fewer hard motion bins than a library.
WORLDS, MINIBATCH, EVERY = 512, 2048, 5
#: Evaluations without success after which training would end by itself.
NEVER = 1_000_000


class Learned(NamedTuple):
    """The policy that knows the motion, as far as it came, and how its run ended."""

    tracker: Tracker
    result: PerpetualResult


def settings(policy: Perpetual, seed: int = 0) -> Perpetual:
    """The policy's own settings, for one motion."""
    config = going_on(policy, Perpetual(num_envs=WORLDS, seed=seed, recovery=False))
    ppo = replace(config.ppo, minibatch=MINIBATCH)
    # One motion is lost or not: that is no curve by which to tell that nothing is gained any more.
    convergence = replace(config.convergence, patience=NEVER)
    return replace(config, evaluate_every=EVERY, cooling=0.0, ppo=ppo, convergence=convergence)


def learn(
    tracker: Tracker,
    placed: Placed,
    folder: Path,
    minutes: float,
    on_iteration: Callable[[Progress], bool | None] | None = None,
    threads: int = 0,
    seed: int = 0,
) -> Learned:
    """Trains until the motion is tracked from its first frame to its last, or the time is over.

    Args:
        folder: of the run, `perpetual.run`; one that holds a run of this motion is gone on with.
        on_iteration, threads: see `perpetual.run.train`.

    Raises:
        PoiseError: a policy of primitives, which cannot go on, or a folder with another run.
    """
    clip = placed.level.onto(clean_clip(placed.clip)[0]).replaced(cyclic=False)
    config = settings(tracker.config, seed)
    imitation = begin(folder, ClipLibrary.of(clip), config, clip.name, earlier=tracker)
    # Exactly what `track` will ask of the policy, on the same body.
    body, rate = imitation.humanoid, config.sim.control_hz
    qpos = place(placed.source, replace(tracker, humanoid=body)).qpos
    imitation = replace(imitation, reference=Reference(body, [qpos], rate, imitation.library.names))
    result = train(
        imitation, folder, Until(minutes=minutes), on_iteration, threads, False, trained=tracker.policy
    )
    # It tracks its recovery motions as before, or nearly.
    learned = replace(policy_of_run(read_run(folder)), recovery_clips=tracker.recovery_clips)
    return Learned(learned, result)
