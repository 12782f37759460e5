"""One motion, or several, imitated by a policy that is trained on them: what `poise imitate` does.

made = imitate("walk.bvh", minutes=3)           # a policy that knows many motions learns this one
made = imitate("walk.bvh", ResidualForce())     # from nothing, with residual force as help
made.card, made.clip, made.save("out")
"""

from __future__ import annotations

import shutil
import tempfile
import weakref
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from poise.body import Humanoid
from poise.env import RewardTerm
from poise.errors import PoiseError
from poise.jobs.keep import EVALUATING, claimed
from poise.jobs.open import Run, open_run
from poise.jobs.practice import Watching, practise
from poise.jobs.result import RUN, Result, clip_of
from poise.jobs.runs import begin, evaluate, train, trained_policy
from poise.jobs.track.in_place import with_travel
from poise.jobs.track_settings import Mode
from poise.jobs.tracker import Tracker
from poise.jobs.warm_start import TrainingCallbacks
from poise.learn import IterationStats, RunResult, Until
from poise.learn.parallel import ALONE, Comm, joined, share_of, together
from poise.motion import Clip, ClipLibrary
from poise.recipes.imitation import Imitation
from poise.recipes.residual_force_settings import ResidualForce
from poise.settings import changed


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
    rewards: Callable[[Humanoid], Sequence[RewardTerm]] | None = None,
    **settings: Any,
) -> Result:
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
        rewards: makes further rewards for the body; the motion is learned from nothing then. The run
            folder has their names alone: whatever goes on with it gives them again.

    Raises:
        PoiseError: a motion that cannot be read or has no human body, an unknown setting, a folder that
            holds another run, a policy beside settings of the recipe, or no time to learn in.
    """
    until = _limit(minutes, iterations)
    several = [clip] if isinstance(clip, Clip | str | Path) else list(clip)
    stated = bool(config or set(settings) - {"seed"} or callbacks or rewards)
    if policy is not None and (stated or len(several) > 1):
        what = "several clips are" if len(several) > 1 else "settings of the recipe are for what is"
        raise PoiseError(
            f"{what} learned from nothing, and a policy was given",
            hint="Leave one out",
            code="settings-conflict",
        )
    config = changed(config or ResidualForce(), settings)
    run = Path(tempfile.mkdtemp(prefix="poise-")) if folder is None else Path(folder) / RUN
    told = Watching(
        iteration=lambda p: None if on_iteration is None else on_iteration(p.stats),
        beginning=lambda _: callbacks,
        stats=on_iteration,
    )
    how = (run, config, until, threads, device, in_place, told)
    job = Job(lambda: [clip_of(c) for c in several], *how, rewards=rewards)
    try:
        made = job.done(policy, stated or len(several) > 1)
    except BaseException:
        if folder is None:
            shutil.rmtree(run, ignore_errors=True)
        raise
    assert made is not None
    own = [n for clip in made.imitation.library for n in clip.skeleton.source.notes]
    own += [*made.sentences, *made.notes]
    travel = None if made.travel is None else made.travel.sentence()
    own += [] if travel is None or travel in own else [travel]
    made = replace(made, notes=(*own, *made.imitation.report.sentences()))
    if folder is None:
        weakref.finalize(made, shutil.rmtree, made.run, True)
    return made


def _limit(minutes: float, iterations: int | None) -> Until:
    """When the training ends, at the latest."""
    if iterations is not None and iterations < 1:
        raise PoiseError(f"iterations must be at least 1, got {iterations}", code="out-of-range")
    if iterations is None and not minutes > 0:
        raise PoiseError(
            f"minutes must be above 0, got {minutes:g}", hint="Or give iterations", code="out-of-range"
        )
    return Until(minutes=minutes if minutes > 0 else None, iterations=iterations)


@dataclass(frozen=True)
class Job:
    """The job of `imitate`, for Python and the command line.

    Attributes:
        read: gives the clips, a single one where a policy begins.
        run: the run folder.
        config, until, threads, device, in_place, told, rewards: see `imitate` and `Watching`.
        attended: by a user at a terminal: processes of `torchrun` train together, what Ctrl-C ended is
            not evaluated, and the curve is kept for TensorBoard as well.
    """

    read: Callable[[], Sequence[Clip]]
    run: Path
    config: ResidualForce
    until: Until
    threads: int = 0
    device: str = "cpu"
    in_place: Mode = "auto"
    told: Watching = field(default_factory=Watching)
    attended: bool = False
    rewards: Callable[[Humanoid], Sequence[RewardTerm]] | None = None

    def done(
        self, policy: Tracker | Run | str | Path | None = None, nothing: bool = False
    ) -> Result | None:
        """The result for the clips; None on every process of `torchrun` but the first.

        nothing: no policy begins.

        Raises:
            KeyboardInterrupt: Ctrl-C ended the training, `attended`; what came of it is saved.
            PoiseError: see `imitate`.
        """
        made = None if nothing else self._practised(policy)
        if made is not None:
            return made
        task, result, rank = self.learned()
        if result.interrupted and self.attended:
            raise KeyboardInterrupt
        if rank:
            return None
        with self.told.doing(EVALUATING):
            net, meta = trained_policy(self.run, task)
            evaluation = evaluate(task, net, meta, device=self.device)
        return Result(task, evaluation, policy=net, run=self.run, interrupted=result.interrupted)

    def _practised(self, policy: Tracker | Run | str | Path | None) -> Result | None:
        """The result by a policy; None if the one that comes with Poise does not fit."""
        (clip,) = self.read()
        self.told.given(ClipLibrary.of(clip))
        with self.told.doing("opening the policy"):
            run = open_run(policy) if policy is None or isinstance(policy, str | Path) else policy
            tracker = run.tracker if isinstance(run, Run) else run
        try:
            tracker = tracker.with_bones_of(clip)
        except PoiseError as problem:
            if policy is not None:
                raise
            self.told.unfit(problem)
            return None
        with claimed(self.run.parent):
            made = practise(
                clip,
                tracker,
                self.run,
                self.until,
                self.config.seed,
                self.threads,
                self.device,
                self.told,
                self.attended,
                self.in_place,
            )
        if made.tracked is None:
            raise KeyboardInterrupt
        return replace(
            made.tracked,
            policy=made.learned.tracker.policy,
            run=self.run,
            sentences=made.sentences,
            interrupted=made.learned.result.interrupted,
        )

    def learned(self) -> tuple[Imitation, RunResult, int]:
        """The clips learned from nothing: the task, how its training ended, this process's rank."""
        with joined() if self.attended else nullcontext(ALONE) as comm:
            task = self._begun(comm)
            more = (self.attended, comm, self.told.beginning(task), self.device)
            try:
                result = train(task, self.run, self.until, self.told.stats, self.threads, *more)
            except KeyboardInterrupt:
                # A second Ctrl-C ends the present iteration too; all before it are saved.
                if not self.attended:
                    raise
                result = RunResult(None, True, None)
        return task, result, comm.rank

    def _begun(self, comm: Comm) -> Imitation:
        """The task on every process: the first one begins the run, the others open its folder."""
        task = None
        with together(comm):
            if comm.size > 1:
                share_of(self.config.num_envs, comm)
            if comm.rank == 0:
                library = self._travelling()
                self.told.given(library)
                with self.told.doing("making the body"), claimed(self.run):
                    task = begin(self.run, library, self.config, self.device, self.rewards)
                self.told.begun(task)
        with together(comm):
            return task or open_run(self.run).task

    def _travelling(self) -> ClipLibrary:
        """The clips, each with a name of its own, and those in place with the travel of their feet."""
        counts, out = Counter[str](), list[Clip]()
        for clip in self.read():
            travel = with_travel(clip, self.in_place, repeats=False, returns=False)
            if travel is not None:
                self.told.say(travel.sentence())
                clip = travel.clip
            counts[clip.name] += 1
            count = counts[clip.name]
            out.append(clip if count == 1 else clip.replaced(name=f"{clip.name}-{count}"))
        return ClipLibrary(tuple(out))
