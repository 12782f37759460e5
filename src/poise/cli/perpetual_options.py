"""The options of `poise train perpetual`, and what they become."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeAlias

from tyro.conf import arg

from poise.cli.library_options import Library
from poise.cli.options import Body, Flag, Training
from poise.cli.settings import derived, given
from poise.errors import PoiseError

if TYPE_CHECKING:
    from poise.recipes.perpetual import Perpetual

    _Derived: TypeAlias = Any
else:
    _Derived = derived(
        "perpetual", "perpetual: ", "single", "max_primitives", "goal", "recovery", "multiplicative",
        "progressive", "termination", "action",
    )  # fmt: skip


@dataclass(frozen=True)
class Primitives(_Derived):
    """What only the recipe perpetual knows."""

    recovery_clips: Flag = True
    """perpetual: characters that recover are told a point to come back to, as in the paper; by default
    they follow the library's own clips, where some of them get up and some walk."""
    going_on: Annotated[Path | None, arg(name="from", metavar="POLICY", help_behavior_hint="")] = None
    """perpetual: go on from a trained policy, a file or a run, with its settings, networks and body;
    with recovery it stays as it is, beside a primitive that recovers or, where it can already, others
    that learn what it fails (--single: one network)."""
    paths: Annotated[int, arg(metavar="N")] = 0
    """perpetual: learn without help, from motions near the clips that need none, found first by so
    many iterations, 11 say; 0 learns with --help-start at first."""
    style: Flag = True
    """perpetual: reward the task alone; by default a discriminator rewards motion like the library's."""


#: Options that stand for a policy or for other settings than their names say.
BY_HAND = ("recovery_clips", "going_on", "paths", "style")


def settings(
    primitives: Primitives, training: Training, body: Body, stated: Mapping[str, Any]
) -> Perpetual:
    """The recipe's settings. stated: by name, what the options state."""
    from poise.recipes import perpetual

    values = {name: value for name, value in stated.items() if name not in BY_HAND}
    if not 1 <= values.get("max_primitives", 1) <= 64:
        raise PoiseError(f"--max-primitives must lie in 1 to 64, got {values['max_primitives']}")
    if primitives.paths and values.get("expert") is False:
        raise PoiseError(
            "--paths are for the expert, and --no-expert does without", hint="Leave one out"
        )
    if primitives.paths:
        # The LQR teacher on optimised trajectories needs no help at any time.
        values |= {"help_start": 0.0, "trajopt.iterations": primitives.paths}
    if not primitives.recovery_clips:
        values["recovering.demonstrations"] = 0
    if not primitives.style:
        values["style"] = None
    additive = values.get("action") == "additive"
    default = perpetual.Perpetual.additive() if additive else perpetual.Perpetual()
    return training.settings("perpetual", default, body, values)


def check_going_on(primitives: Primitives, body: Body, library: Library, returns: bool = True) -> None:
    """Refuses options that the policy decides from which training goes on.

    returns: the policy tracks recovery motions already, so that primitives may learn what it fails.
    """
    if library.onto is not None:
        what = "--from brings the clips onto the policy's body, and --onto onto another skeleton"
        raise PoiseError(what, hint="Leave --onto out")
    free = {"recovery", "recovery_clips", "single", "going_on"}
    if returns and primitives.recovery and primitives.recovery_clips and not primitives.single:
        free.add("max_primitives")
    names = [name for name in given(primitives, body) if name not in free]
    if names:
        what = f"--from goes on with the policy's own settings and body, and there is {', '.join(names)}"
        raise PoiseError(what, hint="Leave it out")
