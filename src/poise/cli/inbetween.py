"""`poise inbetween`: fills the frames between keyframes of a clip."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import OmitArgPrefixes, Positional, arg

from poise.cli.console import Answer, say, tell
from poise.cli.options import Flag, Force, Json, Reading, check_range
from poise.cli.training import left, showing
from poise.errors import PoiseError
from poise.jobs.keep import may_write

if TYPE_CHECKING:
    from poise.motion import Clip


def run(
    clip: Annotated[Positional[Path], arg(metavar="CLIP")],
    keyframes: Annotated[str, arg(metavar="0,30,45")],
    out: Annotated[Path, arg(aliases=["-o"], metavar="OUT")],
    model: Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="")] = None,
    samples: Annotated[int, arg(metavar="N")] = 1,
    foot_lock: Flag = True,
    adapt: Annotated[int, arg(metavar="N")] = 0,
    seed: Annotated[int, arg(metavar="S")] = 0,
    picture: Annotated[Path | None, arg(metavar="FILE.svg", help_behavior_hint="")] = None,
    force: Force = False,
    json: Json = False,
    reading: OmitArgPrefixes[Reading] = Reading(),
) -> Answer:
    """Make everything between keyframes of a clip anew; keyframes and all other frames stay.

    Args:
        clip: the motion file that holds the keyframes.
        keyframes: frames that stay, counted from 0, in rising order; frames outside of them stay too.
        out: the motion file to write; its suffix names the format (.bvh).
        model: a trained network: a run folder of poise train inbetween, or a model file; by default the
            one that comes with Poise.
        samples: clips to make, as OUT-0, OUT-1 ...: the first is the best guess, the others take another
            way.
        foot_lock: leave feet as the network made them; by default standing feet are held, and step clear
            of the floor.
        adapt: iterations of test-time adaptation for each gap, such as 20, about a second in all; by
            default none.
        seed: seed of the variants.
        picture: also draw the poses, keyframes black, over the clip that came in.
    """
    from poise.formats import check_writable, write_clip
    from poise.jobs.inbetween.fill import inbetween
    from poise.synthesis.filler import check_keyframes

    keys = frames_of(keyframes)
    if not 0 <= adapt <= 1000:
        raise PoiseError(f"--adapt must be 0 to 1000, got {adapt}", code="out-of-range")
    check_range("samples", samples, 1, 100)
    check_range("seed", seed, 0)
    one = samples == 1
    outs = [out] if one else [out.with_stem(f"{out.stem}-{k}") for k in range(samples)]
    check_writable(outs[0])
    for path in (*outs, *((picture,) if picture else ())):
        may_write(path, force, clip)
    source = reading.read(clip)
    check_keyframes(keys, source.frames, str(clip))
    begun = time.monotonic()
    tell(f"filling {len(keys) - 1} gaps", "dim")
    with showing("filling", at_once=False) as show:

        def count(done: int, of: int) -> None:
            took = max(1e-9, time.monotonic() - begun)
            how = f"{done / took:.1f} gaps/s, {left(took, done / of)}"
            show(done / of, f"gap {done} of {of}, {how}")

        filled = inbetween(
            source, keys, model, samples=samples, foot_lock=foot_lock, adapt=adapt, seed=seed,
            on_gap=count,
        )  # fmt: skip
    for warning in filled.filled.warnings:
        tell(f"warning: {warning}.", "yellow")
    outputs = {"clip" if one else f"clip-{k}": path for k, path in enumerate(outs)}
    for made, path in zip(filled.clips, outs, strict=True):
        write_clip(made, path)
        say(f"{path.name}: {made.frames} frames at {made.fps:.5g} fps, keyframes {keyframes}")
    if picture is not None:
        draw(source, filled.clips, keys, picture)
        outputs["picture"] = picture
    result = {
        "frames": source.frames, "fps": source.fps, "keyframes": keys,
        "warnings": filled.filled.warnings,
        "faults": [f.to_dict() for f in filled.filled.faults],
    }  # fmt: skip
    return Answer(result, outputs, source.skeleton.source.notes)


def draw(clip: Clip, made: Sequence[Clip], keys: Sequence[int], path: Path) -> None:
    """Up to four of the clips made, at 13 moments from the first keyframe to the last."""
    import numpy as np

    from poise.score.report import PoseRow, pose_rows

    frames = np.unique(np.linspace(keys[0], keys[-1], 13).round().astype(int)).tolist()
    ghost = clip.positions()
    rows = [PoseRow(c.name, c.positions(), ghost) for c in made[:4]]
    title = f"{clip.name}: {len(keys)} keyframes"
    pose_rows(title, rows, clip.skeleton.parents, frames, clip.fps, keys, path=path)


def frames_of(text: str) -> tuple[int, ...]:
    """(0, 30, 45) from "0,30,45" or "0 30 45"."""
    try:
        return tuple(int(word) for word in text.replace(",", " ").split())
    except ValueError:
        hint = "Write for example --keyframes 0,30,45"
        raise PoiseError(
            f"--keyframes needs whole numbers, got '{text}'", hint=hint, code="option-malformed"
        ) from None
