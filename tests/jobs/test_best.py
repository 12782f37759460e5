"""Which of several attempts is kept: the stated order, and one criterion of what is lost."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from poise.jobs.result import LOST, SURVIVED, TRACKED, Merit, merit
from poise.metrics import has_lost, success_rule
from poise.score import ScoreCard, score_rollouts
from poise.score.card import NO_HELP
from poise.score.rollouts import RolloutSet, judge


def episodes(*fails: int | None, frames: int = 40, off: float = 0.05) -> RolloutSet:
    """Episodes of two bodies that are `off` m from their reference, and 0.6 m from frame `fails` on."""
    many, still = len(fails), torch.tensor([1.0, 0, 0, 0])
    ref = torch.zeros(many, frames, 2, 3)
    ref[..., 1, 2] = 1.0
    pos = ref.clone()
    pos[..., 0] += off
    for k, fail in enumerate(fails):
        if fail is not None:
            pos[k, fail:, :, 0] = 0.6
    quat, zero = still.expand(many, frames, 2, 4), torch.zeros(many, frames, 1, 3)
    return RolloutSet(
        pos=pos, quat=quat, ref_pos=ref, ref_quat=quat, alive=torch.ones(many, frames).bool(),
        lengths=torch.full((many,), frames), reached_end=torch.ones(many).bool(), force=zero,
        torque=zero, point_vel=zero, ang_vel=zero, clip=torch.zeros(many).long(),
        start=torch.zeros(many).long(), fps=30.0, mass=50.0, limit_n=0.0, limit_nm=0.0,
    )  # fmt: skip


def card(**changes: object) -> ScoreCard:
    """Of a motion that is tracked, 50 mm off, as jerky as its reference."""
    made = score_rollouts(episodes(None))
    figures = {"jerk": 100.0, "reference": {"jerk": 100.0}, "foot_slide_mm_per_s": 50.0, "tracked": 1.0}
    return replace(made, **(figures | changes))  # type: ignore[arg-type]


def test_an_episode_that_is_lost_in_its_last_frame_came_less_far_than_one_to_its_end() -> None:
    """A search of 38 actions that reaches all of them ends beyond a loss at frame 38."""
    lost, whole = merit(episodes(38, frames=39)), merit(episodes(None, frames=39))
    assert lost.ended == LOST and lost.reached == pytest.approx(38 / 30) and whole.ended == TRACKED
    assert max(lost, whole) is whole


def test_the_order_is_end_then_help_then_how_far_then_error_jerk_and_slide() -> None:
    aid = replace(NO_HELP, force_mean_n=20.0)
    rising = [
        Merit.of(score_rollouts(episodes(10))),
        Merit.of(score_rollouts(episodes(30, off=0.3))),
        Merit.of(score_rollouts(episodes(30))),
        Merit.of(card(tracked=0.0)),
        Merit.of(card(help=replace(aid, force_mean_n=40.0), mpjpe_global_mm=10.0)),
        Merit.of(card(help=aid)),
        Merit.of(card(mpjpe_global_mm=80.0, jerk=50.0)),
        Merit.of(card(jerk=150.0, foot_slide_mm_per_s=10.0)),
        Merit.of(card()),
        Merit.of(card(foot_slide_mm_per_s=20.0)),
    ]
    assert rising == sorted(rising) and len(set(rising)) == len(rising)
    assert [m.ended for m in rising[:4]] == [LOST, LOST, LOST, SURVIVED]
    # Within a step attempts are alike, so that the earlier one stays.
    assert Merit.of(card(mpjpe_global_mm=52.0)) == Merit.of(card(mpjpe_global_mm=58.0))
    # What was not measured is no merit.
    assert Merit.of(card(foot_slide_mm_per_s=math.nan)) < Merit.of(card())


def test_one_of_many_episodes_is_judged_alone() -> None:
    many = episodes(None, 12, 25)
    assert [merit(many, k).ended for k in range(3)] == [TRACKED, LOST, LOST]
    assert merit(many, 2).reached == pytest.approx(25 / 30)
    assert merit(many, 1) == merit(episodes(12))


@pytest.mark.parametrize("off", [0.4999, 0.5, 0.5001, math.nan])
def test_the_criterion_while_characters_act_is_that_of_the_score(off: float) -> None:
    r = episodes(None, frames=3)
    pos = r.pos.clone()
    pos[:, 2, :, 0] = off
    acts = bool(has_lost(pos, r.ref_pos).any())
    failed = judge(replace(r, pos=pos), success_rule("phc")).failed_at
    assert acts == (int(failed) == 2) == (not off <= 0.5)
