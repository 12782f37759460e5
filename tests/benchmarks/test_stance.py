"""The relaxed stance: level soles, balance, symmetry; and bodies of any rig, pose and size hold it."""

from __future__ import annotations

import math
from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch

from benchmarks.common.stance import (
    Stance,
    polygon_margin,
    relaxed_stance,
    sole_corners,
    support_polygon,
)
from benchmarks.suites.retarget_repair import measure, scaled, stand
from poise.body import Humanoid, generate_table, make_humanoid
from poise.formats import read_clip
from poise.kinematics import Kinematics, fit_humanoid, lowest_height
from poise.motion import Clip, trim
from refusals import refused
from rigs import rig
from toy_human import human, swing

SQUARE = np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 2.0], [0.0, 2.0]])


def toy() -> Humanoid:
    return make_humanoid(human(), generate_table(human()))


def body_of(clip: Clip) -> Humanoid:
    return fit_humanoid(clip)[0]


def test_a_margin_is_the_distance_from_the_nearest_edge():
    assert polygon_margin(np.array([0.5, 1.2]), SQUARE) == pytest.approx(0.5)
    assert polygon_margin(np.array([1.0, 1.0]), SQUARE) == pytest.approx(1.0)
    assert polygon_margin(np.array([2.3, 1.0]), SQUARE) == pytest.approx(-0.3)


def test_a_support_polygon_is_the_hull_counter_clockwise():
    points = np.concatenate((SQUARE[[2, 0, 3, 1]], [[1.0, 1.0], [0.3, 1.9]]))
    hull = support_polygon(points)
    assert {tuple(p) for p in hull} == {tuple(p) for p in SQUARE}
    turned = np.roll(hull, -1, 0)
    area = 0.5 * (hull[:, 0] * turned[:, 1] - hull[:, 1] * turned[:, 0]).sum()
    assert area == pytest.approx(4.0)
    with refused("no-stance"):
        support_polygon(np.array([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]]))


def test_the_toys_stance_is_what_it_says():
    humanoid = toy()
    stance = relaxed_stance(humanoid)
    state = Kinematics(humanoid.table)(torch.tensor(stance.qpos))
    pos = dict(zip(humanoid.bodies, state.pos.numpy(), strict=True))
    assert float(lowest_height(humanoid.table, state.pos, state.quat).min()) == pytest.approx(
        0.0, abs=1e-9
    )
    assert stance.tilt_deg < 0.5 and stance.margin_m > 0.05
    # It faces +x with its left on +y, and is a mirror image of itself.
    for name in ("UpLeg", "Leg", "Foot", "Arm", "ForeArm", "Hand"):
        left, right = pos[f"Left{name}"], pos[f"Right{name}"]
        np.testing.assert_allclose(left * [1, -1, 1], right, atol=2e-3)
        assert left[1] > 0.05
    assert pos["LeftHand"][2] < pos["LeftForeArm"][2] < pos["LeftArm"][2]
    # Knees ahead of the line from hip to ankle by 4 degrees' worth.
    assert 0.005 < pos["LeftLeg"][0] - (pos["LeftUpLeg"][0] + pos["LeftFoot"][0]) / 2 < 0.03
    low = [a for row in humanoid.table.rows for a, _ in row.ranges]
    high = [b for row in humanoid.table.rows for _, b in row.ranges]
    assert (stance.qpos[7:] >= np.array(low) - 1e-6).all()
    assert (stance.qpos[7:] <= np.array(high) + 1e-6).all()


def test_the_stance_knows_its_own_balance():
    humanoid = toy()
    stance = relaxed_stance(humanoid)
    data = mujoco.MjData(humanoid.model)
    data.qpos[:] = stance.qpos
    mujoco.mj_forward(humanoid.model, data)
    np.testing.assert_allclose(data.subtree_com[1, :2], stance.com, atol=1e-9)
    assert stance.margin_m == pytest.approx(polygon_margin(stance.com, stance.support))
    ankle = data.xpos[humanoid.feet[0] + 1]
    sole = sole_corners(humanoid.table.rows[humanoid.feet[0]])
    # Two fifths of the way from the ankles to the soles' middle.
    middle = (sole[:, 0].min() + sole[:, 0].max()) / 2
    assert stance.com[0] - ankle[0] == pytest.approx(0.4 * middle, abs=0.004)


def test_a_body_without_soles_or_reach_is_told():
    table = generate_table(human())
    rows = tuple(replace(r, geoms=table.rows[1].geoms) if r.kind == "foot" else r for r in table.rows)
    with refused("no-stance", says="LeftFoot"):
        relaxed_stance(make_humanoid(human(), replace(table, rows=rows)))
    # Ankles that cannot level the soles.
    bent = math.radians(60)
    rows = tuple(
        replace(r, ranges=((-0.1, 0.1), (bent, bent + 0.2), (-0.1, 0.1))) if r.kind == "foot" else r
        for r in table.rows
    )
    stiff = tuple(
        replace(r, ranges=((-0.1, 0.1),) * 3) if r.kind in ("thigh", "shin") else r for r in rows
    )
    with refused("no-stance"):
        relaxed_stance(make_humanoid(human(), replace(table, rows=stiff)))


@pytest.mark.parametrize(
    ("style", "pose", "twist"),
    [("mixamo", "T", "none"), ("unreal", "A", "side"), ("daz", "folded", "chain")],
)
def test_rigs_of_any_rest_pose_stand(style, pose, twist):
    made = rig(style, pose, twist, fingers=True)
    humanoid = body_of(made.clip(size=0.05, frames=12))
    stood = stand(humanoid, relaxed_stance(humanoid), 4.0)
    assert stood.seconds == 4.0 and stood.drop_m < 0.01 and stood.sway_m < 0.05
    assert stood.margin_m > 0.04 and stood.warnings == 0


@pytest.mark.parametrize("height", [0.9, 1.2, 2.5, 3.5])
def test_children_and_giants_stand_at_the_same_settings(height):
    clip = swing()
    clip = scaled(clip, height / generate_table(clip.skeleton, None, [clip]).height_m)
    humanoid = body_of(clip)
    assert humanoid.table.height_m == pytest.approx(height)
    stood = stand(humanoid, relaxed_stance(humanoid), 4.0)
    assert stood.seconds == 4.0 and stood.warnings == 0
    assert stood.sway_m < 0.025 * height and stood.margin_m > 0.03 * height


def test_strength_that_follows_mass_alone_lets_a_giant_sag_more():
    # The reason for the rule: the same giant with the strength of its mass alone.
    from poise.body.body_table import length_factor

    clip = scaled(swing(), 3.5 / generate_table(human()).height_m)
    full = body_of(clip)
    weak = 1.0 / length_factor(3.5)
    rows = tuple(
        replace(r, kp=r.kp * weak, kd=r.kd * weak, torque=r.torque * weak) for r in full.table.rows
    )
    less = make_humanoid(clip.skeleton, replace(full.table, rows=rows))
    stance = relaxed_stance(full)
    assert stand(less, stance, 4.0).sway_m > 2 * stand(full, stance, 4.0).sway_m


def test_a_stance_that_is_pushed_off_balance_falls():
    humanoid = toy()
    stance = relaxed_stance(humanoid)
    leaning = np.array(stance.qpos)
    # 25 degrees forward, stiff as a board.
    turn, lean = np.zeros(4), np.zeros(4)
    mujoco.mju_axisAngle2Quat(lean, np.array([0.0, 1.0, 0.0]), math.radians(25))
    mujoco.mju_mulQuat(turn, lean, leaning[3:7])
    leaning[3:7] = turn
    tilted = Stance(leaning, stance.com, stance.support, stance.margin_m, stance.tilt_deg)
    fell = stand(humanoid, tilted, 4.0)
    assert fell.seconds < 4.0 and fell.margin_m < 0


CLIPS = (
    "LAFAN1",
    "Bandai Namco",
    "DeepMimic",
    "acRNN salsa",
    "dance001",
    "Rokoko video",
    "MASS",
    "Xsens",
)
PATHS = {
    "LAFAN1": "lafan1_bvh/walk4_subject1.bvh",
    "Bandai Namco": "other/bandai_bvh/dataset-1_walk_normal_001.bvh",
    "DeepMimic": "deepmimic_txt/humanoid3d_walk.txt",
    "acRNN salsa": "cmu_bvh/acrnn_salsa/01.bvh",
    "dance001": "cmu_bvh/ad/dance001.bvh",
    "Rokoko video": "noisy/rokoko_video/jesse_dance.bvh",
    "MASS": "other/mass_bvh/walk.bvh",
    "Xsens": "other/xsens_bvh/251021_04_boxing_120Hz_cm_3DsMax.bvh",
}


@pytest.mark.parametrize("name", CLIPS)
def test_bodies_of_eight_makers_stand_and_replay_their_clips(data_dir, name):
    clip = read_clip(data_dir / PATHS[name])
    row = measure(trim(clip, 0, min(clip.frames, 200)), 10.0 if name in CLIPS[:3] else 3.0)
    assert row["stood_s"] == (10.0 if name in CLIPS[:3] else 3.0) and row["warnings"] == 0
    assert row["drop_mm"] < 10 and row["sway_mm"] < 50 and row["margin_mm"] > 50
    assert row["sink_mm"] <= 5.0 and row["joints_mm"] < 1.0
