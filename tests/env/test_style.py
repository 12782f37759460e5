"""What a motion prior sees: the same of characters and of clips, before restarts and up to starts."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from poise.control import range_scale
from poise.env import ImitationEnv
from poise.env import rewards as reward
from poise.env.evaluate import MANY, seen_by
from poise.env.style import ClipFeatures, ClipWindows
from poise.recipes.imitation import Imitation
from poise.sim import make_backend
from refusals import refused
from toy_human import swing

CLIPS = (swing(0.6), swing(0.5, speed=1.2, bend=0.5, cyclic=True, name="walk"), swing(0.2, name="short"))


@pytest.fixture
def task(make_phc) -> Imitation:
    return make_phc(*CLIPS)


def act(env: ImitationEnv, seed: int) -> torch.Tensor:
    rng = torch.Generator().manual_seed(seed)
    near = env.reference.qpos[env.reference.rows(env.clip, env.frame + 1), 7:].float()
    return near / env.task.pd.scale + 0.02 * torch.randn(near.shape, generator=rng)


def test_windows_of_the_same_motion_are_the_same(task):
    frames = 8
    env = task.env(3, auto_reset=False, threads=1)
    clip, first = torch.tensor([0, 1, 1]), torch.tensor([4, 2, 11])
    seen = []
    for t in range(frames):
        env.reset_to(clip, first + t)
        seen.append(seen_by(env.task.style, env.view()))
    window = env.demos(frames).at(clip, first)
    assert window.shape == (3, frames * env.num_features)
    # The last one goes on into the clip's next cycle, turned and carried on.
    torch.testing.assert_close(torch.stack(seen, 1).flatten(1), window, atol=1e-4, rtol=1e-4)
    env.close()


def test_features_are_of_what_the_step_reached_before_restarts(task):
    env, still = task.env(6, seed=2, threads=1), task.env(6, seed=2, auto_reset=False, threads=1)
    env.reset()
    restarted = 0
    for t in range(12):
        still.load_state(env.state())
        a = act(env, t) + 0.1 * (t % 4 == 3)
        step, reached = env.step(a), still.step(a)
        assert torch.equal(env.features(), still.features())
        plain = seen_by(still.task.style, still.view())
        torch.testing.assert_close(still.features(), plain, atol=1e-5, rtol=1e-5)
        assert torch.equal(step.final_obs, reached.final_obs)
        restarted += int((step.terminated | step.truncated).sum())
    assert restarted > 2 and env.features().isfinite().all() and not env.features().requires_grad
    env.close()
    still.close()


def test_the_past_of_a_start_is_that_of_its_clip(task):
    env = task.env(4, threads=1)
    count = 6
    env.reset_to(torch.tensor([0, 0, 1, 2]), torch.tensor([7, 4, 2, 3]))
    rows = torch.tensor([3, 0, 1, 2])
    past = env.past(rows, count)
    assert past is not None and past.shape == (4, count, env.num_features)
    # Rows 1 and 3 begin too early in clips that do not go on.
    assert past.isnan().all((1, 2)).tolist() == [True, False, True, False]
    now = seen_by(env.task.style, env.view())
    torch.testing.assert_close(past[1, -1], now[0], atol=1e-4, rtol=1e-4)
    ref = env.reference
    # Worked out from the frames that are asked for, in place of a table of all frames.
    plain = ClipFeatures(ref, env.task.style, most_bytes=0)
    want = plain(int(ref.start[0]) + torch.arange(2, 8))
    assert not plain.kept and env.clip_features.kept
    torch.testing.assert_close(past[1], want, atol=1e-6, rtol=1e-6)
    # The walk goes on: before its frame 0 come its last frames but the one that is frame 0 again.
    last, first = int(ref.length[1]) - 1, int(ref.start[1])
    order = first + torch.tensor([last - 3, last - 2, last - 1, 0, 1, 2])
    torch.testing.assert_close(past[3], plain(order), atol=1e-6, rtol=1e-6)
    assert env.past(torch.tensor([3, 1]), count) is None
    env.close()


def test_demos_are_drawn_by_the_odds_of_clips_that_are_long_enough(task):
    env = task.env(2, threads=1)
    draw, rng = env.demos(8), torch.Generator().manual_seed(0)
    asked: list[torch.Tensor] = []
    draw.at = lambda clip, first: asked.append(torch.stack((clip, first))) or torch.zeros(0)  # type: ignore
    env.weights = torch.tensor([1.0, 3.0, 96.0])  # The short one has 7 frames.
    draw(4000, rng)
    clip, first = asked[0]
    assert float((clip == 1).float().mean()) == pytest.approx(0.75, abs=0.03) and not (clip == 2).any()
    # 19 frames: from 0 to 11 a window of 8 fits; the walk of 16 frames goes on from each but its last.
    assert first[clip == 0].unique().tolist() == list(range(12))
    assert first[clip == 1].unique().tolist() == list(range(15))
    env.weights = torch.tensor([0.0, 0.0, 1.0])
    draw(500, rng)
    assert set(asked[1][0].tolist()) == {0, 1}
    again = env.demos(8)
    a, b = (again(9, torch.Generator().manual_seed(4)) for _ in range(2))
    assert torch.equal(a, b) and a.shape == (9, 8 * env.num_features) and a.dtype == torch.float32
    env.close()


def test_what_cannot_be_is_refused(task, make_task):
    plain = make_task(*CLIPS, method="deepmimic").env(2, threads=1)
    assert plain.num_features == 0 and plain.features().shape == (2, 0)
    with refused("settings-conflict"):
        plain.demos(4)
    with refused("clip-too-short", says="40"):
        features = ClipFeatures(make_task(CLIPS[0]).reference, task.task.style)
        ClipWindows(features, 40, lambda: torch.ones(1))
    assert "qfrc_actuator" not in plain.backend.state
    plain.close()


def test_recordings_and_halves_are_the_plain_terms(task):
    """Fused, cut into two halves, and one by one: the same numbers, with torques and a style."""
    backend = make_backend(task.model, MANY, "cpu", threads=1)
    fused = ImitationEnv(task.reference, backend, task.task, task.config.sim.substeps, 5)
    backend = make_backend(task.model, MANY, "cpu", threads=1)
    plain = ImitationEnv(task.reference, backend, task.task, task.config.sim.substeps, 5, fused=False)
    assert torch.equal(fused.reset(), plain.reset())
    for t in range(5):
        a, b = fused.step(act(fused, t)), plain.step(act(plain, t))
        for x, y in ((a.obs, b.obs), (a.reward, b.reward), (fused.features(), plain.features())):
            torch.testing.assert_close(x, y, atol=1e-5, rtol=1e-5)
        assert torch.equal(a.terminated, b.terminated)
    # A term that cannot be recorded would be evaluated plainly, and slowly, without a word.
    assert "judge" in fused.recorded and not plain.recorded
    fused.close()
    plain.close()


def test_torques_are_those_of_the_servos_and_the_damping(task):
    backend, model = make_backend(task.model, 2, "cpu", threads=1), task.humanoid.model
    energy = (reward.energy_term(1.0, exempt=0),)
    env = ImitationEnv(task.reference, backend, replace(task.task, rewards=energy, auto_reset=False), 1)
    env.reset_to(torch.tensor([0, 1]), torch.tensor([3, 5]))
    u, q = 0.1 + env.backend.state.qpos[:, 7:].clone(), env.backend.state.qpos[:, 7:].clone()
    step = env.step((u / env.task.pd.scale).float())
    kp, most = torch.tensor(model.actuator_gainprm[:, 0]), torch.tensor(model.actuator_forcerange[:, 1])
    speed = backend.state.qvel[:, 6:]
    # tau = clip(kp (u - q)) - kd q'
    torque = torch.clip(kp * (u - q), -most, most) - torch.tensor(model.dof_damping[6:]) * speed
    frame = env.view()
    assert frame.torque is not None
    torch.testing.assert_close(frame.torque, torque.float(), atol=1e-3, rtol=1e-4)
    power = (torque * speed).abs().sum(-1).float()
    torch.testing.assert_close(env.terms["energy"], power, rtol=1e-3, atol=1e-2)
    torch.testing.assert_close(step.reward, -0.0005 * power, rtol=1e-3, atol=1e-4)
    assert not env.imitation.any() and step.log["reward/energy"] > 0
    env.close()


def test_absolute_actions_have_a_scale_for_each_hinge(task):
    model = task.humanoid.model
    scale = range_scale(torch.tensor(model.jnt_range[1:]))
    ranges = torch.tensor([[-0.5, 0.25], [0.0, 3.0]])
    assert range_scale(ranges).tolist() == pytest.approx([0.6, torch.pi])
    env = task.env(2, auto_reset=False, threads=1)
    env.reset_to(torch.zeros(2, dtype=torch.long), torch.tensor([0, 9]))
    env.step(torch.full((2, env.num_actions), 0.5))
    # Zero offset: half the scale, wherever the reference is.
    torch.testing.assert_close(env.backend.drive.ctrl, (0.5 * scale).expand(2, -1), atol=1e-6, rtol=1e-6)
    env.close()
