"""Tasks and their settings: one clip with help that fades, one policy for a library of clips.

The settings are imported without torch, which the tasks themselves need.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from poise.recipes.residual_force import RECIPE, build
    from poise.recipes.residual_force_settings import ResidualForce

__all__ = ["RECIPE", "ResidualForce", "build"]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module 'poise.recipes' has no attribute '{name}'")
    return getattr(import_module("poise.recipes.residual_force"), name)
