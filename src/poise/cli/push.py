"""`poise push`: a motion in, the same motion with a push in it out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import OmitArgPrefixes, Positional, arg

from poise.cli.console import LOST, Answer, print_card, say
from poise.cli.options import Flag, InPlace, Reading, check_range, places
from poise.cli.training import working
from poise.errors import PoiseError
from poise.jobs.keep import claimed, may_deliver

if TYPE_CHECKING:
    from poise.jobs.track.pushed import PushConfig


@dataclass(frozen=True)
class Options:
    """Let a trained policy do a motion while something pushes it: write the motion with the push in it
    on the skeleton that came in, score.json and report.html. The character gives way as far as --level
    or --stiffness says, keeps its balance if it can, and comes back."""

    clip: Annotated[Positional[Path], arg(metavar="CLIP")]
    """The motion file."""
    out: Annotated[Path, arg(aliases=["-o"], metavar="DIR|FILE")]
    """The folder of the results; or the file of the motion (.bvh, .glb, .npz, ...), and the rest goes
    into a folder of its name."""
    force: Annotated[float, arg(metavar="NEWTONS")] = 150.0
    """How hard it is pushed."""
    at: Annotated[str, arg(metavar="PART")] = "hand"
    """Where: hand, elbow, shoulder, hip, knee or foot, the right one (left_hand is the other); head,
    chest or pelvis; or a body of the policy by its name."""
    start: Annotated[float, arg(name="from", metavar="SECONDS")] = 1.0
    """When the push begins."""
    seconds: Annotated[float, arg(metavar="SECONDS")] = 0.5
    """How long it lasts."""
    direction: Annotated[str | None, arg(metavar="X,Y,Z", help_behavior_hint="")] = None
    """Where it pushes to, Z up, such as 0,1,0; by default from the front, against where the pelvis looks
    when it begins."""
    level: Annotated[float, arg(metavar="0-1")] = 0.12
    """Level of compliance, 0 does not give way; above 0.2 joints turn implausibly far."""
    stiffness: Annotated[float | None, arg(metavar="N/M", help_behavior_hint="")] = None
    """Give way as a spring of so many newtons per metre in place of --level: 1000 is stiff, 50 limp."""
    law: Literal["eq8", "algorithm1"] = "eq8"
    """How the level acts: by the paper's Eq. 8, or by its Algorithm 1 as printed."""
    policy: Annotated[Path | None, arg(metavar="FILE|RUN", help_behavior_hint="")] = None
    """A policy file, the folder of a run of poise train perpetual, or keypoints, the policy that comes
    along and is told places alone; by default the one for rotations that comes with Poise."""
    controller: Literal["lookahead", "policy"] = "lookahead"
    """lookahead tries in copies of the character before it acts, without knowing of the push before it
    begins; policy acts alone, at once."""
    body: Literal["policy", "own"] = "policy"
    """policy is the body that it was trained on; own has the lengths and masses of the skeleton that
    came in."""
    threads: Annotated[int, arg(metavar="N")] = 0
    """Cores for lookahead; 0 is all."""
    seed: Annotated[int, arg(metavar="S")] = 0
    """Seed of what lookahead draws."""
    in_place: InPlace = "auto"
    """A clip that walks in place is simulated with the travel that its feet tell. auto writes it in
    place again; travel writes it with its travel; keep simulates it as it is."""
    hold_feet: Flag = True
    """Leave feet as simulated; by default standing feet are held to the spot in the written motion."""
    overwrite: Flag = False
    """Write over files that are there."""
    json: Flag = False
    """Print one JSON document and nothing else on stdout, see docs/cli.md."""
    reading: OmitArgPrefixes[Reading] = field(default_factory=Reading)


def run(options: Options, argv: Sequence[str]) -> Answer:
    """Reads, tracks with the push, writes; says what the push did."""
    o = options
    push = push_of(o)
    check_range("seed", o.seed, 0)
    check_range("threads", o.threads, 0)
    out, motion = places(o.out)
    may_deliver(out, motion, o.overwrite, o.clip, flag="--overwrite")
    from poise.cli.track import follow
    from poise.jobs.open import open_run
    from poise.jobs.result import story
    from poise.jobs.track import TrackConfig

    config = TrackConfig(
        seed=o.seed, controller=o.controller, threads=o.threads, body=o.body, push=push,
        smooth_hz=o.reading.smooth, in_place=o.in_place,
    )  # fmt: skip
    clip = o.reading.read(o.clip)
    with working("opening the policy"):
        tracker = open_run(o.policy).tracker
    with claimed(out):
        said_early = list[str]()
        tracked = follow(tracker, [clip], config, said_early, "pushing")
        with working("writing"):
            done = tracked.write(out, motion, o.hold_feet)
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


def push_of(options: Options) -> PushConfig:
    """What the words ask for.

    Raises:
        PoiseError: numbers that make no sense.
    """
    from poise.jobs.track.pushed import PushConfig

    o = options
    return PushConfig(
        o.force, o.at, o.start, o.seconds, direction_of(o.direction), o.level, o.stiffness, o.law
    )


def direction_of(text: str | None) -> tuple[float, float, float] | None:
    """The numbers of "0,1,0"; None where nothing is stated.

    Raises:
        PoiseError: these are not three numbers.
    """
    if text is None:
        return None
    try:
        x, y, z = (float(v) for v in text.split(","))
    except ValueError:
        hint = "Write for example --direction 0,1,0"
        raise PoiseError(
            f"--direction needs three numbers, got '{text}'", hint=hint, code="option-malformed"
        ) from None
    return x, y, z
