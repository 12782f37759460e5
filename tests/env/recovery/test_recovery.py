"""Falls and getting up, being far and coming back: kinds of episodes, the point goal, its reward."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from poise.env import DoneTerm, ImitationEnv, ObsTerm, Recovery
from poise.env import observations as obs
from poise.env import rewards as reward
from poise.env.recovery.clock import CONTINUED, FALLEN, FAR, TRACKED, RecoveryClock, toward
from poise.env.recovery.falls import Drop, lies
from poise.errors import PoiseError
from poise.learn import AmpConfig, PPOConfig
from poise.sim import CpuBackend
from refusals import refused
from toy_human import swing

#: Few falls and short waits, so that a test takes a moment.
FEW = Drop(count=6, steps=60)
QUICK = Recovery(grace=3, settle=2, drop=FEW)
WALK = swing(2.0, speed=1.0, name="walk")


@pytest.fixture(scope="module")
def built(make_phc):
    """The PHC task of a walk with Eq. 4's rewards; `recovery` is set by `env_of`."""
    task = make_phc(WALK)
    rewards = reward.recovery_terms(task.task.rewards)
    dones = (DoneTerm("too_far", reward.bodies_too_far),)
    return replace(task, task=replace(task.task, rewards=rewards, dones=dones, recovery=QUICK))


def env_of(
    built,
    worlds: int,
    recovery: Recovery = QUICK,
    auto_reset: bool = True,
    seed: int = 0,
    fused: bool = True,
    **kw,
):
    task = replace(built.task, recovery=recovery, auto_reset=auto_reset, **kw)
    if fused:
        return replace(built, task=task).env(worlds, seed, auto_reset, threads=1)
    backend = CpuBackend(built.model, worlds, 1)
    substeps = built.config.sim.substeps
    return ImitationEnv(built.reference, backend, task, substeps, seed, fused=False)


def rest(env: ImitationEnv) -> Tensor:
    return torch.zeros(env.num_envs, env.num_actions)


def at(worlds: int, frame: int) -> tuple[Tensor, Tensor]:
    """(clip, frame) of so many worlds on one frame of the first clip."""
    return torch.zeros(worlds, dtype=torch.long), torch.full((worlds,), frame)


def move(env: ImitationEnv, to: Tensor) -> None:
    """Puts roots at `to (N, 3)` m from their reference's, without a step."""
    state = env.backend.state
    qpos = state.qpos.clone()
    qpos[:, :3] = env.reference.gather(env.clip, env.frame).pos[:, 0].double() + to
    env.backend.write(None, qpos, state.qvel.clone())


# --- settings --------------------------------------------------------------------------------------


def test_settings_that_cannot_be_are_refused(built):
    for wrong in (
        {"fallen": 1.5}, {"continues": -0.1}, {"grace": -1}, {"distance": (3.0, 2.0)},
        {"switch": 5.0}, {"switch": 0.0},
    ):  # fmt: skip
        with pytest.raises(PoiseError):
            Recovery(**wrong)
    with refused("unknown-choice", says="gravity"):
        Drop(by="gravity")  # type: ignore[arg-type]
    with refused("recovery-off"):
        replace(built.task, recovery=None)


def test_paper_and_code_differ_where_they_do():
    paper, code = Recovery.phc("paper"), Recovery.phc("code")
    assert (paper.switch, paper.reach, paper.distance) == (0.5, 5.0, (2.0, 5.0))
    assert (code.switch, code.reach, code.drop.by) == (0.25, 3.0, "action")
    share = torch.tensor([0.0, 0.25, 1.0])
    assert paper.radius(share).tolist() == [2.0, 2.75, 5.0]
    assert code.radius(share).tolist() == [0.0, 2.5, 5.0]  # 5 sqrt(U)
    alone = Recovery.phc("code", "primitive")
    assert (alone.fallen, alone.continues, code.fallen, code.continues) == (1.0, 0.0, 0.3, 0.5)


# --- kinds of episodes -----------------------------------------------------------------------------


def test_episodes_begin_in_their_kinds_at_their_odds(built):
    env = env_of(built, 60, replace(QUICK, fallen=0.3, far=0.2))
    r, state = env.event(RecoveryClock), env.backend.state
    assert r is not None
    drawn = r.kinds(4000, torch.Generator().manual_seed(0))
    fallen, far = (drawn & FALLEN).bool(), (drawn & FAR).bool()
    for got, want in ((fallen, 0.3), (far, 0.2), (fallen & far, 0.06)):
        assert float(got.float().mean()) == pytest.approx(want, abs=0.03)
    env.reset()
    fallen, far = (r.kind & FALLEN).bool(), (r.kind & FAR).bool()
    assert {int(k) for k in r.kind.unique()} == {TRACKED, FALLEN, FAR, FALLEN | FAR}
    ref = env.reference.gather(env.clip, env.frame)
    apart = (state.qpos[:, :2] - ref.qpos[:, :2]).norm(dim=-1)
    assert float(apart[~far].max()) < 1e-6
    assert float(apart[far].min()) >= 2.0 and float(apart[far].max()) <= 5.0
    assert bool(lies(built.humanoid, state.qpos[fallen]).all()) and not state.qvel[fallen].any()
    assert torch.equal(state.qpos[~fallen, 2:], env.reference.qpos[env.frame][~fallen, 2:])
    height = (state.qpos[:, 2] - ref.qpos[:, 2]).abs()
    torch.testing.assert_close(r.before, (apart**2 + height**2).sqrt().float(), atol=1e-5, rtol=0)
    env.close()


def test_the_reference_waits_for_the_fallen_alone(built):
    env = env_of(built, 3, auto_reset=False)
    env.reset_to(*at(3, 5), torch.tensor([TRACKED, FALLEN, FAR]))
    goal = env.reference.gather(env.clip, env.frame + torch.tensor([1, 0, 1])).qpos
    torch.testing.assert_close(env.reference.layout.unpacked(env.goal.ahead()).qpos, goal)
    frames, goals = [], []
    for _ in range(5):
        env.step(rest(env))
        frames.append(env.frame.tolist())
        goals.append((env.goal.clips.row - env.reference.rows(env.clip, env.frame)).tolist())
    # Three steps of grace; after the last of them the reference goes on.
    assert frames == [[6, 5, 6], [7, 5, 7], [8, 5, 8], [9, 6, 9], [10, 7, 10]]
    assert goals == [[1, 0, 1], [1, 0, 1], [1, 1, 1], [1, 1, 1], [1, 1, 1]]
    assert env.age.tolist() == [5, 5, 5]
    env.close()


def test_who_recovers_cannot_fail_and_fails_again_once_settled(built):
    env = env_of(built, 2, auto_reset=False)
    env.reset_to(*at(2, 0), torch.tensor([FAR, TRACKED]))
    off = torch.tensor([[0.0, 3.0, 0.0], [0.0, 3.0, 0.0]])
    move(env, off)
    step = env.step(rest(env))
    assert step.failed.tolist() == [False, True] and step.terminated.tolist() == [False, True]
    spare = []
    for _ in range(5):
        move(env, 0.0 * off)
        step = env.step(rest(env))
        clock = env.event(RecoveryClock)
        assert clock is not None
        spare.append(int(clock.spare[0]))
    # 2 steps near, and one more after which failures count.
    assert spare == [2, 1, 0, 0, 0]
    move(env, off)
    assert env.step(rest(env)).failed.tolist() == [True, True]
    env.close()


def test_a_clip_does_not_end_for_who_recovers(built):
    env = env_of(built, 2, auto_reset=False)
    last = int(env.reference.length[0]) - 1
    env.reset_to(*at(2, last - 1), torch.tensor([FAR, TRACKED]))
    ends = [env.step(rest(env)).terminated.tolist() for _ in range(4)]
    assert [first for first, _ in ends] == [False] * 4 and ends[0][1]
    rows = env.reference.rows(env.clip, env.frame)
    assert int(rows[0]) == last
    env.close()


def test_failures_go_on_at_their_odds_and_the_reference_waits_where_it_was_going(built):
    env = env_of(built, 400, Recovery(0.0, 0.0, 0.4, grace=3, settle=2, drop=FEW))
    env.reset_to(*at(400, 7))
    move(env, torch.tensor([0.0, 3.0, 0.0]).expand(400, 3))
    step = env.step(rest(env))
    clock = env.event(RecoveryClock)
    assert clock is not None
    on = (clock.kind & CONTINUED).bool()
    assert float(on.float().mean()) == pytest.approx(0.4, abs=0.07)
    assert torch.equal(step.failed, ~on) and torch.equal(step.terminated, ~on)
    assert torch.equal(step.obs[on], step.final_obs[on]) and bool((env.age[on] == 1).all())
    frames = []
    for _ in range(6):
        step = env.step(rest(env))
        assert not step.failed[on].any()
        frames.append(int(env.frame[on].unique().item()))
    # It reaches the frame it made for, and waits there for three steps.
    assert frames == [9, 9, 9, 9, 10, 11]
    assert step.log["recovery/far"] > 0.3 and step.log["recovery/waiting"] < 0.1
    env.close()


def test_a_time_out_stays_one_where_a_failure_is_taken_back(built):
    env = env_of(built, 4, Recovery(0.0, 0.0, 1.0, drop=FEW), horizon=1)
    env.reset_to(*at(4, 0))
    move(env, torch.tensor([0.0, 3.0, 0.0]).expand(4, 3))
    step = env.step(rest(env))
    assert step.truncated.all() and not step.terminated.any() and not step.failed.any()
    assert not env.age.any()
    env.close()


# --- the point goal --------------------------------------------------------------------------------


def test_far_away_the_goal_is_a_point_and_near_all_of_the_motion(built):
    """3 and 12 m off to +x: the goal is the root alone, at most 5 m away; at 0.4 m it is the whole."""
    env = env_of(built, 3, auto_reset=False)
    env.reset_to(*at(3, 4))
    away = torch.tensor([0.4, 3.0, 12.0])
    move(env, torch.stack((-away, 0 * away, 0 * away), -1))
    frame, whole = env.view(), env.reference.gather(env.clip, env.frame + 1)
    sim, ahead, bodies = frame.sim, frame.ahead, len(built.humanoid.bodies)
    assert frame.point is not None and ahead is not None
    assert frame.point.far.tolist() == [False, True, True]
    torch.testing.assert_close(frame.point.distance, away)
    for name in ("qpos", "qvel", "pos", "quat", "linvel", "angvel", "com", "local"):
        theirs, own = getattr(ahead, name), getattr(sim, name)
        assert torch.equal(theirs[0], getattr(whole, name)[0]), name
        if name in ("qvel", "linvel", "angvel", "com", "local"):
            assert torch.equal(theirs[1:], own[1:]), name
    assert torch.equal(ahead.pos[1:, 1:], sim.pos[1:, 1:])
    assert torch.equal(ahead.quat[1:, 1:], sim.quat[1:, 1:])
    assert torch.equal(ahead.quat[1:, 0], whole.quat[1:, 0])
    torch.testing.assert_close(ahead.pos[1, 0], whole.pos[1, 0])
    to = ahead.pos[2, 0] - sim.pos[2, 0]
    assert float(to.norm()) == pytest.approx(5.0, abs=1e-4)
    true = whole.pos[2, 0] - sim.pos[2, 0]
    torch.testing.assert_close(to / 5.0, true / true.norm())
    # As the goals tell it: no body differs from its own but the root.
    rotation = obs.rotation_goal(frame)[1].split([3 * bodies] * 4 + [6 * bodies] * 2)
    for part in rotation[:3]:
        assert not part.unflatten(0, (bodies, 3))[1:].any()
    assert not rotation[1].any() and not rotation[2].any()
    same = torch.tensor([1.0, 0, 0, 0, 1, 0]).expand(bodies - 1, 6)
    torch.testing.assert_close(rotation[5].unflatten(0, (bodies, 6))[1:], same, atol=1e-6, rtol=0)
    keys = obs.keypoint_goal(frame)[1].unflatten(0, (3, bodies, 3))
    assert not keys[0, 1:].any() and not keys[1].any() and float(keys[0, 0].norm()) > 2.9
    env.close()


@pytest.mark.parametrize("goal", [obs.rotation_goal, obs.keypoint_goal])
def test_what_a_policy_sees_of_a_point_does_not_depend_on_how_the_reference_moves(built, goal):
    terms = (ObsTerm("self", obs.self_state), ObsTerm("goal", goal))
    env = env_of(built, 2, auto_reset=False, obs=terms)
    env.reset_to(*at(2, 3))
    move(env, torch.tensor([[0.0, 2.0, 0.0]] * 2))
    frame = env.view()
    assert frame.ahead is not None
    other = env.reference.gather(env.clip, torch.tensor([4, 40]))
    qpos = frame.sim.qpos  # Another moment of the clip, its root at the same place and turn.
    root = other.pos[:1, 0], other.quat[:1, 0]
    alike = replace(
        other,
        pos=torch.cat((root[0].expand(2, 1, 3), other.pos[:, 1:]), 1),
        quat=torch.cat((root[1].expand(2, 1, 4), other.quat[:, 1:]), 1),
    )
    aims = toward(frame.sim, alike, torch.ones(2, dtype=torch.bool), 5.0)
    seen = goal(frame.replaced(ahead=aims))
    assert len(qpos) == 2
    torch.testing.assert_close(seen[0], seen[1])
    env.close()


# --- rewards ---------------------------------------------------------------------------------------


def test_the_point_goals_reward_by_hand(built):
    env = env_of(built, 3, auto_reset=False)
    env.reset_to(*at(3, 4))
    move(env, torch.tensor([[0.0, 0.1, 0.0], [0.0, 3.0, 0.0], [0.0, 9.0, 0.0]]))
    clock = env.event(RecoveryClock)
    assert clock is not None
    clock.before.copy_(torch.tensor([0.3, 3.1, 8.0]))
    step = env.step(rest(env))
    now = (env.pose().pos[:, 0] - env.reference.gather(env.clip, env.frame).pos[:, 0]).norm(dim=-1)
    point, energy = env.terms["point_goal"], env.terms["energy_far"]
    expected = [0.0, 3.1 - float(now[1]), 8.0 - float(now[2])]
    torch.testing.assert_close(point, torch.tensor(expected), atol=1e-5, rtol=0)
    torch.testing.assert_close(env.event(RecoveryClock).before, now)
    # Imitation counts near the reference alone.
    assert env.terms["body_velocities"].gt(0).tolist() == [True, False, False]
    assert env.imitation.gt(0).tolist() == [True, False, False]
    torch.testing.assert_close(step.reward[1:], (point - 0.0001 * energy)[1:])
    env.close()


def test_the_codes_reward_counts_progress_everywhere_and_imitation_by_half(built):
    plain = (*built.task.rewards,)
    assert [t.when for t in plain] == ["near"] * 5 + ["far", "far"]
    base = tuple(replace(t, when="always") for t in plain[:5])
    code = {t.name: t for t in reward.recovery_terms(base, "code")}
    assert code["body_positions"].weight == 0.25 and code["body_positions"].when == "near"
    assert code["energy"].weight == base[4].weight and code["energy"].when == "always"
    paper = {t.name: t for t in reward.recovery_terms(base)}
    assert paper["energy_far"].weight == pytest.approx(0.1 * base[4].weight)
    env = env_of(built, 3, rewards=tuple(code.values()))
    frame = env.view()
    before, now = torch.tensor([1.0, 3.0, 2.0]), torch.tensor([0.9, 2.0, 2.5])
    assert frame.point is not None
    frame = frame.replaced(point=frame.point._replace(before=before, distance=now))
    term = code["point_goal"]
    # 9 x 0.1; a metre counts as a third; going away costs.
    torch.testing.assert_close(term.fn(frame, **term.params), torch.tensor([0.9, 3.0, -4.5]))
    assert term.when == "always"
    env.close()


# --- the rest of the environment -------------------------------------------------------------------


def rollout(env: ImitationEnv, steps: int, seed: int = 0) -> list[Tensor]:
    out, rng = [], torch.Generator().manual_seed(seed)
    for _ in range(steps):
        s = env.step(0.1 * torch.randn(env.num_envs, env.num_actions, generator=rng))
        out += [s.obs.clone(), s.reward, s.terminated, s.truncated, s.final_obs, env.frame.clone()]
    return out


def test_state_continues_bit_for_bit(built):
    config = Recovery(grace=4, settle=2, drop=FEW)
    clips = env_of(built, 12, config, horizon=9)
    clips.reset()
    rollout(clips, 6)
    saved = {k: v.clone() for k, v in clips.state().items()}
    other = env_of(built, 12, config, seed=5, horizon=9)
    other.load_state(saved)
    ours, theirs = rollout(clips, 25, 1), rollout(other, 25, 1)
    assert all(torch.equal(a, b) for a, b in zip(ours, theirs, strict=True))
    assert clips.event(RecoveryClock) is not None and other.event(RecoveryClock) is not None
    assert len(clips.event(RecoveryClock).kind.unique()) > 2
    assert torch.equal(clips.event(RecoveryClock).table, other.event(RecoveryClock).table)
    # A state from before recovery goes on as tracked.
    old = {k: v for k, v in saved.items() if k not in ("recovery", "falls")}
    other.load_state(old)
    assert not other.event(RecoveryClock).table.any()
    clips.close()
    other.close()


def test_one_seed_is_one_run_fused_or_not(built):
    runs = []
    for seed, fused in ((1, True), (1, True), (2, True), (1, False)):
        env = env_of(built, 8, seed=seed, fused=fused, horizon=9)
        env.reset()
        runs.append(rollout(env, 15))
        assert torch.allclose(runs[-1][-6], env.observe(), atol=2e-5)
        env.close()
    assert all(torch.equal(a, b) for a, b in zip(runs[0], runs[1], strict=True))
    assert not all(torch.equal(a, b) for a, b in zip(runs[0], runs[2], strict=True))
    torch.testing.assert_close(runs[0][:12], runs[3][:12], atol=1e-4, rtol=1e-4)


def test_a_cyclic_reference_waits_where_it_has_come_to(built, make_phc):
    task = make_phc(swing(0.5, speed=1.0, bend=0.4, cyclic=True, name="round"))
    task = replace(task, task=replace(task.task, recovery=QUICK, auto_reset=False))
    env = task.env(2, 0, False, threads=1)
    env.reset_to(*at(2, 20), torch.tensor([FALLEN, FAR]))
    for k in range(6):
        env.step(rest(env))
        ahead = env.frame + (torch.tensor([0, 1]) if k < 2 else 1)
        goal = env.reference.gather(env.clip, ahead)
        torch.testing.assert_close(env.reference.layout.unpacked(env.goal.ahead()).pos, goal.pos)
    assert env.frame.tolist() == [23, 26]
    env.close()


def test_a_task_without_recovery_is_as_before(built, make_phc):
    """Odds of 0 and no world far: the same numbers as without any recovery, bit for bit."""
    task = make_phc(WALK)
    plain = task.env(6, 3, False, threads=1)
    assert plain.event(RecoveryClock) is None and "recovery" not in plain.state()
    with refused("recovery-off"):
        plain.reset_to(*at(6, 0), torch.full((6,), FALLEN))
    never = Recovery(0.0, 0.0, 0.0, switch=50.0, reach=60.0)
    idle = replace(task, task=replace(task.task, recovery=never)).env(6, 3, False, threads=1)
    for env in (plain, idle):
        env.reset_to(torch.zeros(6, dtype=torch.long), torch.arange(6) * 5)
    for a, b in zip(rollout(plain, 3)[:12], rollout(idle, 3)[:12], strict=True):
        torch.testing.assert_close(a, b)
    plain.close()
    idle.close()


def test_the_motion_prior_is_not_told_that_the_clip_led_to_a_fall(built):
    env = env_of(built, 3, auto_reset=False)
    env.reset_to(*at(3, 20), torch.tensor([TRACKED, FALLEN, FAR]))
    past = env.past(torch.arange(3), 4)
    assert past is not None
    assert past.isnan().flatten(1).any(1).tolist() == [False, True, False]
    assert math.isfinite(float(past[[0, 2]].sum()))
    env.close()


def test_a_trainer_with_a_motion_prior_goes_on_where_it_stopped(built):
    ppo = PPOConfig(horizon=6, epochs=1, minibatch=24, policy_hidden=(8,), value_hidden=(8,), std=0.05)
    prior = AmpConfig(hidden=(8,), frames=3, steps=1, minibatch=16, kept=32)
    task = replace(built, task=replace(built.task, horizon=9))
    first, second = (task.trainer(threads=1, ppo=ppo, style=prior) for _ in range(2))
    first.iterate()
    second.load_state(first.state())
    first.iterate()
    second.iterate()
    ours, theirs = first.state(), second.state()
    # The counters hold the time on the clock.
    assert [k for k in ours if not torch.equal(ours[k], theirs[k])] == ["trainer/counters"]
    assert "env/recovery" in ours and len(ours) == len(theirs)
    for trainer in (first, second):
        trainer.env.close()
