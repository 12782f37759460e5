"""The scripted expert: what it asks for in each form of action, its limits, and how far it gets."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch

from poise.env import ImitationEnv
from poise.plan import Expert, ExpertConfig, make_plan
from refusals import refused
from toy_human import swing

N = 4
MakeEnv = Callable[..., ImitationEnv]


def started(make_env: MakeEnv, **settings: object) -> tuple[ImitationEnv, torch.Tensor]:
    env = make_env(N, auto_reset=False, **settings)
    return env, env.reset_to(torch.zeros(N, dtype=torch.long), torch.arange(N) * 5)


def test_on_the_reference_the_wrench_is_the_planned_one(make_env: MakeEnv) -> None:
    env, obs = started(make_env, help_limit=5000.0)
    expert = Expert(env)
    action = expert.act(obs)
    assert action.shape == (N, env.num_actions)
    rows = env.reference.rows(env.clip, env.frame)
    torch.testing.assert_close(action[:, -6:-3] * 5000, expert.plan.force_h[rows], atol=0.05, rtol=1e-3)
    torch.testing.assert_close(action[:, -3:] * 5000, expert.plan.torque_b[rows], atol=0.05, rtol=1e-3)


def test_a_push_is_answered_by_the_stated_spring(make_env: MakeEnv) -> None:
    env, obs = started(make_env, help_limit=5000.0)
    expert, mass = Expert(env), env.reference.humanoid.mass
    before = expert.act(obs)[:, -6:-3]
    qpos, qvel = env.backend.state.qpos.clone(), env.backend.state.qvel.clone()
    qpos[:, 2] -= 0.1
    qvel[:, 2] -= 0.2
    env.backend.write(None, qpos, qvel)
    c = expert.config.spring
    pull = mass * c.frequency**2 * 0.1 + 2 * c.damping * mass * c.frequency * 0.2
    change = (expert.act(obs)[:, -6:-3] - before) * 5000
    torch.testing.assert_close(change[:, 2], torch.full((N,), pull), atol=0.05, rtol=1e-3)
    torch.testing.assert_close(change[:, :2], torch.zeros(N, 2), atol=0.05, rtol=0)


def test_help_stays_within_its_limit(make_env: MakeEnv) -> None:
    env, obs = started(make_env, help_limit=30.0)
    expert = Expert(env)
    for _ in range(8):
        action = expert.act(obs)
        assert (action[:, -6:-3].norm(dim=-1) <= 1 + 1e-6).all()
        assert (action[:, -3:].norm(dim=-1) <= 1 + 1e-6).all()
        obs = env.step(action).obs
    none, obs = started(make_env, help_limit=0.0)
    assert not Expert(none).act(obs)[:, -6:].any()


def test_every_form_of_action_says_the_same_targets(make_env: MakeEnv) -> None:
    env, obs = started(make_env)
    joints = Expert(env).act(obs)[:, : env.hinges]
    target = joints + env.reference.qpos[env.reference.rows(env.clip, env.frame + 1), 7:].float()
    for settings in ({"action": "absolute"}, {"method": "deepmimic"}, {"method": "rfc-explicit"}):
        other, obs = started(make_env, **settings)
        action = Expert(other).act(obs)
        assert action.shape == (N, other.num_actions)
        now = action[:, : env.hinges]
        absolute = settings.get("action") == "absolute"
        torch.testing.assert_close(now, target if absolute else joints, atol=1e-5, rtol=1e-4)


def test_explicit_help_pulls_as_the_implicit_does(make_env: MakeEnv) -> None:
    wrenches = []
    for method in ("rfc-implicit", "rfc-explicit"):
        env, obs = started(make_env, method=method, help_limit=400.0)
        env.step(Expert(env).act(obs))
        assert env.wrench is not None
        wrenches.append((env.wrench.force.sum(1), env.wrench.torque.sum(1)))
    for a, b in zip(*wrenches, strict=True):
        torch.testing.assert_close(a, b, atol=0.1, rtol=1e-3)


def test_without_the_root_among_the_helped_bodies_there_is_no_expert(make_env: MakeEnv) -> None:
    env, _ = started(make_env, method="rfc-explicit")
    assert env.task.residual is not None
    env.task = replace(env.task, residual=replace(env.task.residual, bodies=(3,)))  # type: ignore[arg-type]
    with refused("residual-force-missing"):
        Expert(env)


def test_it_follows_where_doing_nothing_falls_behind(make_env: MakeEnv) -> None:
    def errors(act: bool) -> float:
        env, obs = started(make_env, clips=(swing(2.0),))
        expert, total = Expert(env), 0.0
        for _ in range(25):
            obs = env.step(expert.act(obs) if act else torch.zeros(N, env.num_actions)).obs
            ref = env.reference.gather(env.clip, env.frame)
            total += float((env.pose().pos - ref.pos).norm(dim=-1).mean()) / 25
        return total

    assert errors(True) < 0.5 * errors(False)


def test_a_plan_holds_every_clip_and_a_cycle_goes_on(make_env: MakeEnv) -> None:
    clips = (swing(1.0, cyclic=True, speed=1.0, name="a"), swing(2.0, name="b"))
    env = make_env(N, auto_reset=False, clips=clips)
    plan = make_plan(env.reference)
    assert len(plan.torque) == env.reference.frames and len(plan.parts) == 2
    beyond = env.reset_to(torch.zeros(N, dtype=torch.long), torch.full((N,), 40))
    expert = Expert(env, ExpertConfig(), plan)
    assert expert.act(beyond).isfinite().all()


def test_a_real_walk_is_followed_without_learning(data_dir) -> None:
    from poise.formats import read_clip
    from poise.jobs.warm_start import score_expert
    from poise.recipes.residual_force import build
    from poise.recipes.residual_force_settings import ResidualForce

    imitation = build(read_clip(data_dir / "cmu_amc/02/02_01.amc"), ResidualForce())
    card = score_expert(imitation)
    assert card.succ > 0.9 and card.mpjpe_mm < 30
    assert card.help.force_mean_n <= 100
