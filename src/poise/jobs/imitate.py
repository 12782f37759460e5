"""One motion, or several, imitated by a policy that is trained on them: what `poise imitate` does.

made = imitate("walk.bvh", minutes=3)           # a policy that knows many motions learns this one
made = imitate("walk.bvh", ResidualForce())     # from nothing, with residual force as help
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

from poise.errors import PoiseError
from poise.jobs.deliver import Delivery, deliver, finished
from poise.jobs.open import Run, open_run
from poise.jobs.perpetual.stage_order import Progress
from poise.jobs.practice import Watching, practise
from poise.jobs.result import Result, Shown, clip_of
from poise.jobs.run_file import learning_curve
from poise.jobs.runs import Evaluation, begin, evaluate, train, trained_policy
from poise.jobs.track import Tracked, write
from poise.jobs.track.rates import with_travel
from poise.jobs.track.settings import Mode
from poise.jobs.tracker import Tracker
from poise.jobs.warm_start import TrainingCallbacks
from poise.learn import IterationStats, PolicyBundle, Until
from poise.motion import Clip, ClipLibrary
from poise.recipes.imitation import Imitation
from poise.recipes.residual_force import ResidualForce
from poise.score import ScoreCard
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
        tracked: what is kept, the best of what policy, lookahead and search do, where a policy began;
            else None.
        sentences: what is said of that beside `track.story`.
    """

    task: Imitation
    policy: PolicyBundle
    evaluation: Evaluation
    run: Path
    interrupted: bool = False
    tracked: Tracked | None = None
    sentences: tuple[str, ...] = ()

    @cached_property
    def _finished(self) -> Delivery:
        return finished(self.task, self.evaluation)

    @property
    def clips(self) -> tuple[Clip, ...]:
        """The simulated motion of every clip, standing feet held."""
        if self.tracked is not None:
            return (self.tracked.clip,)
        return tuple(self._finished.clips.values())

    @property
    def clip(self) -> Clip:
        """The simulated motion of the first clip."""
        return self.clips[0]

    @property
    def card(self) -> ScoreCard:
        """The score of all start frames."""
        return self._finished.card if self.tracked is None else self.tracked.card

    @property
    def notes(self) -> tuple[str, ...]:
        """What was repaired in the motion, and what holding the feet did."""
        own = [n for clip in self.task.library for n in clip.skeleton.source.notes]
        if self.tracked is not None:
            own += [*self.sentences, *self.tracked.notes]
            travel = self.tracked.travel
            own += [] if travel is None or travel.sentence() in own else [travel.sentence()]
        return (*own, *self.task.report.sentences(), *self._finished.notes)

    def _shown(self) -> Shown:
        source = self.tracked.placed.source if self.tracked else self.task.library.clips[0]
        if self.tracked is not None and self.tracked.travel is not None:
            source = self.tracked.travel.beside
        return Shown(self.clip, source, self.card, self.notes)

    def _save_all(self, folder: Path) -> dict[str, Path]:
        curve = learning_curve(self.run)
        if self.tracked is not None:
            paths = write(self.tracked, folder, curve=curve).paths
        else:
            paths = deliver(self.task, self.evaluation, folder, curve).paths
        kept = folder / RUN
        if kept.resolve() != self.run.resolve():
            shutil.copytree(self.run, kept, dirs_exist_ok=True)
        return paths | {"run": kept}


def imitate(
    clip: Clip | str | Path | Sequence[Clip | str | Path],
    minutes: float = 3.0,
    config: ResidualForce | None = None,
    *,
    policy: Tracker | Run | str | Path | None = None,
    folder: str | Path | None = None,
    iterations: int | None = None,
    threads: int = 0,
    device: str = "cpu",
    on_iteration: Callable[[IterationStats], bool | None] | None = None,
    callbacks: TrainingCallbacks | None = None,
    in_place: Mode = "auto",
    **settings: Any,
) -> Imitated:
    """Trains a policy on a motion, simulates it from every start frame, and scores it.

    By default a policy that knows many motions learns this one, on its own joints with the bones of the
    clip, until it succeeds from 32 start frames or the time is over; where it loses the motion at first,
    a residual force helps it meanwhile, and fades (`jobs.practice`). Several clips, or any setting of
    the recipe but the seed, are learned from nothing by the recipe `ResidualForce`, on a body with every
    joint of the clip.

    Args:
        clip: a clip or a file; or several on one skeleton, which one policy learns.
        minutes: of training, above 0; with `iterations` whichever ends first, and 0 sets no time.
        config: the recipe's settings; `settings` are those that differ, such as help_limit=50.0 or
            num_envs=64.
        policy: which begins, see `track`; by default the one that comes with Poise.
        folder: keeps the run (the same again goes on with it); by default it is gone with the result,
            unless that is saved.
        threads: of the physics; 0 takes all cores.
        device: "cpu" or "cuda".
        on_iteration: is called after each iteration; returning False ends the training.
        callbacks: are told what happens before PPO begins, where nothing is there to begin with.
        in_place: what becomes of a clip in place, see `track.in_place`; what is
            learned from nothing keeps its travel.

    Raises:
        PoiseError: a motion that cannot be read or has no human body, an unknown setting, a folder that
            holds another run, a policy beside settings of the recipe, or no time to learn in.
    """
    until = _limit(minutes, iterations)
    several = [clip] if isinstance(clip, Clip | str | Path) else list(clip)
    stated = config is not None or set(settings) - {"seed"} or callbacks is not None
    if policy is not None and (stated or len(several) > 1):
        what = "several clips are" if len(several) > 1 else "settings of the recipe are for what is"
        raise PoiseError(
            f"{what} learned from nothing, and a policy was given",
            hint="Leave one out",
            code="settings-conflict",
        )
    config = changed(config or ResidualForce(), settings)
    library = ClipLibrary.of([clip_of(c) for c in several])
    run = Path(tempfile.mkdtemp(prefix="poise-")) if folder is None else Path(folder) / RUN
    try:
        tracker = None if stated or len(several) > 1 else _tracker(policy, library.clips[0])
        if tracker is not None:
            how = (run, until, config.seed, threads, device, on_iteration, in_place)
            return _kept(_practised(library.clips[0], tracker, *how), folder)
        travels = [with_travel(c, in_place, repeats=False, returns=False) for c in library]
        moving = [c if t is None else t.clip for c, t in zip(library, travels, strict=True)]
        task = begin(run, ClipLibrary.of(moving), config, device)
        done = train(task, run, until, on_iteration, threads, False, beginning=callbacks, device=device)
        learned, meta = trained_policy(run, task)
        scored = evaluate(task, learned, meta, device=device)
        return _kept(Imitated(task, learned, scored, run, done.interrupted), folder)
    except BaseException:
        if folder is None:
            shutil.rmtree(run, ignore_errors=True)
        raise


def _limit(minutes: float, iterations: int | None) -> Until:
    """When the training ends, at the latest."""
    if iterations is not None and iterations < 1:
        raise PoiseError(f"iterations must be at least 1, got {iterations}", code="out-of-range")
    if iterations is None and not minutes > 0:
        raise PoiseError(
            f"minutes must be above 0, got {minutes:g}", hint="Or give iterations", code="out-of-range"
        )
    return Until(minutes=minutes if minutes > 0 else None, iterations=iterations)


def _tracker(policy: Tracker | Run | str | Path | None, clip: Clip) -> Tracker | None:
    """The policy with the bones of the clip; None where that which comes with Poise does not fit."""
    run = open_run(policy) if policy is None or isinstance(policy, str | Path) else policy
    tracker = run.tracker if isinstance(run, Run) else run
    try:
        return tracker.with_bones_of(clip)
    except PoiseError:
        if policy is None:
            return None
        raise


def _practised(
    clip: Clip,
    tracker: Tracker,
    run: Path,
    until: Until,
    seed: int,
    threads: int,
    device: str,
    on_iteration: Callable[[IterationStats], bool | None] | None,
    in_place: Mode,
) -> Imitated:
    """What came of a policy that learned a motion on its own joints with the bones of the clip."""

    def tell(p: Progress) -> bool | None:
        return None if on_iteration is None else on_iteration(p.stats)

    made = practise(
        clip, tracker, run, until, seed, threads, device, Watching(iteration=tell), False, in_place
    )
    done, learned = made.tracked, made.learned
    assert done is not None
    task, evaluation = done.imitation, done.evaluation
    interrupted = learned.result.interrupted
    return Imitated(task, learned.tracker.policy, evaluation, run, interrupted, done, made.sentences)


def _kept(made: Imitated, folder: str | Path | None) -> Imitated:
    """The same; a run without a folder is deleted with its result."""
    if folder is None:
        weakref.finalize(made, shutil.rmtree, made.run, True)
    return made
