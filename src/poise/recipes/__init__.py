"""Recipes: each paper as one short file over shared parts.

Their settings are imported without torch, which the recipes themselves need.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from poise.recipes.residual_force import RECIPE, ResidualForce, build

__all__ = ["RECIPE", "ResidualForce", "build"]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module 'poise.recipes' has no attribute '{name}'")
    return getattr(import_module("poise.recipes.residual_force"), name)
