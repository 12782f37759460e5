"""`poise dream`: a character that goes about, for as long as is asked."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import OmitArgPrefixes, arg

from poise.cli.console import INTERRUPTED, LOST, Answer, say, table
from poise.cli.options import Flag, Reading, check_range, places
from poise.cli.training import staged, working
from poise.errors import PoiseError
from poise.jobs.keep import claimed, may_deliver, may_write

if TYPE_CHECKING:
    from poise.jobs.endless.dreamt import Dreamt

#: The most targets on a command line or in a file.
MOST_TARGETS = 10_000


@dataclass(frozen=True)
class Options:
    """Let a simulated character go about without task, clip or help: a kinematic policy says what comes
    next, from what it was doing, and a control policy does it. Write the motion, as it is made,
    score.json and report.html."""

    out: Annotated[Path, arg(aliases=["-o"], metavar="DIR|FILE")]
    """The folder of the results; or the file of the motion (.bvh, .glb, .npz, ...), and the rest goes
    into a folder of its name. Only .bvh is written as it is made."""
    seconds: Annotated[float, arg(metavar="S")] = 60.0
    """How long it goes about. Ctrl-C keeps what was done."""
    seed_clip: Annotated[Path | None, arg(metavar="CLIP", help_behavior_hint="")] = None
    """Go on from the end of this clip, of any human skeleton; by default from some second of the
    library."""
    temperature: Annotated[float, arg(metavar="T")] = 1.0
    """Below 1 the motion is more usual, above it less."""
    count: Annotated[int, arg(metavar="K")] = 1
    """Characters in one world; they keep away from each other."""
    steer: Annotated[str | None, arg(metavar="'X,Y X,Y'|FILE", help_behavior_hint="")] = None
    """Points to reach one after another, in m from where it begins, Z up; or a file with one on each
    line. After the last one it goes where it likes."""
    style: Annotated[str | None, arg(metavar="LABEL", help_behavior_hint="")] = None
    """Only motion of this label, where the generator's library has labels, such as dance."""
    label_seconds: Annotated[float, arg(metavar="S")] = 10.0
    """It keeps to motion of one label of the library for about so long, and then turns to another one;
    0 leaves that to chance. Neither with --style nor on the way to points."""
    generator: Annotated[Path | None, arg(metavar="FILE|RUN", help_behavior_hint="")] = None
    """A kinematic policy: its file, or the folder of poise train endless; by default the one that comes
    with Poise."""
    policy: Annotated[Path | None, arg(metavar="FILE|RUN", help_behavior_hint="")] = None
    """The control policy; by default the one that comes with Poise."""
    controller: Literal["lookahead", "policy"] = "lookahead"
    """lookahead tries in copies of the character before it acts; policy acts at once, ten times faster
    and rougher."""
    budget: Annotated[float | None, arg(metavar="STEPS", help_behavior_hint="")] = None
    """Simulated control steps of lookahead for each that is made; by default 192."""
    recover: Flag = True
    """Leave a character that has fallen where it lies."""
    past: Literal["own", "simulated"] = "own"
    """What the kinematic policy goes on from: its own frames, or what the character did."""
    seed: Annotated[int, arg(metavar="S")] = 0
    """Seed of all draws."""
    threads: Annotated[int, arg(metavar="N")] = 0
    """Cores for lookahead; 0 is all."""
    hold_feet: Flag = True
    """Leave feet as simulated; by default standing feet are held to the spot in the written motion."""
    force: Flag = False
    """Write over files that are there."""
    json: Flag = False
    """Print one JSON document and nothing else on stdout, see docs/cli.md."""
    reading: OmitArgPrefixes[Reading] = field(default_factory=Reading)


def run(options: Options, argv: Sequence[str]) -> Answer:
    """Opens the policies, simulates, writes."""
    o = options
    check_range("seed", o.seed, 0)
    check_range("threads", o.threads, 0)
    check_range("budget", o.budget, 1, 1_000_000)
    check_range("seconds", o.seconds, 0.1, 36_000)
    check_range("label-seconds", o.label_seconds, 0, 3600)
    out, motion = places(o.out)
    read = () if o.seed_clip is None else (o.seed_clip,)
    may_deliver(out, motion, o.force, *read)
    targets = () if o.steer is None else targets_of(o.steer)
    from poise.jobs.endless.dreaming import dream, names_of
    from poise.jobs.endless.dreamt import Dream
    from poise.jobs.endless.model import load_generator
    from poise.jobs.open import open_run
    from poise.plan import LookaheadConfig

    ahead = LookaheadConfig() if o.budget is None else LookaheadConfig().with_budget(o.budget)
    config = Dream(
        temperature=o.temperature, count=o.count, targets=targets, seed=o.seed, controller=o.controller,
        lookahead=ahead, recover=o.recover, past=o.past, style=o.style, label_seconds=o.label_seconds,
        hold_feet=o.hold_feet, threads=o.threads,
    )  # fmt: skip
    files = names_of(motion or out / "simulated.bvh", o.count)
    for file in files:
        may_write(file, o.force, *read)
    clip = None if o.seed_clip is None else o.reading.read(o.seed_clip)
    with working("opening the policies"):
        tracker, model = open_run(o.policy).tracker, load_generator(o.generator)
    with claimed(out):
        with contextlib.ExitStack() as shown:
            done = dream(
                o.seconds, model, tracker, config, seed_clip=clip, out=files[0], progress=staged(shown)
            )
        if not done.paths:
            return Answer(exit_code=INTERRUPTED, outcome="interrupted")
        with working("writing"):
            paths = done.write_score(out)
    _say(done)
    say(done.sentence)
    if done.interrupted:
        say(f"Stopped; {done.seconds:.1f} of {o.seconds:g} s are written.")
    named = {"simulated" if k == 0 else f"simulated {k + 1}": p for k, p in enumerate(done.paths)}
    word = "interrupted" if done.interrupted else "lost" if done.stayed_down else "dreamt"
    code = INTERRUPTED if done.interrupted else LOST if done.stayed_down else 0
    result = {"outcome": word, **done.to_dict()}
    return Answer(result, {**named, **paths}, done.notes, code, word)


def targets_of(text: str) -> tuple[tuple[float, float], ...]:
    """Points as `5,0 5,5`, or from a file with one on each line.

    Raises:
        PoiseError: something else, naming it.
    """
    path, where = Path(text), "--steer"
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
