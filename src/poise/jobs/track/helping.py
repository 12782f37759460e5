"""How much help a motion wants that is lost without: a hand that leads the root, as weak as suffices."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch

from poise.eval import ClipResults
from poise.jobs.perpetual.evaluation import evaluate_clips
from poise.learn import PolicyBundle
from poise.plan import Guide, make_plan
from poise.recipes.imitation import Imitation
from poise.recipes.perpetual.config import Perpetual

#: m/s^2, gravity, by which body weight is counted.
GRAVITY = 9.81
#: Shares of the body's weight that are tried as help, from the least on.
SHARES = (0.15, 0.3, 0.6, 1.2, 2.4)
#: Start frames from which the help is to suffice.
STARTS = 16
#: Where in the training the help has ended at the latest, and the noise on the residual action beside
#: the hand that leads, in units of the limit.
ENDS, NOISE = 0.6, 0.02


def with_guide(imitation: Imitation) -> Imitation:
    """The task of `helped` settings with a hand that leads the root, as far as the help's limit goes."""
    residual = imitation.task.residual
    if residual is None:
        return imitation
    plan = make_plan(imitation.reference)
    guide = Guide(imitation.reference, residual, plan.force_h, plan.torque_b)
    return replace(imitation, task=replace(imitation.task, guide=guide))


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
