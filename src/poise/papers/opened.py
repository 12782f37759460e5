"""Opening what was trained, runs of the papers' own recipes among it.

run = opened("run")                      # what poise train dual-policy wrote, or any other recipe
"""

from __future__ import annotations

from pathlib import Path

from poise.jobs.open import Run, open_run
from poise.jobs.run_file import RUN_FILE, read_run
from poise.settings import imported

#: The classes of runs that the engine does not know, and what reads their settings, by their recipes.
KINDS = {
    "compliant-imitation": (
        "poise.papers.compliant.controller_run:ControllerRun",
        "poise.papers.compliant.imitation_controller:config_of",
    ),
    "dual-policy": (
        "poise.papers.residual_force.dual_run:DualRun",
        "poise.papers.residual_force.dual_run:config_of",
    ),
}


def opened(path: Path) -> Run:
    """`open_run`, which knows runs of the papers' recipes as well."""
    if path.is_dir() and any((path / n / RUN_FILE).exists() for n in (".", "run")):
        file = read_run(path)
        if file.recipe in KINDS:
            kind, config_of = map(imported, KINDS[file.recipe])
            config = config_of(file.meta["config"], file.path)
            return kind(file.path.parent, file.recipe, config, file)
    return open_run(path)
