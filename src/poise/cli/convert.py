"""`poise convert`: one motion file becomes another."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from tyro.conf import OmitArgPrefixes, Positional, arg

from poise.cli.console import notes, say
from poise.cli.options import Reading
from poise.errors import PoiseError


@dataclass(frozen=True)
class Options:
    """Write a motion file in another format or at another frame rate."""

    source: Annotated[Positional[Path], arg(metavar="IN")]
    """The motion file to read."""
    target: Annotated[Positional[Path], arg(metavar="OUT")]
    """The motion file to write; its suffix names the format (.bvh)."""
    resample: Annotated[float | None, arg(metavar="FPS", help_behavior_hint="")] = None
    """Frames per second of the result."""
    reading: OmitArgPrefixes[Reading] = field(default_factory=Reading)


def run(options: Options, argv: Sequence[str]) -> int:
    """Reads, resamples where asked to, writes."""
    from poise.motion import resample
    from poise.motion.io import write_clip

    target = options.target
    if target.exists() and options.source.exists() and target.samefile(options.source):
        raise PoiseError("the clip would be written over itself", target, "Give OUT another name")
    clip = options.reading.read(options.source)
    if options.resample is not None:
        clip = resample(clip, options.resample)
    write_clip(clip, target)
    say(f"{target}: {clip.frames} frames at {clip.fps:.5g} fps, {clip.seconds:.2f} s")
    notes(clip.skeleton.source.notes)
    return 0
