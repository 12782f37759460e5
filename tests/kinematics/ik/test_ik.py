"""Joint positions of a posed humanoid give back a pose with the same positions, without jumps."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from paper_humanoid import body_points, count_jumps, paper_humanoid

import poise
import toy_human
from poise.body import generate_table, make_humanoid
from poise.formats import read_clip
from poise.kinematics import (
    IkBody,
    IkConfig,
    Kinematics,
    analytic_ik,
    clip_ik,
    clip_to_qpos,
    ik_body,
    qpos_to_clip,
)
from poise.motion import Skeleton
from poise.motion.rotations import normalize, quat_angle, quat_conj, quat_mul, quat_to_matrix
from refusals import refused

FILES = (
    "lafan1_bvh/walk4_subject1.bvh",
    "other/bandai_bvh/dataset-1_kick_normal_001.bvh",
    "deepmimic_txt/humanoid3d_backflip.txt",
    "cmu_amc/01/01_01.amc",
    "cmu_bvh/acrnn_salsa/01.bvh",
)


def toy() -> IkBody:
    skeleton = toy_human.human()
    return ik_body(generate_table(skeleton), skeleton)


def t_pose(one_hinge: bool = False) -> IkBody:
    skeleton = toy_human.human()
    made, table = paper_humanoid(generate_table(skeleton), skeleton, one_hinge)
    return ik_body(table, made)


def pose(body: IkBody, q: np.ndarray) -> np.ndarray:
    """World positions `(T, P, 3)` of a body's points."""
    state = Kinematics(body.table)(q)
    return body_points(body, state.pos, quat_to_matrix(state.quat))


def random_motion(body: IkBody, frames: int, seed: int, size: float = 0.6) -> np.ndarray:
    """Smooth random coordinates with hinges that swing by up to `size` rad."""
    rng = np.random.default_rng(seed)
    n = sum(len(r.order) for r in body.table.rows)
    t = np.linspace(0, 1, frames)[:, None]
    q = np.zeros((frames, 7 + n))
    q[:, :3] = rng.normal(size=3) + t * rng.normal(size=3)
    turn = rng.normal(size=4) + t * rng.normal(size=4)
    q[:, 3:7] = normalize(turn)
    q[:, 7:] = size * np.sin(rng.uniform(0, 6, n) + rng.uniform(1, 5, n) * t)
    return q


def distance_mm(body: IkBody, q: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    return np.linalg.norm(pose(body, q) - wanted, axis=-1) * 1000


@pytest.mark.parametrize("body", [toy(), t_pose()], ids=["hanging", "T-pose"])
@pytest.mark.parametrize("seed", range(5))
def test_positions_of_any_pose_come_back(body, seed):
    q = random_motion(body, 60, seed)
    wanted = pose(body, q)
    found = analytic_ik(wanted, body)
    assert distance_mm(body, found, wanted).max() < 1e-6
    apart = quat_angle(quat_mul(quat_conj(q[:, 3:7]), found[:, 3:7]))
    assert float(apart.max()) < 1e-6


@pytest.mark.parametrize("seed", range(3))
def test_knees_and_elbows_of_one_hinge_come_back(seed):
    body = t_pose(one_hinge=True)
    q = random_motion(body, 60, seed)
    at = 7
    for row in body.table.rows:
        if len(row.order) == 1:
            # Bent by at least 20 degrees to the side that the joint allows.
            sign = np.sign(sum(row.ranges[0]))
            q[:, at] = sign * (0.8 + 0.4 * np.sin(np.arange(60) / 9))
        at += len(row.order)
    wanted = pose(body, q)
    found = analytic_ik(wanted, body)
    # Frames around one count a ten-thousandth of it or less in its bend plane.
    assert distance_mm(body, found, wanted).max() < 0.02
    assert count_jumps(found[:, 7:], 0.5).sum() == 0
    at = 7
    for row in body.table.rows:
        if len(row.order) == 1:
            np.testing.assert_allclose(found[:, at], q[:, at], atol=1e-4)
        at += len(row.order)


def test_elbows_bend_to_minus_z_on_the_left_and_plus_z_on_the_right():
    # The paper's T-pose with both forearms bent by 45.8 degrees (Eqs. 10 and 13).
    body = t_pose(one_hinge=True)
    q = np.zeros((3, 7 + sum(len(r.order) for r in body.table.rows)))
    q[:, 3] = 1.0
    names = [n for r in body.table.rows for n in r.hinge_names()]
    left, right = names.index("LeftForeArm_z"), names.index("RightForeArm_z")
    q[:, 7 + left], q[:, 7 + right] = -0.8, 0.8
    points = pose(body, q)
    for side in "lr":
        # Both hands come down, so the arms are mirror images.
        wrist, elbow = body.roles[f"{side}w"], body.roles[f"{side}e"]
        assert (points[:, wrist, 2] < points[:, elbow, 2] - 0.1).all()
    found = analytic_ik(points, body)
    np.testing.assert_allclose(found[:, 7:], q[:, 7:], atol=1e-9)


def test_a_pirouette_counts_up_in_the_root_and_leaves_hinges_alone():
    clip = toy_human.swing(seconds=4.0, bend=6 * math.pi)
    body = toy()
    q = clip_ik(clip, body)
    still = clip_ik(toy_human.swing(seconds=4.0), body)
    np.testing.assert_allclose(q[:, 7:], still[:, 7:], atol=1e-9)
    assert (np.sum(q[1:, 3:7] * q[:-1, 3:7], -1) > 0).all()


def test_arms_that_circle_overhead_do_not_jump():
    # A straight arm that swings full circles passes every lock and has no bend plane at all.
    body = toy()
    clip = toy_human.swing(seconds=4.0)
    rot = clip.rot.copy()
    t = np.linspace(0, 4 * math.pi, clip.frames)
    for side in ("Left", "Right"):
        rot[:, clip.skeleton.index(f"{side}Arm")] = toy_human.turn("Y", -t)
        rot[:, clip.skeleton.index(f"{side}ForeArm")] = toy_human.turn("Y", 0.0 * t)
    clip = clip.replaced(rot=rot)
    q = clip_ik(clip, body)
    assert (
        distance_mm(body, q, clip.positions()[:, [clip.skeleton.index(n) for n in body.points]]).max()
        < 1e-6
    )
    assert count_jumps(q[:, 7:]).sum() == 0


def test_collars_that_hang_on_the_neck_do_not_let_the_chest_spin():
    # Neck and collars in one place show no turn about the line to them; the shoulders do.
    clip = read_clip(Path(poise.__file__).parent / "data/walk.bvh")
    body = ik_body(generate_table(clip.skeleton), clip.skeleton)
    apart = body.rest_pos[body.roles["lcl"]] - body.rest_pos[body.roles["rcl"]]
    assert np.linalg.norm(apart) < 0.01
    made = qpos_to_clip(clip_ik(clip, body), body.table, clip.skeleton, clip.fps)
    turned = quat_angle(quat_mul(quat_conj(made.rot[:-1]), made.rot[1:])) * clip.fps
    assert turned[:, clip.skeleton.index(body.points[body.chest])].max() < 5.0
    assert turned.max() < 20.0


def test_rotations_decide_what_positions_do_not_show():
    clip = toy_human.swing(seconds=2.0)
    rot = clip.rot.copy()
    twist = 0.5 * np.sin(np.linspace(0, 6, clip.frames))
    fore = clip.skeleton.index("LeftForeArm")
    rot[:, fore] = quat_mul(rot[:, fore], toy_human.turn("Z", twist))
    clip = clip.replaced(rot=rot)
    body = toy()
    pos, quat = clip.world()
    names = [n for r in body.table.rows for n in r.hinge_names()]
    z = 7 + names.index("LeftForeArm_z")
    without = analytic_ik(pos, body, names=clip.skeleton.names)
    given = analytic_ik(pos, body, names=clip.skeleton.names, rotations=quat)
    source = clip_to_qpos(clip, body.table)
    np.testing.assert_allclose(given, source, atol=1e-7)
    assert np.ptp(given[:, z]) > 0.5
    assert np.abs(without[:, 7:] - source[:, 7:]).max() > 0.3


def test_bones_of_another_length_are_followed_in_direction():
    small, large = toy(), toy_human.swing(seconds=1.0, scale=1.3)
    q = clip_ik(large, small)
    wanted = large.positions()[:, [large.skeleton.index(n) for n in small.points]]
    got = pose(small, q)
    for arm in small.arms:
        for a, b in ((arm.upper, arm.lower), (arm.lower, arm.end)):
            u, v = wanted[:, b] - wanted[:, a], got[:, b] - got[:, a]
            cos = (u * v).sum(-1) / np.linalg.norm(u, axis=-1) / np.linalg.norm(v, axis=-1)
            assert cos.min() > 1 - 1e-9


def test_degenerate_bones_stay_finite():
    body = toy()
    wanted = pose(body, random_motion(body, 20, 3))
    wanted[4:9, body.roles["le"]] = wanted[4:9, body.roles["ls"]]
    wanted[10, body.roles["lf"]] = wanted[10, body.roles["lan"]]
    wanted[15] = wanted[15, :1]
    q = analytic_ik(wanted, body)
    assert np.isfinite(q).all()
    np.testing.assert_allclose(np.linalg.norm(q[:, 3:7], axis=-1), 1.0)


def test_a_body_without_a_spine():
    full = toy_human.human()
    kept = [j for j, n in enumerate(full.names) if n not in ("Spine", "Chest")]
    rest = full.rest_positions()
    parents = [full.parents[j] if full.parents[j] in kept else 0 for j in kept]
    offsets = [rest[j] - rest[p] if j else rest[0] for j, p in zip(kept, parents, strict=True)]
    skeleton = Skeleton(
        tuple(full.names[j] for j in kept),
        tuple(kept.index(p) if j else -1 for j, p in zip(kept, parents, strict=True)),
        np.array(offsets),
    )
    body = ik_body(generate_table(skeleton), skeleton)
    assert body.spine == () and body.chest == 0
    wanted = pose(body, random_motion(body, 20, 6))
    for config in (IkConfig(), IkConfig(faithful="paper")):
        assert np.isfinite(analytic_ik(wanted, body, config)).all()
    assert distance_mm(body, analytic_ik(wanted, body), wanted).max() < 1e-6


def test_one_frame_and_missing_toes():
    body = toy()
    q = random_motion(body, 1, 4)
    wanted = pose(body, q)
    rows = len(body.table.rows)
    found = analytic_ik(wanted[:, :rows], body)
    assert distance_mm(body, found, wanted)[:, :rows].max() < 1e-6


def test_mistakes_are_told_in_a_sentence():
    body = toy()
    wanted = pose(body, random_motion(body, 5, 5))
    names = list(body.points)
    with refused("wrong-shape"):
        analytic_ik(wanted[0], body)
    with refused("joint-missing", says="LeftHand"):
        analytic_ik(wanted, body, names=["Wrist" if n == "LeftHand" else n for n in names])
    with refused("count-differs"):
        analytic_ik(wanted, body, names=names[:-1])
    wanted[3, 2, 1] = np.nan
    with refused("not-finite", says="frame 3"):
        analytic_ik(wanted, body)


@pytest.mark.parametrize("file", FILES)
def test_real_clips_on_their_own_humanoid(data_dir, file):
    clip = read_clip(data_dir / file)
    clip = clip.replaced(root_pos=clip.root_pos[:600], rot=clip.rot[:600])
    table = generate_table(clip.skeleton, None, [clip])
    body = IkBody.of(make_humanoid(clip.skeleton, table))
    q = clip_ik(clip, body)
    wanted = clip.positions()[:, [clip.skeleton.index(n) for n in body.points]]
    error = distance_mm(body, q, wanted)[:, : len(table.rows)]
    three = all(len(r.order) in (0, 3) for r in table.rows)
    # Hinges that are missing cost a little where the clip uses them (DeepMimic, CMU).
    assert error.mean() < (1e-6 if three else 0.2)
    source = clip_to_qpos(clip, table)
    assert count_jumps(q[:, 7:]).sum() <= count_jumps(source[:, 7:]).sum()
