"""The policy that comes with Poise: small, honest about its data, and it walks."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from majority import majority
from poise.env import Reference
from poise.formats import read_clip
from poise.jobs.library.files import subject_of
from poise.jobs.open import open_run
from poise.jobs.perpetual.evaluation import try_recovery
from poise.jobs.result import shortfalls
from poise.jobs.track import TrackConfig, imitation_of, track
from poise.jobs.track.placement import place
from poise.jobs.tracker import POLICIES, SHIPPED, Tracker
from poise.motion import trim
from poise.score.recovered import KINDS
from toy_human import human, swing, turn
from toy_policy import WALK


@pytest.fixture(scope="module", params=[None, *POLICIES], ids=["rotations", *POLICIES])
def tracker(request: pytest.FixtureRequest) -> Tracker:
    return open_run(request.param).tracker


def test_it_is_small_and_says_what_it_learned(tracker: Tracker) -> None:
    assert SHIPPED.stat().st_size < 5_000_000
    assert all(file.stat().st_size < 5_000_000 for file in POLICIES.values())
    about = tracker.about
    assert about["help_n"] == 0.0 and about["samples"] > 50_000_000 and about["finished"]
    learned = {subject_of(name) for name in about["clips"]}
    assert "cmu 02" in learned and not learned & {"cmu 05", "cmu 11", "cmu 14"}
    # Clips that may not be learned from by what ships.
    assert not any(
        x in name.lower() for name in about["clips"] for x in ("bandai", "lafan", "sie", "ase")
    )


def test_the_embedded_walk_is_done_without_help(tracker: Tracker) -> None:
    def check(seed: int) -> None:
        tracked = track(read_clip(WALK), tracker, controller="policy", seed=seed)
        card = tracked.evaluation.card
        assert not tracked.failures and card.succ == 1.0 and card.help.limit_n == 0.0
        assert card.mpjpe_mm < 60

    majority(check)


def test_it_gets_up_and_comes_back(tracker: Tracker) -> None:
    assert tracker.recovery_clips is not None
    still = tracker.recovery_clips.ease.expand(30, -1).numpy()
    walk = imitation_of(tracker, [place(read_clip(WALK), tracker)])
    stands = replace(walk, reference=Reference(tracker.humanoid, [still], 30.0, ["stands"]))
    card = try_recovery(stands, tracker.policy, 8, threads=1)
    assert {r.kind: r.within[1] >= 0.5 for r in card.rows} == dict.fromkeys(KINDS, True)


def test_who_is_thrown_off_a_motion_goes_on_with_it(tracker: Tracker) -> None:
    """A jump aside of 2 m in one frame, which no character can do."""
    clip = read_clip(WALK)
    pos = clip.root_pos.copy()
    pos[clip.frames // 2 :, 1] += 2.0

    def check(seed: int) -> None:
        config = TrackConfig(recover=True, controller="policy", seed=seed)
        tracked = track(clip.replaced(root_pos=pos), tracker, config)
        losses = tracked.losses
        assert losses is not None and len(losses.back) == len(losses.lost)
        assert "came back" in losses.sentence()
        rows = tracked.evaluation.recordings[0].qpos
        assert abs(rows[-1, :2] - tracked.placed.qpos[-1, :2]).max() < 0.5

    majority(check)


def test_a_held_out_take_is_followed_for_a_while(tracker: Tracker, data_dir: Path) -> None:
    clip = read_clip(data_dir / "cmu_bvh/ad/14_14.bvh")
    tracked = track(trim(clip, 0, round(5 * clip.fps)), tracker, controller="policy")
    assert not tracked.failures or tracked.failures[0][1] > 1.0


def test_a_chair_that_is_not_there_is_named(tracker: Tracker) -> None:
    """A body that stands, and sits down on nothing."""
    clip, names = swing(4.0, 30.0), human().names
    share = np.clip((np.arange(clip.frames) - 30) / 30, 0.0, 1.0)
    angle = share * share * (3 - 2 * share) * np.pi / 2
    rot, path = np.zeros_like(clip.rot), np.zeros((clip.frames, 3))
    rot[..., 0] = 1.0
    for joint, sign in (("UpLeg", -1.0), ("Leg", 1.0)):
        for side in ("Left", "Right"):
            rot[:, names.index(side + joint)] = turn("Y", torch.tensor(sign * angle)).numpy()
    path[:, 0], path[:, 2] = -0.42 * np.sin(angle), 0.9 - 0.42 * (1 - np.cos(angle))
    sitting = clip.replaced(rot=rot, root_pos=path)
    tracked = track(sitting, tracker, controller="policy", supports="none")
    card = tracked.evaluation.card
    assert card.tracked == 0.0
    (need,) = card.needs
    assert need["what"] == "a seat" and 1.0 < need["start_s"] < 2.0 and need["stop_s"] > 3.8
    assert "It needs a seat from 1.4 to 4.0 s." in shortfalls(card)
    there = track(sitting, tracker, controller="policy")
    assert [s.kind for s in there.supports] == ["seat"] and there.evaluation.card.needs == ()
