"""A motion in, the same motion done by a trained policy out: what `poise track` does.

tracked = track_clip("kick.bvh", search=True)
tracked.card, tracked.clip, tracked.save("out")
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from poise.jobs.open import Run, open_run
from poise.jobs.result import clip_of
from poise.jobs.track.points import points_of
from poise.jobs.track.policy import Tracker
from poise.jobs.track.tracking import TrackConfig, Tracked, track
from poise.motion import Clip
from poise.motion.io.raw import ReadOptions
from poise.motion.keypoints import Keypoints
from poise.plan import SamplingConfig
from poise.settings import changed


def track_clip(
    clip: Clip | Keypoints | str | Path,
    policy: Tracker | Run | str | Path | None = None,
    config: TrackConfig | None = None,
    *,
    search: bool | SamplingConfig = False,
    on_search: Callable[[int, int], None] | None = None,
    **settings: Any,
) -> Tracked:
    """Lets a trained policy do a motion that it need not know, without help and without training.

    Args:
        clip: a clip, keypoints, or a file; keypoints in a file stay keypoints.
        policy: a policy file, the folder of a run of poise train perpetual, or one that is open; by
            default the policy that comes with Poise.
        config: how it is tracked; `settings` are those that differ, such as recover=True or count=4.
        search: a motion that the policy loses is looked for by many characters at once.
        on_search: is told how many control steps of how many are searched.

    Raises:
        PoiseError: a motion that cannot be read or that no human makes, or no such policy.
    """
    config = changed(config or TrackConfig(), settings)
    given = clip if isinstance(clip, Keypoints) else clip_of(clip)
    if isinstance(clip, str | Path) and isinstance(given, Clip):
        given = points_of(given, ReadOptions()) or given
    if not isinstance(policy, Tracker):
        policy = (policy if isinstance(policy, Run) else open_run(policy)).tracker
    if search:
        how = search if isinstance(search, SamplingConfig) else SamplingConfig(seed=config.seed)
        config = replace(config, search=how)
    return track(policy, given, config, on_search)
