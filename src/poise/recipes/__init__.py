"""Tasks and their settings: one clip with help that fades, one policy for a library of clips.

The settings are imported without torch, which the tasks themselves need.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from poise.lazy import lazy

if TYPE_CHECKING:
    from poise.recipes.residual_force import RECIPE, build
    from poise.recipes.residual_force_settings import ResidualForce

__all__ = ["RECIPE", "ResidualForce", "build"]

__getattr__ = lazy(__name__, {"residual_force": "RECIPE ResidualForce build"})
