"""No channel of any rig is lost on the way through the humanoid's coordinates and back."""

from __future__ import annotations

import numpy as np
import pytest

from poise.body import BodyTable, find_anatomy, generate_table
from poise.kinematics import clip_to_qpos, qpos_to_clip
from poise.kinematics.forward import Kinematics
from poise.motion import Clip
from poise.motion.rotations import quat_angle, quat_conj, quat_mul
from rigs import Rig, rig

VARIANTS = [
    ("mixamo", "I", "none", False, False),
    ("unreal", "A", "side", True, True),
    ("vrm", "T", "chain", True, False),
    ("daz", "folded", "chain", True, True),
    ("numbers", "folded", "side", True, False),
]


def apart(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angles (rad) between rotations `(..., 4)`."""
    return quat_angle(quat_mul(quat_conj(a), b))


def made(variant: tuple) -> tuple[Rig, Clip, BodyTable]:
    style, pose, twist, fingers, helpers = variant
    one = rig(style, pose, twist, fingers, helpers)
    clip = one.clip(seed=3)
    return one, clip, generate_table(one.skeleton, None, [clip])


@pytest.mark.parametrize("variant", VARIANTS)
def test_there_and_back_is_the_same_motion_in_every_channel(variant):
    one, clip, table = made(variant)
    qpos = clip_to_qpos(clip, table)
    back = qpos_to_clip(qpos, table, one.skeleton, clip.fps, template=clip)
    assert apart(back.rot, clip.rot).max() < 1e-6
    np.testing.assert_allclose(back.root_pos, clip.root_pos, atol=1e-9)


@pytest.mark.parametrize("variant", VARIANTS)
def test_what_the_body_does_differently_moves_its_joints_alone(variant):
    one, clip, table = made(variant)
    qpos = clip_to_qpos(clip, table)
    rng = np.random.default_rng(0)
    qpos[:, 7:] += 0.2 * rng.normal(size=qpos.shape[1] - 7)
    back = qpos_to_clip(qpos, table, one.skeleton, clip.fps, template=clip)
    riders = list(find_anatomy(one.skeleton, [clip]).riders(one.skeleton))
    # Fingers, toes, twist bones and helpers keep their own channels, to the bit.
    rigid = [r.joint for r in table.rows if not r.order and r.parent >= 0]
    np.testing.assert_allclose(back.rot[:, riders + rigid], clip.rot[:, riders + rigid], atol=1e-12)
    # Every joint with a body turns in the world as the body does.
    quat = Kinematics(table)(qpos).quat
    world = back.world()[1]
    for i, row in enumerate(table.rows):
        if row.order:
            assert apart(world[:, row.joint], quat[:, i]).max() < 1e-6
            assert apart(back.rot[:, row.joint], clip.rot[:, row.joint]).max() > 0.01


def test_a_twist_in_the_chain_leaves_the_elbow_in_place_and_the_forearm_turned():
    # A twist about the arm moves no joint; the forearm's hinges take it up and the twist bone keeps it.
    one = rig("vrm", "I", "chain")
    still = one.clip(size=0.0)
    table = generate_table(one.skeleton, None, [still])
    rot = np.array(still.rot)
    twist, elbow = one.roles["upper_arm twist left"], one.roles["forearm left"]
    angle = 0.5 * np.sin(np.linspace(0, 6, still.frames))
    rot[:, twist] = np.stack((np.cos(angle / 2), 0 * angle, 0 * angle, np.sin(angle / 2)), -1)
    rot[:, elbow] = [np.cos(0.4), 0.0, -np.sin(0.4), 0.0]
    clip = still.replaced(rot=rot)
    qpos = clip_to_qpos(clip, table)
    here = Kinematics(table)(qpos)
    joints = [r.joint for r in table.rows]
    np.testing.assert_allclose(here.pos, clip.positions()[:, joints], atol=1e-9)
    row = [r.name for r in table.rows].index("J_Bip_L_LowerArm")
    assert apart(here.quat[:, row], clip.world()[1][:, elbow]).max() < 1e-6
    # The upper arm does not turn: its own channels rest.
    arm = [r.name for r in table.rows].index("J_Bip_L_UpperArm")
    assert np.ptp(here.quat[:, arm], axis=0).max() < 1e-9
    back = qpos_to_clip(qpos, table, one.skeleton, clip.fps, template=clip)
    assert apart(back.rot[:, twist], rot[:, twist]).max() < 1e-9


def test_without_a_template_riders_stay_at_rest():
    one, clip, table = made(VARIANTS[1])
    back = qpos_to_clip(clip_to_qpos(clip, table), table, one.skeleton, clip.fps)
    riders = list(find_anatomy(one.skeleton).riders(one.skeleton))
    np.testing.assert_array_equal(back.rot[:, riders, 0], 1.0)
