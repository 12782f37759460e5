"""`poise demo`: the walk that comes with Poise, imitated, so that a fresh installation can be tried."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Annotated

from tyro.conf import Fixed, Suppress, arg

from poise.cli.console import Answer, say
from poise.cli.imitate import Options as Whole
from poise.cli.imitate import run as run_whole
from poise.cli.options import Force, Json, Threads, Training
from poise.errors import PoiseError
from poise.jobs.keep import may_deliver

#: The clip that comes with Poise.
WALK = Path(__file__).parents[1] / "data" / "walk.bvh"


def run(
    out: Annotated[Path, arg(aliases=["-o"], metavar="DIR")] = Path("demo"),
    minutes: Annotated[float, arg(metavar="M")] = 1.2,
    iterations: Annotated[int | None, arg(metavar="N", help_behavior_hint="")] = None,
    threads: Threads = 0,
    force: Force = False,
    json: Json = False,
    clip: Annotated[Path, Suppress, Fixed] = WALK,
) -> Answer:
    """Try Poise without a clip of your own: a policy learns the walk that comes along, which takes under
    two minutes on two cores and no network. Write the motion, score.json, report.html and the run.

    Args:
        out: the folder of the results.
        minutes: training time in minutes at most; it ends before where the walk is done from all over.
        iterations: stop after so many iterations as well; for tests.
    """
    training = Training(minutes=minutes, iterations=iterations, threads=threads)
    whole = Whole(clip, out, force=force, training=training)
    # Its numbers and those of the whole are refused before anything is removed.
    training.check(whole.recipe_settings)
    held = out / "run"
    if held.exists() and not force:
        raise PoiseError(
            "already holds a run",
            out,
            "Choose another folder with -o, or use --force",
            code="run-exists",
        )
    may_deliver(out, None, force, clip)
    if held.exists():
        _remove(held)
    line = [str(clip), "-o", str(out), "--minutes", f"{minutes:g}"]
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
