"""`poise play`: one episode of a trained run as a page to watch."""

from __future__ import annotations

import webbrowser
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from poise.cli.console import Answer
from poise.cli.options import Force, Json, OpenPage
from poise.cli.training import working
from poise.errors import PoiseError, did_you_mean
from poise.jobs.keep import may_write

if TYPE_CHECKING:
    from poise.recipes.imitation import Imitation


def run(
    run: Annotated[Positional[Path], arg(metavar="RUN")],
    out: Annotated[Path | None, arg(aliases=["-o"], metavar="FILE", help_behavior_hint="")] = None,
    start: Annotated[int, arg(metavar="FRAME")] = 0,
    clip: Annotated[str | None, arg(metavar="NAME", help_behavior_hint="")] = None,
    open: OpenPage = False,
    force: Force = False,
    json: Json = False,
) -> Answer:
    """Simulate the latest policy of a run from one frame and write a page to watch.

    Args:
        run: the folder of a result or of a run.
        out: the page to write; by default play.html in the run folder.
        start: the frame of the clip to start from.
        clip: the clip, where the run has several; by default the first one.
    """
    if out is not None:
        may_write(out, force)
    from poise.jobs.deliver import make_report
    from poise.papers.opened import opened as open_run
    from poise.score.report import write_report

    with working("simulating"):
        opened = open_run(run)
        index, frame = _place(opened.task, clip, start)
        page = out or opened.path / "play.html"
        write_report(make_report(opened.task, opened.episode(index, frame), opened.curve), page)
    if open and not webbrowser.open(page.absolute().as_uri()):
        raise PoiseError("no browser could be opened", page, "Open the page by hand", code="no-browser")
    clip_name = opened.task.library.names[index]
    return Answer({"clip": clip_name, "start": start}, {"page": page})


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
