"""Several clips one after another: where they stand, what is scored, what is refused."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
import torch

from poise.env import ImitationEnv, Reference
from poise.env.recovery.recovering import RETURNS, TRACKS, Recovering
from poise.formats import read_clip
from poise.jobs.open import open_run
from poise.jobs.track import recovery_run as recovering
from poise.jobs.track import track
from poise.jobs.track.placement import home, place, place_all
from poise.jobs.track.recovery_run import cut, parts_of
from poise.jobs.tracker import Tracker
from poise.motion import Clip, shifted, trim
from poise.plan import LookaheadConfig
from refusals import refused
from toy_human import swing
from toy_policy import WALK, toy_run, walk

#: Few copies that look a little ahead.
SHORT = LookaheadConfig(candidates=10, horizon=4)


@pytest.fixture(scope="module")
def tracker() -> Tracker:
    """The policy that comes with Poise, which walks."""
    return open_run().tracker


def apart(gap: tuple[float, float]) -> list[Clip]:
    """The embedded walk's first second twice, the second `gap` m from the first one's end."""
    first = trim(read_clip(WALK), 0, 30).replaced(name="first")
    to = first.root_pos[-1] - first.root_pos[0] + np.array([*gap, 0.0])
    return [first, shifted(first, to).replaced(name="second")]


def test_two_walks_apart_are_one_motion(tracker: Tracker, tmp_path: Path) -> None:
    clips = apart((1.0, 1.0))
    tracked = track(clips, tracker, controller="policy")
    a, b = tracked.parts
    assert a.done and b.done and not tracked.failures and a.begins == 0.0 and a.after == 0.0
    assert a.ends == pytest.approx(29 / 30) and b.ends is not None and b.begins is not None
    assert b.ends - b.begins == pytest.approx(29 / 30) and 1.0 < b.begins - a.ends < 10.0
    assert b.after == pytest.approx(b.begins - a.ends)
    # No step is longer than a fast walk's.
    qpos, rate = tracked.evaluation.recordings[0].qpos, 30
    assert np.linalg.norm(np.diff(qpos[:, :3], axis=0), axis=-1).max() < 2.5 / rate
    # It does the second clip where that stands.
    begin, there = round(b.begins * rate), place_all(clips, tracker)[1].qpos
    np.testing.assert_allclose(tracked.placed.qpos[begin : begin + 30], there, atol=1e-9)
    assert abs(qpos[begin, :2] - there[0, :2]).max() < 0.4
    card = tracked.card
    assert card.succ == 1.0 and card.episodes == 2 and card.help.limit_n == 0.0
    assert [row["clip"] for row in card.per_clip] == ["first", "second"] and card.frames == 60
    assert card.per_clip[1]["after_s"] == b.after and card.per_clip[1]["done"]
    # Only what belongs to a clip is scored, and against it.
    r = tracked.evaluation.rollouts
    own = (r.pos[0, begin : begin + 30] - r.ref_pos[0, begin : begin + 30]).norm(dim=-1).mean() * 1000
    assert card.per_clip[1]["mpjpe_global_mm"] == pytest.approx(float(own), rel=1e-4)
    done = tracked.write(tmp_path / "out", tmp_path / "out.bvh")
    assert set(done.paths) == {"simulated", "body", "score", "report"}
    made = read_clip(tmp_path / "out.bvh")
    assert made.frames == len(qpos) and made.skeleton.names == clips[0].skeleton.names
    page = (tmp_path / "out/report.html").read_text("utf-8")
    assert "first, second" in page and "second: reached" in page
    score = json.loads((tmp_path / "out/score.json").read_text())
    assert score["per_clip"][1]["begins_s"] == b.begins
    # A clip that was not reached, and one that did not end.
    spans = [(0, 29), (begin, None), (None, None)]
    names = replace_names(tracked.imitation.reference, 3)
    scores = cut(r, spans, names)
    assert scores.lengths.tolist() == [30, int(r.lengths[0]) - begin, 0]
    one, two, three = parts_of(scores, spans, "phc", returns=False)
    assert one.done and not two.done and two.lost is not None and not three.done
    assert "lost at" in two.sentence() and three.sentence().endswith("not reached.")


def replace_names(reference: Reference, count: int) -> Reference:
    """A reference of `count` clips like the first."""
    motions = [reference.qpos.numpy()] * count
    names = [f"clip {k}" for k in range(count)]
    return Reference(reference.humanoid, motions, reference.rate_hz, names)


def test_a_clip_that_goes_on_where_the_last_one_ends_begins_at_once(tracker: Tracker) -> None:
    whole = read_clip(WALK)
    cuts = [trim(whole, a, b).replaced(name=f"{a}") for a, b in ((0, 30), (29, 60))]
    tracked = track(cuts, tracker, controller="policy")
    assert tracked.parts[1].after == 0.0 and all(p.done for p in tracked.parts)
    assert len(tracked.evaluation.recordings[0].qpos) == 60


def test_it_looks_ahead_on_the_way_too(tracker: Tracker) -> None:
    clips = [trim(clip, 0, 10) for clip in apart((0.3, 0.0))]
    tracked = track(clips, tracker, lookahead=SHORT, threads=1)
    assert tracked.controller == "lookahead" and "lookahead" in tracked.card.method
    assert [p.begins is not None for p in tracked.parts] == [True, True]


def test_a_clip_that_is_lost_on_the_way_is_come_back_to(tracker: Tracker) -> None:
    clips = apart((0.6, 0.0))
    # A jump aside of 2 m that no character can do.
    pos = clips[0].root_pos.copy()
    pos[15:, 1] += 2.0
    clips[0] = clips[0].replaced(root_pos=pos)
    tracked = track(clips, tracker, controller="policy", recover=True)
    first, second = tracked.parts
    assert first.lost is not None and first.lost < 1.0 and first.came_back and first.done
    assert "come back to and done" in first.sentence() and tracked.losses is not None
    assert second.begins is not None and second.done
    # Without, it is lost, and the next one is done none the less.
    tracked = track(clips, tracker, controller="policy")
    first, second = tracked.parts
    assert first.lost is not None and not first.done and second.done
    assert tracked.failures == ((0, first.lost),)


def test_a_clip_that_is_given_up_is_left_for_the_next(
    tracker: Tracker, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recovering, "LOSSES", 0)
    clips = apart((0.6, 0.0))
    pos = clips[0].root_pos.copy()
    pos[15:, 1] += 2.0
    clips[0] = clips[0].replaced(root_pos=pos)
    tracked = track(clips, tracker, controller="policy", recover=True)
    first, second = tracked.parts
    assert not first.done and first.lost is not None and second.done and second.begins is not None
    losses = tracked.losses
    assert losses is not None and losses.given_up == losses.lost[:1] and len(losses.back) == 1
    assert "It left a clip for the next, first at" in losses.sentence()
    # What follows is no part of it.
    assert int(tracked.evaluation.rollouts.lengths[0]) > second.begins * 30
    assert tracked.card.per_clip[0]["frames"] <= second.begins * 30 + 1


def test_clips_that_are_not_come_to_are_left_three_in_a_row_at_most() -> None:
    goal, left = SimpleNamespace(), list[int]()
    length = SimpleNamespace(length=torch.tensor([2] * 9))
    goal.rate_hz, goal.chained, goal.lost, goal.doing = 1.0, True, [], torch.tensor([TRACKS])
    zero = torch.tensor([0])
    goal.clips = SimpleNamespace(clip=zero, frame=zero, reference=length)
    goal.aimed = torch.zeros(1, 7)

    def leave(_: object) -> None:
        left.append(int(goal.clips.clip))
        goal.clips.clip, goal.clips.frame = goal.clips.clip + 1, torch.tensor([0])

    goal.leave = leave
    led = recovering.LedCharacter(cast("Recovering", goal), torch.zeros(1, 7))
    env = SimpleNamespace(given=torch.zeros(1, 1))
    away, step = math.ceil(recovering.AWAY_S) + 1, 0

    def go_on(steps: int) -> bool:
        nonlocal step
        ends = False
        for _ in range(steps):
            ends = led.see(cast("ImitationEnv", env), step)
            step += 1
        return ends

    go_on(1)
    goal.clips.clip, goal.doing = torch.tensor([1]), torch.tensor([RETURNS])
    assert not go_on(2 * away + 2) and left == [1, 2]
    # One that is come to counts anew.
    goal.doing = torch.tensor([TRACKS])
    assert not go_on(1) and led.spans[3][0] is not None
    goal.clips.clip, goal.doing = torch.tensor([4]), torch.tensor([RETURNS])
    assert not go_on(2 * away + 2) and left == [1, 2, 4, 5]
    assert go_on(away) and led.spans[6] == (None, None)


def test_clips_of_other_skeletons_come_onto_the_first_ones(tracker: Tracker) -> None:
    first, other = swing(1.0, speed=1.0, name="first"), read_clip(WALK)
    other = shifted(trim(other, 0, 30), (3.0, -2.0, 0.0)).replaced(name="other")
    one, two = place_all([first, other], tracker)
    assert two.source.skeleton.same_bones(first.skeleton) and "on another skeleton" in two.notes[0]
    # It begins where it stands, on the skeleton that came in.
    np.testing.assert_allclose(two.source.root_pos[0, :2], other.root_pos[0, :2], atol=0.06)
    assert one.moved is not None and two.moved is not None
    away = one.moved.scale * (other.root_pos[0, :2] - first.root_pos[0, :2])
    np.testing.assert_allclose(two.qpos[0, :2] - one.qpos[0, :2], away, atol=0.06)
    assert home(one.clip, one, tracker).skeleton.same_bones(first.skeleton)
    # Hinges are no whole turn away from those at ease, between which recovery motions lead.
    assert tracker.recovery_clips is not None
    for p in (one, two):
        off = p.qpos[:, 7:].mean(0) - tracker.recovery_clips.ease[7:].numpy()
        low, high = tracker.humanoid.model.jnt_range[1:].T
        near = p.qpos[:, 7:] - 2 * math.pi * np.round(off / (2 * math.pi))
        fits = (near.min(0) >= low) & (near.max(0) <= high)
        assert (abs(off)[fits] <= math.pi).all()
    # Beside what `place` gives only whole turns differ.
    alone = place(first, tracker).qpos
    turns = (one.qpos[:, 7:] - alone[:, 7:]) / (2 * math.pi)
    np.testing.assert_allclose(turns, np.round(turns), atol=1e-9)


def test_what_is_refused(tracker: Tracker, tmp_path: Path) -> None:
    clips = apart((1.0, 0.0))
    for settings in ({"count": 2}, {"reset_on_fail": True}, {"controller": "search"}):
        with refused("single-clip-only"):
            track(clips, tracker, **settings)
    with refused("no-clips"):
        track([], tracker)
    with refused("file-missing", says="absent"):
        track([WALK, tmp_path / "absent.bvh"], tracker)
    toy = open_run(toy_run(tmp_path / "run")).tracker
    with refused("recovery-not-learned", says="from one clip to the next"):
        track([walk(0, 30), walk(10, 40)], toy)
    able = replace(tracker, value=None)
    tracked = track([trim(clips[0], 0, 6), trim(clips[0], 5, 12)], able)
    assert tracked.controller == "policy" and any("without its critic" in n for n in tracked.notes)


@pytest.mark.parametrize(("apart", "ends"), [(2, True), (12, False)])
def test_a_motion_is_given_up_where_it_is_lost_again_and_again(apart: int, ends: bool) -> None:
    """Nine losses within ten seconds of a motion end it; nine in a long one do not."""
    goal = SimpleNamespace(rate_hz=1.0, chained=False, lost=[], doing=torch.tensor([TRACKS]))
    length = SimpleNamespace(length=torch.tensor([1000]))
    zero = torch.tensor([0])
    goal.clips = SimpleNamespace(clip=zero, frame=zero, reference=length)
    goal.aimed = torch.zeros(1, 7)
    led = recovering.LedCharacter(cast("Recovering", goal), torch.zeros(1, 7))
    env, step = cast("ImitationEnv", SimpleNamespace(given=torch.zeros(1, 1))), 0
    over = led.see(env, step)
    for k in range(30):
        for doing in (RETURNS, TRACKS):
            if doing == RETURNS:
                goal.lost.append((0, apart * k // 3))
            goal.doing, step = torch.tensor([doing]), step + 1
            over = over or led.see(env, step)
        goal.clips.frame = torch.tensor([apart * (k + 1) // 3])
    assert over == ends
