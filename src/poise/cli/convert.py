"""`poise convert`: one motion file becomes another."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from tyro.conf import OmitArgPrefixes, Positional, arg

from poise.cli.console import Answer, say
from poise.cli.options import Force, Json, Reading, each
from poise.errors import PoiseError
from poise.jobs.keep import claimed, may_write


def run(
    source: Annotated[Positional[Path], arg(metavar="IN")],
    target: Annotated[Positional[Path | None], arg(metavar="OUT", help_behavior_hint="")] = None,
    out: Annotated[Path | None, arg(aliases=["-o"], metavar="OUT", help_behavior_hint="")] = None,
    resample: Annotated[float | None, arg(metavar="FPS", help_behavior_hint="")] = None,
    frames: Annotated[str | None, arg(metavar="A-B", help_behavior_hint="")] = None,
    to: Annotated[str, arg(metavar="FORMAT")] = "bvh",
    force: Force = False,
    json: Json = False,
    reading: OmitArgPrefixes[Reading] = Reading(),
) -> Answer:
    """Write a motion file in another format or at another frame rate, or a part of it.

    Args:
        source: the motion file to read, or a folder of such files.
        target: the motion file to write; its suffix names the format (.bvh). For a folder the folder to
            write.
        out: the same as OUT.
        resample: frames per second of the result.
        frames: only the frames from A to B, both of them, counted from 0 as they are read.
        to: the format of the files that are made of a folder: bvh, glb, npz, ...
    """
    from poise.formats import check_writable, write_clip
    from poise.motion import resample as resampled
    from poise.motion import trim

    into = target_of(target, out)
    if source.is_dir():
        suffix = "." + to.lstrip(".")
        check_writable(Path(f"OUT{suffix}"))

        def one(path: Path, name: str) -> Answer:
            file = into / f"{name}{suffix}"
            file.parent.mkdir(parents=True, exist_ok=True)
            return run(path, file, None, resample, frames, to, force, json, reading)

        with claimed(into):
            return each("convert", (source,), into, one)
    may_write(into, force, source)
    clip = reading.read(source)
    if frames is not None:
        first, last = _span(frames, clip.frames, source)
        clip = trim(clip, first, last + 1)
    if resample is not None:
        clip = resampled(clip, resample)
    write_clip(clip, into)
    say(f"{clip.frames} frames at {clip.fps:.5g} fps, {clip.seconds:.2f} s")
    figures = {"frames": clip.frames, "fps": clip.fps, "seconds": clip.seconds}
    notes, outcome = clip.skeleton.source.notes, f"{clip.frames} frames"
    return Answer(figures, {"clip": into}, notes, outcome=outcome)


def _span(words: str, frames: int, where: Path) -> tuple[int, int]:
    """The first and the last frame that are wanted."""
    try:
        first, last = (int(w) for w in words.split("-"))
    except ValueError:
        raise PoiseError(
            f"--frames '{words}' makes no sense", hint="Write --frames 30-240", code="option-malformed"
        ) from None
    if not 0 <= first < last < frames:
        what = f"--frames must rise within 0 to {frames - 1}, got {words}"
        raise PoiseError(what, where, "Two frames are the fewest", code="frame-outside")
    return first, last


def target_of(target: Path | None, out: Path | None) -> Path:
    """OUT, which may be given by its place or with -o."""
    given = [x for x in (target, out) if x is not None]
    if len(given) != 1:
        what = "OUT is given twice" if given else "poise convert needs OUT"
        raise PoiseError(
            what,
            hint="Write poise convert IN OUT, or poise convert IN -o OUT",
            code="option-repeated" if given else "argument-missing",
        )
    return given[0]
