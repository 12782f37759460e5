"""Coming back: a thousand trials of each of the fail-states of Perpetual Humanoid Control's Table 4.

The reference stands at ease; a character has fallen, is 2 to 5 m away, or both, as `score.recovered`
draws them. Back is one with bodies within its distance for its time. The null does nothing (action 0).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from benchmarks.common.rows import Figure, of
from benchmarks.common.runner import Part, Places, Raws
from benchmarks.common.stance import relaxed_stance
from benchmarks.common.starts import Nothing
from poise.env import ImitationEnv, Reference
from poise.jobs.open import open_run
from poise.jobs.track import imitation_of
from poise.jobs.track.placement import place
from poise.score.recovered import KINDS, recovery_card, trial_task

TRIALS = 1000


def recovered(places: Places, kind: str, policy: str, acts: bool) -> Any:
    """Trials of one fail-state."""
    tracker = open_run(None if policy == "tracker" else policy).tracker
    made = imitation_of(tracker, [place(tracker.example, tracker)])
    still = np.tile(relaxed_stance(made.humanoid).qpos, (30, 1))
    reference = Reference(made.humanoid, [still], made.config.sim.control_hz, ["standing at ease"])
    clips, trials = made.recovery_clips, 2 if places.smoke else TRIALS
    task = trial_task(made.task, falls=trials, guided=clips is not None)

    def make(worlds: int) -> ImitationEnv:
        tried = replace(made, reference=reference, task=task)
        return tried.env(worlds, None, False, 1, help_scale=0.0, guard=False)

    by = tracker.policy if acts else Nothing(tracker.policy.num_actions)
    card = recovery_card(make, by, trials, method=policy, kinds=(kind,), recovery_clips=clips)
    return card.to_dict()["rows"][0]


def rows(places: Places, raws: Raws, method: str) -> Iterator[Figure]:
    """Shares that were back, and times."""
    for kind, row in raws.items():
        values = {f"back_in_{s}_s": share for s, share in zip((5, 10), row["within"], strict=True)}
        values |= {"median_s": row["median"], "slowest_s": row["slowest"]}
        yield from of(f"{kind}; {method}", values, row["trials"])


def part(policy: str, method: str, acts: bool, hours: float) -> Part:
    """The part of one policy."""
    return Part(
        f"trials of each fail-state, {method}",
        lambda p: list(KINDS)[:1] if p.smoke else list(KINDS),
        partial(recovered, policy=policy, acts=acts),
        partial(rows, method=method),
        (policy,),
        hours=hours,
        needs=(),
    )


PARTS = {
    "policy": part("tracker", "policy", True, 0.3),
    "keypoints": part("keypoints", "policy of keypoints", True, 0.3),
    "nothing": part("tracker", "nothing (action 0)", False, 0.3),
}
