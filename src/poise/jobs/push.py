"""A motion with a push in it, for animators.

pushed = push("walk.bvh", 150.0, at="hand", level=0.12)
pushed.pushed.sentence(), pushed.clip, pushed.save("out")
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from poise.jobs.open import Run
from poise.jobs.result import Result
from poise.jobs.track import TrackConfig, track
from poise.jobs.track.controllers import Show
from poise.jobs.track.pushed import PushConfig
from poise.jobs.tracker import Tracker
from poise.motion import Clip
from poise.settings import changed


def push(
    clip: Clip | str | Path,
    newtons: float = PushConfig.newtons,
    policy: Tracker | Run | str | Path | None = None,
    config: TrackConfig | None = None,
    *,
    progress: Show | None = None,
    **settings: Any,
) -> Result:
    """Lets a trained policy do a motion while something pushes it, without help and without training.

    The character gives way: its goal is displaced where it is pushed, and comes back afterwards. What
    comes back is what `poise.track` gives, with `Result.pushed`.

    Args:
        clip: a clip, or the file of one.
        newtons: the force.
        policy: see `track`.
        config: how it is tracked; its `push` is what `settings` change.
        progress: see `track`.
        settings: of the push, see `PushConfig`: at, start_s, seconds, direction, level, stiffness, law.

    Raises:
        PoiseError: a body without such a part, a level above 1, a motion that ends before the push; and
            what `track` raises.
    """
    given = config or TrackConfig()
    made = changed(given.push or PushConfig(), {"newtons": newtons, **settings})
    return track(clip, policy, changed(given, {"push": made}), progress=progress)
