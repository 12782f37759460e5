"""`poise push`: a motion in, the same motion with a push in it out."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import OmitArgPrefixes, Positional, arg

from poise.cli.console import LOST, Answer, print_card, say
from poise.cli.options import (
    Flag,
    HoldFeet,
    InPlaceMode,
    Json,
    Out,
    PolicyFile,
    Reading,
    Threads,
    check_range,
    places,
)
from poise.cli.training import working
from poise.jobs.keep import claimed, may_deliver


def run(
    clip: Annotated[Positional[Path], arg(metavar="CLIP")],
    out: Out,
    newtons: Annotated[float, arg(name="force", metavar="NEWTONS")] = 150.0,
    at: Annotated[str, arg(metavar="PART")] = "hand",
    start: Annotated[float, arg(name="from", metavar="SECONDS")] = 1.0,
    seconds: Annotated[float, arg(metavar="SECONDS")] = 0.5,
    direction: Annotated[str | None, arg(metavar="X,Y,Z", help_behavior_hint="")] = None,
    level: Annotated[float, arg(metavar="0-1")] = 0.12,
    stiffness: Annotated[float | None, arg(metavar="N/M", help_behavior_hint="")] = None,
    law: Literal["eq8", "algorithm1"] = "eq8",
    policy: PolicyFile = None,
    controller: Literal["lookahead", "policy"] = "lookahead",
    body: Literal["policy", "own"] = "policy",
    threads: Threads = 0,
    seed: Annotated[int, arg(metavar="S")] = 0,
    in_place: InPlaceMode = "auto",
    hold_feet: HoldFeet = True,
    overwrite: Flag = False,
    json: Json = False,
    reading: OmitArgPrefixes[Reading] = Reading(),
) -> Answer:
    """Let a trained policy do a motion while something pushes it: write the motion with the push in it
    on the skeleton that came in, score.json and report.html. The character gives way as far as --level
    or --stiffness says, keeps its balance if it can, and comes back.

    Args:
        clip: the motion file.
        newtons: how hard it is pushed.
        at: the part that is pushed: hand, elbow, shoulder, hip, knee or foot, the right one (left_hand
            is the other); head, chest or pelvis; or a body of the policy by its name.
        start: when the push begins.
        seconds: how long it lasts.
        direction: where it pushes to, Z up, such as 0,1,0; by default from the front, against where the
            pelvis looks when it begins.
        level: level of compliance, 0 does not give way; above 0.2 joints turn implausibly far.
        stiffness: give way as a spring of so many newtons per metre in place of --level: 1000 is stiff,
            50 limp.
        law: how the level acts: by the paper's Eq. 8, or by its Algorithm 1 as printed.
        controller: lookahead tries in copies of the character before it acts, without knowing of the
            push before it begins; policy acts alone, at once.
        body: policy is the body that it was trained on; own has the lengths and masses of the skeleton
            that came in.
        seed: seed of what lookahead draws.
        overwrite: write over files that are there.
    """
    from poise.jobs.track.pushed import PushConfig, way_of

    way = None if direction is None else way_of(direction)
    push = PushConfig(newtons, at, start, seconds, way, level, stiffness, law)
    check_range("seed", seed, 0)
    check_range("threads", threads, 0)
    folder, motion = places(out)
    may_deliver(folder, motion, overwrite, clip, flag="--overwrite")
    from poise.cli.track import follow
    from poise.jobs.open import open_run
    from poise.jobs.result import story
    from poise.jobs.track import TrackConfig

    config = TrackConfig(
        seed=seed,
        controller=controller,
        threads=threads,
        body=body,
        push=push,
        smooth_hz=reading.smooth,
        in_place=in_place,
    )
    source = reading.read(clip)
    with working("opening the policy"):
        tracker = open_run(policy).tracker
    with claimed(folder):
        said_early = list[str]()
        tracked = follow(tracker, [source], config, said_early, "pushing")
        with working("writing"):
            done = tracked.write(folder, motion, hold_feet)
    assert tracked.pushed is not None
    print_card(done.card)
    became = story(tracked, hint=False)
    say(became.sentence)
    say(tracked.pushed.sentence())
    if became.word == "lost":
        say("A weaker or shorter push, or a lower --level, may be borne.")
    word = became.word if became.failed else "pushed"
    result = {
        "outcome": word,
        "controller": tracked.controller,
        "sentence": became.sentence,
        "failures": [{"character": k, "seconds": t} for k, t in tracked.failures],
        "push": asdict(tracked.pushed),
        "score": done.card.to_dict(),
    }
    # The sentence on the push is said already.
    told = tuple(n for n in (*tracked.notes, *done.notes) if n != tracked.pushed.sentence())
    code, early = LOST if became.failed else 0, tuple(said_early)
    return Answer(result, done.paths, told, code, word, done.card.mpjpe_mm, early)
