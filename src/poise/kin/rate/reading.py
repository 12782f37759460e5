"""Motion files read at the rate that physics vouches for where they state none."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from poise.kin.rate.judge import judge_rate
from poise.motion import Clip
from poise.motion.io import read_clip as read_as_stated


def read_clip(path: str | Path, **stated: Any) -> Clip:
    """Reads a motion file as a clip in metres, Z up, see `poise.motion.read_clip`, which has the same
    arguments and errors.

    Where neither the file nor the caller states a frame rate, and the evidence against the usual one is
    clear, the rate that the motion has is taken (`settled`).
    """
    return settled(read_as_stated(path, **stated))


def settled(clip: Clip) -> Clip:
    """The clip at the rate that it has, of those that such files have (`Source.rates`), and a note that
    says why; as it is where a rate is stated, or where the usual one is not clearly wrong."""
    source = clip.skeleton.source
    if len(source.rates) < 2:
        return clip
    judged = judge_rate(clip)
    if judged.likely is None or judged.likely not in source.rates:
        return clip
    said = dict(source.evidence).get("fps", "")
    begins = said.partition(":")[0] or "The file states no frame rate"
    note = (
        f"{begins}: {judged.likely:g} frames per second taken, not {clip.fps:g}, at which {judged.why()}"
    )
    notes = tuple(note if n == said else n for n in source.notes)
    evidence = tuple((k, note if k == "fps" else v) for k, v in source.evidence)
    skeleton = clip.skeleton.with_source(notes=notes, evidence=evidence, rates=())
    return clip.replaced(skeleton=skeleton, fps=judged.likely)
