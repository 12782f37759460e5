"""Two characters in a scene, in miniature: the chicken fight, and hand in hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from poise.control import Compliance
from poise.jobs.open import open_run
from poise.jobs.track import imitation_of
from poise.jobs.track.placement import place
from poise.jobs.tracker import Tracker
from poise.papers.compliant.motions import BEGINS_S, FLIES_S, STANDS_S, G, hopping, hops
from poise.papers.compliant.opponents import (
    APART_M,
    HANDS_APART_M,
    Opponent,
    opposing,
    partner_stage,
    rival_stage,
    weighed,
)
from poise.papers.compliant.scene_play import play
from poise.papers.compliant.scenes import Chicken, HandInHand
from poise.papers.compliant.scenes.stage import hand_of
from poise.recipes.imitation import Imitation
from refusals import refused

STEPS = 4


@pytest.fixture(scope="module")
def tracker() -> Tracker:
    return open_run(None).tracker


@pytest.fixture(scope="module")
def task(tracker: Tracker) -> Imitation:
    return imitation_of(tracker, [place(hopping(tracker, 2.0), tracker)])


def test_hops_by_hand() -> None:
    h = 1e-3
    t = BEGINS_S + np.arange(0.0, 2.0, h)
    along, height, foot = hops(t)
    # Up and down without a jump, and free fall while the foot is off the ground.
    assert np.abs(np.diff(height)).max() < 1.01 * h * 0.5 * G * FLIES_S
    flies = (foot > 1e-3)[1:-1]
    fall = np.diff(height, 2) / h**2
    assert np.abs(fall[flies] + G).max() < 1e-3 * G and flies.mean() == pytest.approx(1 / 3, abs=0.05)
    # A standing foot does not move along the ground; four ways lead back to where it began.
    stands = foot == 0.0
    assert np.abs(np.diff(along[:, 0]))[stands[1:] & stands[:-1]].max() < 1e-9
    end = hops(np.array([BEGINS_S + 8 * (STANDS_S + FLIES_S) + 1e-6]))[0]
    assert np.abs(end).max() < 1e-9


def test_a_hopping_motion(task: Imitation) -> None:
    body, pose = task.humanoid, task.reference.pose
    by = {body.table.rows[i].side: i for i in body.feet}
    stands = round(1.2 * task.reference.rate_hz)
    off = pose.com[stands] - pose.pos[stands, by["right"]]
    assert float(off[:2].norm()) < 0.02
    assert float(pose.pos[stands, by["left"], 2] - pose.pos[0, by["left"], 2]) > 0.15


def test_masses_change_nothing_of_a_player_alone(tracker: Tracker, task: Imitation) -> None:
    ends = list[torch.Tensor]()
    for kg in (36.0, 85.0):
        own = weighed(task, kg)
        assert own.humanoid.mass == pytest.approx(kg)
        env = own.env(1, threads=1, auto_reset=False, help_scale=0.0)
        zero = torch.zeros(1, dtype=torch.long)
        obs = env.reset_to(zero, zero)
        for _ in range(STEPS):
            obs = env.step(tracker.policy.act(obs)).obs
        ends.append(env.backend.state.qpos.clone())
        env.close()
    torch.testing.assert_close(*ends, atol=2e-3, rtol=0)


def test_an_opponent_out_of_reach_moves_as_if_it_were_alone(tracker: Tracker, task: Imitation) -> None:
    scene = Chicken(against="rival")
    stage, rival = rival_stage(scene, tracker, scene.stage(task.humanoid, task.reference))
    far = weighed(rival, 36.0, 10.0)
    assert float((far.reference.qpos - rival.reference.qpos)[0, 0]) == pytest.approx(10.0)
    assert 0.6 * APART_M < float(rival.reference.qpos[0, 0]) < 1.4 * APART_M
    given = Compliance(0.1)
    own = replace(
        task.task,
        events=(*stage.events, opposing(far, tracker.policy, given)),
        compliance=given,
        dones=(),
    )
    made = replace(task, task=own, props=stage.props, touches=stage.touches)
    env = made.env(2, threads=1, auto_reset=False, help_scale=0.0, guard=False)
    # A policy that gives way sees the level, whether anything pushes it or not.
    lone = replace(far, task=replace(far.task, events=(), compliance=given)).env(
        1, threads=1, auto_reset=False, help_scale=0.0, guard=False
    )
    opposing_one = env.event(Opponent)
    assert opposing_one is not None
    zero = torch.zeros(2, dtype=torch.long)
    obs, other = env.reset_to(zero, zero), lone.reset_to(zero[:1], zero[:1])
    for _ in range(STEPS):
        obs = env.step(tracker.policy.act(obs)).obs
        other = lone.step(tracker.policy.act(other)).obs
    for row in opposing_one.env.backend.state.qpos:
        torch.testing.assert_close(row, lone.backend.state.qpos[0], atol=1e-5, rtol=0)
    env.close()
    lone.close()


@pytest.mark.parametrize("side", ["left", "right"])
def test_a_partner_walks_beside_the_character_hand_by_hand(tracker: Tracker, side: str) -> None:
    task = imitation_of(tracker, [place(tracker.example, tracker)])
    scene = HandInHand(side=side, partner="person")  # type: ignore[arg-type]
    _, other = partner_stage(scene, tracker, task, scene.stage(task.humanoid, task.reference))
    theirs = hand_of(task.humanoid, {"left": "right", "right": "left"}[side], "hands")
    hand = hand_of(task.humanoid, side, "hands")
    apart = other.reference.pose.pos[:, theirs] - task.reference.pose.pos[:, hand]
    assert float(apart[0, :2].norm()) == pytest.approx(HANDS_APART_M, abs=0.1)
    # Their arms swing alike, and they go the same way, though the walk turns a little.
    assert float((apart.norm(dim=-1) - HANDS_APART_M).abs().max()) < 0.15
    assert torch.allclose(other.reference.qpos[:, 2], task.reference.qpos[:, 2], atol=0.05)


def test_two_people_hand_in_hand(tracker: Tracker) -> None:
    task = imitation_of(tracker, [place(tracker.example, tracker)])
    scene = HandInHand(partner="person")
    stage, other = partner_stage(scene, tracker, task, scene.stage(task.humanoid, task.reference))
    events = (*stage.events, opposing(other, tracker.policy, Compliance(), name="partner"))
    own = replace(task.task, events=events, compliance=Compliance(), dones=())
    env = replace(task, task=own, props=stage.props, links=stage.links).env(
        1, threads=1, auto_reset=False, help_scale=0.0, guard=False
    )
    zero = torch.zeros(1, dtype=torch.long)
    obs = env.reset_to(zero, zero)
    for _ in range(30):
        obs = env.step(tracker.policy.act(obs)).obs
    sim = env.backend.sim  # type: ignore[attr-defined]
    one, two = (sim.link(name).force[0] for name in ("hands", "theirs"))
    # Each pulls the other back: the thing between them weighs next to nothing.
    assert float(one.norm()) > 1.0
    assert float((one + two).norm()) < 0.2 * float(one.norm()) + 3.0
    env.close()


def test_two_people_do_not_look_ahead() -> None:
    with refused("settings-conflict", says="two people"):
        play(HandInHand(partner="person"), controller="lookahead")
    with refused("settings-conflict", says="as fast as the character"):
        HandInHand(partner="person", lead=0.5)


def test_players_that_are_none() -> None:
    with refused("out-of-range", says=("mass", "1")):
        Chicken(mass=1.0)
    with refused("unknown-choice", says=("against", "wall")):
        Chicken(against="wall")  # type: ignore[arg-type]
