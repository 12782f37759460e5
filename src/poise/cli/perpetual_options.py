"""The options of `poise train perpetual`, and what they become."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import arg

from poise.cli.library_options import Library
from poise.cli.options import Body, Flag, Training
from poise.errors import PoiseError

if TYPE_CHECKING:
    from poise.recipes.perpetual import Perpetual

Goal = Literal["rotations", "keypoints"]
Termination = Literal["relaxed", "all", "code"]
Action = Literal["absolute", "additive"]


@dataclass(frozen=True)
class Primitives:
    """What only the recipe perpetual knows."""

    single: Flag = False
    """perpetual: one larger network in place of primitives and a composer."""
    max_primitives: Annotated[int, arg(metavar="K")] = 3
    """perpetual: train at most so many primitives, each on what the ones before it fail."""
    goal: Annotated[Goal, arg(metavar="NAME")] = "rotations"
    """perpetual: rotations tells of places and rotations, keypoints of places alone."""
    recovery: Flag = True
    """perpetual: fallen and far characters learn to get up and come back; so nobody does."""
    recovery_clips: Flag = True
    """perpetual: they follow ways that are made of the library's clips, where somebody gets up in it and
    somebody walks; so they are told a point to come back to, as in the paper."""
    multiplicative: Flag = True
    """perpetual: a composer combines primitives; so there is one network of their size."""
    progressive: Flag = True
    """perpetual: a primitive learns what earlier ones fail; so all learn with the composer."""
    termination: Annotated[Termination, arg(metavar="NAME")] = "relaxed"
    """perpetual: bodies whose mean distance ends an episode: relaxed leaves feet out, all; or code."""
    action: Annotated[Action, arg(metavar="NAME")] = "absolute"
    """perpetual: joint targets as in the paper, or additive ones, with settings for hours on a CPU."""
    going_on: Annotated[Path | None, arg(name="from", metavar="POLICY", help_behavior_hint="")] = None
    """perpetual: go on from a trained policy, a file or a run, with its settings, networks and body;
    with recovery it stays as it is, beside a primitive that recovers or, where it can already, others
    that learn what it fails (--single: one network)."""
    paths: Annotated[int, arg(metavar="N")] = 0
    """perpetual: learn without help, from motions near the clips that need none, found first by so
    many iterations, 11 say; 0 learns with --help-start at first."""
    style: Flag = True
    """perpetual: a discriminator rewards motion like that of the library; so the task alone does."""


def settings(primitives: Primitives, training: Training, body: Body) -> Perpetual:
    """The recipe's settings; options that belong to other recipes are refused."""
    plain = Training()
    for name in ("method", "reward", "help_limit"):
        if getattr(training, name) != getattr(plain, name):
            option = name.replace("_", "-")
            raise PoiseError(f"the recipe perpetual has no --{option}", hint="Leave it out")
    if not 1 <= primitives.max_primitives <= 64:
        raise PoiseError(f"--max-primitives must lie in 1 to 64, got {primitives.max_primitives}")
    if primitives.paths and not training.expert:
        raise PoiseError(
            "--paths are for the expert, and --no-expert does without", hint="Leave one out"
        )
    from poise.plan import TrajOptConfig
    from poise.recipes.perpetual import Perpetual

    config = replace(
        Perpetual.additive() if primitives.action == "additive" else Perpetual(),
        single=primitives.single,
        max_primitives=primitives.max_primitives,
        goal=primitives.goal,
        recovery=primitives.recovery,
        multiplicative=primitives.multiplicative,
        progressive=primitives.progressive,
        termination=primitives.termination,
        # What follows paths needs no help from the beginning.
        help_start=0.0 if primitives.paths else training.help_start,
        trajopt=TrajOptConfig(iterations=primitives.paths) if primitives.paths else None,
        seed=training.seed,
        expert=training.expert,
        body=body.config(),
    )
    if not primitives.recovery_clips:
        config = replace(config, recovering=replace(config.recovering, demonstrations=0))
    if not primitives.style:
        config = replace(config, style=None)
    return config if training.envs is None else replace(config, num_envs=training.envs)


def check_going_on(primitives: Primitives, body: Body, library: Library, returns: bool = True) -> None:
    """Refuses options whose say a policy has that training goes on from. returns: it comes back by ways
    already, so that primitives may learn what it fails."""
    if library.onto is not None:
        what = "--from brings the clips onto the policy's body, and --onto onto another skeleton"
        raise PoiseError(what, hint="Leave --onto out")
    free = ["recovery", "recovery_clips", "single", "going_on"]
    if returns and primitives.recovery and primitives.recovery_clips and not primitives.single:
        free.append("max_primitives")
    own = {name: getattr(primitives, name) for name in free}
    plain = Primitives(**own)
    names = [f.name for f in fields(plain) if getattr(primitives, f.name) != getattr(plain, f.name)]
    names += [f.name for f in fields(body) if getattr(body, f.name) != getattr(Body(), f.name)]
    if names:
        what = f"--from goes on with the policy's own settings and body, and there is {', '.join(names)}"
        raise PoiseError(what, hint="Leave it out")
