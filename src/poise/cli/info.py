"""`poise info`: what motion files hold, what had to be guessed, and what will be repaired."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from tyro.conf import OmitArgPrefixes, Positional, arg

from poise.cli.console import Answer, notes, say, table
from poise.cli.options import Json, Reading, each
from poise.errors import PoiseError

#: The keys of a clip in the result, which programs rely on.
KEYS = (
    *("format", "joints", "fps", "frames", "seconds", "unit_m", "up_axis", "height_m", "warnings"),
    *("repairs", "guesses", "in_place"),
)

#: What guesses that are numbers are in.
UNITS = {"unit": " m", "ground": " m", "fps": " frames/s"}


def run(
    clips: Annotated[
        Positional[tuple[Path, ...]], arg(metavar="CLIP ...", help_behavior_hint="(required)")
    ] = (),
    json: Json = False,
    reading: OmitArgPrefixes[Reading] = Reading(),
) -> Answer:
    """Say what motion files hold, and what was guessed: each guess, why, and how to state it instead.

    Args:
        clips: motion files, or folders of them.
    """
    if not clips:
        raise PoiseError("no clip was given", hint="Write poise info CLIP", code="argument-missing")
    if any(path.is_dir() for path in clips):
        return each("info", clips, None, lambda p, _: run((p,), json, reading))
    from poise.kinematics import find_faults, find_guesses
    from poise.motion.clip_info import describe

    read = [reading.read(path) for path in clips]
    facts, faults = [describe(clip) for clip in read], [find_faults(clip) for clip in read]
    for fact, fault in zip(facts, faults, strict=True):
        fact["repairs"] = None if fault is None else fault.numbers
        travel = None if fault is None else fault.travel
        fact["in_place"] = None if travel is None else travel.to_dict()
    for clip, fact in zip(read, facts, strict=True):
        fact["guesses"] = [g.to_dict() for g in find_guesses(clip)]
    for path, fact, fault in zip(clips, facts, faults, strict=True):
        table(str(path), ("", ""), _rows(fact), left=2)
        if fact["in_place"]:
            say(f"It {fact['in_place']['said']}; a body is given that travel, see --in-place.")
        say("Guessed, and how to state it instead:")
        notes([_guess(g) for g in fact["guesses"]], 40)
        told = " ".join(g["evidence"] for g in fact["guesses"])
        more = [w for w in fact["warnings"] if w not in told]
        if more:
            say("Also noticed:")
            notes(more, 40)
        if fault is not None and fault.sentences:
            say("Will be repaired or should be checked:")
            notes(fault.sentences, 40)
    plain = [{key: fact[key] for key in KEYS} for fact in facts]
    frames = f"{facts[0]['format']}, {facts[0]['frames']} frames at {facts[0]['fps']:.5g} fps"
    return Answer(plain[0] if len(plain) == 1 else plain, outcome=frames)


def _guess(guess: dict[str, Any]) -> str:
    """One guess in a line; a number that is 0 but for rounding is 0."""
    value = guess["value"]
    if isinstance(value, float):
        value = f"{value if abs(value) >= 1e-9 else 0:.5g}{UNITS.get(guess['what'], '')}"
    value = "not told" if value is None else value
    return f"{guess['what']}: {value}. {guess['evidence']}. [{guess['override']}]"


def _rows(fact: dict[str, Any]) -> list[tuple[str, str]]:
    return [
        ("format", fact["format"]),
        ("joints", str(fact["joints"])),
        ("frames", f"{fact['frames']} at {fact['fps']:.5g} fps, {fact['seconds']:.2f} s"),
        ("unit", f"{fact['unit_m']:.6g} m, {fact['up_axis']} up"),
        ("height", f"{fact['height_m']:.2f} m, {fact['height_from']}"),
    ]
