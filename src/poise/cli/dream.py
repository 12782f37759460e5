"""`poise dream`: a character that goes about, for as long as is asked."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import OmitArgPrefixes, UseAppendAction, arg

from poise.cli.console import INTERRUPTED, LOST, Answer, say, table
from poise.cli.options import (
    Budget,
    Flag,
    Force,
    HoldFeet,
    Json,
    Out,
    Reading,
    Threads,
    check_range,
    lookahead_of,
    places,
)
from poise.cli.training import staged, working
from poise.errors import PoiseError
from poise.jobs.keep import claimed, may_deliver, may_write

if TYPE_CHECKING:
    from poise.jobs.endless.dream_world import DreamPush
    from poise.jobs.endless.dreamt import Dreamt

#: The most targets on a command line or in a file.
MOST_TARGETS = 10_000


def run(
    out: Out,
    seconds: Annotated[float, arg(metavar="S")] = 60.0,
    seed_clip: Annotated[Path | None, arg(metavar="CLIP", help_behavior_hint="")] = None,
    temperature: Annotated[float, arg(metavar="T")] = 1.0,
    count: Annotated[int, arg(metavar="K")] = 1,
    steer: Annotated[str | None, arg(metavar="'X,Y X,Y'|FILE", help_behavior_hint="")] = None,
    path: Annotated[str | None, arg(metavar="'X,Y X,Y'|FILE", help_behavior_hint="")] = None,
    pace: Annotated[float | None, arg(metavar="M/S", help_behavior_hint="")] = None,
    scene: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None,
    push: Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="'WORD=VALUE ...'")] = (),
    help_limit: Annotated[float, arg(metavar="NEWTONS")] = 0.0,
    style: Annotated[str | None, arg(metavar="LABEL", help_behavior_hint="")] = None,
    label_seconds: Annotated[float, arg(metavar="S")] = 10.0,
    loop: Annotated[float | None, arg(metavar="S", help_behavior_hint="")] = None,
    generator: Annotated[Path | None, arg(metavar="FILE|RUN", help_behavior_hint="")] = None,
    policy: Annotated[Path | None, arg(metavar="FILE|RUN", help_behavior_hint="")] = None,
    controller: Literal["lookahead", "policy"] = "lookahead",
    budget: Budget = None,
    tries: Annotated[int, arg(metavar="K")] = 8,
    recover: Flag = True,
    past: Literal["own", "simulated"] = "own",
    seed: Annotated[int, arg(metavar="S")] = 0,
    threads: Threads = 0,
    hold_feet: HoldFeet = True,
    force: Force = False,
    json: Json = False,
    reading: OmitArgPrefixes[Reading] = Reading(),
) -> Answer:
    """Let a simulated character go about without task or clip, and without help unless some is allowed:
    a kinematic policy says what comes next, from what it was doing, and a control policy does it. Write
    the motion, a .bvh as it is made, score.json and report.html.

    Args:
        seconds: how long it goes about. Ctrl-C keeps what was done.
        seed_clip: go on from the end of this clip, of any human skeleton; by default from some second of
            the library.
        temperature: below 1 the motion is more usual, above it less.
        count: characters in one world; they keep away from each other.
        steer: points to reach one after another, in m from where it begins, Z up; or a file with one on
            each line. After the last one it goes where it likes.
        path: points of a path to walk along, as for --steer; one whose last point is its first is walked
            round and round.
        pace: speed along --path; by default whatever the character is at.
        scene: boxes that stand in the world (.json), as --support of poise track takes them; characters
            walk round them, and sit down on a seat now and then.
        push: a push on each character, in the words of poise push, such as 'at=chest force=200 from=5
            seconds=0.2 direction=0,1,0'. every=10, or every=5-15, pushes again after so many s;
            direction=any draws a direction each time. May be given several times.
        help_limit: a hand that no real person has leads the root with up to so many N and N m.
        style: only motion of this label, where the generator's library has labels, such as dance.
        label_seconds: it keeps to motion of one label of the library for about so long, and then turns
            to another one; 0 leaves that to chance. Neither with --style nor on the way to points.
        loop: write a part of about so many seconds whose end meets its start, too, as loop with the
            ending of the motion's file; the first character's, without falls.
        generator: a kinematic policy: its file, or the folder of poise train endless; by default the one
            that comes with Poise.
        policy: the control policy; by default the one that comes with Poise.
        controller: lookahead tries in copies of the character before it acts; policy acts at once, ten
            times faster and rougher.
        budget: simulated control steps of lookahead for each that is made, by default 192.
        tries: futures of the kinematic policy that copies of a character try before it goes on with one
            that it can do; 1 takes what comes.
        recover: leave a character that has fallen where it lies.
        past: what the kinematic policy goes on from: its own frames, or what the character did.
        seed: seed of all draws.
    """
    check_range("seed", seed, 0)
    check_range("threads", threads, 0)
    check_range("seconds", seconds, 0.1, 36_000)
    check_range("label-seconds", label_seconds, 0, 3600)
    if loop is not None:
        check_range("loop", loop, 1, 600)
        if 1.5 * loop > seconds:
            raise PoiseError(
                f"a loop of {loop:g} s is looked for in a longer motion, and this has {seconds:g} s",
                "--loop",
                f"Give --seconds {max(60.0, 4 * loop):g}",
                code="clip-too-short",
            )
    folder, motion = places(out)
    read = () if seed_clip is None else (seed_clip,)
    may_deliver(folder, motion, force, *read)
    check_range("help-limit", help_limit, 0, 100_000)
    targets = () if steer is None else points_of(steer, "--steer")
    if pace is not None and path is None:
        raise PoiseError(
            "--pace is the speed along a --path", hint="Give a path", code="option-needs-option"
        )
    from poise.env.walk_path import WalkPath
    from poise.formats import write_clip
    from poise.jobs.endless.dreaming import dream, names_of
    from poise.jobs.endless.dreamt import Dream
    from poise.jobs.endless.model import load_generator
    from poise.jobs.open import open_run
    from poise.kinematics.supports import read_supports

    ahead = lookahead_of(budget)
    config = Dream(
        temperature=temperature,
        count=count,
        targets=targets,
        path=None if path is None else WalkPath(points_of(path, "--path"), pace),
        supports=() if scene is None else read_supports(scene),
        pushes=tuple(push_of(text) for text in push),
        help_limit=help_limit,
        seed=seed,
        controller=controller,
        lookahead=ahead,
        tries=tries,
        recover=recover,
        past=past,
        style=style,
        label_seconds=label_seconds,
        hold_feet=hold_feet,
        threads=threads,
    )
    files = names_of(motion or folder / "simulated.bvh", count)
    ring = files[0].with_name(f"loop{files[0].suffix}")
    for file in (*files, *(() if loop is None else (ring,))):
        may_write(file, force, *read)
    clip = None if seed_clip is None else reading.read(seed_clip)
    with working("opening the policies"):
        tracker, model = open_run(policy).tracker, load_generator(generator)
    with claimed(folder):
        with contextlib.ExitStack() as shown:
            done = dream(
                seconds, model, tracker, config, seed_clip=clip, out=files[0], progress=staged(shown)
            )
        if not done.paths:
            return Answer(exit_code=INTERRUPTED, outcome="interrupted")
        with working("writing"):
            paths = done.write_score(folder)
            notes = list(done.notes)
            if loop is not None:
                try:
                    clip, said = done.loop(loop)
                except PoiseError as problem:
                    notes.append(f"No loop is written: {problem.what}. {problem.hint}.")
                else:
                    write_clip(clip, ring)
                    paths["loop"] = ring
                    notes.append(said)
    _say(done)
    say(done.sentence)
    if done.interrupted:
        say(f"Stopped; {done.seconds:.1f} of {seconds:g} s are written.")
    named = {"simulated" if k == 0 else f"simulated {k + 1}": p for k, p in enumerate(done.paths)}
    word = "interrupted" if done.interrupted else "lost" if done.stayed_down else "dreamt"
    code = INTERRUPTED if done.interrupted else LOST if done.stayed_down else 0
    result = {"outcome": word, **done.to_dict()}
    return Answer(result, {**named, **paths}, tuple(notes), code, word)


def points_of(text: str, where: str) -> tuple[tuple[float, float], ...]:
    """Points as `5,0 5,5`, or from a file with one on each line; `where` is the option.

    Raises:
        PoiseError: something else, naming it.
    """
    path = Path(text)
    if path.is_file():
        where = str(path)
        lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
        words = [line.split("#")[0].strip() for line in lines]
        words = ["".join(w.split()) for w in words if w]
    else:
        words = text.replace(";", " ").split()
    out = list[tuple[float, float]]()
    for word in words:
        try:
            x, y = map(float, word.split(","))
        except ValueError:
            what = f"'{word[:40]}' is no point" + ("" if "," in word else ", and no such file is there")
            raise PoiseError(
                what, where, "Write X,Y in m, such as 5,0", code="option-malformed"
            ) from None
        out.append((x, y))
    if not 1 <= len(out) <= MOST_TARGETS:
        raise PoiseError(
            f"there must be 1 to {MOST_TARGETS:,} points, got {len(out)}", where, code="out-of-range"
        )
    return tuple(out)


def push_of(text: str) -> DreamPush:
    """A push in words: `at=chest force=200 from=5 seconds=0.2 direction=0,1,0 every=5-15`.

    Raises:
        PoiseError: another word, or a value that makes no sense.
    """
    from poise.jobs.endless.dream_world import DreamPush
    from poise.jobs.track.pushed import way_of

    names = {
        "force": "newtons",
        "at": "at",
        "from": "start_s",
        "seconds": "seconds",
        "direction": "direction",
        "every": "every_s",
    }
    values = dict[str, Any]()
    for part in text.split():
        word, equals, value = part.partition("=")
        if word not in names or not equals or not value:
            raise PoiseError(
                f"'{part[:40]}' makes no push",
                "--push",
                f"Write WORD=VALUE with {', '.join(names)}, such as force=200",
                code="option-malformed",
            )
        if word == "at" or value in ("any", "front"):
            values[names[word]] = value
            continue
        try:
            if word == "direction":
                values["direction"] = way_of(value)
            elif word == "every":
                low, _, high = value.partition("-")
                values["every_s"] = float(low), float(high or low)
            else:
                values[names[word]] = float(value)
        except (ValueError, PoiseError):
            raise PoiseError(
                f"'{part[:40]}' has no number",
                "--push",
                "Write for example force=200, every=5-15 or direction=0,1,0",
                code="option-malformed",
            ) from None
    return DreamPush(**values)


def _say(done: Dreamt) -> None:
    """Simulated and asked for, side by side."""
    names = {
        "foot_slide_mm_per_s": "foot slide mm/s", "penetration_mm": "sinks mm",
        "jerk_m_per_s3": "jerk m/s^3", "speed_m_per_s": "speed m/s", "longest_still_s": "stands still s",
    }  # fmt: skip

    def row(kind: str) -> tuple[str, ...]:
        values = (done.figures[kind][name] for name in names)
        return (kind, *("" if v is None else f"{v:.3g}" for v in values))

    table("what was done, and what the kinematic policy asked for", ("", *names.values()),
          [row("simulated"), row("asked")], left=1)  # fmt: skip
