"""Settings by name: what a paper states, what its code does, and what is fast here."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from poise.errors import PoiseError, did_you_mean
from poise.jobs.inbetween.inbetween_settings import Inbetween, small
from poise.motion import Clip
from poise.recipes.perpetual_settings import BY_STAGES
from poise.recipes.residual_force_settings import ResidualForce
from poise.settings import imported


def _endless() -> Any:
    # Its settings stand beside its training, which takes seconds to import.
    return imported("poise.jobs.endless.endless_training:Endless")


_CONTROLLER = "poise.papers.compliant.imitation_controller:CompliantImitation"
#: The names of presets.
NAMES = ("paper", "code", "fast")

_PRESETS: dict[str, dict[str, Callable[..., Any]]] = {
    "residual-force": {
        "paper": ResidualForce.paper, "code": ResidualForce.code, "fast": lambda _: ResidualForce(),
    },
    "perpetual": {
        name: lambda _, made=made: getattr(imported(BY_STAGES), made)()
        for name, made in (("paper", "paper"), ("code", "code"), ("fast", "additive"))
    },
    "inbetween": {
        "paper": lambda _: Inbetween.paper(), "code": lambda _: Inbetween.code(),
        "fast": lambda _: small(Inbetween()),
    },
    "endless": {"paper": lambda _: _endless().paper(), "fast": lambda _: _endless()()},
    "compliant-imitation": {
        "paper": lambda _: imported(_CONTROLLER).paper(), "fast": lambda _: imported(_CONTROLLER)(),
    },
}  # fmt: skip


def preset_of(recipe: str, name: str, clip: Clip | None = None) -> Any:
    """The settings of a recipe ("residual-force", "perpetual", "inbetween", "endless" or
    "compliant-imitation") by the name of a preset.

    clip: what is imitated, by which the paper chooses its reward and the code its damping.

    Raises:
        PoiseError: a recipe or a preset that there is not.
    """
    if recipe not in _PRESETS:
        raise PoiseError(
            f"there is no recipe '{recipe}'",
            hint=did_you_mean(recipe, list(_PRESETS)),
            code="unknown-recipe",
        )
    known = _PRESETS[recipe]
    if name not in known:
        raise PoiseError(
            f"{recipe} has no preset '{name}'",
            hint=did_you_mean(name, list(known)),
            code="unknown-preset",
        )
    return known[name](clip)
