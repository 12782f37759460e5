"""Reward, observation and failure terms by hand on toy poses, and their purity."""

from __future__ import annotations

import math
from dataclasses import fields, replace

import pytest
import torch

from poise.env import observations as obs
from poise.env import rewards as reward
from poise.env.frame import Frame, ObsTerm, Pose
from poise.motion.rotations import (
    axis_angle_to_quat,
    euler_to_quat,
    heading_quat,
    normalize,
    quat_mul,
    quat_rotate,
)

N, B, J, H = 2, 4, 3, 5
REWARDS = [
    (reward.pose, {}),
    (reward.pose, {"half": True, "weights": torch.ones(J)}),
    (reward.velocity, {}),
    (reward.end_effectors, {"bodies": torch.tensor([1, 3])}),
    (reward.end_effectors, {"bodies": torch.tensor([1, 3]), "local": True}),
    (reward.centre_of_mass, {}),
    (reward.root_pose, {}),
    (reward.root_velocity, {}),
]
OBSERVATIONS = [
    (obs.root_height, {}),
    (obs.root_tilt, {}),
    (obs.root_velocity, {}),
    (obs.joint_angles, {}),
    (obs.joint_velocities, {}),
    (obs.phase, {}),
    (obs.body_positions, {}),
    (obs.target_joints, {}),
    (obs.target_root, {}),
    (obs.target_bodies, {}),
]
FAILURES = [
    (reward.root_too_low, {}),
    (reward.bodies_too_far, {}),
    (reward.any_body_too_far, {}),
]


def a_pose(seed: int = 0) -> Pose:
    rng = torch.Generator().manual_seed(seed)

    def randn(*shape: int) -> torch.Tensor:
        return torch.randn(N, *shape, generator=rng)

    quat, pos = normalize(randn(B, 4)), randn(B, 3)
    qpos = torch.cat((pos[:, 0], quat[:, 0], randn(H)), -1)
    linvel, qvel = randn(B, 3), randn(6 + H)
    qvel[:, :3] = linvel[:, 0]
    return Pose(
        qpos, qvel, pos, quat, linvel, randn(B, 3), randn(3), normalize(randn(J, 4)),
        heading_quat(quat[:, 0]),
    )  # fmt: skip


def a_frame(sim: Pose, ref: Pose | None = None) -> Frame:
    ahead = a_pose(5)
    return Frame.given(
        sim=sim, ref=ref or sim, ahead=ahead, phase=torch.tensor([0.25, 0.5]), residual=torch.zeros(N,
        6), reg=torch.tensor([1.0, 0.7]), min_height=torch.tensor([0.8, 0.9]),
    )  # fmt: skip


def turned(pose: Pose, yaw: float, shift: tuple[float, float]) -> Pose:
    """The same character in a world turned about +Z and moved along the floor."""
    q = axis_angle_to_quat(torch.tensor([0.0, 0, 1]), torch.tensor(yaw))
    move = torch.tensor([*shift, 0.0])
    pos = quat_rotate(q.expand(N, B, 4), pose.pos) + move
    quat = quat_mul(q.expand(N, B, 4), pose.quat)
    return Pose(
        torch.cat((pos[:, 0], quat[:, 0], pose.qpos[:, 7:]), -1),
        torch.cat((quat_rotate(q.expand(N, 4), pose.qvel[:, :3]), pose.qvel[:, 3:]), -1),
        pos,
        quat,
        quat_rotate(q.expand(N, B, 4), pose.linvel),
        quat_rotate(q.expand(N, B, 4), pose.angvel),
        quat_rotate(q.expand(N, 4), pose.com) + move,
        pose.local,
        heading_quat(quat[:, 0]),
    )


@pytest.mark.parametrize(("term", "params"), REWARDS)
def test_rewards_are_one_at_the_reference_and_below_elsewhere(term, params):
    at = term(a_frame(a_pose()), **params)
    assert at.shape == (N,)
    torch.testing.assert_close(at, torch.ones(N), atol=1e-6, rtol=0)
    off = term(a_frame(a_pose(0), a_pose(1)), **params)
    assert ((off >= 0) & (off < 1)).all()


def test_pose_reward_by_hand():
    sim = a_pose()
    angle = torch.tensor([0.3, 0.0, -0.4])
    more = axis_angle_to_quat(torch.tensor([0.0, 1, 0]).expand(J, 3), angle)
    ref = replace(sim, local=quat_mul(more.expand(N, J, 4), sim.local))
    value = reward.pose(a_frame(sim, ref))
    torch.testing.assert_close(value, torch.full((N,), math.exp(-2 * (0.09 + 0.16))))
    # Minus a quaternion is the same rotation.
    torch.testing.assert_close(reward.pose(a_frame(replace(sim, local=-sim.local), ref)), value)
    half = reward.pose(a_frame(sim, ref), half=True)
    torch.testing.assert_close(half, torch.full((N,), math.exp(-2 * 0.25 * (0.09 + 0.16))))
    heavy = reward.pose(a_frame(sim, ref), weights=torch.tensor([0.0, 1.0, 2.0]))
    torch.testing.assert_close(heavy, torch.full((N,), math.exp(-2 * 2 * 0.16)))


def test_velocity_reward_by_hand_counts_hinges_only():
    sim = a_pose()
    other = sim.qvel.clone()
    other[:, :6] += 100.0
    other[:, 6] += 3.0
    other[:, 8] -= 4.0
    value = reward.velocity(a_frame(sim, replace(sim, qvel=other)))
    torch.testing.assert_close(value, torch.full((N,), math.exp(-0.005 * 25)), rtol=1e-5, atol=1e-6)


def test_position_rewards_by_hand():
    sim = a_pose()
    pos = sim.pos.clone()
    pos[:, 1, 0] += 0.1
    pos[:, 3, 2] -= 0.2
    pos[:, 2] += 9.0  # No end effector: it must not count.
    value = reward.end_effectors(a_frame(sim, replace(sim, pos=pos)), torch.tensor([1, 3]))
    torch.testing.assert_close(value, torch.full((N,), math.exp(-5 * 0.05)))
    com = reward.centre_of_mass(a_frame(sim, replace(sim, com=sim.com + torch.tensor([0.03, 0, 0.04]))))
    torch.testing.assert_close(com, torch.full((N,), math.exp(-100 * 0.0025)), rtol=1e-4, atol=0)


def test_root_rewards_by_hand():
    sim = a_pose()
    pos = sim.pos.clone()
    pos[:, 0, 2] += 0.05
    value = reward.root_pose(a_frame(sim, replace(sim, pos=pos)))
    torch.testing.assert_close(value, torch.full((N,), math.exp(-300 * 0.0025)), rtol=1e-4, atol=0)
    upright = replace(sim, quat=torch.tensor([1.0, 0, 0, 0]).repeat(N, B, 1))
    upright = replace(upright, heading=heading_quat(upright.quat[:, 0]))
    lean = euler_to_quat(torch.tensor([0.8, 0.06]), "ZY")  # A heading of 0.8 and a lean of 0.06.
    leaning = replace(upright, quat=lean.repeat(N, B, 1), heading=heading_quat(lean.repeat(N, 1)))
    value = reward.root_pose(a_frame(upright, leaning))
    torch.testing.assert_close(value, torch.full((N,), math.exp(-300 * 0.0036)), rtol=1e-4, atol=0)
    qvel, angular = upright.qvel.clone(), upright.angvel.clone()
    qvel[:, 1] += 0.5
    angular[:, 0, 2] += 2.0
    value = reward.root_velocity(a_frame(upright, replace(upright, qvel=qvel, angvel=angular)))
    torch.testing.assert_close(value, torch.full((N,), math.exp(-0.25 - 0.1 * 4.0)), rtol=1e-4, atol=0)


def test_residual_reward_is_the_regularizer():
    assert reward.residual(a_frame(a_pose())).tolist() == pytest.approx([1.0, 0.7])


@pytest.mark.parametrize(
    ("term", "params"), [(t, p) for t, p in REWARDS if t not in (reward.centre_of_mass,)]
)
def test_rewards_do_not_change_when_the_whole_world_turns(term, params):
    sim, ref = a_pose(0), replace(a_pose(0), pos=a_pose(0).pos + 0.05)
    far = a_frame(turned(sim, 2.1, (3.0, -8.0)), turned(ref, 2.1, (3.0, -8.0)))
    here, there = term(a_frame(sim, ref), **params), term(far, **params)
    torch.testing.assert_close(there, here, atol=2e-5, rtol=1e-4)


def test_local_end_effectors_forgive_where_in_the_world():
    sim = a_pose()
    far = turned(sim, -1.0, (50.0, 2.0))
    bodies = torch.tensor([1, 3])
    local = reward.end_effectors(a_frame(sim, far), bodies, alpha=20.0, local=True)
    torch.testing.assert_close(local, torch.ones(N), atol=1e-4, rtol=0)
    assert reward.end_effectors(a_frame(sim, far), bodies).max() < 0.01


@pytest.mark.parametrize(("term", "params"), OBSERVATIONS)
def test_observations_are_free_of_place_and_heading(term, params):
    frame = a_frame(a_pose())
    assert frame.ahead is not None
    moved = frame.replaced(
        sim=turned(frame.sim, 2.3, (4.0, -7.0)),
        ref=turned(frame.ref, 2.3, (4.0, -7.0)),
        ahead=turned(frame.ahead, 2.3, (4.0, -7.0)),
    )
    here, there = term(frame, **params), term(moved, **params)
    assert here.ndim == 2 and here.shape[0] == N
    torch.testing.assert_close(there, here, atol=1e-4, rtol=1e-4)


def test_observations_by_hand():
    sim = a_pose()
    sim = replace(sim, heading=euler_to_quat(torch.tensor([math.pi / 2]), "Z").repeat(N, 1))
    pos = torch.zeros(N, B, 3)
    pos[:, 1] = torch.tensor([0.0, 2.0, 1.0])  # Two metres ahead of a character that faces +y.
    out = obs.body_positions(a_frame(replace(sim, pos=pos)))
    torch.testing.assert_close(out[:, :3], torch.tensor([[2.0, 0, 1.0]] * N), atol=1e-6, rtol=0)
    frame = a_frame(sim)
    assert frame.ahead is not None
    torch.testing.assert_close(
        obs.target_joints(frame),
        torch.cat((frame.ahead.qpos[:, 7:] - sim.qpos[:, 7:], frame.ahead.qvel[:, 6:]), -1),
    )
    assert obs.phase(frame).tolist() == [[0.25], [0.5]]
    with pytest.raises(ValueError, match="next reference frame"):
        obs.target_root(frame.replaced(ahead=None))


@pytest.mark.parametrize(("term", "params"), FAILURES)
def test_failures_are_one_yes_or_no_per_environment(term, params):
    failed = term(a_frame(a_pose(0), a_pose(1)), **params)
    assert failed.shape == (N,) and failed.dtype == torch.bool


def test_failures_by_hand():
    sim = a_pose()
    pos = sim.pos.clone()
    pos[0, 0, 2], pos[1, 0, 2] = 0.69, 0.81  # Lowest allowed: 0.8 - 0.1 and 0.9 - 0.1.
    assert reward.root_too_low(a_frame(replace(sim, pos=pos))).tolist() == [True, False]
    pos = sim.pos.clone()
    pos[0, 2, 0] += 1.2  # Mean over four bodies: 0.3. World 1: 0.6 each.
    pos[1, :, 2] += 0.6
    frame = a_frame(sim, replace(sim, pos=pos))
    assert reward.bodies_too_far(frame, limit=0.5).tolist() == [False, True]
    assert reward.bodies_too_far(frame, limit=0.29).tolist() == [True, True]
    assert reward.any_body_too_far(frame, limit=1.0).tolist() == [True, False]


def test_terms_are_pure():
    sim, ref = a_pose(0), a_pose(1)
    frame = a_frame(sim, ref)
    poses = [sim, ref, frame.ahead]
    before = [[getattr(p, f.name).clone() for f in fields(Pose)] for p in poses if p]
    for term, params in (*REWARDS, *OBSERVATIONS, *FAILURES):
        once = term(frame, **params)
        assert torch.equal(once, term(frame, **params)) and not once.requires_grad
    after = [[getattr(p, f.name) for f in fields(Pose)] for p in poses if p]
    for a, b in zip(before, after, strict=True):
        assert all(torch.equal(x, y) for x, y in zip(a, b, strict=True))


def test_columns_of_an_observation_have_names() -> None:
    term = ObsTerm("goal", obs.root_height, parts={"pos": 3, "linvel": 3, "rot": 6})
    assert term.columns(10, 24) == {
        "goal": slice(10, 34),
        "goal.pos": slice(10, 16),
        "goal.linvel": slice(16, 22),
        "goal.rot": slice(22, 34),
    }
    assert ObsTerm("height", obs.root_height).columns(3, 1) == {"height": slice(3, 4)}
