"""What the perpetual recipe may observe, filter and price beside the paper's, and what it then does."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from poise.env import ImitationEnv
from poise.env.evaluate import seen_by
from poise.env.stream_goal import StreamGoal
from poise.learn import PPOConfig
from poise.motion.rotations import axis_angle_to_quat, lateral_heading, quat_mul
from poise.papers.perpetual.ablations import StagedPerpetual
from poise.recipes.imitation import Imitation
from poise.recipes.perpetual import build
from poise.recipes.perpetual_settings import Perpetual, config_of
from poise.settings import to_data
from poise.sim import make_backend
from refusals import refused
from toy_library import PLAIN, library, tiny

HERE = torch.tensor([0, 1, 2, 2])


def built(**changes: object) -> Imitation:
    return build(library(), tiny(**({"action": "additive"} | PLAIN | changes)))


def an_env(**changes: object) -> ImitationEnv:
    return built(**changes).env(4, threads=1, auto_reset=False)


def actions(env: ImitationEnv, count: int = 3) -> torch.Tensor:
    rng = torch.Generator().manual_seed(0)
    return 0.1 * torch.randn(count, env.num_envs, env.num_actions, generator=rng)


# --- settings -------------------------------------------------------------------------------------


def test_settings_of_before_mean_the_twist_and_nothing_new() -> None:
    old = to_data(Perpetual())
    prices = ("action_rate", "torque_rate", "acceleration", "foot_slide")
    for name in ("heading", "window", "filter", "root", *prices):
        del old[name]
    assert config_of(old) == Perpetual(heading="twist") != Perpetual()
    assert StagedPerpetual.paper().heading == StagedPerpetual.code().heading == "twist"
    assert config_of(to_data(Perpetual(window=(2, 4, 8)))).window == (2, 4, 8)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"window": (1, 2)}, ("out-of-range", "window")),
        ({"window": (4, 2)}, ("not-rising", "window")),
        ({"filter": 1.0}, ("out-of-range", "filter")),
        ({"foot_slide": -0.1}, ("out-of-range", "foot_slide")),
        ({"acceleration": -0.1}, ("out-of-range", "acceleration")),
        ({"heading": "nose"}, ("unknown-choice", ("heading", "nose"))),
    ],
)
def test_settings_that_cannot_be_are_refused(changes: dict[str, object], said: tuple) -> None:
    with refused(*said):
        tiny(**changes)


@pytest.mark.parametrize(
    ("name", "value", "term"),
    [
        ("filter", 0.5, "last_action"),
        ("window", (3,), "goal_in_3"),
        ("root", 0.2, "root_position"),
        ("action_rate", 1.0, "action_rate"),
        ("torque_rate", 1.0, "torque_rate"),
        ("acceleration", 1.0, "acceleration"),
        ("foot_slide", 1.0, "foot_slide"),
    ],
)
def test_a_setting_brings_its_term_in(name: str, value: object, term: str) -> None:
    plain, with_it = built().task, built(**{name: value}).task
    names = [{t.name for t in (*task.obs, *task.rewards)} for task in (plain, with_it)]
    assert names[1] - names[0] == {term}
    env = built(**{name: value}).env(4, threads=1)
    done = env.step(actions(env, 1)[0])
    assert done.obs.isfinite().all() and done.reward.isfinite().all()
    env.close()


# --- heading --------------------------------------------------------------------------------------


def test_all_headings_of_an_environment_are_those_of_the_hips() -> None:
    env = an_env(heading="hips", style=Perpetual().style)
    left = torch.tensor(env.goal.humanoid.left)
    assert float(left.norm()) == pytest.approx(1.0, abs=1e-6)
    env.reset_to(HERE, HERE * 2)
    env.step(actions(env, 1)[0])
    frame = env.view()
    for pose in (frame.sim, frame.ref, frame.ahead, env.pose(), env.goal_pose()):
        assert torch.equal(pose.heading, lateral_heading(pose.qpos[:, 3:7], left))
    # A clip is seen as a character that does it: what a motion prior sees of both is the same.
    env.reset_to(HERE, HERE * 2)
    row = env.reference.rows(HERE, HERE * 2)
    seen = seen_by(env.task.style, env.view())
    torch.testing.assert_close(env.clip_features(row), seen, atol=2e-4, rtol=1e-3)
    env.close()


def test_nothing_observed_depends_on_where_it_looks_and_hips_do_not_jump_upside_down() -> None:
    env = an_env(heading="hips", window=(2,))
    twist = an_env(heading="twist", window=(2,))
    far = {}
    left = torch.tensor(env.goal.humanoid.left, dtype=torch.float64)
    for name, one in (("hips", env), ("twist", twist)):
        one.reset_to(HERE, HERE)
        qpos, qvel = (x.clone() for x in (one.backend.state.qpos, one.backend.state.qvel))
        qpos[:, 2] += 2.0
        seen = []
        # A degree before and a degree behind standing on its head.
        for angle in (3.12, 3.16):
            over = axis_angle_to_quat(left, torch.tensor(angle).double())
            there = qpos.clone()
            there[:, 3:7] = quat_mul(qpos[:, 3:7], over.expand(4, 4))
            one.backend.write(None, there, qvel)
            seen.append(one.observe()[:, 1:40].clone())
        far[name] = float((seen[0] - seen[1]).abs().amax())
        one.close()
    assert far["hips"] < 0.1 and far["twist"] > 0.5


# --- filter ---------------------------------------------------------------------------------------


def test_what_acts_is_filtered_and_observed_and_the_first_action_is_taken_as_it_is() -> None:
    env = an_env(filter=0.75)
    env.reset_to(HERE, HERE)
    given, last = actions(env), None
    where = env.columns["last_action"].start
    for u in given:
        before = u.clone()
        obs = env.step(u).final_obs
        want = u if last is None else 0.25 * u + 0.75 * last
        torch.testing.assert_close(env.action, want)
        assert torch.equal(obs[:, where:], env.action) and torch.equal(u, before)
        assert torch.equal(env.given, u)
        ref = env.reference.hinges[env.reference.rows(env.clip, env.frame)]
        torch.testing.assert_close(env.backend.drive.ctrl, ref + want, atol=1e-6, rtol=0)
        last = env.action.clone()
    env.close()


def test_unfiltered_states_what_acts() -> None:
    env, plain = an_env(filter=0.9), an_env()
    for one in (env, plain):
        one.reset_to(HERE, HERE)
    for u in actions(env, 5):
        env.step(env.unfiltered(u))
        plain.step(plain.unfiltered(u))
        torch.testing.assert_close(env.action, u, atol=1e-6, rtol=0)
        torch.testing.assert_close(
            env.backend.state.qpos, plain.backend.state.qpos, atol=1e-4, rtol=1e-4
        )
    assert plain.unfiltered(u) is u
    env.close()
    plain.close()


# --- window ---------------------------------------------------------------------------------------


def test_a_window_tells_the_frames_of_the_clip() -> None:
    env = an_env(window=(2, 4))
    env.reset_to(HERE, HERE * 3)
    window = env.view().window
    assert window.pos.shape == (4, 2, len(env.goal.humanoid.bodies), 3)
    for i, k in enumerate((2, 4)):
        assert torch.equal(window.pos[:, i], env.reference.gather(HERE, HERE * 3 + k).pos)
    one = env.observe()[1:2].clone()
    env.close()
    # A world that begins anew by itself sees its own window, too.
    fresh = built(window=(2, 4), horizon=2).env(4, threads=1)
    for u in actions(fresh, 2):
        obs = fresh.step(u).obs
    torch.testing.assert_close(obs, fresh.observe(), atol=2e-5, rtol=1e-4)
    fresh.close()
    assert one.isfinite().all()


def test_a_stream_repeats_its_last_frame() -> None:
    task = built(window=(2, 4))
    frames, stream = task.reference.qpos[:6], StreamGoal(task.humanoid, task.config.sim.control_hz)
    stream.push(frames[0])
    backend = make_backend(task.model, 1)
    own = replace(task.task, auto_reset=False, help_by="all")
    env = ImitationEnv(stream, backend, own, task.config.sim.substeps)
    env.reset()
    stream.push(frames[1])
    env.step(torch.zeros(1, env.num_actions))
    stream.push(frames[2])
    told = env.view()
    torch.testing.assert_close(told.ahead.qpos[0], frames[2].float())
    for i in range(2):
        assert torch.equal(told.window.qpos[:, i], told.ahead.qpos)
    env.close()


def test_keypoints_tell_no_heading_of_later_frames() -> None:
    task = built(goal="keypoints", window=(2,), action="absolute").task
    assert task.obs[-1].params["turns"] is False


def test_prices_follow_the_task_weight_of_a_prior() -> None:
    style = Perpetual().style
    assert style is not None
    for prior in (None, style):
        rewards = {t.name: t.weight for t in built(foot_slide=0.3, style=prior).task.rewards}
        share = 1.0 if prior is None else prior.task_weight
        assert rewards["foot_slide"] == pytest.approx(-0.3 / share)


def test_costs_of_an_environment_are_those_of_its_steps() -> None:
    env = an_env(action_rate=1.0, torque_rate=1.0, filter=0.5)
    env.reset_to(HERE, HERE)
    limits = torch.tensor(env.goal.humanoid.model.actuator_forcerange[:, 1]).float()
    action = torque = None
    for u in actions(env):
        env.step(u)
        now = env.view().torque.clone()
        if action is None:
            assert not env.terms["action_rate"].any() and not env.terms["torque_rate"].any()
        else:
            want = (env.action - action).square().mean(-1)
            torch.testing.assert_close(env.terms["action_rate"], want)
            want = ((now - torque) / limits).square().mean(-1)
            torch.testing.assert_close(env.terms["torque_rate"], want)
        action, torque = env.action.clone(), now
    env.close()


def test_acceleration_is_how_velocities_change_otherwise_than_the_goals() -> None:
    env = an_env(acceleration=1.0)
    env.reset_to(HERE, HERE)
    for u in actions(env):
        before = env.pose().linvel - env.goal_pose().linvel
        env.step(u)
        after = env.pose().linvel - env.goal_pose().linvel
        want = (after - before).norm(dim=-1).mean(-1)
        torch.testing.assert_close(env.terms["acceleration"], want)
        assert want.min() > 0
    env.close()


@pytest.mark.parametrize("goal", ["rotations", "keypoints"])
@pytest.mark.parametrize("shape", [False, True])
def test_what_smooth_policies_do_not_answer_to_are_the_goals_velocities(goal: str, shape: bool) -> None:
    given = {"goal": goal, "shape": shape, "window": (2,), "action": "absolute"}
    imitation = built(**given)
    env = imitation.env(4, threads=1, auto_reset=False)
    env.reset()
    frame, parts = env.view(), [env.columns[name] for name in imitation.task.velocities]
    first, last = parts[0].start, parts[-1].stop
    before = seen_by(imitation.task.obs, frame)
    frame.ahead.linvel.add_(1.0)
    frame.ahead.angvel.add_(1.0)
    moved = (seen_by(imitation.task.obs, frame) != before).any(0).nonzero().flatten()
    assert moved[0] == first and moved[-1] == last - 1 and len(moved) == last - first
    wanted = built(**given, ppo=PPOConfig(smooth_weight=0.1)).ppo().smooth_over
    assert wanted == (first, last) and imitation.ppo().smooth_over is None
    env.close()
