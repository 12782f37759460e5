"""PPO by numbers on toy tensors, and on a toy task."""

from dataclasses import replace

import pytest
import torch
from toy_point_env import LIMIT, PointEnv

from poise.learn import (
    LAST_GOOD,
    PPO,
    PPOConfig,
    Rollout,
    StepResult,
    Trainer,
    Until,
    load_policy,
    run,
)
from poise.learn.networks import gaussian_kl, gaussian_log_prob
from poise.learn.ppo import clipped_surrogate
from poise.learn.rollout import Episodes, collect
from refusals import refused

TOY = PPOConfig(
    std=0.3,
    policy_lr=1e-3,
    value_lr=1e-3,
    policy_hidden=(32,),
    value_hidden=(32,),
    minibatch=256,
)


def test_the_ratio_is_clipped_on_the_side_that_would_gain():
    ratio = torch.tensor([1.5, 1.5, 0.5, 0.5, 1.1], requires_grad=True)
    advantage = torch.tensor([1.0, -1.0, 1.0, -1.0, 2.0])
    loss = clipped_surrogate(ratio.log(), torch.zeros(5), advantage, clip=0.2)
    # min(r A, clip(r) A) = 1.2, -1.5, 0.5, -0.8, 2.2: the mean is 0.32.
    torch.testing.assert_close(loss.item(), -0.32)
    loss.backward()
    assert ratio.grad is not None
    torch.testing.assert_close(ratio.grad, -torch.tensor([0.0, -1.0, 1.0, 0.0, 2.0]) / 5)


def filled(ppo: PPO, horizon: int = 8, num_envs: int = 16, seed: int = 0) -> Rollout:
    g = torch.Generator().manual_seed(seed)
    rollout = Rollout(horizon, num_envs, ppo.actor.num_obs, ppo.actor.num_actions, torch.device("cpu"))
    rollout.obs.copy_(torch.randn(rollout.obs.shape, generator=g))
    with torch.no_grad():
        policy = ppo.actor.policy
        rollout.action.copy_(policy.act(rollout.obs[:-1], g))
        rollout.mean.copy_(policy(rollout.obs[:-1]))
        rollout.log_prob.copy_(gaussian_log_prob(rollout.action, rollout.mean, policy.log_std))
    rollout.reward.copy_(10 + torch.randn(rollout.reward.shape, generator=g))
    return rollout


def test_time_outs_are_bootstrapped_with_the_state_reached():
    ppo = PPO(4, 2, TOY, seed=0)
    rollout = filled(ppo)
    rollout.truncated[3, 5] = True
    rollout.cut_at = torch.tensor([3 * 16 + 5])
    rollout.cut_obs = torch.ones(1, 4)
    ppo.estimate(rollout)
    with torch.no_grad():
        reached = ppo.value(torch.ones(4))
        torch.testing.assert_close(rollout.next_value[3, 5], reached)
        torch.testing.assert_close(rollout.next_value[2, 5], ppo.value(rollout.obs[3, 5]))
    want = rollout.reward[3, 5] + TOY.gamma * reached
    torch.testing.assert_close(rollout.returns[3, 5], want)

    as_failure = PPO(4, 2, replace(TOY, bootstrap_timeouts=False), seed=0)
    as_failure.estimate(rollout)
    torch.testing.assert_close(rollout.returns[3, 5], rollout.reward[3, 5])


def test_rescaled_returns_leave_the_values_unchanged():
    # Nothing is learned, so that the scale of the returns alone changes.
    ppo = PPO(4, 2, replace(TOY, policy_lr=1e-12, value_lr=1e-12), seed=0)
    obs = torch.randn(50, 4, generator=torch.Generator().manual_seed(1))
    first, second = filled(ppo), filled(ppo, seed=1)
    ppo.update(first)
    before, returns = ppo.value(obs).detach(), first.returns
    # A fresh critic predicts the mean return.
    assert abs(float(before.mean() - returns.mean())) < 0.5 * float(returns.std())
    second.reward.mul_(10.0)
    ppo.update(second)
    assert float(ppo.return_norm.std) > 3 * float(returns.std())
    assert abs(float(ppo.return_norm.mean - before.mean())) > 100
    torch.testing.assert_close(ppo.value(obs), before, rtol=1e-4, atol=1e-4)


def test_warm_up_trains_only_the_critic():
    ppo = PPO(4, 2, TOY, seed=0)
    before = ppo.state()
    stats = ppo.update(filled(ppo), train_policy=False)
    after = ppo.state()
    assert stats.kl == stats.policy_loss == 0.0
    for name, value in before.items():
        if name.startswith("policy/"):
            assert torch.equal(value, after[name]), name
    assert not torch.equal(before["critic/layers.0.weight"], after["critic/layers.0.weight"])
    ppo.update(filled(ppo, seed=1))
    assert not torch.equal(
        ppo.state()["policy/mean.layers.0.weight"], before["policy/mean.layers.0.weight"]
    )


def test_the_reported_kl_is_that_of_the_old_and_new_policy():
    # With one minibatch per epoch the last epoch's KL is measured before its own step.
    ppo = PPO(4, 2, replace(TOY, products="float32", epochs=2, minibatch=10_000), seed=0)
    rollout = filled(ppo)
    one = PPO(4, 2, replace(TOY, products="float32", epochs=1, minibatch=10_000), seed=0)
    kl = ppo.update(rollout).kl
    one.update(filled(one))
    with torch.no_grad():
        mean = one.actor.policy(rollout.obs[:-1])
    log_std = one.actor.policy.log_std.detach()
    torch.testing.assert_close(kl, gaussian_kl(rollout.mean, log_std, mean, log_std).mean().item())


@pytest.mark.parametrize(("target", "factor"), [(1e-9, 1 / 1.5), (10.0, 1.5)])
def test_the_lr_follows_the_kl(target, factor):
    ppo = PPO(4, 2, replace(TOY, kl_target=target), seed=0)
    assert ppo.update(filled(ppo)).policy_lr == pytest.approx(1e-3 * min(factor, 1.0))
    wide = PPO(4, 2, replace(TOY, kl_target=target, lr_range=(1e-5, 1.0)), seed=0)
    assert wide.update(filled(wide)).policy_lr == pytest.approx(1e-3 * factor)


def test_too_large_a_kl_stops_the_policy_but_not_the_critic():
    wild = replace(TOY, policy_lr=0.3, minibatch=32, epochs=6, policy_grad_norm=None)
    free, stopped = PPO(4, 2, replace(wild, kl_stop=None), 0), PPO(4, 2, replace(wild, kl_stop=0.5), 0)
    kl_free, kl_stopped = free.update(filled(free)).kl, stopped.update(filled(stopped)).kl
    assert kl_free > 5 * kl_stopped > 0
    for a, b in zip(free.critic.parameters(), stopped.critic.parameters(), strict=True):
        assert torch.equal(a, b)


def test_a_bound_pulls_the_mean_inside():
    config = replace(TOY, bound_weight=100.0, bound_limit=0.0, epochs=20)
    ppo = PPO(4, 2, config, seed=0)
    with torch.no_grad():
        ppo.actor.policy.mean.last.bias.fill_(1.0)
    rollout = filled(ppo)
    ppo.update(rollout)
    with torch.no_grad():
        assert float(ppo.actor.policy(rollout.obs[:-1]).abs().mean()) < float(rollout.mean.abs().mean())


def test_a_smooth_policy_answers_alike_to_states_that_are_near():
    def rough(ppo):
        g = torch.Generator().manual_seed(7)
        obs = torch.randn(4096, 4, generator=g)
        near = obs + 0.4 * torch.randn(obs.shape, generator=g)
        with torch.no_grad():
            policy = ppo.actor.policy
            kl = gaussian_kl(policy(obs), policy.log_std, policy(near), policy.log_std)
            return kl.mean().item()

    made = replace(TOY, smooth_weight=1.0, smooth_noise=0.4)
    plain, smooth = PPO(4, 2, TOY, seed=0), PPO(4, 2, made, seed=0)
    with torch.no_grad():
        for ppo in (plain, smooth):
            ppo.actor.policy.mean.last.weight.mul_(30.0)
    before = rough(plain)
    for k in range(10):
        plain.update(filled(plain, seed=k))
        smooth.update(filled(smooth, seed=k))
    assert rough(smooth) < 0.6 * before < 0.9 * rough(plain)


def test_a_policy_may_be_smooth_over_some_columns_alone():
    ppo = PPO(4, 2, replace(TOY, smooth_weight=1.0, smooth_over=(1, 3)), seed=0)
    near = ppo.near(torch.zeros(8, 4))
    assert (near[:, [0, 3]] == 0).all() and near[:, 1:3].std() == pytest.approx(0.8, rel=0.1)
    with refused("not-rising", says="smooth_over"):
        replace(TOY, smooth_over=(3, 3))
    with refused("index-outside", says=("5", "4")):
        PPO(4, 2, replace(TOY, smooth_over=(1, 5)), seed=0)


def test_a_learned_deviation_moves_and_a_fixed_one_does_not():
    for learn in (False, True):
        ppo = PPO(4, 2, replace(TOY, learn_std=learn, entropy_weight=1.0), seed=0)
        assert (ppo.update(filled(ppo)).std > 0.301) == learn


@pytest.mark.parametrize(("value", "normalised"), [(1e38, False), (torch.inf, True)])
def test_a_broken_loss_names_itself_and_keeps_the_weights(value, normalised):
    ppo = PPO(4, 2, replace(TOY, normalise_returns=normalised), seed=0)
    ppo.update(filled(ppo))
    before, rollout = ppo.state(), filled(ppo, seed=1)
    rollout.reward[2, 3] = value
    with refused("training-diverged", says="value loss"):
        ppo.update(rollout)
    after = ppo.state()
    assert before.keys() == after.keys()
    for name in before:
        assert torch.equal(before[name], after[name]), name
    ppo.update(filled(ppo, seed=2))


class Faulty(PointEnv):
    """Breaks one number at the 20th step."""

    broken = "reward"

    def step(self, actions: torch.Tensor) -> StepResult:
        step = super().step(actions)
        self.steps = getattr(self, "steps", 0) + 1
        if self.steps == 20:
            getattr(step, self.broken)[7] = torch.nan
            return step._replace(log={"pose": float("nan"), "energy": 1.0})
        return step


@pytest.mark.parametrize(
    ("broken", "words"),
    [
        ("reward", ("environment row 7", "reward", "pose")),
        ("obs", ("environment row 7, entry 0", "observation")),
    ],
)
def test_a_broken_environment_is_named(broken, words):
    env = Faulty(16)
    env.broken = broken
    trainer = Trainer(env, replace(TOY, norm_warmup=8, horizon=4))
    trainer.iterate()
    trainer.iterate()
    before = trainer.ppo.actor.policy.mean.last.weight.detach().clone()
    with refused("training-diverged", says=words):
        trainer.iterate()
    assert torch.equal(before, trainer.ppo.actor.policy.mean.last.weight)


def test_a_run_that_breaks_keeps_the_last_good_policy(tmp_path):
    trainer = Trainer(Faulty(16), replace(TOY, norm_warmup=8, horizon=4))
    with refused("training-diverged"):
        run(trainer, Until(iterations=9), tmp_path, every=5, tensorboard=False)
    kept = load_policy(tmp_path / LAST_GOOD)
    assert kept.meta["metadata"]["iteration"] == 2
    assert torch.equal(kept.policy.mean.last.weight, trainer.policy().policy.mean.last.weight)


def test_a_rollout_records_what_was_seen_done_and_reached():
    env, ppo = PointEnv(6), PPO(4, 2, TOY, seed=0)
    rollout = Rollout(LIMIT + 3, 6, 4, 2, env.device)
    episodes = Episodes(6, env.device)
    actor = ppo.actor
    obs = collect(env, actor.policy, actor.norm, rollout, env.reset(), episodes, ppo.noise)
    # All rows time out together at step LIMIT; the toy's state follows from its action.
    last = LIMIT - 1
    assert rollout.truncated.nonzero()[:, 0].tolist() == [last] * 6
    assert rollout.cut_at.tolist() == [last * 6 + n for n in range(6)]
    reached = rollout.obs[last, :, :2] + 0.2 * rollout.action[last]
    torch.testing.assert_close(rollout.cut_obs, torch.cat([reached, rollout.obs[last, :, 2:]], -1))
    torch.testing.assert_close(rollout.obs[1, :, :2], rollout.obs[0, :, :2] + 0.2 * rollout.action[0])
    assert torch.equal(rollout.obs[-1], obs)
    with torch.no_grad():
        want = gaussian_log_prob(rollout.action, *actor.policy.distribution(rollout.obs[:-1]))
    torch.testing.assert_close(rollout.log_prob, want)
    assert episodes.finished == 6 and episodes.finished_length == 6 * LIMIT and episodes.failures == 0
    assert episodes.length.tolist() == [3] * 6
    assert float(actor.norm.count) == 6 * (LIMIT + 3)
    d = (rollout.cut_obs[:, :2] - rollout.cut_obs[:, 2:]).norm(dim=-1)
    torch.testing.assert_close(rollout.reward[last], (-(d**2)).exp())


def test_ppo_solves_the_toy_task_and_the_seed_decides_the_numbers():
    runs = []
    for seed in (1, 1, 2):
        trainer = Trainer(PointEnv(64), TOY, seed=seed)
        runs.append([trainer.iterate() for _ in range(3)])
    rewards = [[s.reward for s in run] for run in runs]
    assert rewards[0] == rewards[1] != rewards[2]

    trainer = Trainer(PointEnv(64), TOY, seed=1)
    stats = [trainer.iterate() for _ in range(60)]
    assert stats[0].reward < 0.5 and stats[-1].reward > 0.85
    last = stats[-1]
    assert last.samples == 60 * 16 * 64 and last.iteration == 60
    assert last.episode_length == LIMIT and last.failure_rate == 0.0
    assert last.episode_reward == pytest.approx(last.episode_length * last.reward, rel=0.15)
    assert set(last.terms) == {"distance"}

    # Without noise the policy brings the points to their targets.
    env, policy = PointEnv(128, seed=9), trainer.policy()
    obs = env.reset()
    for _ in range(LIMIT - 1):
        obs = env.step(policy.act(obs)).obs
    assert float((obs[:, :2] - obs[:, 2:]).norm(dim=-1).mean()) < 0.3


def test_the_papers_settings():
    config = PPOConfig.paper(num_envs=1000)
    assert (config.horizon, config.minibatch, config.epochs) == (50, 2048, 10)
    assert (config.policy_lr, config.value_lr, config.policy_grad_norm) == (5e-5, 3e-4, 40.0)
    assert config.std == pytest.approx(0.1**0.5) and config.bootstrap_timeouts
    code = PPOConfig.paper(num_envs=1000, faithful="code")
    assert code.std == 0.1 and not code.bootstrap_timeouts


@pytest.mark.parametrize("wrong", [{"horizon": 0}, {"gamma": 1.5}, {"lr_range": (1e-3, 1e-4)}])
def test_wrong_settings_are_refused(wrong):
    with refused("out-of-range", says=next(iter(wrong))):
        PPOConfig(**wrong)
