"""`poise complete`: keyframes in, the motion of a simulated body out."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeAlias

from tyro.conf import OmitArgPrefixes, Positional, UseAppendAction, arg

from poise.cli.console import LOST, Answer, print_card, say, table, tell
from poise.cli.inbetween import frames_of
from poise.cli.options import (
    Directing,
    Flag,
    Force,
    HoldFeet,
    Json,
    Out,
    PolicyFile,
    Reading,
    check_range,
    places,
)
from poise.cli.recipe_options import TRACK, derived, given
from poise.cli.training import staged, working
from poise.errors import PoiseError
from poise.jobs.keep import claimed, may_deliver, may_write

if TYPE_CHECKING:
    from poise.jobs.result import Result
    from poise.motion import Clip

#: s outside the keyframes that are worth a sentence.
LONG_S = 5.0


if TYPE_CHECKING:
    Tracking: TypeAlias = Any
else:
    Tracking = derived(TRACK, "", "controller", "seed", "threads", "in_place")


@dataclass(frozen=True)
class Options:
    """From keyframes to a body: make the motion between keyframes of a clip, let a simulated character
    do it without help, and write it on the skeleton that came in, with score.json and report.html."""

    clip: Annotated[Positional[Path], arg(metavar="CLIP")]
    """The motion file that holds the keyframes."""
    keyframes: Annotated[str, arg(metavar="0,30,60")]
    """Frames that stay, counted from 0, in rising order; frames outside of them stay too. Or all, with
    --times: each frame of the file is a pose."""
    out: Out
    times: Annotated[str | None, arg(metavar="0,1.2,2.5", help_behavior_hint="")] = None
    """Times of the keyframes, in s from the first; by default they stay where they are in the file.
    They may be rough: see --retime."""
    partial: Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="FRAME[:PARTS]")] = ()
    """Further frames of which only hands, feet and pelvis stay, or some of them: 45:hands,pelvis."""
    kinematic: Flag = False
    """Only fill the frames, without a body: keyframes are met exactly. See poise inbetween."""
    retime: Flag = False
    """Give gaps that no body does in their time more of it; the new times are said."""
    policy: PolicyFile = None
    model: Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="")] = None
    """A trained in-betweening network; by default the one that comes with Poise."""
    adapt: Annotated[int, arg(metavar="N")] = 0
    """Iterations of test-time adaptation for each gap, such as 20; by default none."""
    hold_feet: HoldFeet = True
    force: Force = False
    json: Json = False
    tracking: OmitArgPrefixes[Tracking] = field(default_factory=Tracking)
    directing: OmitArgPrefixes[Directing] = Directing()
    reading: OmitArgPrefixes[Reading] = Reading()


def run(options: Options, argv: Sequence[str]) -> Answer:
    """Reads, fills, simulates, writes."""
    o = options
    every = o.keyframes == "all"
    if every and o.times is None:
        raise PoiseError(
            "--keyframes all leaves nothing to fill",
            hint="Say when with --times 0,1.2,2.5",
            code="nothing-to-fill",
        )
    keys = () if every else frames_of(o.keyframes)
    check_range("adapt", o.adapt, 0, 1000)
    if o.kinematic:
        return _kinematic(o, keys)
    out, motion = places(o.out)
    may_deliver(out, motion, o.force, o.clip)
    from poise.cli.track import telling
    from poise.jobs.complete import complete
    from poise.jobs.open import open_run
    from poise.jobs.result import story
    from poise.jobs.track_settings import TrackConfig
    from poise.synthesis.filler import check_keyframes
    from poise.synthesis.keyframes import partials_of, times_of

    config = TrackConfig(**given(o.tracking), **o.directing.values())
    times, partial = None if o.times is None else times_of(o.times), partials_of(o.partial)
    clip = o.reading.read(o.clip)
    keys = tuple(range(clip.frames)) if every else keys
    check_keyframes(keys, clip.frames, str(o.clip))
    _beside(keys, clip, o.clip)
    with working("opening the policy"):
        tracker = open_run(o.policy).tracker
    with claimed(out):
        said_early = list[str]()
        with contextlib.ExitStack() as shown:
            done = complete(
                clip, keys, tracker, config, model=o.model, adapt=o.adapt, retime=o.retime, times=times,
                partial=partial, progress=staged(shown), warn=telling(said_early),
            )  # fmt: skip
        with working("writing"):
            delivered = done.write(out, motion, o.hold_feet)
    _say(done)
    print_card(delivered.card)
    say(done.sentence)
    became = story(done, hint=False)
    word = became.word if became.failed else "completed"
    result = {
        "outcome": word,
        "controller": done.controller,
        "sentence": done.sentence,
        "keyframes": list(done.keyframes),
        "at": list(done.at),
        "met_mm": [round(x, 1) for x in done.met_mm],
        "stages": [s.to_dict() for s in done.stages],
        "faults": [f.to_dict() for f in done.filled.faults],
        "score": delivered.card.to_dict(),
    }
    told, early = (*done.notes, *delivered.notes), tuple(said_early)
    code, error = LOST if became.failed else 0, delivered.card.mpjpe_mm
    return Answer(result, delivered.paths, told, code, word, error, early)


def _beside(keys: tuple[int, ...], clip: Clip, path: Path) -> None:
    """Says how much is simulated before the first keyframe and after the last, where that is most."""
    first, last = min(keys, default=0), max(keys, default=clip.frames - 1)
    beside = clip.frames - 1 - (last - first)
    if beside > max(last - first, LONG_S * clip.fps):
        tell(
            f"{beside / clip.fps:.1f} s lie outside the keyframes and are simulated as they are; "
            f"poise convert {path.name} part.bvh --frames {first}-{last} leaves them out."
        )


def _kinematic(o: Options, keys: tuple[int, ...]) -> Answer:
    """The filled frames alone."""
    if o.partial or o.retime or given(o.directing).keys() - {"budget"}:
        raise PoiseError(
            "--kinematic has no body to direct or to wait for",
            hint="Leave it out",
            code="option-not-applicable",
        )
    from poise.formats import check_writable, names_file, write_clip
    from poise.jobs.inbetween.fill import inbetween
    from poise.synthesis.filler import check_keyframes
    from poise.synthesis.keyframes import timed, times_of

    path = o.out if names_file(o.out) and not o.out.is_dir() else o.out / f"filled{o.clip.suffix}"
    check_writable(path)
    may_write(path, o.force, o.clip)
    clip = o.reading.read(o.clip)
    keys = check_keyframes(keys or tuple(range(clip.frames)), clip.frames, str(o.clip))
    asked = keys
    if o.times is not None:
        clip, keys = timed(clip, keys, times_of(o.times))
    with contextlib.ExitStack() as shown:
        bar = staged(shown)
        filled = inbetween(
            clip,
            keys,
            o.model,
            adapt=o.adapt,
            seed=o.tracking.seed or 0,
            on_gap=lambda n, of: bar("filling", n, of),
        )
    path.parent.mkdir(parents=True, exist_ok=True)
    write_clip(filled.clip, path)
    say(
        f"{path.name}: {filled.clip.frames} frames at {filled.clip.fps:.5g} fps, keyframes {o.keyframes}"
    )
    result = {
        "outcome": "filled", "keyframes": list(asked), "at": list(keys),
        "warnings": list(filled.filled.warnings), "faults": [f.to_dict() for f in filled.filled.faults],
    }  # fmt: skip
    return Answer(result, {"motion": path}, filled.notes, outcome="filled")


def _say(done: Result) -> None:
    """The stages as a table."""

    def figure(value: float | None, digits: int = 0) -> str:
        return "" if value is None else f"{value:.{digits}f}"

    rows = [
        (
            s.name, figure(s.key_mm), figure(s.sole_slide_mm_per_s), figure(s.penetration_mm, 1),
            figure(s.jerk_m_per_s3), figure(s.fastest_m_per_s, 1),
        )
        for s in done.stages
    ]  # fmt: skip
    names = ("stage", "keyframes mm", "sole slide mm/s", "sinks mm", "jerk m/s^3", "fastest m/s")
    table("stage by stage", names, rows, left=1)
