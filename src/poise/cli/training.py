"""What `imitate` and `train` share: check, read, build, train, and the way to go on.

Under `torchrun` several processes do one job: rank 0 reads, writes and prints, the others open the
run folder that it made and train with it.
"""

from __future__ import annotations

import os
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from poise.cli import progress
from poise.cli.answer import INTERRUPTED, Answer
from poise.cli.callbacks import First, beginning
from poise.cli.console import launched, notes, say, tell
from poise.cli.options import Reading, Training
from poise.cli.output import claimed
from poise.errors import PoiseError

if TYPE_CHECKING:
    from poise.learn import RunResult
    from poise.learn.parallel import Comm
    from poise.motion import ClipLibrary
    from poise.recipes import ResidualForce
    from poise.recipes.imitation import Imitation


@dataclass(frozen=True)
class Job:
    """One training: which clips, into which result folder and run folder, how."""

    clips: tuple[Path, ...]
    out: Path
    run: Path
    training: Training
    config: ResidualForce
    reading: Reading
    again: str
    """The command line that goes on with it."""

    def start(self, comm: Comm) -> Imitation:
        """The task on every process: rank 0 begins the run, the others open its folder."""
        from poise.jobs.open import open_run
        from poise.learn.parallel import share_of, together

        with together(comm):
            if comm.size > 1:
                share_of(self.config.num_envs, comm)
            imitation = self.begin() if comm.rank == 0 else None
        with together(comm):
            return imitation or open_run(self.run).task

    def begin(self) -> Imitation:
        """Reads the clips, tries the folder, builds the task; nothing stays if that fails."""
        from poise.jobs.runs import RUN_FILE, begin

        held = (self.run / RUN_FILE).exists()
        if held and not self.training.resume:
            hint = "Go on with --resume, or choose another folder"
            raise PoiseError("already holds a run", self.out, hint)
        library = self.read()
        say(f"{', '.join(library.names[:6])}: {library.seconds:.1f} s")
        notes([n for clip in library for n in clip.skeleton.source.notes])
        with claimed(self.out), claimed(self.run), progress.working("making the body"):
            imitation = begin(self.run, library, self.config, self.training.device)
        if self.training.resume and not held:
            tell(f"There was no run in {self.run}; a new one starts.")
        notes(imitation.report.sentences())
        return imitation

    def read(self) -> ClipLibrary:
        """All clips, each with a name of its own."""
        from poise.motion import ClipLibrary

        seen: dict[str, int] = {}
        clips = []
        for path in self.clips:
            clip = self.reading.read(path)
            seen[clip.name] = seen.get(clip.name, 0) + 1
            count = seen[clip.name]
            clips.append(clip if count == 1 else clip.replaced(name=f"{clip.name}-{count}"))
        return ClipLibrary(tuple(clips))

    def train(self, imitation: Imitation, comm: Comm, first: First | None = None) -> RunResult:
        """Trains until the limit or Ctrl-C; either way everything is saved. `first` gets the clone."""
        from poise.jobs.runs import train
        from poise.learn import RunResult, Until

        until = Until(minutes=self.training.minutes, iterations=self.training.iterations)
        if self.training.device != "cpu":
            tell("The first steps on a new GPU compile its kernels, which takes minutes once.", "dim")
        try:
            with progress.training(until) as show:
                t, begins = self.training, beginning(first)
                return train(
                    imitation, self.run, until, show, t.threads,
                    comm=comm, beginning=begins, device=t.device,
                )  # fmt: skip
        except KeyboardInterrupt:
            # A second Ctrl-C ends the present iteration too; all before it are saved.
            return RunResult(None, True, None)


def stopped(run: Path, again: str, where: str = "") -> Answer:
    """Says what Ctrl-C left in the run folder, and the command line that goes on with it."""
    from poise.learn import LATEST

    if (run / LATEST).exists():
        tell(f"Stopped{where}; the training so far is saved. Go on with:")
    else:
        tell(f"Stopped{where} before there was anything to save. Begin again with:")
    tell(f"  {again}")
    return Answer({"again": again}, exit_code=INTERRUPTED)


def command_line(verb: str, argv: Sequence[str]) -> str:
    """The command line that resumes `poise VERB ARGV`, as one process or as `torchrun` runs it."""
    more = () if "--resume" in argv else ("--resume",)
    program: tuple[str, ...] = ("poise",)
    if launched():
        here, all_ = os.environ["LOCAL_WORLD_SIZE"], os.environ["WORLD_SIZE"]
        nodes = () if here == all_ else ("--nnodes", str(int(all_) // int(here)))
        program = ("torchrun", *nodes, "--nproc-per-node", here, "-m", "poise")
    return shlex.join((*program, verb, *argv, *more))
