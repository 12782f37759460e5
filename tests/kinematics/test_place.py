"""A clip comes onto a body as its steps one by one would bring it there."""

from __future__ import annotations

import numpy as np
import pytest

from poise.body import generate_table, make_humanoid
from poise.kinematics import (
    clean_clip,
    clip_to_qpos,
    fit_ground,
    fit_humanoid,
    level_feet,
    place_on_body,
    retarget,
)
from poise.kinematics.coords import within_turns
from poise.motion import Clip, resample
from poise.motion.rotations import quat_mul, rotvec_to_quat
from poise.motion.smoothing import white_mm
from toy_human import human, swing


def walk() -> Clip:
    return swing(2.0, 60.0)


def test_a_clip_on_the_bodys_skeleton_takes_every_step_once():
    clip = walk()
    table = generate_table(clip.skeleton, None, [clip])
    humanoid = make_humanoid(clip.skeleton, table)
    on = place_on_body(clip, table, clip.skeleton, 30.0, near=humanoid)
    mended, found = clean_clip(clip)
    made = level_feet(mended, table).onto(mended)
    q = within_turns(clip_to_qpos(resample(made, 30.0), table), humanoid)
    q, ground = fit_ground(q, table, 30.0)
    np.testing.assert_array_equal(on.qpos, q)
    assert on.retargeting is None and on.moved is clip and on.cleaned == found
    assert on.ground.lift_m == ground.lift_m and on.cycle is None and on.joint_error_mm < 30


def test_a_hinge_stays_where_its_range_has_room_for_turns():
    clip = walk()
    humanoid = make_humanoid(clip.skeleton, generate_table(clip.skeleton, None, [clip]))
    q = clip_to_qpos(clip, humanoid.table)
    low, high = humanoid.model.jnt_range[1:].T
    turned = q.copy()
    turned[:, 7:] += 2 * np.pi
    # Outside its range it comes back, by whole turns.
    shifted = within_turns(turned, humanoid)[:, 7:]
    narrow = high - low < 2 * np.pi
    np.testing.assert_allclose(shifted[:, narrow], q[:, 7:][:, narrow], atol=1e-12)
    # A range from -1 to 2 turns has its middle half a turn off.
    humanoid.model.jnt_range[1:] = (-2 * np.pi, 6 * np.pi)
    np.testing.assert_array_equal(within_turns(q, humanoid), q)


def test_another_skeleton_is_retargeted_and_steps_can_be_left_out():
    clip, large = walk(), human(1.3)
    table = generate_table(large, None, [])
    on = place_on_body(clip, table, large, clean=False, level=False)
    moved, report = retarget(clip, large)
    assert on.retargeting is not None and on.retargeting.scale == pytest.approx(report.scale)
    np.testing.assert_array_equal(on.clip.rot, moved.rot)
    assert len(on.qpos) == clip.frames and not on.level.turns and not on.cleaned
    # A floor that is known to be at z = 0 is not looked for.
    assert place_on_body(clip, table, large, known=True).ground.lift_m == 0.0


def test_a_cycle_is_joined_where_that_is_asked_for():
    clip = walk().replaced(cyclic=True)
    humanoid, motions, report = fit_humanoid(clip)
    assert report.clips[0].cycle is not None
    on = place_on_body(clip, humanoid.table, clean=False, level=False, join=True)
    assert on.cycle is not None and on.cycle.closed == report.cyclic[0]
    once = place_on_body(clip, humanoid.table, clean=False, level=False)
    assert once.cycle is None
    ends = [float(np.abs(np.array(q[-1, 7:] - q[0, 7:])).max()) for q in (on.qpos, once.qpos)]
    assert ends[0] <= ends[1] + 1e-12
    assert len(motions[0]) < clip.frames


def test_joints_without_a_body_lose_the_noise_of_the_file_too():
    clip = walk()
    table = generate_table(clip.skeleton, None, [clip])
    rng = np.random.default_rng(0)
    turn = 0.06 * rng.standard_normal((clip.frames, len(clip.skeleton), 3))
    noisy = clip.replaced(rot=quat_mul(clip.rot, rotvec_to_quat(turn)))
    on = place_on_body(noisy, table)
    assert white_mm(noisy.positions(), clip.fps) > 10.0
    # All joints of what is carried along are calm, and the noise is told once.
    assert white_mm(on.moved.positions(), clip.fps) < 3.0
    assert [f.kind for f in on.cleaned.noise if f.kind == "tremble"] == ["tremble"]
    kept = place_on_body(noisy.replaced(skeleton=noisy.skeleton.with_source(raw=True)), table)
    np.testing.assert_array_equal(kept.moved.rot, noisy.rot)
    assert not kept.cleaned.noise
