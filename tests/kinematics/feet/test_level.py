"""Feet that stand on their edge are turned flat, and back again."""

from __future__ import annotations

import numpy as np
import pytest

from poise.body import generate_table
from poise.kinematics.feet import level_feet
from poise.motion import Clip
from poise.motion.rotations import axis_angle_to_quat, quat_mul, quat_rotate
from toy_human import swing


def rolled(clip: Clip, joint: int, degrees: float) -> Clip:
    axis = np.array([0.0, 1.0, 0.0], dtype=float)
    turn = axis_angle_to_quat(axis, np.radians(degrees))
    rot = clip.rot.copy()
    rot[:, joint] = quat_mul(rot[:, joint], np.broadcast_to(turn, (len(rot), 4)))
    return clip.replaced(rot=rot)


def tilt(clip: Clip, table, joint: int) -> float:
    """Mean angle between the sole's normal and the vertical, degrees."""
    row = next(r for r in table.rows if r.joint == joint)
    box = next(g for g in row.geoms if g.kind == "box")
    up = quat_rotate(np.array(box.quat), np.array([0.0, 0.0, 1.0]))
    normal = quat_rotate(clip.world()[1][:, joint], np.broadcast_to(up, (clip.frames, 3)))
    return float(np.rad2deg(np.arccos(np.clip(normal[:, 2], -1, 1))).mean())


def test_a_foot_on_its_edge_comes_to_stand_flat_and_goes_back():
    clip = swing(seconds=2.0)
    table = generate_table(clip.skeleton, None, [clip])
    feet = [r.joint for r in table.rows if r.kind == "foot"]
    edge = rolled(clip, feet[0], 15.0)
    before = tilt(clip, table, feet[0])
    assert tilt(edge, table, feet[0]) > before + 10.0
    level = level_feet(edge, table)
    assert feet[0] in level.turns
    flat = level.onto(edge)
    assert tilt(flat, table, feet[0]) == pytest.approx(before, abs=2.0)
    # What hangs on the foot stays as it is, in place and attitude but for the foot's own joint.
    for child in clip.skeleton.children(feet[0]):
        turn = np.abs((flat.world()[1][:, child] * edge.world()[1][:, child]).sum(-1))
        assert turn == pytest.approx(1.0, abs=1e-9)
    np.testing.assert_allclose(np.abs((level.off(flat).rot * edge.rot).sum(-1)), 1.0, atol=1e-9)


def test_flat_feet_and_feet_that_never_stand_stay():
    clip = swing(seconds=2.0)
    clip = clip.replaced(
        rot=np.repeat(clip.rot[:1], clip.frames, 0), root_pos=clip.root_pos[[0] * clip.frames]
    )
    table = generate_table(clip.skeleton, None, [clip])
    assert not level_feet(clip, table).turns
    assert level_feet(clip, table).onto(clip) is clip
    feet = [r.joint for r in table.rows if r.kind == "foot"]
    # Pointed like a dancer's: that is no error of the capture.
    assert feet[0] not in level_feet(rolled(clip, feet[0], 60.0), table).turns
    fast = clip.replaced(root_pos=clip.root_pos + np.arange(clip.frames)[:, None] * 0.1)
    assert not level_feet(rolled(fast, feet[0], 15.0), table).turns
