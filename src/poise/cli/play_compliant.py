"""`poise play compliant`: a character that gives way in a scene, and its twin that does not."""

from __future__ import annotations

import webbrowser
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import OmitArgPrefixes, Positional, arg

from poise.cli.console import Answer, say, table
from poise.cli.options import (
    Budget,
    Flag,
    Force,
    Json,
    OpenPage,
    PolicyFile,
    Reading,
    Threads,
    check_range,
    lookahead_of,
)
from poise.cli.training import working
from poise.errors import PoiseError, did_you_mean
from poise.jobs.keep import claimed, may_write

if TYPE_CHECKING:
    from poise.control import Compliance, Stiffness
    from poise.papers.compliant.controller_run import ControllerRun
    from poise.papers.compliant.scene_play import Played
    from poise.papers.compliant.scenes import PlayScene

#: What is written into the folder.
RESULTS = ("simulated.bvh", "score.json", "figures.json", "report.html")


def run(
    scene: Annotated[Positional[str], arg(metavar="SCENE")],
    out: Annotated[Path, arg(aliases=["-o"], metavar="DIR")],
    clip: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None,
    duration: Annotated[float, arg(metavar="SECONDS")] = 8.0,
    level: Annotated[float | None, arg(metavar="0-1", help_behavior_hint="")] = None,
    newtons_per_metre: Annotated[
        float | None, arg(name="stiffness", metavar="N/M", help_behavior_hint="")
    ] = None,
    lag: Annotated[float, arg(metavar="SECONDS")] = 0.5,
    count: Annotated[int, arg(metavar="N")] = 16,
    newtons: Annotated[float | None, arg(metavar="N", help_behavior_hint="")] = None,
    direction: Annotated[str | None, arg(metavar="X,Y,Z", help_behavior_hint="")] = None,
    side: Annotated[Literal["left", "right"] | None, arg(help_behavior_hint="")] = None,
    lead: Annotated[float | None, arg(metavar="M/S", help_behavior_hint="")] = None,
    sway: Annotated[float | None, arg(metavar="METRES", help_behavior_hint="")] = None,
    partner: Annotated[Literal["carried", "person"] | None, arg(help_behavior_hint="")] = None,
    mass: Annotated[float | None, arg(metavar="KG", help_behavior_hint="")] = None,
    other: Annotated[float | None, arg(metavar="KG", help_behavior_hint="")] = None,
    against: Annotated[Literal["bag", "rival", "nobody"] | None, arg(help_behavior_hint="")] = None,
    width: Annotated[float | None, arg(metavar="METRES", help_behavior_hint="")] = None,
    made_for: Annotated[float | None, arg(metavar="METRES", help_behavior_hint="")] = None,
    height: Annotated[float | None, arg(metavar="METRES", help_behavior_hint="")] = None,
    first: Annotated[float | None, arg(metavar="SECONDS", help_behavior_hint="")] = None,
    length: Annotated[float | None, arg(metavar="METRES", help_behavior_hint="")] = None,
    pushes: Annotated[float | None, arg(metavar="N", help_behavior_hint="")] = None,
    seed: Annotated[int | None, arg(metavar="S", help_behavior_hint="")] = None,
    policy: PolicyFile = None,
    learned: Annotated[Path | None, arg(metavar="RUN|none", help_behavior_hint="")] = None,
    recover: Flag = False,
    controller: Literal["policy", "lookahead"] = "policy",
    budget: Budget = None,
    threads: Threads = 0,
    open: OpenPage = False,
    force: Force = False,
    json: Json = False,
    reading: OmitArgPrefixes[Reading] = Reading(),
) -> Answer:
    """Let a trained policy stand, or do a motion, in a scene in which something pushes it: a ball that
    is thrown, a sustained pull, a partner hand in hand, a door, a trampoline, a ball on a rod on its
    head, or an opponent that hops on one leg as it does. It gives way; the same is simulated without
    compliance, and a table compares both. Writes the motion, figures.json, score.json, report.html.

    Args:
        scene: throws, pull, hands, door, trampoline, ball or chicken.
        out: the folder of the results.
        clip: what the character does; by default it stands.
        duration: how long it stands.
        level: level of compliance; by default 0.16, or for the ball a stiffness.
        newtons_per_metre: give way as a spring of so many newtons per metre in place of --level.
        lag: how fast it gives way with --stiffness: the time constant. Held hands need a slow one.
        count: episodes, side by side, whose starts differ; the report shows the first.
        newtons: pull: how hard (20).
        direction: pull: where to, Z up (0,1,0).
        side: pull, hands: which hand (left).
        lead: hands: how much faster than the motion the partner goes (0).
        sway: hands: how far the partner's hand swings (0.1).
        partner: hands: a hand that is carried along (default), or a person who does the same in a mirror
            and gives way, too.
        mass: throws: of the ball (1). chicken: of the player (85).
        other: chicken: of the opponent (36).
        against: chicken: a punching bag as heavy as the opponent (default), the opponent itself, or
            nobody.
        width: door: how wide (1).
        made_for: door: how wide the door is for which the motion is made; by default 1 m for doors
            of 1 to 1.7 m, as the policy for doors has learned it, else the door's own width.
        height: trampoline: how far its actuators rise for a bounce (0.15).
        first: trampoline: when the first bounce begins (1).
        length: ball: of the rod (1).
        pushes: ball: how hard the chest is pushed for 0.1 s every 2 to 3 s (0).
        seed: throws, ball, chicken: of the draws (0).
        learned: what was learned on top of the policy: the folder of poise train compliant SCENE, at
            --level where it learned levels; of two people for both. For ball, chicken, door and hands
            a policy comes along; none goes without.
            pull, hands: also that of poise train compliant-imitation, which stands by itself.
        recover: get up after a fall and go on; an opponent stays down.
        controller: the policy alone, or with lookahead, which tries what it may do in copies of the
            scene.
        budget: simulated control steps of lookahead for each that is made, by default 192.
    """
    check_range("count", count, 1, 1024)
    check_range("duration", duration, 0.5, 3600)
    check_range("threads", threads, 0)
    if budget is not None and controller != "lookahead":
        what = "--budget is for --controller lookahead"
        raise PoiseError(
            what, hint="Add --controller lookahead, or leave --budget out", code="option-needs-option"
        )
    for name in RESULTS:
        may_write(out / name, force, *([clip] if clip else []))
    from poise.jobs.open import open_run
    from poise.jobs.track.pushed import way_of
    from poise.papers.compliant.scene_play import play
    from poise.papers.compliant.scene_training import along, open_learned

    how = lookahead_of(budget)
    stated: dict[str, Any] = {
        "newtons": newtons,
        "direction": None if direction is None else way_of(direction),
        "side": side,
        "lead": lead,
        "sway": sway,
        "partner": partner,
        "mass": mass,
        "width": width,
        "made_for": made_for,
        "height": height,
        "first": first,
        "length": length,
        "pushes": pushes,
        "other": other,
        "against": against,
        "seed": seed,
    }
    place, given = scene_of(scene, stated), given_of(level, newtons_per_metre, lag)
    own = None if learned is None else controller_in(learned)
    if own is not None:
        for option, value in (
            ("--clip", clip),
            ("--stiffness", newtons_per_metre),
            ("--policy", policy),
            ("--controller lookahead", controller == "lookahead" or None),
            ("--recover", recover or None),
        ):
            if value is not None:
                raise PoiseError(
                    f"the run of --learned stands and acts by itself, so that {option} means nothing",
                    learned,
                    "Leave it out",
                    code="option-not-applicable",
                )
        with claimed(out):
            with working("simulating"):
                played = own.play(place, level, count, duration, threads, scene)
            return told(played, out, given, open)
    motion = None if clip is None else reading.read(clip)
    with working("opening the policy"):
        tracker = open_run(policy).tracker
        chosen = level is not None or newtons_per_metre is not None
        if learned is None:
            knows = None if controller == "lookahead" else along(place, tracker)
            # A policy that comes along is asked for nothing that it has not learned.
            drawn = knows is not None and knows.config.drawn is not None
            knows = None if (newtons_per_metre is not None if drawn else chosen) else knows
        else:
            knows = None if str(learned) == "none" else open_learned(learned, tracker)
            if knows is not None and knows.config.policy and policy is None:
                tracker = open_run(knows.config.policy).tracker
    if knows is not None and knows.config.scene != scene:
        what = f"the run learned the scene '{knows.config.scene}', not '{scene}'"
        raise PoiseError(
            what, learned, f"Write poise play compliant {knows.config.scene}", code="scene-differs"
        )
    if knows is not None:
        given, place = knows.config.played(given), knows.config.suits(place) or place
    with claimed(out):
        with working("simulating"):
            more = (count, duration, threads, scene, knows, controller, how, recover)
            played = play(place, tracker, motion, given, *more)
        return told(played, out, given, open)


def told(played: Played, out: Path, given: Compliance | Stiffness | None, open: bool) -> Answer:
    """Writes what came of a scene, and says it."""
    with working("writing"):
        paths = played.write(out)
    rows = [(played.words[k], f"{v:.4g}", f"{played.stiff[k]:.4g}") for k, v in played.figures.items()]
    table(f"{played.scene}, {played.count} episodes", ("", "compliant", "without"), rows, left=1)
    say(played.sentence())
    if open and not webbrowser.open(paths["report"].absolute().as_uri()):
        raise PoiseError(
            "no browser could be opened", paths["report"], "Open the page by hand", code="no-browser"
        )
    result = {"scene": played.scene, "compliant": dict(played.figures), "without": dict(played.stiff)}
    return Answer(result, paths, (*played.notes, *(() if given is None else given.notes)))


def controller_in(learned: Path) -> ControllerRun | None:
    """The run of the imitation controller that a folder holds; None where it holds none."""
    from poise.jobs.run_file import RUN_FILE
    from poise.papers.compliant.controller_run import ControllerRun
    from poise.papers.opened import opened

    run = opened(learned) if (learned / RUN_FILE).exists() else None
    return run if isinstance(run, ControllerRun) else None


def given_of(level: float | None, stiffness: float | None, lag: float) -> Compliance | Stiffness | None:
    """How the character gives way; None leaves it to the scene.

    Raises:
        PoiseError: numbers that make no sense.
    """
    from poise.control import Compliance, Stiffness

    if stiffness is not None:
        return Stiffness(stiffness, lag)
    return None if level is None else Compliance(level)


def scene_of(scene: str, stated: dict[str, Any]) -> PlayScene:
    """The scene with what is stated of it; None is not.

    Raises:
        PoiseError: no such scene, or an option of another one.
    """
    from poise.papers.compliant.scenes import SCENES

    if scene not in SCENES:
        known = f"{did_you_mean(scene, list(SCENES))}"
        raise PoiseError(f"there is no scene '{scene}'", hint=known, code="unknown-scene")
    kind: Any = SCENES[scene]
    stated = {k: v for k, v in stated.items() if v is not None}
    own = {f.name for f in fields(kind)}
    for name in stated:
        if name not in own:
            option = "--" + name.replace("_", "-")
            raise PoiseError(
                f"{option} says nothing of the scene '{scene}'",
                hint="Leave it out",
                code="option-not-applicable",
            )
    return kind(**stated)
