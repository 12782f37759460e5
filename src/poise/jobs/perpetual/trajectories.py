"""Trajectory optimisation of a library, kept in the run folder so that a killed run goes on with it."""

from __future__ import annotations

from pathlib import Path

from poise.errors import PoiseError
from poise.jobs.warm_start import TrainingCallbacks
from poise.learn import load_checkpoint, save_checkpoint
from poise.plan import Trajectories, TrajectoryOptimizer
from poise.recipes.imitation import Imitation
from poise.recipes.perpetual.config import Perpetual

#: The file of a run folder with the trajectories of its clips, as far as they were optimised.
PATHS = "paths.safetensors"


def find_paths(
    imitation: Imitation, folder: Path, threads: int, tell: TrainingCallbacks
) -> Trajectories:
    """A trajectory for every clip; goes on with what the folder holds of an unfinished optimisation."""
    config: Perpetual = imitation.config
    assert config.trajopt is not None
    search = TrajectoryOptimizer(imitation.reference, config.sim, config.trajopt, threads)
    path, names = folder / PATHS, list(imitation.reference.names)
    if path.exists():
        state, meta = load_checkpoint(path)
        if meta.get("clips") != names or state["qpos"].shape != search.qpos.shape:
            raise PoiseError(
                "it holds trajectories of other clips", path, "Remove it, or choose another folder"
            )
        search.load_state(state)
    while not search.done:
        stats = search.iterate()
        save_checkpoint(path, search.state(), {"kind": "paths", "clips": names})
        if tell.path is not None:
            tell.path(stats, config.trajopt.iterations)
    return search.trajectories()
