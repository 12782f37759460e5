"""`poise eval`: the score card of a trained run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from poise.cli.console import Answer, print_card
from poise.cli.options import Device, Flag, Rule, check_device
from poise.cli.training import working
from poise.errors import PoiseError
from poise.jobs.keep import may_write


@dataclass(frozen=True)
class Options:
    """Simulate a trained run from every start frame with 1 s to come, and print its score card."""

    run: Annotated[Positional[Path], arg(metavar="RUN")]
    """The folder of a result or of a run."""
    json: Flag = False
    """Print one JSON document and nothing else on stdout, see docs/cli.md."""
    rule: Annotated[Rule, arg(metavar="NAME")] = "phc"
    """When an episode has failed: phc, phc_strict, any_25cm, rfc_height or s2h_root."""
    starts: Annotated[int, arg(metavar="N")] = 1
    """Begin every episode N times, its joints about 1 mrad off, and say how far figures spread."""
    help_limit: Annotated[float | None, arg(metavar="NEWTONS", help_behavior_hint="")] = None
    """The help dial: the most residual force, from 0; by default what training has left of it."""
    rollouts: Annotated[Path | None, arg(metavar="FILE.npz", help_behavior_hint="")] = None
    """Also write every step of 32 episodes: observations, actions, rewards, ends, names."""
    force: Flag = False
    """Write over the file of --rollouts."""
    device: Device = "cpu"
    """Where it runs: cpu, or cuda for an NVIDIA GPU (needs poise-motion[gpu])."""


def run(options: Options, argv: Sequence[str]) -> Answer:
    """Rebuilds the task from the run folder alone and evaluates the latest policy."""
    o = options
    check_device(o.device)
    if o.rollouts is not None:
        if o.rollouts.suffix != ".npz":
            raise PoiseError(
                "rollouts are written as .npz",
                o.rollouts,
                "Give --rollouts FILE.npz",
                code="wrong-suffix",
            )
        may_write(o.rollouts, o.force)
    from poise.jobs.open import open_run

    opened, outputs = open_run(o.run), {}
    with working("simulating every start frame"):
        card = opened.score(o.rule, o.help_limit, o.device, o.starts)
        if o.rollouts is not None:
            steps = opened.transitions(help_limit=o.help_limit, device=o.device)
            outputs["rollouts"] = steps.save(o.rollouts)
    print_card(card)
    return Answer(card.to_dict(), outputs)
