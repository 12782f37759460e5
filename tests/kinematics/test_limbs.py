"""Two bones: laws of triangles, reach, stable bend planes, and clips that keep what is not asked for."""

from __future__ import annotations

import math

import numpy as np
import pytest

import toy_human
from poise.formats import read_clip
from poise.kinematics import limb_of, match_positions
from poise.kinematics.limbs import soft_reach
from poise.motion.rotations import (
    forward_kinematics,
    frame_quat,
    normalize,
    quat_angle,
    quat_conj,
    quat_mul,
    quat_rotate,
    shortest_arc,
)
from poise.motion.vectors import norm
from refusals import refused


def rand(*shape: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=shape)


def vec(*xyz: float) -> np.ndarray:
    return np.asarray(xyz, dtype=float)


def joints(clip, rot):
    skeleton = clip.skeleton
    return forward_kinematics(skeleton.parents, skeleton.offsets, clip.root_pos, rot)


def test_out_of_reach_is_approached_softly_and_never_crossed():
    bone = np.asarray(0.5, dtype=float)
    d = np.linspace(0.0, 3.0, 3001)
    got = soft_reach(d, bone, bone, 0.05)
    assert float(got.max()) <= 1.0
    assert bool((got[1:] >= got[:-1] - 1e-15).all())
    # Slope 1 where it begins, so no corner: the knee's speed does not jump.
    slope = (got[1:] - got[:-1]) / (d[1:] - d[:-1])
    assert float(np.abs(slope[1:] - slope[:-1]).max()) < 0.03
    np.testing.assert_allclose(got[:950], d[:950], atol=1e-7)
    assert float(soft_reach(9.0, bone, bone, 0.0)) == pytest.approx(1.0)


def test_the_shortest_arc():
    a, b = rand(50, 3, seed=7), rand(50, 3, seed=8)
    q = shortest_arc(a, b)
    np.testing.assert_allclose(normalize(quat_rotate(q, a)), normalize(b), atol=1e-7)
    between = np.arccos(np.clip((normalize(a) * normalize(b)).sum(-1), -1, 1))
    np.testing.assert_allclose(quat_angle(q), between, atol=1e-7)
    half = shortest_arc(vec(0.2, 0, 0), vec(-1, 0, 0))
    assert float(quat_angle(half)) == pytest.approx(math.pi)
    np.testing.assert_allclose(shortest_arc(vec(0, 0, 0), vec(1, 0, 0)), vec(1, 0, 0, 0), atol=1e-7)


def test_two_frames_of_a_bone_give_its_rotation():
    q = normalize(rand(20, 4, seed=9))
    axis, normal = np.broadcast_to(vec(1, 2, 3), (20, 3)), np.broadcast_to(vec(0, 1, 0), (20, 3))
    now = frame_quat(quat_rotate(q, axis), quat_rotate(q, normal))
    got = quat_mul(now, quat_conj(frame_quat(axis, normal)))
    assert float(quat_angle(quat_mul(got, quat_conj(q))).max()) < 1e-7


def test_the_limbs_of_a_human():
    skeleton = toy_human.human()
    names = [skeleton.names[j] for j in limb_of(skeleton, "LeftFoot")]
    assert names == ["LeftUpLeg", "LeftLeg", "LeftFoot"]
    assert skeleton.names[limb_of(skeleton, "RightToe").root] == "RightLeg"
    with refused("limb-too-short"):
        limb_of(skeleton, "Spine")


def test_targets_that_are_already_met_change_nothing():
    clip = toy_human.swing()
    rot = clip.rot.copy()
    pos, _ = joints(clip, rot)
    skeleton = clip.skeleton
    targets = {n: pos[:, skeleton.index(n)] for n in ("LeftFoot", "RightFoot", "LeftHand", "RightHand")}
    got = match_positions(skeleton, rot, clip.root_pos, targets)
    assert float(quat_angle(quat_mul(quat_conj(got), rot)).max()) < 1e-5


def test_feet_and_hands_meet_their_targets_and_the_rest_is_kept():
    clip = toy_human.swing(bend=1.0, speed=1.0)
    skeleton, rot = clip.skeleton, clip.rot
    pos, quat = joints(clip, rot)
    foot, hand = skeleton.index("LeftFoot"), skeleton.index("RightHand")
    goals = {"LeftFoot": pos[:, foot] + vec(0.05, 0.04, 0.1), hand: pos[:, hand] + vec(0.1, 0.0, 0.12)}
    got = match_positions(skeleton, rot, clip.root_pos, goals)
    pos2, quat2 = joints(clip, got)
    np.testing.assert_allclose(pos2[:, foot], goals["LeftFoot"], atol=1e-9, rtol=0)
    np.testing.assert_allclose(pos2[:, hand], goals[hand], atol=1e-9, rtol=0)
    moved = {skeleton.index(n) for n in ("LeftUpLeg", "LeftLeg", "LeftFoot")}
    moved |= {skeleton.index(n) for n in ("RightArm", "RightForeArm", "RightHand")}
    still = [j for j in range(len(skeleton)) if j not in moved]
    np.testing.assert_allclose(got[:, still], rot[:, still], atol=1e-7)
    for j in (foot, hand, skeleton.index("LeftToe")):
        assert float(quat_angle(quat_mul(quat_conj(quat2[:, j]), quat[:, j])).max()) < 1e-6
    steps = quat_angle(quat_mul(quat_conj(got[:-1]), got[1:]))
    assert float(steps.max()) < 0.3


def test_free_frames_stay():
    clip = toy_human.swing()
    skeleton, rot, root = clip.skeleton, clip.rot, clip.root_pos
    foot = skeleton.index("LeftFoot")
    pos, _ = joints(clip, rot)
    goal = pos[:, foot] + vec(0.0, 0.0, 0.1)
    free = goal.copy()
    free[:10] = float("nan")
    a, _ = joints(clip, match_positions(skeleton, rot, root, {foot: free}))
    np.testing.assert_allclose(a[:10, foot], pos[:10, foot], atol=1e-7)
    np.testing.assert_allclose(a[10:, foot], goal[10:], atol=1e-7)


def test_a_straight_knee_bends_to_its_usual_side():
    # A leg that is stiff in its middle frames must bend forward there as it does elsewhere.
    clip = toy_human.swing(seconds=2.0)
    skeleton, rot = clip.skeleton, clip.rot.copy()
    knee, foot = skeleton.index("LeftLeg"), skeleton.index("LeftFoot")
    angle = 0.6 * np.abs(np.cos(np.linspace(0, math.pi, clip.frames)))
    rot[:, knee] = toy_human.turn("Y", angle)
    pos, _ = joints(clip, rot)
    lifted = {"LeftFoot": pos[:, foot] + vec(0.0, 0.0, 0.08)}
    got = match_positions(skeleton, rot, clip.root_pos, lifted)
    pos2, _ = joints(clip, got)
    np.testing.assert_allclose(pos2[:, foot], lifted["LeftFoot"], atol=1e-9, rtol=0)
    assert bool((got[:, knee, 2] > 0.1).all())
    assert float(quat_angle(quat_mul(quat_conj(got[:-1]), got[1:])).max()) < 0.2


@pytest.mark.parametrize("file", ["lafan1_bvh/walk4_subject1.bvh", "cmu_bvh/acrnn_salsa/01.bvh"])
def test_real_clips_move_by_what_is_asked_without_jumps(data_dir, file):
    clip = read_clip(data_dir / file)
    clip = clip.replaced(root_pos=clip.root_pos[:1500], rot=clip.rot[:1500])
    skeleton, rot, root = clip.skeleton, clip.rot, clip.root_pos
    pos, _ = joints(clip, rot)
    ends = [j for j, n in enumerate(skeleton.names) if n.lower().endswith(("foot", "hand"))]
    assert len(ends) == 4
    goals = {j: pos[:, j] + vec(0.0, 0.0, 0.05) for j in ends}
    got = match_positions(skeleton, rot, root, goals)
    pos2, _ = joints(clip, got)
    off = np.concatenate([norm(pos2[:, j] - goals[j]) for j in ends])
    # Some arms hang straight and cannot follow; they fall short by less than what was asked.
    assert np.median(off) < 1e-9 and off.max() < 0.05 + 1e-9
    before = quat_angle(quat_mul(quat_conj(rot[:-1]), rot[1:])).max(0)
    after = quat_angle(quat_mul(quat_conj(got[:-1]), got[1:])).max(0)
    assert float((after - before).max()) < 0.35
    same = match_positions(skeleton, rot, root, {j: pos[:, j] for j in ends})
    assert float(quat_angle(quat_mul(quat_conj(same), rot)).max()) < 1e-4


def test_a_knee_beyond_straight_bends_to_its_usual_side_without_a_jump() -> None:
    """A knee that is stretched 0 to 12 degrees beyond straight, asked to shorten by 2 cm."""
    skeleton = toy_human.human()
    clip = toy_human.swing(1.0)
    knee, hip, foot = (skeleton.index(f"Left{n}") for n in ("Leg", "UpLeg", "Foot"))
    root, rot = clip.arrays()
    count = len(rot)
    rot = np.zeros_like(rot)
    rot[..., 0] = 1.0
    # Most of the clip bends it the usual way; then it is stretched further and further.
    angle = np.full((count,), 0.8)
    angle[-14:] = np.linspace(0.0, -0.21, 14)
    rot[:, knee] = toy_human.turn("y", angle)
    root = root * 0.0
    offsets = skeleton.offsets
    pos = forward_kinematics(skeleton.parents, offsets, root, rot)[0]
    goal = pos[:, foot] + 0.02 * (pos[:, hip] - pos[:, foot]) / 0.8
    out = match_positions(skeleton, rot, root, {foot: goal})
    there = forward_kinematics(skeleton.parents, offsets, root, out)[0]
    step = norm(np.diff(there[-13:, knee], axis=0))
    assert float(step.max()) < 0.03
    np.testing.assert_allclose(there[-14:, foot], goal[-14:], atol=2e-3, rtol=0)
