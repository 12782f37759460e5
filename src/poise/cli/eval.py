"""`poise eval`: the score card of a trained run."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from poise.cli.console import Answer, print_card
from poise.cli.options import Device, Force, Json, Rule, check_device
from poise.cli.training import working
from poise.errors import PoiseError
from poise.jobs.keep import may_write


def run(
    run: Annotated[Positional[Path], arg(metavar="RUN")],
    json: Json = False,
    rule: Annotated[Rule, arg(metavar="NAME")] = "phc",
    starts: Annotated[int, arg(metavar="N")] = 1,
    help_limit: Annotated[float | None, arg(metavar="NEWTONS", help_behavior_hint="")] = None,
    rollouts: Annotated[Path | None, arg(metavar="FILE.npz", help_behavior_hint="")] = None,
    force: Force = False,
    device: Device = "cpu",
) -> Answer:
    """Simulate a trained run from every start frame with 1 s to come, and print its score card.

    Args:
        run: the folder of a result or of a run.
        rule: when an episode has failed: phc, phc_strict, any_25cm, rfc_height or s2h_root.
        starts: begin every episode N times, its joints about 1 mrad off, and say how far figures spread.
        help_limit: the help dial: the most residual force, from 0; by default what training has left of
            it.
        rollouts: also write every step of 32 episodes: observations, actions, rewards, ends, names.
        device: where it runs: cpu, or cuda for an NVIDIA GPU (needs poise-motion[gpu]).
    """
    check_device(device)
    if rollouts is not None:
        if rollouts.suffix != ".npz":
            raise PoiseError(
                "rollouts are written as .npz",
                rollouts,
                "Give --rollouts FILE.npz",
                code="wrong-suffix",
            )
        may_write(rollouts, force)
    from poise.papers.opened import opened as open_run

    opened, outputs = open_run(run), {}
    with working("simulating every start frame"):
        card = opened.score(rule, help_limit, device, starts)
        if rollouts is not None:
            steps = opened.transitions(help_limit=help_limit, device=device)
            outputs["rollouts"] = steps.save(rollouts)
    print_card(card)
    return Answer(card.to_dict(), outputs)
