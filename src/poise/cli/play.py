"""`poise play`: one episode of a trained run as a page to watch."""

from __future__ import annotations

import webbrowser
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from poise.cli.console import Answer
from poise.cli.options import Flag
from poise.cli.training import working
from poise.errors import PoiseError, did_you_mean
from poise.jobs.keep import may_write

if TYPE_CHECKING:
    from poise.recipes.imitation import Imitation


@dataclass(frozen=True)
class Options:
    """Simulate the latest policy of a run from one frame and write a page to watch."""

    run: Annotated[Positional[Path], arg(metavar="RUN")]
    """The folder of a result or of a run."""
    out: Annotated[Path | None, arg(aliases=["-o"], metavar="FILE", help_behavior_hint="")] = None
    """The page to write; by default play.html in the run folder."""
    start: Annotated[int, arg(metavar="FRAME")] = 0
    """The frame of the clip to start from."""
    clip: Annotated[str | None, arg(metavar="NAME", help_behavior_hint="")] = None
    """The clip, where the run has several; by default the first one."""
    open: Flag = False
    """Open the page in the browser."""
    force: Flag = False
    """Write over files that are there."""
    json: Flag = False
    """Print one JSON document and nothing else on stdout, see docs/cli.md."""


def run(options: Options, argv: Sequence[str]) -> Answer:
    """Simulates one episode to its end and writes its report page."""
    if options.out is not None:
        may_write(options.out, options.force)
    from poise.jobs.deliver import make_report
    from poise.jobs.open import open_run
    from poise.score.report import write_report

    with working("simulating"):
        run = open_run(options.run)
        clip, frame = _place(run.task, options.clip, options.start)
        page = options.out or run.path / "play.html"
        write_report(make_report(run.task, run.episode(clip, frame), run.curve), page)
    if options.open and not webbrowser.open(page.absolute().as_uri()):
        raise PoiseError("no browser could be opened", page, "Open the page by hand", code="no-browser")
    clip_name = run.task.library.names[clip]
    return Answer({"clip": clip_name, "start": options.start}, {"page": page})


def _place(imitation: Imitation, name: str | None, start: int) -> tuple[int, int]:
    """Clip index and control frame of frame `start` of the clip called `name`."""
    names = imitation.library.names
    if name is not None and name not in names:
        raise PoiseError(
            f"the run has no clip '{name}'. {did_you_mean(name, names)}", code="unknown-clip"
        )
    index = 0 if name is None else names.index(name)
    clip = imitation.library.clips[index]
    if not 0 <= start < clip.frames:
        raise PoiseError(
            f"--start must be a frame of '{clip.name}', 0 to {clip.frames - 1}, got {start}",
            code="frame-outside",
        )
    # The clip's frames have the file's rate, the simulation's have the control rate; an episode
    # needs at least one step.
    frame = round(start / clip.fps * imitation.reference.rate_hz)
    return index, min(frame, int(imitation.reference.length[index]) - 2)
