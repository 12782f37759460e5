"""What was tracked as files: the motion on the skeleton that came in, its score, its report."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from poise.errors import PoiseError
from poise.jobs.deliver import Delivery, deliver
from poise.jobs.track.tracking import Tracked
from poise.motion.io import home_suffix, write_clip


def write(tracked: Tracked, out: Path, motion: Path | None = None, hold: bool = True) -> Delivery:
    """Writes the motion, `score.json` and `report.html` into `out`, see `deliver`.

    The motion is on the skeleton that came in; where that is not the body's, the motion on the body's
    skeleton lies beside it as `body.bvh`.

    Args:
        motion: the file of the motion, in place of one in `out`. hold: see `deliver`.
    """
    t, placed, count = tracked, tracked.placed, len(tracked.evaluation.recordings)
    if count > 1 and motion is not None:
        raise PoiseError(f"{count} characters make {count} files", motion, "Give a folder as -o")
    other = placed.moved is not None
    inner = out / "body.bvh" if other and count == 1 else motion
    said = tuple(
        f"The character failed at {seconds:.1f} s" + (f" (character {k + 1})." if count > 1 else ".")
        for k, seconds in t.failures
    )
    done = deliver(t.imitation, t.evaluation, out, {}, inner, hold, placed.source, said)
    if not other:
        return done
    paths: dict[str, Path] = {}
    for k, (name, path) in enumerate(done.paths.items()):
        if k >= count:
            paths[name] = path
            continue
        back = t.delivered(k, hold)
        body = name.replace("simulated", "body", 1)
        paths[body] = path.rename(out / f"{body}{path.suffix}")
        paths[name] = motion or out / f"{name}{home_suffix(back)}"
        write_clip(back, paths[name])
    return replace(done, paths=paths)
