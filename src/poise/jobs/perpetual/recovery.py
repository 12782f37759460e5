"""How well recovery goes: trials of PHC's fail-states."""

from __future__ import annotations

from dataclasses import replace

from poise.env import Acts
from poise.env.recovery.falls import fall_states
from poise.errors import PoiseError
from poise.eval import RecoveryCard, recovery_card, trial_task
from poise.learn import PolicyBundle
from poise.recipes.imitation import Imitation
from poise.recipes.perpetual.config import Perpetual
from poise.recipes.perpetual.recovery import standing
from poise.sim import make_backend

#: Distance from the reference, m, at which trials far from it begin (PHC, Sec. 4.2).
FAR = 3.0


def check_falls(imitation: Imitation, count: int = 32) -> None:
    """Lets some characters fall, so that a body that never comes to lie is known before the training.

    Raises:
        PoiseError: they do not.
    """
    recovery = imitation.task.recovery
    if recovery is None:
        return
    backend = make_backend(imitation.humanoid.model, count, "cpu", threads=1)
    try:
        drop = replace(recovery.drop, count=min(count, recovery.drop.count))
        fall_states(backend, imitation.humanoid, imitation.task.pd, drop, int(imitation.config.seed))
    except PoiseError as problem:
        hint = "Train without recovery: --no-recovery"
        raise PoiseError(problem.what, "recovery", hint) from None
    finally:
        backend.close()


def try_recovery(
    imitation: Imitation, policy: Acts, trials: int, threads: int = 0, device: str = "cpu"
) -> RecoveryCard:
    """Trials of every kind of fail-state against a reference that stands, without help.

    imitation: with the task of a stage that learns recovery. The same falls and directions every time.
    """
    config: Perpetual = imitation.config
    clip, frame = standing(imitation.reference)
    if isinstance(policy, PolicyBundle):
        policy = policy.copy().to(device)
    recovery_clips = imitation.recovery_clips
    tried = trial_task(imitation.task, FAR, trials, recovery_clips is not None)
    tried = replace(imitation, task=tried).bare()
    return recovery_card(
        lambda n: tried.env(n, None, False, threads, None, 0.0, device, guard=False),
        policy, trials, method=config.method, clip=clip, frame=frame, seconds=config.recovering.seconds,
        recovery_clips=recovery_clips,
    )  # fmt: skip


def back(card: RecoveryCard) -> tuple[int, int]:
    """How many of how many trials of all kinds were back in the last of the card's times."""
    return sum(round(r.within[-1] * r.trials) for r in card.rows), sum(r.trials for r in card.rows)
