"""The search for paths of a library, kept in the run folder so that a killed run goes on with it."""

from __future__ import annotations

from pathlib import Path

from poise.env import Paths, PathSearch
from poise.errors import PoiseError
from poise.learn import load_checkpoint, save_checkpoint
from poise.recipes.expert import Beginning
from poise.recipes.imitation import Imitation
from poise.recipes.perpetual.config import Perpetual

#: The file of a run folder with the paths of its clips, as far as they were found.
PATHS = "paths.safetensors"


def find_paths(imitation: Imitation, folder: Path, threads: int, tell: Beginning) -> Paths:
    """A path for every clip; goes on with what the folder holds of an unfinished search."""
    config: Perpetual = imitation.config
    assert config.paths is not None
    search = PathSearch(imitation.reference, config.sim, config.paths, threads)
    path, names = folder / PATHS, list(imitation.reference.names)
    if path.exists():
        state, meta = load_checkpoint(path)
        if meta.get("clips") != names or state["qpos"].shape != search.qpos.shape:
            raise PoiseError(
                "it holds paths of other clips", path, "Remove it, or choose another folder"
            )
        search.load_state(state)
    while not search.done:
        stats = search.iterate()
        save_checkpoint(path, search.state(), {"kind": "paths", "clips": names})
        if tell.path is not None:
            tell.path(stats, config.paths.iterations)
    return search.paths()
