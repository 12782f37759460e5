"""`poise play compliant`: a character that gives way in a scene, and its twin that does not."""

from __future__ import annotations

import webbrowser
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import OmitArgPrefixes, Positional, arg

from poise.cli.console import Answer, say, table
from poise.cli.options import Flag, Reading, check_range
from poise.cli.training import working
from poise.errors import PoiseError, did_you_mean
from poise.jobs.keep import claimed, may_write

if TYPE_CHECKING:
    from poise.control import Compliance, Stiffness
    from poise.papers.compliant.scenes import PlayScene

#: What is written into the folder.
RESULTS = ("simulated.bvh", "score.json", "figures.json", "report.html")


@dataclass(frozen=True)
class Options:
    """Let a trained policy stand, or do a motion, in a scene in which something pushes it: a ball that
    is thrown, a sustained pull, a partner hand in hand, a door, a trampoline, a ball on a rod on its
    head, or an opponent that hops on one leg as it does. It gives way; the same is simulated without
    compliance, and a table compares both. Writes the motion, figures.json, score.json, report.html."""

    scene: Annotated[Positional[str], arg(metavar="SCENE")]
    """throws, pull, hands, door, trampoline, ball or chicken."""
    out: Annotated[Path, arg(aliases=["-o"], metavar="DIR")]
    """The folder of the results."""
    clip: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """What the character does; by default it stands."""
    duration: Annotated[float, arg(metavar="SECONDS")] = 8.0
    """How long it stands."""
    level: Annotated[float | None, arg(metavar="0-1", help_behavior_hint="")] = None
    """Level of compliance; by default 0.16, or for the ball a stiffness."""
    stiffness: Annotated[float | None, arg(metavar="N/M", help_behavior_hint="")] = None
    """Give way as a spring of so many newtons per metre in place of --level."""
    lag: Annotated[float, arg(metavar="SECONDS")] = 0.5
    """How fast it gives way with --stiffness: the time constant. Held hands need a slow one."""
    count: Annotated[int, arg(metavar="N")] = 16
    """Episodes, side by side, that begin a hair apart; the report shows the first."""
    newtons: Annotated[float | None, arg(metavar="N", help_behavior_hint="")] = None
    """pull: how hard (20)."""
    direction: Annotated[str | None, arg(metavar="X,Y,Z", help_behavior_hint="")] = None
    """pull: where to, Z up (0,1,0)."""
    side: Annotated[Literal["left", "right"] | None, arg(help_behavior_hint="")] = None
    """pull, hands: which hand (left)."""
    lead: Annotated[float | None, arg(metavar="M/S", help_behavior_hint="")] = None
    """hands: how much faster than the motion the partner goes (0)."""
    sway: Annotated[float | None, arg(metavar="METRES", help_behavior_hint="")] = None
    """hands: how far the partner's hand swings (0.1)."""
    mass: Annotated[float | None, arg(metavar="KG", help_behavior_hint="")] = None
    """throws: of the ball (1). chicken: of the player (85)."""
    other: Annotated[float | None, arg(metavar="KG", help_behavior_hint="")] = None
    """chicken: of the opponent (36)."""
    against: Annotated[Literal["bag", "rival"] | None, arg(help_behavior_hint="")] = None
    """chicken: a punching bag as heavy as the opponent (default), or the opponent itself."""
    width: Annotated[float | None, arg(metavar="METRES", help_behavior_hint="")] = None
    """door: how wide (1)."""
    made_for: Annotated[float | None, arg(metavar="METRES", help_behavior_hint="")] = None
    """door: how wide the door is for which the motion is made; by default the door's own width."""
    height: Annotated[float | None, arg(metavar="METRES", help_behavior_hint="")] = None
    """trampoline: how far its actuators rise for a bounce (0.15)."""
    first: Annotated[float | None, arg(metavar="SECONDS", help_behavior_hint="")] = None
    """trampoline: when the first bounce begins (1)."""
    length: Annotated[float | None, arg(metavar="METRES", help_behavior_hint="")] = None
    """ball: of the rod (1)."""
    pushes: Annotated[float | None, arg(metavar="N", help_behavior_hint="")] = None
    """ball: how hard the chest is pushed for 0.1 s every 2 to 3 s (0)."""
    seed: Annotated[int | None, arg(metavar="S", help_behavior_hint="")] = None
    """throws, ball, chicken: of the draws (0)."""
    policy: Annotated[Path | None, arg(metavar="FILE|RUN", help_behavior_hint="")] = None
    """A policy file, the folder of a run of poise train perpetual, or keypoints, the policy that comes
    along and is told places alone; by default the one for rotations that comes with Poise."""
    learned: Annotated[Path | None, arg(metavar="RUN|none", help_behavior_hint="")] = None
    """What was learned on top of the policy: the folder of poise train compliant SCENE. For the ball
    something comes along; none goes without."""
    controller: Literal["policy", "lookahead"] = "policy"
    """The policy alone, or with lookahead, which tries what it may do in copies of the scene."""
    budget: Annotated[float | None, arg(metavar="STEPS", help_behavior_hint="")] = None
    """Lookahead: control steps simulated for each that is made (192)."""
    threads: Annotated[int, arg(metavar="N")] = 0
    """Cores; 0 is all."""
    open: Flag = False
    """Open the page in the browser."""
    force: Flag = False
    """Write over files that are there."""
    json: Flag = False
    """Print one JSON document and nothing else on stdout, see docs/cli.md."""
    reading: OmitArgPrefixes[Reading] = field(default_factory=Reading)


def run(options: Options, argv: Sequence[str]) -> Answer:
    """Plays the scene with and without compliance, and writes what came of it."""
    o = options
    check_range("count", o.count, 1, 1024)
    check_range("duration", o.duration, 0.5, 3600)
    check_range("threads", o.threads, 0)
    check_range("budget", o.budget, 1, 1_000_000)
    if o.budget is not None and o.controller != "lookahead":
        what = "--budget is for --controller lookahead"
        raise PoiseError(
            what, hint="Add --controller lookahead, or leave --budget out", code="option-needs-option"
        )
    for name in RESULTS:
        may_write(o.out / name, o.force, *([o.clip] if o.clip else []))
    from poise.jobs.open import open_run
    from poise.papers.compliant.scene_play import play
    from poise.papers.compliant.scene_training import open_learned, shipped
    from poise.plan import LookaheadConfig

    how = LookaheadConfig() if o.budget is None else LookaheadConfig().with_budget(o.budget)
    scene, given = scene_of(o), given_of(o)
    clip = None if o.clip is None else o.reading.read(o.clip)
    with working("opening the policy"):
        tracker = open_run(o.policy).tracker
        stated = o.level is not None or o.stiffness is not None
        if o.learned is None:
            alone = stated or o.controller == "lookahead"
            learned = None if alone else shipped(o.scene, tracker)
        else:
            learned = None if str(o.learned) == "none" else open_learned(o.learned, tracker)
    if learned is not None and learned.config.scene != o.scene:
        what = f"the run learned the scene '{learned.config.scene}', not '{o.scene}'"
        raise PoiseError(
            what, o.learned, f"Write poise play compliant {learned.config.scene}", code="scene-differs"
        )
    if learned is not None and stated:
        raise PoiseError(
            "a run gives way as it has learned to",
            hint="Leave --level, --stiffness out",
            code="option-not-applicable",
        )
    with claimed(o.out):
        with working("simulating"):
            more = (o.count, o.duration, o.threads, o.scene, learned, o.controller, how)
            played = play(scene, tracker, clip, given, *more)
        with working("writing"):
            paths = played.write(o.out)
    rows = [(played.words[k], f"{v:.4g}", f"{played.stiff[k]:.4g}") for k, v in played.figures.items()]
    table(f"{o.scene}, {o.count} episodes", ("", "compliant", "without"), rows, left=1)
    say(played.sentence())
    if o.open and not webbrowser.open(paths["report"].absolute().as_uri()):
        raise PoiseError(
            "no browser could be opened", paths["report"], "Open the page by hand", code="no-browser"
        )
    result = {"scene": o.scene, "compliant": dict(played.figures), "without": dict(played.stiff)}
    return Answer(result, paths, () if given is None else given.notes)


def given_of(options: Options) -> Compliance | Stiffness | None:
    """How the character gives way; None leaves it to the scene.

    Raises:
        PoiseError: numbers that make no sense.
    """
    from poise.control import Compliance, Stiffness

    if options.stiffness is not None:
        return Stiffness(options.stiffness, options.lag)
    return None if options.level is None else Compliance(options.level)


def scene_of(options: Options) -> PlayScene:
    """The scene with what is stated of it.

    Raises:
        PoiseError: no such scene, or an option of another one.
    """
    from poise.cli.push import direction_of
    from poise.papers.compliant.scenes import SCENES

    o = options
    if o.scene not in SCENES:
        known = f"{did_you_mean(o.scene, list(SCENES))}"
        raise PoiseError(f"there is no scene '{o.scene}'", hint=known, code="unknown-scene")
    kind: Any = SCENES[o.scene]
    stated: dict[str, Any] = {
        "newtons": o.newtons, "direction": direction_of(o.direction), "side": o.side, "lead": o.lead,
        "sway": o.sway, "mass": o.mass, "width": o.width, "made_for": o.made_for, "height": o.height,
        "first": o.first, "length": o.length, "pushes": o.pushes, "other": o.other,
        "against": o.against, "seed": o.seed,
    }  # fmt: skip
    stated = {k: v for k, v in stated.items() if v is not None}
    own = {f.name for f in fields(kind)}
    for name in stated:
        if name not in own:
            option = "--" + name.replace("_", "-")
            raise PoiseError(
                f"{option} says nothing of the scene '{o.scene}'",
                hint="Leave it out",
                code="option-not-applicable",
            )
    return kind(**stated)
