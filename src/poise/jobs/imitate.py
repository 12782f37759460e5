"""One motion, or several, imitated by a policy that is trained on them: what `poise imitate` does.

made = imitate("walk.bvh", minutes=3)
made.card, made.clip, made.save("out")
"""

from __future__ import annotations

import shutil
import tempfile
import weakref
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from poise.eval import ScoreCard
from poise.jobs.deliver import Delivery, deliver, finished
from poise.jobs.result import Result, Shown, clip_of
from poise.jobs.run_file import learning_curve
from poise.jobs.runs import Evaluation, begin, evaluate, train, trained_policy
from poise.jobs.warm_start import TrainingCallbacks
from poise.learn import IterationStats, PolicyBundle, Until
from poise.motion import Clip, ClipLibrary
from poise.recipes.imitation import Imitation
from poise.recipes.residual_force import ResidualForce
from poise.settings import changed

#: The run folder in a result folder.
RUN = "run"


@dataclass(frozen=True, eq=False, repr=False)
class Imitated(Result):
    """What came of an imitation.

    Attributes:
        task: the motion with its body.
        policy: the trained one.
        evaluation: every start frame simulated.
        run: the run folder.
        interrupted: whether Ctrl-C ended the training early; it was evaluated all the same.
    """

    task: Imitation
    policy: PolicyBundle
    evaluation: Evaluation
    run: Path
    interrupted: bool = False

    @cached_property
    def _finished(self) -> Delivery:
        return finished(self.task, self.evaluation)

    @property
    def clips(self) -> tuple[Clip, ...]:
        """The simulated motion of every clip, standing feet held."""
        return tuple(self._finished.clips.values())

    @property
    def clip(self) -> Clip:
        """The simulated motion of the first clip."""
        return self.clips[0]

    @property
    def card(self) -> ScoreCard:
        """The score of all start frames."""
        return self._finished.card

    @property
    def notes(self) -> tuple[str, ...]:
        """What was repaired in the motion, and what holding the feet did."""
        own = [n for clip in self.task.library for n in clip.skeleton.source.notes]
        return (*own, *self.task.report.sentences(), *self._finished.notes)

    def _shown(self) -> Shown:
        return Shown(self.clip, self.task.library.clips[0], self.card, self.notes)

    def _save_all(self, folder: Path) -> dict[str, Path]:
        paths = deliver(self.task, self.evaluation, folder, learning_curve(self.run)).paths
        kept = folder / RUN
        if kept.resolve() != self.run.resolve():
            shutil.copytree(self.run, kept, dirs_exist_ok=True)
        return paths | {"run": kept}


def imitate(
    clip: Clip | str | Path | Sequence[Clip | str | Path],
    minutes: float = 3.0,
    config: ResidualForce | None = None,
    *,
    folder: str | Path | None = None,
    iterations: int | None = None,
    threads: int = 0,
    device: str = "cpu",
    on_iteration: Callable[[IterationStats], bool | None] | None = None,
    callbacks: TrainingCallbacks | None = None,
    **settings: Any,
) -> Imitated:
    """Trains a policy on a motion, simulates it from every start frame, and scores it.

    Args:
        clip: a clip or a file; or several on one skeleton, which one policy learns.
        minutes: of training; with `iterations` whichever ends first.
        config: the recipe's settings; `settings` are those that differ, such as help_limit=50.0 or
            num_envs=64.
        folder: keeps the run (the same again goes on with it); by default it is gone with the result,
            unless that is saved.
        threads: of the physics; 0 takes all cores.
        device: "cpu" or "cuda".
        on_iteration: is called after each iteration; returning False ends the training.
        callbacks: are told what happens before PPO begins.

    Raises:
        PoiseError: a motion that cannot be read or has no human body, an unknown setting, a folder that
            holds another run.
    """
    config = changed(config or ResidualForce(), settings)
    several = [clip] if isinstance(clip, Clip | str | Path) else list(clip)
    library = ClipLibrary.of([clip_of(c) for c in several])
    run = Path(tempfile.mkdtemp(prefix="poise-")) if folder is None else Path(folder) / RUN
    try:
        task = begin(run, library, config, device)
        until, log = Until(minutes=minutes, iterations=iterations), False
        done = train(task, run, until, on_iteration, threads, log, beginning=callbacks, device=device)
        policy, meta = trained_policy(run, task)
        made = Imitated(task, policy, evaluate(task, policy, meta, device=device), run, done.interrupted)
    except BaseException:
        if folder is None:
            shutil.rmtree(run, ignore_errors=True)
        raise
    if folder is None:
        # A run without a folder is deleted with its result.
        weakref.finalize(made, shutil.rmtree, run, True)
    return made
