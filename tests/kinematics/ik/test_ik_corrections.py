"""Every correction of the paper's equations: what goes wrong without it, and that it mends that."""

from __future__ import annotations

import math

import numpy as np
from paper_humanoid import body_points, count_jumps, paper_humanoid

import toy_human
from poise.body import generate_table
from poise.kinematics import CORRECTIONS, IkBody, IkConfig, Kinematics, analytic_ik, ik_body
from poise.motion import Skeleton
from poise.motion.rotations import quat_to_matrix
from refusals import refused

#: Hips in front of the root and three spine joints, as in LAFAN1, so that the paper's equations apply.
_ROWS = (
    ("Hips", "", (0, 0, 0)),
    ("LeftUpLeg", "Hips", (0.02, 0.1, 0)),
    ("LeftLeg", "LeftUpLeg", (0, 0, -0.43)),
    ("LeftFoot", "LeftLeg", (0, 0, -0.42)),
    ("LeftToe", "LeftFoot", (0.16, 0, -0.05)),
    ("RightUpLeg", "Hips", (0.02, -0.1, 0)),
    ("RightLeg", "RightUpLeg", (0, 0, -0.43)),
    ("RightFoot", "RightLeg", (0, 0, -0.42)),
    ("RightToe", "RightFoot", (0.16, 0, -0.05)),
    ("Spine", "Hips", (-0.025, 0, 0.07)),
    ("Spine1", "Spine", (0, 0, 0.125)),
    ("Spine2", "Spine1", (0, 0, 0.123)),
    ("LeftShoulder", "Spine2", (-0.015, 0.06, 0.197)),
    ("LeftArm", "LeftShoulder", (0, 0.113, 0)),
    ("LeftForeArm", "LeftArm", (0, 0.33, 0)),
    ("LeftHand", "LeftForeArm", (0, 0.25, 0)),
    ("RightShoulder", "Spine2", (-0.015, -0.06, 0.197)),
    ("RightArm", "RightShoulder", (0, -0.113, 0)),
    ("RightForeArm", "RightArm", (0, -0.33, 0)),
    ("RightHand", "RightForeArm", (0, -0.25, 0)),
)


def made(one_hinge: bool = False, hips: float = 0.02) -> IkBody:
    names = [r[0] for r in _ROWS]
    offsets = np.array([r[2] for r in _ROWS], dtype=float)
    for side in ("Left", "Right"):
        offsets[names.index(f"{side}UpLeg"), 0] = hips
        offsets[names.index(f"{side}UpLeg"), 2] = 0.02 - hips
    parents = tuple(names.index(r[1]) if r[1] else -1 for r in _ROWS)
    skeleton = Skeleton(tuple(names), parents, offsets)
    return ik_body(*reversed(paper_humanoid(generate_table(skeleton), skeleton, one_hinge)))


def rest(body: IkBody, frames: int) -> np.ndarray:
    q = np.zeros((frames, 7 + sum(len(r.order) for r in body.table.rows)))
    q[:, 2], q[:, 3] = 0.9, 1.0
    return q


def column(body: IkBody, hinge: str) -> int:
    return 7 + [n for r in body.table.rows for n in r.hinge_names()].index(hinge)


def pose(body: IkBody, q: np.ndarray) -> np.ndarray:
    state = Kinematics(body.table)(q)
    return body_points(body, state.pos, quat_to_matrix(state.quat))


def error_mm(body: IkBody, wanted: np.ndarray, config: IkConfig) -> dict[str, float]:
    got = pose(body, analytic_ik(wanted, body, config))
    mean = np.linalg.norm(got - wanted, axis=-1).mean(0) * 1000
    return dict(zip(body.points, mean.tolist(), strict=True))


def bent(body: IkBody, frames: int = 40) -> np.ndarray:
    """Knees, elbows and ankles bent, the trunk leaning: nothing degenerate."""
    q, t = rest(body, frames), np.linspace(0, 2 * math.pi, frames)
    for name, sign in (("Left", -1.0), ("Right", 1.0)):
        q[:, column(body, f"{name}ForeArm_z")] = sign * (0.8 + 0.3 * np.sin(t))
        q[:, column(body, f"{name}Leg_x")] = 0.7 + 0.3 * np.sin(t)
        q[:, column(body, f"{name}UpLeg_x")] = -0.5 + 0.2 * np.sin(t)
        q[:, column(body, f"{name}Foot_x")] = 0.3 * np.cos(t)
    q[:, column(body, "Spine1_x")] = 0.2
    q[:, column(body, "Spine2_x")] = 0.2
    return q


PAPER = IkConfig(faithful="paper")


def test_a_switch_follows_what_the_config_is_faithful_to():
    assert all(IkConfig().on(c) for c in CORRECTIONS) and IkConfig().square
    assert not any(PAPER.on(c) for c in CORRECTIONS)
    mixed = IkConfig(faithful="paper", square_ankle=True)
    assert [c for c in CORRECTIONS if mixed.on(c)] == ["square_ankle"]
    with refused("unknown-choice", says=("faithful", "code")):
        IkConfig(faithful="code")
    with refused("out-of-range", says="straight"):
        IkConfig(straight=0.0)


def test_paper_and_correction_agree_on_a_plain_pose():
    # Nothing is degenerate, feet are square to the shins, hips in front of the root: all is well.
    body = made()
    q = bent(body)
    for side in ("Left", "Right"):
        q[:, column(body, f"{side}Foot_x")] = 0.0
    wanted = pose(body, q)
    config = IkConfig(faithful="paper", square_ankle=True, knee_subscripts=True)
    assert max(error_mm(body, wanted, config).values()) < 1e-6
    assert max(error_mm(body, wanted, IkConfig()).values()) < 1e-6


def test_knee_subscripts():
    body = made()
    q = bent(body)
    q[:, column(body, "LeftUpLeg_y")] = q[:, column(body, "RightUpLeg_y")] = 0.3
    q[:, column(body, "LeftUpLeg_z")] = q[:, column(body, "RightUpLeg_z")] = 0.2
    wanted = pose(body, q)
    hip_line = {"thigh_twist": False}
    wrong = error_mm(body, wanted, IkConfig(knee_subscripts=False, **hip_line))
    # Only the left leg is misprinted.
    assert wrong["LeftFoot"] > 5.0 and wrong["RightFoot"] < 1e-6
    assert max(error_mm(body, wanted, IkConfig(**hip_line)).values()) < 1e-6


def test_square_ankle():
    body = made()
    wanted = pose(body, bent(body))
    wrong = error_mm(body, wanted, IkConfig(square_ankle=False))
    assert wrong["LeftToe"] > 3.0 and wrong["RightToe"] > 3.0 and wrong["LeftFoot"] < 1e-6
    assert max(error_mm(body, wanted, IkConfig()).values()) < 1e-6


def noisy_straight_arm(body: IkBody) -> np.ndarray:
    """An arm bent, then straight within a tenth of a millimetre, bent again: `(T, P, 3)`."""
    q = rest(body, 60)
    bend = np.concatenate((np.linspace(1, 0, 20), np.zeros(20), np.linspace(0, 1, 20)))
    q[:, column(body, "LeftForeArm_z")] = -bend
    points = pose(body, q)
    noise = np.random.default_rng(0).normal(size=(60, 3)) * 1e-4
    points[:, body.roles["lw"]] += noise
    return points


def test_hold_bend_keeps_a_straight_arm_from_spinning():
    body = made()
    wanted = noisy_straight_arm(body)
    upper = [column(body, f"LeftArm_{c}") for c in "xyz"]
    raw = analytic_ik(wanted, body, IkConfig(hold_bend=False))[:, upper]
    held = analytic_ik(wanted, body)[:, upper]
    assert np.abs(np.diff(raw, axis=0)).max() > math.pi / 4
    assert np.abs(np.diff(held, axis=0)).max() < 0.1
    # The wrist is met all the same: three hinges at the elbow bend to any side.
    assert error_mm(body, wanted, IkConfig())["LeftHand"] < 1.0


def test_hold_bend_lets_a_knee_go_beyond_straight():
    body = made()
    q = rest(body, 60)
    q[:, column(body, "LeftLeg_x")] = 0.4 * np.cos(np.linspace(0, 2 * math.pi, 60)) + 0.3
    wanted = pose(body, q)
    found = analytic_ik(wanted, body)
    np.testing.assert_allclose(found[:, 7:], q[:, 7:], atol=1e-6)
    flipped = analytic_ik(wanted, body, IkConfig(hold_bend=False))
    assert np.abs(np.diff(flipped[:, 7:], axis=0)).max() > 2.0


def test_an_arm_without_any_bend_keeps_its_rest_roll():
    body = made()
    q = rest(body, 30)
    q[:, column(body, "LeftArm_z")] = np.linspace(0, -1.2, 30)
    found = analytic_ik(pose(body, q), body)
    np.testing.assert_allclose(found[:, 7:], q[:, 7:], atol=1e-6)


def test_spine_twist():
    body = made()
    q = rest(body, 41)
    q[:, column(body, "Spine1_x")] = np.radians(np.linspace(-1, 1, 41))
    wanted = pose(body, q)
    flips = analytic_ik(wanted, body, IkConfig(spine_twist=False))
    found = analytic_ik(wanted, body)
    assert np.abs(np.diff(flips[:, 7:], axis=0)).max() > 2.0
    assert np.abs(np.diff(found[:, 7:], axis=0)).max() < 0.01
    # Collarbones turn by a quarter of a degree about themselves: Eq. 12 looks at the mid spine.
    np.testing.assert_allclose(found[:, 7:], q[:, 7:], atol=0.01)


def test_spine_twist_is_spread_from_hips_to_shoulders():
    body = made()
    q = rest(body, 10)
    q[:, column(body, "Spine2_y")] = 0.9
    found = analytic_ik(pose(body, q), body)
    for row in ("Spine", "Spine1", "Spine2"):
        np.testing.assert_allclose(found[:, column(body, f"{row}_y")], 0.3, atol=0.02)


def test_trunk_fit_where_hips_hang_straight_below_the_root():
    body = made(hips=0.0)
    names = [r.name for r in body.table.rows]
    below = body.rest_pos[names.index("LeftUpLeg"), 0]
    assert abs(below - body.rest_pos[0, 0]) < 2e-3
    wanted = pose(body, bent(body))
    assert max(error_mm(body, wanted, IkConfig()).values()) < 1e-6
    # y of Eq. 18 points forward (up x left is backward) instead of up.
    left, right = (wanted[0, body.roles[f"{s}hip"]] - wanted[0, 0] for s in "lr")
    y = np.cross(right, left)
    assert abs(y[0]) > 0.99 * np.linalg.norm(y)


def test_trunk_fit_where_hips_lie_beside_the_root():
    # All three on one line: Eq. 18 has no y axis at all (DeepMimic).
    skeleton = toy_human.human()
    body = ik_body(generate_table(skeleton), skeleton)
    clip = toy_human.swing(bend=1.0)
    wanted = clip.positions()[:, [skeleton.index(n) for n in body.points]]
    assert max(error_mm(body, wanted, IkConfig()).values()) < 1e-6
    assert max(error_mm(body, wanted, IkConfig(trunk_fit=False)).values()) > 50.0


def test_thigh_twist_that_a_knee_of_one_hinge_cannot_take():
    body = made(one_hinge=True)
    q = bent(body)
    q[:, column(body, "LeftUpLeg_y")] = 0.5
    wanted = pose(body, q)
    wrong = error_mm(body, wanted, IkConfig(thigh_twist=False))
    assert wrong["LeftFoot"] > 50.0
    assert max(error_mm(body, wanted, IkConfig()).values()) < 1e-6
    # A knee of three hinges hides it in its own twist.
    free = made()
    assert error_mm(free, wanted, IkConfig(thigh_twist=False))["LeftFoot"] < 1e-6


def test_branches():
    # Both arms go from hanging to far overhead, through the lock of their middle hinge.
    body = made()
    q = rest(body, 90)
    for side, sign in (("Left", 1.0), ("Right", -1.0)):
        q[:, column(body, f"{side}Arm_y")] = sign * np.linspace(-0.4, -2.2, 90)
        q[:, column(body, f"{side}ForeArm_z")] = -sign * 0.7
    wanted = pose(body, q)
    once = analytic_ik(wanted, body, IkConfig(branches=False))
    found = analytic_ik(wanted, body)
    assert count_jumps(once[:, 7:]).sum() > 0
    assert count_jumps(found[:, 7:]).sum() == 0
    np.testing.assert_allclose(found[:, 7:], q[:, 7:], atol=1e-6)
