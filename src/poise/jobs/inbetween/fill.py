"""The frames between keyframes of a clip: what `poise inbetween` does.

made = inbetween("walk.bvh", (0, 30, 45))
made.clip, made.save("filled.bvh")
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from importlib.resources import files
from pathlib import Path

from poise.errors import PoiseError
from poise.jobs.result import Result, clip_of
from poise.learn.inbetween_model import MODEL, InbetweenModel, load_model
from poise.motion import Clip
from poise.synthesis.filler import EACH_GAP, Filling, check_keyframes
from poise.synthesis.keyframes import fill_keyframes


def inbetween(
    clip: Clip | str | Path,
    keyframes: Sequence[int],
    model: InbetweenModel | str | Path | None = None,
    *,
    samples: int = 1,
    foot_lock: bool = True,
    adapt: int = 0,
    seed: int = 0,
    on_gap: Callable[[int, int], None] | None = None,
) -> Result:
    """Makes everything between keyframes of a clip anew; keyframes and all other frames stay.

    Args:
        keyframes: frames that stay, counted from 0, in rising order.
        model: a trained network, its file or its run folder; by default the one that comes with Poise.
        samples: clips to make. foot_lock: whether feet that stand are held. adapt: iterations of
            test-time adaptation for each gap, such as 20. seed: of the variants.
        on_gap: is told how many gaps of how many are made.

    Raises:
        PoiseError: keyframes that make no sense, or a skeleton that cannot be brought onto the model's.
    """
    if not 0 <= adapt <= 1000:
        raise PoiseError(f"adapt must be 0 to 1000 iterations, got {adapt}", code="out-of-range")
    source = clip_of(clip)
    keys = check_keyframes(keyframes, source.frames, source.name)
    net = model if isinstance(model, InbetweenModel) else load_model(shipped_model(model))
    adaptation = replace(EACH_GAP, iterations=adapt) if adapt else None
    filling = Filling(samples, foot_lock, adaptation=adaptation, seed=seed)
    filled = fill_keyframes(source, keys, net, filling, on_gap)
    notes = (*(f"{w}." for w in filled.warnings), *source.skeleton.source.notes)
    return Result(filled=filled, came=source, keyframes=tuple(keys), notes=notes)


def shipped_model(path: str | Path | None = None) -> Path:
    """Where a network lies; without a path that of the one that comes with Poise.

    Raises:
        PoiseError: none came with this installation.
    """
    if path is not None:
        return Path(path)
    shipped = Path(str(files("poise"))) / "data" / "inbetween" / MODEL
    if not shipped.exists():
        raise PoiseError(
            "no in-betweening network came with this installation",
            hint="Train one with poise train inbetween --library DIR -o RUN, and give --model RUN",
            code="model-missing",
        )
    return shipped
