"""A body as MJCF, the file that MuJoCo and what is built on it load."""

from __future__ import annotations

from pathlib import Path

from poise.body import Humanoid
from poise.formats.text import write_whole
from poise.sim.backend import SimConfig
from poise.sim.scene import Character, Scene


def mjcf_of(humanoid: Humanoid, sim: SimConfig | None = None) -> str:
    """The text of a model: the body on a floor, a position servo for every hinge, the physics settings.

    `ctrl` are target angles in rad; lengths are m, masses kg, the vertical is Z. MuJoCo writes numbers
    with six digits, so that the loaded model differs from the simulated one by 1e-6 of each.

    sim: the physics; by default those of the recipes. A control step is `sim.substeps` of MuJoCo's.
    """
    spec = Scene((Character(humanoid),), sim=sim or SimConfig()).spec
    # What is written is complete only after it was compiled.
    spec.compile()
    return spec.to_xml()


def write_mjcf(humanoid: Humanoid, path: str | Path, sim: SimConfig | None = None) -> Path:
    """Writes `mjcf_of` into a file, whole or not at all."""
    write_whole(Path(path), mjcf_of(humanoid, sim))
    return Path(path)
