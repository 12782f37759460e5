"""`poise demo`: the walk that comes with Poise, imitated, so that a fresh installation can be tried."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import arg

from poise.cli.console import Answer, say
from poise.cli.imitate import Options as Whole
from poise.cli.imitate import run as run_whole
from poise.cli.options import Flag, Training
from poise.errors import PoiseError
from poise.jobs.keep import may_deliver

#: The clip that comes with Poise.
WALK = Path(__file__).parents[1] / "data" / "walk.bvh"


@dataclass(frozen=True)
class Options:
    """Try Poise without a clip of your own: a policy learns the walk that comes along, which takes under
    two minutes on two cores and no network. Write the motion, score.json, report.html and the run."""

    out: Annotated[Path, arg(aliases=["-o"], metavar="DIR")] = Path("demo")
    """The folder of the results."""
    minutes: Annotated[float, arg(metavar="M")] = 1.2
    """Training time in minutes at most; it ends before where the walk is done from all over."""
    iterations: Annotated[int | None, arg(metavar="N", help_behavior_hint="")] = None
    """Stop after so many iterations as well; for tests."""
    threads: Annotated[int, arg(metavar="N")] = 0
    """Threads of the physics; 0 takes every core."""
    force: Flag = False
    """Write over the results that are there."""
    json: Flag = False
    """Print one JSON document and nothing else on stdout, see docs/cli.md."""

    @property
    def clip(self) -> Path:
        """The motion file that is read."""
        return WALK


def run(options: Options, argv: Sequence[str]) -> Answer:
    """Does what `poise imitate` does with the walk, in a folder that holds nothing else."""
    o = options
    training = Training(minutes=o.minutes, iterations=o.iterations, threads=o.threads)
    whole = Whole(WALK, o.out, force=o.force, training=training)
    # Its numbers and those of the whole are refused before anything is removed.
    training.check(whole.recipe_settings)
    held = o.out / "run"
    if held.exists() and not o.force:
        raise PoiseError(
            "already holds a run",
            o.out,
            "Choose another folder with -o, or use --force",
            code="run-exists",
        )
    may_deliver(o.out, None, o.force, WALK)
    if held.exists():
        _remove(held)
    line = [str(WALK), "-o", str(o.out), "--minutes", f"{o.minutes:g}"]
    answer = run_whole(whole, line)
    if report := answer.outputs.get("report"):
        say(f"Open {report} in a browser. The same with a clip of yours: poise imitate CLIP -o out")
    return answer


def _remove(held: Path) -> None:
    """Removes the run of a former demo, and nothing that is none."""
    from poise.jobs.run_file import RUN_FILE

    if not (held / RUN_FILE).is_file() or held.is_symlink():
        raise PoiseError(
            "is there and is no run", held, "Choose another folder with -o", code="not-a-run"
        )
    shutil.rmtree(held)
