"""Recovery motions of a library's own clips: what they are made of, where they lead, how they move."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from poise.env import Reference
from poise.env.recovery.get_up import CALM, LIFT, QUICK, GetUpPlanner, RecoveryClips, find_recovery_clips
from poise.env.recovery.planner import (
    SPEEDS_UP,
    STOPS,
    plan_recovery,
    recovery_motions,
    run_up,
    walk_of,
    way_to_stand,
)
from poise.kinematics import Kinematics
from poise.motion import ClipLibrary
from poise.motion.rotations import facing, heading_angle, quat_angle, quat_between, turned, yaw_quat
from poise.recipes.perpetual import build, standing, walking_clips
from poise.recipes.perpetual_settings import Perpetual
from refusals import refused
from toy_human import swing
from toy_library import rises, tiny

Built = tuple[Reference, GetUpPlanner]


@pytest.fixture(scope="module")
def built() -> Built:
    made = build(ClipLibrary.of([swing(1.2, speed=1.0, name="walk"), rises("rises")]), tiny())
    reference = made.reference
    recovery_clips = find_recovery_clips(reference, standing(reference), walking_clips(reference))
    assert recovery_clips is not None
    return reference, GetUpPlanner(recovery_clips, reference.humanoid.table, reference.rate_hz)


def test_a_library_knows_a_walk_and_how_to_get_up(built: Built) -> None:
    recovery_clips = built[1].recovery_clips
    (walk,), (up,) = recovery_clips.walks, recovery_clips.ups
    # One cycle along +X, closed: its last frame is its first one farther on.
    assert walk[0, 0] == 0 and walk[-1, 0] == pytest.approx(1.2, abs=0.15)
    assert torch.allclose(walk[-1, 7:], walk[0, 7:], atol=1e-9)
    assert float(walk[-1, 1] - walk[0, 1]) == pytest.approx(0.0, abs=1e-9)
    height = float(recovery_clips.ease[2])
    assert up[0, 2] < 0.4 * height and up[-1, 2] > 0.9 * height


def test_what_was_lost_is_tried_in_another_way(built: Built) -> None:
    """Slower at its begin, then by the clip that is next nearest, and round again."""
    reference, planner = built
    one = planner.recovery_clips.ups[0]
    planner = GetUpPlanner(
        replace(planner.recovery_clips, ups=(one, one.repeat_interleave(2, 0))),
        reference.humanoid.table, reference.rate_hz,
    )  # fmt: skip
    lies = one[0].clone()
    lies[7:] += 0.4
    ways = [planner.up(lies, again) for again in range(5)]
    lengths = [len(way) for way in ways]
    assert lengths[1] > lengths[0] and lengths[3] > lengths[2] and torch.equal(ways[4], ways[0])
    assert lengths[2] != lengths[0]
    for way in ways:
        assert torch.allclose(way[0, 7:], lies[7:]) and torch.allclose(way[-1, 7:], one[-1, 7:])


def test_what_moves_stands_where_it_can_stop(built: Built) -> None:
    """Ahead by x = v |v| / 2a; what lies stands where it gets up, in other ways if that was lost."""
    planner = built[1]
    ease = planner.recovery_clips.ease.clone()
    moves = 1.2 * torch.tensor([math.cos(0.3), math.sin(0.3)], dtype=torch.float64)
    way = way_to_stand(planner, ease, moves=moves)
    ahead = float((way[-1, :2] - ease[:2]).norm())
    assert ahead == pytest.approx(1.2**2 / (2 * STOPS), abs=0.1)
    assert float((way_to_stand(planner, ease)[-1, :2] - ease[:2]).norm()) < 0.1
    lies = planner.recovery_clips.ups[0][0].clone()
    assert bool(planner.lies(lies)) and not bool(planner.lies(ease))
    first, again = (way_to_stand(planner, lies, again=k) for k in (0, 1))
    assert len(again) > len(first)
    for way in (first, again):
        assert torch.allclose(way[-1, 7:], ease[7:], atol=1e-6)


def test_nobody_walks_or_nobody_gets_up() -> None:
    for clips in (
        [swing(1.2, speed=1.0, name="walk"), swing(1.2, name="calm")],
        [swing(1.2, name="calm"), rises("rises")],
    ):
        reference = build(ClipLibrary.of(clips), tiny()).reference
        assert find_recovery_clips(reference, standing(reference), walking_clips(reference)) is None


@pytest.mark.parametrize("bearing", [0.3, 2.0, -2.9])
def test_a_walk_leads_from_anywhere_to_a_place(built: Built, bearing: float) -> None:
    reference, get_up = built
    recovery_clips = get_up.recovery_clips
    start, place = facing(recovery_clips.ease, bearing), facing(recovery_clips.ease, 0.5)
    start[0], start[1] = 2.0, -1.0
    way = plan_recovery(get_up, start, place)
    assert (way[0, :2] - start[:2]).norm() < 0.05
    assert turned_by(way[0], start) < 0.1
    assert way[-1, :2].norm() < 0.1
    assert turned_by(way[-1], place) < 0.15
    # No motion runs, and all stand for a second at the end.
    pace = (way[1:, :2] - way[:-1, :2]).norm(dim=-1) * reference.rate_hz
    assert pace.max() < 1.5 and pace[-20:].max() < 1e-6


@pytest.mark.parametrize(("speed", "way"), [(1.4, 1), (2.5, 1), (1.0, -1)])
def test_a_run_up_leads_from_standing_into_a_motion(built: Built, speed: float, way: int) -> None:
    reference, get_up = built
    ease, faces = get_up.recovery_clips.ease, walk_of(get_up, 0)[2]
    place = facing(ease, 0.7)
    place[:2], direction = torch.tensor([3.0, -2.0]), 0.7 - faces + (math.pi if way < 0 else 0.0)
    velocity = torch.zeros(6 + len(ease) - 7, dtype=torch.float64)
    velocity[0], velocity[1] = speed * math.cos(direction), speed * math.sin(direction)
    frames = run_up(get_up, place, velocity)
    assert torch.allclose(frames[-1], place)
    step = (frames[1:, :2] - frames[:-1, :2]).norm(dim=-1) * reference.rate_hz
    # It begins at rest, at ease, speeds up evenly, and arrives as fast as the motion is.
    assert step[0] < 0.15 and turned_by(frames[0], place) < 0.15
    assert float(step[-1]) == pytest.approx(speed, abs=SPEEDS_UP / reference.rate_hz)
    assert (step[1:] - step[:-1]).abs().max() * reference.rate_hz < 2 * SPEEDS_UP
    gone = place[:2] - frames[0, :2]
    assert float(gone.norm()) == pytest.approx(speed**2 / (2 * SPEEDS_UP), rel=0.1)
    assert float(gone @ velocity[:2]) > 0
    # What stands, and what goes sideways, has none.
    assert torch.equal(run_up(get_up, place, 0.1 * velocity), place[None])
    aside = velocity.clone()
    aside[0], aside[1] = -velocity[1], velocity[0]
    assert torch.equal(run_up(get_up, place, aside), place[None])


def test_what_walks_already_walks_on(built: Built) -> None:
    reference, get_up = built
    cycle, speed, _ = walk_of(get_up, 0)
    start, place = cycle[7].clone(), facing(get_up.recovery_clips.ease, 0.0)
    place[0], place[1] = 2.0, 1.0
    moves = torch.tensor([speed, 0.0], dtype=torch.float64)
    way = plan_recovery(get_up, start, place, moves=moves)
    steps = (way[1:, 0] - way[:-1, 0]) * reference.rate_hz
    assert steps[:10].min() > 0.5 * speed and way[-1, :2].sub(place[:2]).norm() < 0.1
    stops = plan_recovery(get_up, start, place)
    assert abs(float(stops[1, 0] - stops[0, 0])) * reference.rate_hz < 0.2 * speed
    # Behind a place that is at hand it first comes to rest.
    place[0], place[1] = float(start[0]) + 0.1, float(start[1])
    way = plan_recovery(get_up, start, place, moves=moves)
    assert way[:, 0].max() > place[0] + 0.1 and way[-1, :2].sub(place[:2]).norm() < 0.1


def test_what_is_near_and_behind_is_come_to_backwards(built: Built) -> None:
    _, get_up = built
    recovery_clips, place = get_up.recovery_clips, facing(get_up.recovery_clips.ease, 0.0)
    walk_faces = heading_angle(recovery_clips.walks[0][:-1, 3:7])
    for off, backwards in ((0.8, True), (2.0, False)):
        start = facing(recovery_clips.ease, walk_faces)
        start[0] = off
        way = plan_recovery(get_up, start, place)
        assert way[-1, :2].norm() < 0.1
        # A motion that turns around to walk there faces the other way in between.
        turns = max(turned_by(q, start) for q in way)
        assert (turns < 1.0) == backwards


@pytest.mark.parametrize("side", [0.0, math.pi])
def test_who_lies_gets_up_whichever_side_is_up(built: Built, side: float) -> None:
    reference, get_up = built
    recovery_clips = get_up.recovery_clips
    table, place = reference.humanoid.table, facing(recovery_clips.ease, 0.0)
    lying = turned(
        recovery_clips.ups[0][:1], 1.0, recovery_clips.ups[0][0, :2], torch.tensor([1.0, 1.0])
    )[0]
    lying[3:7] = rolled(lying[3:7], side)
    way = plan_recovery(get_up, lying, place)
    # Turned over as a whole it floats or is in the floor, onto which the way sets it.
    kept = [k for k in range(len(lying)) if k != 2]
    assert torch.allclose(way[0, kept], lying[kept], atol=1e-6)
    assert way[-1, :2].norm() < 0.1 and way[-1, 2] > 0.9 * recovery_clips.ease[2]
    body = Kinematics(table)(way, torch.zeros(len(way), way.shape[1] - 1, dtype=way.dtype))
    speed = (body.pos[1:] - body.pos[:-1]).norm(dim=-1) * reference.rate_hz
    assert speed.max() < 8.0
    # Turning over on the floor is no flight: before it gets up the root stays low.
    up = int((way[:, 2] > 0.5 * recovery_clips.ease[2]).nonzero()[0])
    assert up > reference.rate_hz * (0.2 if side == 0 else 0.5)
    assert way[:up, 2].max() < float(lying[2]) + LIFT + 0.3


def test_as_many_as_asked_for_of_both_kinds_and_by_seed(built: Built) -> None:
    reference, get_up = built
    recovery_clips = get_up.recovery_clips
    falls = recovery_clips.ups[0][:3]
    how = get_up, falls, 3.0, 6
    first, again, other = (recovery_motions(*how, seed) for seed in (0, 0, 1))
    assert list(first) == ["far-0", "fallen-0", "far-1", "fallen-1", "far-2", "fallen-2"]
    assert all(np.array_equal(first[k], again[k]) for k in first)
    assert any(first[k].shape != other[k].shape or (first[k] != other[k]).any() for k in first)
    assert [q[0, 2] < 0.5 for q in first.values()] == [False, True] * 3
    assert Reference(reference.humanoid, list(first.values()), 30, list(first)).length.min() > 30


def test_turns_about_the_vertical() -> None:
    pose = torch.tensor([1.0, 2.0, 0.9, *yaw_quat(torch.tensor(0.4)), 0.3], dtype=torch.float64)
    assert heading_angle(pose[3:7]) == pytest.approx(0.4)
    east = facing(pose, 0.0)
    assert torch.allclose(east[:3], torch.tensor([0.0, 0.0, 0.9]).double())
    assert heading_angle(east[3:7]) == pytest.approx(0.0) and east[7] == 0.3


def turned_by(a: Tensor, b: Tensor) -> float:
    return float(quat_angle(quat_between(a[3:7], b[3:7])))


def rolled(quat: Tensor, angle: float) -> Tensor:
    """Turned about the body's own long axis."""
    from poise.motion.rotations import quat_mul

    half = 0.5 * angle
    return quat_mul(quat, torch.tensor([math.cos(half), 0.0, 0.0, math.sin(half)], dtype=torch.float64))


def test_who_lies_takes_the_nearest_clip_that_gets_up(built: Built) -> None:
    _, get_up = built
    recovery_clips = get_up.recovery_clips
    # The same clip on the belly, as if it had gotten up from there.
    prone = recovery_clips.ups[0].clone()
    prone[:, 3:7] = torch.stack([rolled(q, math.pi) for q in prone[:, 3:7]])
    both = GetUpPlanner(
        RecoveryClips(recovery_clips.ease, recovery_clips.walks, (*recovery_clips.ups, prone)),
        get_up.table,
        get_up.rate_hz,
    )
    for clip in both.recovery_clips.ups:
        up = both.up(clip[0])
        assert turned_by(up[-1], clip[-1]) < 1e-6
    again = RecoveryClips.of(both.recovery_clips.state())
    assert len(again.ups) == 2 and torch.equal(again.ups[1], prone)
    assert torch.equal(again.walks[0], recovery_clips.walks[0]) and torch.equal(
        again.ease, recovery_clips.ease
    )


def test_a_quick_pace_is_up_and_back_sooner_and_is_kept(built: Built) -> None:
    reference, calm = built
    clips = replace(calm.recovery_clips, pace=QUICK)
    quick = GetUpPlanner(clips, reference.humanoid.table, reference.rate_hz)
    start = facing(clips.ups[0][0], 2.0)
    start[0] = 3.0
    place = facing(clips.ease, 0.5)
    slow, fast = (plan_recovery(g, start, place) for g in (calm, quick))
    assert len(slow) - len(fast) > 0.5 * reference.rate_hz
    assert (fast[-1, :2] - slow[-1, :2]).norm() < 0.1
    # To half a metre away it walks as ever.
    near = facing(clips.ease, 0.5)
    near[0] = 0.5
    steps = [(w[1:, :2] - w[:-1, :2]).norm(dim=-1).max() for g in (calm, quick)
             for w in (plan_recovery(g, near, place),)]  # fmt: skip
    assert steps[1] < 1.2 * steps[0]
    # Of a file of single precision; one from before has none.
    state = {k: v.float() for k, v in clips.state().items()}
    assert RecoveryClips.of(state).pace == QUICK
    del state["pace"]
    assert RecoveryClips.of(state).pace == CALM


def test_settings_refuse_what_makes_no_sense() -> None:

    with refused("out-of-range", says="demonstration_share"):
        replace(Perpetual().recovering, demonstration_share=1.0)
