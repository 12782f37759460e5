"""Clips of a library in a mirror and backwards: a turn to the left is learned to the right, too."""

from __future__ import annotations

from poise.jobs.library.clips import LibraryConfig, Target, set_down
from poise.jobs.library.files import BACKWARDS, MIRRORED, matches, subject_of
from poise.motion import Clip
from poise.motion.edits import backwards
from poise.motion.mirror import mirrored_clip


def images(clip: Clip, target: Target, config: LibraryConfig) -> list[Clip]:
    """A placed clip, and as what else the library takes it.

    Raises:
        PoiseError: no joint's name tells a side.
    """
    both = [clip, mirror_image(clip, target, config)] if config.mirror else [clip]
    if matches(config.backwards, clip.name, subject_of(clip.name)):
        both += [backwards(c).replaced(name=c.name + BACKWARDS) for c in both]
    return both


def mirror_image(clip: Clip, target: Target, config: LibraryConfig) -> Clip:
    """A placed clip in a mirror, on the target again: its sides differ a little in bones and soles.

    Raises:
        PoiseError: no joint's name tells a side.
    """
    seen = mirrored_clip(clip)
    example = None if target.example is None else mirrored_clip(target.example)
    seen, _ = set_down(seen, example, target, config)
    return seen.replaced(skeleton=clip.skeleton, name=clip.name + MIRRORED, cyclic=clip.cyclic)
