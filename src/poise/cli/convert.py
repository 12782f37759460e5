"""`poise convert`: one motion file becomes another."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

from tyro.conf import OmitArgPrefixes, Positional, arg

from poise.cli.console import Answer, say
from poise.cli.options import Flag, Reading, each
from poise.errors import PoiseError
from poise.jobs.keep import claimed, may_write


@dataclass(frozen=True)
class Options:
    """Write a motion file in another format or at another frame rate, or a part of it."""

    source: Annotated[Positional[Path], arg(metavar="IN")]
    """The motion file to read, or a folder of such files."""
    target: Annotated[Positional[Path | None], arg(metavar="OUT", help_behavior_hint="")] = None
    """The motion file to write; its suffix names the format (.bvh). For a folder the folder to write."""
    out: Annotated[Path | None, arg(aliases=["-o"], metavar="OUT", help_behavior_hint="")] = None
    """The same as OUT."""
    resample: Annotated[float | None, arg(metavar="FPS", help_behavior_hint="")] = None
    """Frames per second of the result."""
    frames: Annotated[str | None, arg(metavar="A-B", help_behavior_hint="")] = None
    """Only the frames from A to B, both of them, counted from 0 as they are read."""
    to: Annotated[str, arg(metavar="FORMAT")] = "bvh"
    """The format of the files that are made of a folder: bvh, glb, npz, ..."""
    force: Flag = False
    """Write over files that are there."""
    json: Flag = False
    """Print one JSON document and nothing else on stdout, see docs/cli.md."""
    reading: OmitArgPrefixes[Reading] = field(default_factory=Reading)


def run(options: Options, argv: Sequence[str]) -> Answer:
    """Reads, resamples where asked to, writes."""
    from poise.formats import check_writable, write_clip
    from poise.motion import resample, trim

    target = target_of(options)
    if options.source.is_dir():
        to = "." + options.to.lstrip(".")
        check_writable(Path(f"OUT{to}"))

        def one(path: Path, name: str) -> Answer:
            into = target / f"{name}{to}"
            into.parent.mkdir(parents=True, exist_ok=True)
            return run(replace(options, source=path, target=into, out=None), argv)

        with claimed(target):
            return each("convert", (options.source,), target, one)
    may_write(target, options.force, options.source)
    clip = options.reading.read(options.source)
    if options.frames is not None:
        first, last = _span(options.frames, clip.frames, options.source)
        clip = trim(clip, first, last + 1)
    if options.resample is not None:
        clip = resample(clip, options.resample)
    write_clip(clip, target)
    say(f"{clip.frames} frames at {clip.fps:.5g} fps, {clip.seconds:.2f} s")
    figures = {"frames": clip.frames, "fps": clip.fps, "seconds": clip.seconds}
    notes, outcome = clip.skeleton.source.notes, f"{clip.frames} frames"
    return Answer(figures, {"clip": target}, notes, outcome=outcome)


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


def target_of(options: Options) -> Path:
    """OUT, which may be given by its place or with -o."""
    given = [x for x in (options.target, options.out) if x is not None]
    if len(given) != 1:
        what = "OUT is given twice" if given else "poise convert needs OUT"
        raise PoiseError(
            what,
            hint="Write poise convert IN OUT, or poise convert IN -o OUT",
            code="option-repeated" if given else "argument-missing",
        )
    return given[0]
