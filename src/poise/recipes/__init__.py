"""Recipes: each paper as one short file over shared parts."""

from poise.recipes.residual_force import RECIPE, ResidualForce, build

__all__ = ["RECIPE", "ResidualForce", "build"]
