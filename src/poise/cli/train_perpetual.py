"""`poise train perpetual`: one policy for a whole library, stage after stage."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Protocol, TypeAlias

from tyro.conf import arg

from poise.cli import training as progress
from poise.cli.console import Answer, launched, notes, say, table, tell
from poise.cli.library_options import Library
from poise.cli.options import Body, Flag, Training, check_range
from poise.cli.recipe_options import SOURCES, configured, derived, given, stated
from poise.cli.training import beginning, clock, held_already, left, showing, stopped
from poise.errors import PoiseError
from poise.jobs.keep import claimed
from poise.settings import imported

if TYPE_CHECKING:
    from poise.jobs.perpetual.perpetual_run import PerpetualResult
    from poise.jobs.perpetual.stages import Progress
    from poise.recipes.imitation import Imitation
    from poise.score import RecoveryCard


#: Clips that are named in the end.
NAMED = 10


def report(imitation: Imitation, result: PerpetualResult, out: Path) -> Answer:
    """What the run came to, and which clips are the hardest."""
    if result.last is None:
        say(f"{out} had reached its limit before; nothing was trained.")
    else:
        stats = result.last.stats
        say(f"Trained {clock(stats.seconds)}, {stats.samples:,} samples, {parts(result)}")
    r, names = result.results, imitation.library.names
    assert r is not None
    won, total = int(r.succeeded.sum()), len(r.clip)
    say(f"Without help {won} of {total} clips succeed ({100 * r.rate:.1f} %), {r.error_mm:.0f} mm")
    if result.recovery is not None:
        say(recovered(result.recovery))
    if hard := r.hardest(NAMED):
        rows = []
        for c in hard:
            k = r.clip.tolist().index(c)
            rows.append((names[c], f"{int(r.tracked[k])} of {int(r.frames[k])}"))
        table(f"The hardest of {total - won} that fail", ("clip", "frames tracked"), rows)
    figures = {"succeeded": won, "clips": total, "succ": r.rate, "error_mm": r.error_mm}
    return Answer(figures, {"run": out})


def recovered(card: RecoveryCard) -> str:
    """What trials of recovery came to: "Recovery: fallen 95 % within 5 s and 99 % within 10 s; ..."."""
    rows = []
    for row in card.rows:
        each = (f"{100 * x:.0f} % within {t:g} s" for x, t in zip(row.within, card.seconds, strict=True))
        rows.append(f"{row.kind} {' and '.join(each)}")
    return f"Recovery, {card.rows[0].trials} trials each: {'; '.join(rows)}"


def parts(result: PerpetualResult) -> str:
    """What was trained, in words."""
    n = result.primitives
    made = f"{n} primitive{'s' if n > 1 else ''}" if n else "one network"
    return f"{made}; nothing fails any more" if result.solved else made


def figures(p: Progress) -> str:
    """What one iteration says: the stage, its clips, the speed."""
    what = "trials" if p.stage.kind == "recovery" else "clips"
    won = "" if p.succeeded is None else f"  {p.succeeded} of {p.clips} {what}"
    helped = f"  help at most {p.help_n:.0f} N" if p.help_n else "  no help"
    reward = p.stats.terms.get("imitation", p.stats.reward)
    speed = f"{p.stats.samples_per_s:,.0f} samples/s"
    return f"{p.stage.name}{won}  {speed}  imitation {reward:.3f}{helped}"


def times(p: Progress) -> str:
    """How far it is: "1:20, 8:40 left"."""
    return f"{clock(p.stats.seconds)}, {left(p.stats.seconds, p.share)}"


def events(p: Progress) -> None:
    """A line for each evaluation, where another stage begins, and for what went wrong."""
    if p.trouble:
        tell(
            f"Gone on from the last checkpoint with other draws, since a simulation failed: {p.trouble}"
        )
    if p.results is not None:
        won, total = int(p.results.succeeded.sum()), len(p.results.clip)
        tell(
            f"{clock(p.stats.seconds)}  {p.stage.name}: {won} of {total} clips succeed, "
            f"{p.results.error_mm:.0f} mm"
        )
    if p.recovery is not None:
        tell(f"{clock(p.stats.seconds)}  {p.stage.name}: {recovered(p.recovery)}")
    if p.following is not None:
        tell(f"{clock(p.stats.seconds)}  {p.following.name} begins")


@contextlib.contextmanager
def shown() -> Iterator[Callable[[Progress], None]]:
    """A bar in a terminal, a line now and then elsewhere, and `events`."""
    with showing("training") as show:

        def one(p: Progress) -> None:
            show(p.share, f"{times(p)}  {figures(p)}")
            events(p)

        yield one


if TYPE_CHECKING:
    from poise.jobs.tracker import Tracker
    from poise.papers.perpetual.ablations import StagedPerpetual
    from poise.recipes.imitation import Imitation

    _Derived: TypeAlias = Any
else:
    _Derived = derived(
        "perpetual", "perpetual: ", "single", "max_primitives", "goal", "recovery", "multiplicative",
        "progressive", "termination", "action",
    )  # fmt: skip


#: The teacher that is no policy.
LOOKAHEAD = "lookahead"


@dataclass(frozen=True)
class Primitives(_Derived):
    """What only the recipe perpetual knows."""

    recovery_clips: Flag = True
    """perpetual: characters that recover are told a point to come back to, as in the paper; by default
    they follow the library's own clips, where some of them get up and some walk."""
    going_on: Annotated[Path | None, arg(name="from", metavar="POLICY", help_behavior_hint="")] = None
    """perpetual: go on from a trained policy, a file or a run, with its networks and body and, but for
    what --set states, its settings; with recovery it stays as it is, beside a primitive that recovers
    or, where it can already, others that learn what it fails (--single: one network). compliant: from
    what was learned of the scene on another policy. endless, dual-policy: the policy with the body."""
    paths: Annotated[int, arg(metavar="N")] = 0
    """perpetual: learn without help, from motions near the clips that need none, found first by so
    many iterations, 11 say; 0 learns with --help-start at first."""
    teacher: Annotated[str | None, arg(metavar="lookahead|POLICY", help_behavior_hint="")] = None
    """perpetual: lookahead tells the policy what it should have done where it comes to; the policy
    learns from that alone, and PPO trains the critic. With --from the policy comes to observe more.
    A POLICY, a file or a run, is imitated at first, with its settings and body but for what is stated,
    such as --goal keypoints."""
    noise: Annotated[tuple[float, ...], arg(metavar="X [X ...]", help_behavior_hint="")] = ()
    """perpetual: learn each clip once more with so many times a video estimator's noise, such as
    0.25 0.5: the policy is told the noisy motion and judged by the clean one."""
    style: Flag = True
    """perpetual: reward the task alone; by default a discriminator rewards motion like the library's."""


#: Options that stand for a policy or for other settings than their names say.
BY_HAND = ("recovery_clips", "going_on", "paths", "style", "teacher")


def recipe(additive: bool) -> StagedPerpetual:
    """The settings before anything is stated but the kind of actions."""
    from poise.papers.perpetual.ablations import StagedPerpetual

    return StagedPerpetual.additive() if additive else StagedPerpetual()


def settings(
    primitives: Primitives, training: Training, body: Body, options: Mapping[str, Any]
) -> StagedPerpetual:
    """The recipe's settings. options: by name, what the options state."""
    from poise.papers.perpetual.ablations import ONE_NETWORK, StagedPerpetual

    values = {name: value for name, value in options.items() if name not in BY_HAND}
    if not 1 <= values.get("max_primitives", 1) <= 64:
        raise PoiseError(
            f"--max-primitives must lie in 1 to 64, got {values['max_primitives']}", code="out-of-range"
        )
    check_range("paths", primitives.paths, 0)
    if primitives.paths and values.get("expert") is False:
        raise PoiseError(
            "--paths are for the expert, and --no-expert does without",
            hint="Leave one out",
            code="option-conflict",
        )
    if primitives.paths:
        # The LQR teacher on optimised trajectories needs no help at any time.
        values |= {"help_start": 0.0, "trajopt.iterations": primitives.paths}
    if not primitives.recovery_clips:
        values["recovering.demonstrations"] = 0
    if not primitives.style:
        values["style"] = None
    additive = values.get("action") == "additive"
    default = recipe(additive)
    if primitives.teacher == LOOKAHEAD:
        default = default.taught()
    elif primitives.teacher:
        from poise.jobs.open import open_run
        from poise.jobs.perpetual.distillation import taught_by

        if primitives.going_on is not None:
            what = "--teacher POLICY is imitated by a new network, and --from goes on with one"
            raise PoiseError(
                what, hint="Leave one out, or take --teacher lookahead", code="option-conflict"
            )
        goal = {"goal": values["goal"]} if "goal" in values else {}
        default = taught_by(open_run(Path(primitives.teacher)).tracker.config, **goal)
        default = StagedPerpetual.of(default, **ONE_NETWORK)
    return training.settings("perpetual", default, body, values)


class TrainOptions(Protocol):
    """The options of `poise train`, as far as this recipe reads them."""

    @property
    def library(self) -> Library: ...
    @property
    def primitives(self) -> Primitives: ...
    @property
    def out(self) -> Path: ...
    @property
    def training(self) -> Training: ...
    @property
    def body(self) -> Body: ...
    @property
    def recipe_settings(self) -> Any: ...


def check_going_on(o: TrainOptions, returns: bool = True) -> dict[str, Any]:
    """Refuses options that the policy decides from which training goes on; the settings in --set that it
    does not, by dotted names.

    returns: the policy tracks recovery motions already, so that primitives may learn what it fails.
    """
    from poise.jobs.perpetual import perpetual_run
    from poise.papers.perpetual import ablations

    library, primitives, body = o.library, o.primitives, o.body
    if library.onto is not None:
        what = "--from brings the clips onto the policy's body, and --onto onto another skeleton"
        raise PoiseError(what, hint="Leave --onto out", code="option-conflict")
    free = {"recovery", "recovery_clips", "single", "going_on", "teacher", "noise"}
    if returns and primitives.recovery and primitives.recovery_clips and not primitives.single:
        free.add("max_primitives")
    names = [name for name in given(primitives, replace(body, set=())) if name not in free]
    names += [name for name in ("preset", "config") if getattr(o.training, name)]
    names += ["help_start"] if o.recipe_settings.help_start else []
    more, of_the_body = stated(body.set, imported(SOURCES["perpetual"]))
    names += [text.partition("=")[0] for text in of_the_body]
    # A part that is kept, one of its settings, or a part with a setting that is kept.
    kept = [f"{name}." for name in perpetual_run.KEPT | ablations.KEPT]
    names += [n for n in more if any(f"{n}.".startswith(k) or k.startswith(f"{n}.") for k in kept)]
    if names:
        what = f"--from goes on with the policy's own settings and body, and there is {', '.join(names)}"
        raise PoiseError(what, hint="Leave it out", code="option-conflict")
    return more


def goes_on(o: TrainOptions, config: StagedPerpetual) -> tuple[Tracker, StagedPerpetual]:
    """The policy of --from, and the settings of a run that goes on from it.

    config: what the command line states without it.
    """
    from poise.jobs.open import open_run
    from poise.papers.perpetual.ablations import going_on

    primitives, asked = o.primitives, o.recipe_settings.num_envs
    assert primitives.going_on is not None
    check_going_on(o)
    tracker = open_run(primitives.going_on).tracker
    # Whether --max-primitives has a say is known by the policy alone.
    returns = tracker.recovery_clips is not None
    more = check_going_on(o, returns)
    if asked is None:
        config = replace(config, num_envs=tracker.config.num_envs)
    config = going_on(tracker.config, config, returns)
    if primitives.teacher == LOOKAHEAD:
        config = config.taught() if asked is None else replace(config.taught(), num_envs=asked)
    return tracker, configured(config, more)


def run(o: TrainOptions, config: StagedPerpetual, again: str) -> Answer:
    """Trains until nothing fails, a limit is reached, or Ctrl-C."""
    library, primitives, out, training = o.library, o.primitives, o.out, o.training
    library.folder("perpetual")
    if launched() and int(os.environ["WORLD_SIZE"]) > 1:
        hint = "Start it without torchrun; --threads and --device take all of one machine"
        raise PoiseError(
            "the recipe perpetual trains in one process", hint=hint, code="option-not-applicable"
        )
    from poise.jobs.perpetual.perpetual_run import train
    from poise.jobs.run_file import RUN_FILE
    from poise.learn import LATEST, Until

    held = (out / RUN_FILE).exists()
    if held and not training.resume:
        raise held_already(out)
    tracker = None
    if primitives.going_on is not None:
        tracker, config = goes_on(o, config)
    elif primitives.teacher not in (None, LOOKAHEAD):
        tracker = _teacher(primitives, library)
    imitation = begin(library, out, config, training, held, tracker)
    until = Until(minutes=training.minutes, iterations=training.iterations)
    t, result, trained = training, None, None
    # A run that was killed before its first checkpoint begins as if it had not been begun.
    if tracker is not None and not (out / LATEST).exists():
        from poise.jobs.perpetual.distillation import distilled
        from poise.jobs.warm_start import widened

        if primitives.going_on is None:
            trained = distilled(tracker, imitation, t.threads, out / "dumps", beginning(), t.device)
        else:
            trained = widened(tracker, imitation)
    with contextlib.suppress(KeyboardInterrupt), shown() as show:
        # A second Ctrl-C ends the present iteration too; what is in the last checkpoint stays.
        result = train(
            imitation, out, until, show, t.threads, device=t.device, beginning=beginning(),
            trained=trained,
        )  # fmt: skip
    if result is None or result.interrupted:
        where = "" if result is None or result.last is None else f" in {result.last.stage.name}"
        return stopped(out, again, where)
    return report(imitation, result, out)


def _teacher(primitives: Primitives, library: Library) -> Tracker:
    """The policy that teaches; the clips are brought onto its body."""
    from poise.jobs.open import open_run

    if library.onto is not None:
        what = "--teacher POLICY brings the clips onto its body, and --onto onto another skeleton"
        raise PoiseError(what, hint="Leave --onto out", code="option-conflict")
    assert primitives.teacher is not None
    return open_run(Path(primitives.teacher)).tracker


def begin(
    library: Library,
    out: Path,
    config: StagedPerpetual,
    training: Training,
    held: bool,
    tracker: Tracker | None,
) -> Imitation:
    """Reads the folder, tries the run folder, builds the task; nothing stays if that fails.

    held: the run folder holds a run already, which then is all that is read. tracker: the policy that it
    goes on from or is taught by.
    """
    from poise.jobs.perpetual import perpetual_run

    folder = library.folder("perpetual")
    hold_out, never = ((p,) if p else () for p in (library.hold_out, library.never))
    source = ", without ".join((str(folder.resolve()), *hold_out, *never))
    source = ", ".join((source, *library.source()))
    if held:
        with progress.working("opening the run"):
            return perpetual_run.resume(out, config, source, training.device)
    if training.resume:
        tell(f"There was no run in {out}; a new one starts.")
    onto = library.onto if tracker is None else tracker.target
    clips, said = perpetual_run.clips_of(
        folder, config.body, hold_out, never, tell, onto, library.reading()
    )
    say(f"{len(clips)} clips, {clock(clips.seconds)}")
    notes(said)
    with claimed(out), progress.working("making the body"):
        return perpetual_run.begin(out, clips, config, source, training.device, tracker)
