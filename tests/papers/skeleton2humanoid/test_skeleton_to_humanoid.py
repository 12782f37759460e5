"""The stages of Skeleton2Humanoid; of the third its state, its curriculum, its baseline, and that it
learns."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from poise.control import LinearHelp
from poise.env import Reference
from poise.env import observations as obs
from poise.env import rewards as reward
from poise.jobs.inbetween.fill import inbetween
from poise.kinematics import clip_ik
from poise.motion import resample, shifted
from poise.motion.rotations import quat_conj, quat_mul, quat_rotate
from poise.papers.skeleton2humanoid.recipe import (
    FALLS,
    INITIAL,
    LEFT,
    Budget,
    build,
    pipeline,
    posed,
    settings,
)
from poise.recipes.imitation import Imitation
from poise.recipes.residual_force_settings import ResidualForce
from refusals import refused
from toy_human import swing


@pytest.fixture(scope="module")
def full() -> Imitation:
    return build(swing(2.0), settings(budget=Budget(num_envs=2)))


def test_the_curriculum_is_equation_9() -> None:
    paper = settings("full", Budget.paper())
    assert paper.num_envs * paper.ppo.horizon == pytest.approx(50_000, rel=0.01)
    assert paper.ppo.policy_hidden == (1024, 512, 256)
    horizon = paper.ppo.horizon
    assert paper.help_steps == tuple(i * horizon for i in FALLS)
    help_ = LinearHelp(*paper.help_steps, final=LEFT / INITIAL)
    for iteration in (0, 100, 400, 1300, 1500):
        alpha = 0.1 * (min(max(iteration, 100), 1300) - 100)
        assert help_.scale(1.0, iteration * horizon, 0.5) * INITIAL == pytest.approx(220 - alpha)
    # A shorter training has the same curriculum, in shares.
    short = Budget(iterations=150, horizon=16)
    assert short.falls == (10 * 16, 130 * 16)


def test_the_baseline_differs_in_one_frame_and_the_curriculum_alone() -> None:
    budget = Budget(num_envs=2)
    whole, uhc = (settings(v, budget) for v in ("full", "uhc"))
    differs = {
        k for k, v in vars(whole).items() if v != getattr(uhc, k)
    }  # fmt: skip
    assert differs == {"observation", "help_start", "help_limit"}
    assert uhc.help_limit == INITIAL and uhc.help_start is None
    assert settings("one frame", budget).help_limit == LEFT
    assert settings("no curriculum", budget).observation == "next two"
    assert settings("full to zero", budget).help_limit == 0.0
    with refused("unknown-choice", says="variant"):
        settings("half")  # type: ignore[arg-type]


def test_the_state_says_what_is_missing(full: Imitation) -> None:
    env = full.env(2, auto_reset=False)
    clip, frame = torch.tensor([0, 0]), torch.tensor([3, 20])
    env.reset_to(clip, frame)
    f = env.view()
    ref, h = full.reference, full.humanoid.head
    assert h is not None
    for step in (0, 1):
        at = frame + step + 1
        q = ref.qpos[at].float()
        angles = obs.next_angles(f, step)
        torch.testing.assert_close(angles[:, 6:], q[:, 7:] - f.sim.qpos[:, 7:])
        speeds = obs.next_velocities(f, step)
        torch.testing.assert_close(speeds[:, 3:], ref.qvel[at].float()[:, 3:] - f.sim.qvel[:, 3:])
        both = obs.next_joints(f, step, h).unflatten(1, (2, -1, 3))
        pos, quat = ref.pose.pos[at], ref.pose.quat[at, h]
        seen = quat_rotate(quat_conj(quat)[:, None], pos - pos[:, h : h + 1])
        own = obs.joints_from_head(f, h).unflatten(1, (-1, 3))
        torch.testing.assert_close(both[:, 0] + own, seen, atol=1e-5, rtol=1e-4)
        assert torch.allclose(both[:, 1].norm(dim=-1), (pos - f.sim.pos).norm(dim=-1), atol=1e-5)
    env.close()


def test_the_state_knows_no_place_and_no_heading(full: Imitation) -> None:
    env = full.env(2, auto_reset=False)
    zero = torch.zeros(2, dtype=torch.long)
    env.reset_to(zero, zero + 5)
    here = env.view()
    turn = torch.tensor([np.cos(0.6), 0.0, 0.0, np.sin(0.6)]).float()

    def moved(pose):
        lead = pose.pos.shape[:-1]
        pos = quat_rotate(turn.expand(*lead, 4), pose.pos) + torch.tensor([3.0, -2.0, 0.0])
        quat = quat_mul(turn.expand(*lead, 4), pose.quat)
        qpos, qvel = pose.qpos.clone(), pose.qvel.clone()
        qpos[..., :3], qpos[..., 3:7] = pos[..., 0, :], quat[..., 0, :]
        qvel[..., :3] = quat_rotate(turn.expand(*lead[:-1], 4), qvel[..., :3])
        heading = quat_mul(turn.expand(*lead[:-1], 4), pose.heading)
        return type(pose)(qpos, qvel, pos, quat, pose.linvel, pose.angvel, pose.com, pose.local, heading)

    class There:
        sim, window = moved(env.pose()), moved(here.window)

    h = full.humanoid.head or 0
    for term, params in (
        (obs.joints_from_head, {"head": h}), (obs.next_angles, {"step": 1}),
        (obs.next_velocities, {"step": 1}), (obs.next_joints, {"step": 1, "head": h}),
    ):  # fmt: skip
        torch.testing.assert_close(term(here, **params), term(There(), **params), atol=2e-5, rtol=1e-4)
    env.close()


def test_an_episode_ends_half_a_metre_too_low(full: Imitation) -> None:
    assert [t.fn for t in full.task.dones] == [reward.root_below]
    env = full.env(2, auto_reset=False)
    zero = torch.zeros(2, dtype=torch.long)
    env.reset_to(zero, zero)
    f = env.view()
    assert not reward.root_below(f).any()
    assert reward.root_below(f, margin=-0.01).all()
    env.close()


def test_it_learns_and_the_force_becomes_less() -> None:
    config = settings("full", Budget(num_envs=32, iterations=12), seed=1)
    assert isinstance(config, ResidualForce)
    trainer = build(swing(1.0), config).trainer(threads=1)
    rewards = [trainer.iterate().reward for _ in range(12)]
    assert np.mean(rewards[-3:]) > np.mean(rewards[:3])
    assert trainer.env.help.now == pytest.approx(LEFT / INITIAL, abs=0.1)  # type: ignore[attr-defined]
    trainer.env.close()


def test_stage_two_poses_the_body_by_the_places_of_joints_alone() -> None:
    clip = swing(1.0)
    twisted = clip.rot.copy()
    elbow = clip.skeleton.index("LeftForeArm")
    # A turn about a bone's own axis moves no joint: stage II must not know of it.
    bone = clip.skeleton.offsets[clip.skeleton.index("LeftHand")]
    axis = bone / np.linalg.norm(bone)
    turn = np.array([np.cos(0.3), *(np.sin(0.3) * axis)])
    twisted[:, elbow] = quat_mul(twisted[:, elbow], np.broadcast_to(turn, twisted[:, elbow].shape))
    other = clip.replaced(rot=twisted)
    assert np.abs(other.positions() - clip.positions()).max() < 1e-9
    one, two = (posed(c).clips[0] for c in (clip, other))
    np.testing.assert_allclose(one.rot, two.rot, atol=1e-9)
    np.testing.assert_allclose(one.positions(), clip.positions(), atol=1e-4)


def test_stages_are_left_out_one_by_one() -> None:
    clip, config = swing(1.0), settings(budget=Budget(num_envs=2))
    clip = shifted(clip, (0.0, 0.0, 0.02))
    high = build(clip, config, floor=False)
    # Stage II equals its twin: the analytic inverse kinematics on the very body.
    qpos = clip_ik(resample(clip, high.reference.rate_hz), high.humanoid)
    twin = Reference(high.humanoid, [qpos], high.reference.rate_hz, ["twin"]).pose.pos
    assert float((twin - high.reference.pose.pos).norm(dim=-1).max()) < 1e-4
    low = build(clip, config).reference.pose.pos
    lift = (low - high.reference.pose.pos)[..., 2]
    assert float(lift.abs().max()) > 0.01
    own = build(clip, config, analytic=False).reference.qpos
    assert own.shape == build(clip, config).reference.qpos.shape


def test_the_pipeline_fills_and_poses() -> None:
    clip, config = swing(1.0), settings(budget=Budget(num_envs=2))
    keys = (9, clip.frames - 6)
    task = pipeline([clip], keys, config, adapt=0, floor=False)
    filled = inbetween(clip, keys, adapt=0, foot_lock=False).clip
    rows = [r.joint for r in task.humanoid.table.rows]
    there = resample(filled, task.reference.rate_hz).positions()[:, rows]
    np.testing.assert_allclose(task.reference.pose.pos.numpy(), there, atol=1e-3)
