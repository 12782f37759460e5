"""The motion prior: numbers by hand, buffers, its place in a trainer, and going on bit for bit."""

from __future__ import annotations

import math
import threading
from dataclasses import replace

import pytest
import torch
from toy_style_env import FRAMES, StyleEnv, to_the_right

from poise.learn import Amp, AmpConfig, PPOConfig, Trainer
from poise.learn.amp import LEAST, Discriminator, adversarial_loss, gradient_penalty, style_reward
from poise.learn.window_sampler import History, WindowBuffer
from refusals import refused

PPO = PPOConfig(std=0.3, horizon=12, epochs=2, policy_hidden=(16,), value_hidden=(16,), minibatch=128)
AMP = AmpConfig(frames=FRAMES, hidden=(16,), lr=1e-3, steps=3, minibatch=64, kept=96, replay=128)


def rng(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def make(seed: int = 0, config: AmpConfig = AMP, past: bool = False, envs: int = 32) -> Trainer:
    env = StyleEnv(envs, seed, past)
    return Trainer(env, PPO, seed, "point", style=Amp(env, to_the_right, config, seed))


def test_losses_and_rewards_are_those_of_the_equations():
    agent, demo = torch.tensor([-1.0, 2.0]), torch.tensor([0.5, 3.0, -0.2])
    p = torch.sigmoid
    want = -0.5 * ((1 - p(agent)).log().mean() + p(demo).log().mean())
    torch.testing.assert_close(adversarial_loss(agent, demo, "bce"), want)
    # 1/2 (mean(0, 9) + mean(0.25, 4, 1.44))
    assert float(adversarial_loss(agent, demo, "least_squares")) == pytest.approx(0.5 * (4.5 + 5.69 / 3))
    d = torch.linspace(-12, 12, 49, dtype=torch.float64)
    want = -(1 - p(d)).clamp_min(LEAST).log() * 2
    torch.testing.assert_close(style_reward(d, AmpConfig()), want)
    squares = AmpConfig.phc("paper")
    at = style_reward(torch.tensor([-1.0, 0.0, 1.0, 3.0, 9.0]), squares)
    assert at.tolist() == [0.0, 0.75, 1.0, 0.0, 0.0]
    # 1 - beta (D - 1)^2 goes on below 0.
    free = style_reward(torch.tensor([-1.0, 0.0, 1.0, 4.0]), AmpConfig.compliant())
    torch.testing.assert_close(free, torch.tensor([0.2, 0.8, 1.0, -0.8]))
    assert AmpConfig.compliant(few=False).shape == 0.25
    assert AmpConfig.phc("code").loss == "bce" and AmpConfig.phc("code").scale == 2.0


def test_the_gradient_penalty_is_that_of_finite_differences():
    net = Discriminator(3, 2, (8, 5), "tanh", generator=rng()).double()
    x = torch.randn(7, 6, generator=rng(1), dtype=torch.float64)
    penalty, logit = gradient_penalty(net, x)
    eps, slope = 1e-6, torch.zeros(7, 6, dtype=torch.float64)
    for i in range(6):
        step = torch.zeros(6, dtype=torch.float64)
        step[i] = eps
        slope[:, i] = (net.logit(x + step) - net.logit(x - step)) / (2 * eps)
    torch.testing.assert_close(penalty, slope.square().sum(-1).mean(), rtol=1e-6, atol=1e-9)
    torch.testing.assert_close(logit, net.logit(x))
    # And its own gradient, which the update follows.
    w = net.weights()[0]
    (got,) = torch.autograd.grad(penalty, w)
    with torch.no_grad():
        w[2, 3] += eps
        up = gradient_penalty_value(net, x)
        w[2, 3] -= 2 * eps
        down = gradient_penalty_value(net, x)
    assert float(got[2, 3]) == pytest.approx((up - down) / (2 * eps), rel=1e-4)


def gradient_penalty_value(net: Discriminator, x: torch.Tensor) -> float:
    with torch.enable_grad():
        return float(gradient_penalty(net, x)[0].detach())


def test_one_step_descends_the_whole_loss():
    # With SGD in the place of Adam a step is minus the gradient of the loss, term by term.
    config = replace(AMP, activation="tanh", logit_weight=0.3, weight_decay=0.2, gradient_weight=1.7)
    amp = Amp(StyleEnv(8), to_the_right, config)
    amp.optimizer = torch.optim.SGD(amp.net.net.parameters(), lr=1.0)
    agent = torch.randn(16, FRAMES * 4, generator=rng(1))
    demo = to_the_right(16, rng(2))
    params = list(amp.net.net.parameters())
    before = [p.detach().clone() for p in params]
    x = amp.net.normalise(demo).requires_grad_()
    real = amp.net.logit(x)
    slope = torch.autograd.grad(real.sum(), x, create_graph=True)[0]
    fake = amp.net(agent)
    loss = 0.5 * (-(1 - fake.sigmoid()).log().mean() - real.sigmoid().log().mean())
    w1, w2 = amp.net.net.layers[0].weight, amp.net.net.layers[2].weight
    loss = loss + 1.7 * slope.square().sum(-1).mean() + 0.3 * w2.square().sum()
    loss = loss + 0.2 * (w1.square().sum() + w2.square().sum())
    grads = torch.autograd.grad(loss, params)
    numbers = amp.descend(agent, demo)
    for p, old, g in zip(params, before, grads, strict=True):
        torch.testing.assert_close(p.detach(), old - g, rtol=1e-4, atol=1e-6)
    assert numbers["demo_accuracy"] == pytest.approx(float((real > 0).float().mean()))


def test_windows_never_cross_the_end_of_an_episode():
    history = History(3, 2, 1, torch.device("cpu"))
    history.add(torch.tensor([[1.0], [2.0], [3.0]]))
    assert history.full().tolist() == []
    history.add(torch.tensor([[4.0], [5.0], [6.0]]))
    assert history.windows(history.full()).tolist() == [[1, 4], [2, 5], [3, 6]]
    history.restart(torch.tensor([1]), None)
    history.restart(torch.tensor([2]), torch.tensor([[[7.0], [8.0]]]))
    history.add(torch.tensor([[9.0], [10.0], [11.0]]))
    assert history.full().tolist() == [0, 2]
    assert history.windows(history.full()).tolist() == [[4, 9], [8, 11]]
    nan = float("nan")
    history.restart(torch.tensor([0, 2]), torch.tensor([[[nan], [nan]], [[1.0], [2.0]]]))
    assert history.full().tolist() == [2]
    with refused("wrong-shape"):
        history.add(torch.zeros(3, 2))


def test_a_full_buffer_keeps_the_given_share_in_place_of_the_oldest():
    buffer = WindowBuffer(100, 1, torch.device("cpu"))
    buffer.add(torch.zeros(60, 1), 0.0, rng())
    buffer.add(torch.zeros(60, 1), 0.0, rng())  # 40 fill it, of 20 none enters.
    assert len(buffer) == 100 and buffer.next == 0
    g, entered = rng(3), 0
    for _ in range(200):
        before = buffer.next
        buffer.add(torch.ones(50, 1), 0.02, g)
        entered += (buffer.next - before) % 100
    # 10,000 draws of 0.02: 200 +- 14.
    assert abs(entered - 200) < 50
    assert int((buffer.data == 0).sum()) == 0
    order = WindowBuffer(3, 1, torch.device("cpu"))
    order.add(torch.arange(5.0).view(5, 1), 1.0, rng())
    assert order.data.flatten().tolist() == [3, 4, 2]
    order.add(torch.arange(10.0, 15.0).view(5, 1), 1.0, rng())
    assert sorted(order.data.flatten().tolist()) == [12, 13, 14]
    empty = WindowBuffer(0, 1, torch.device("cpu"))
    empty.add(torch.ones(5, 1), 1.0, rng())
    assert len(empty) == 0


@pytest.mark.parametrize("past", [False, True])
def test_the_total_reward_is_the_weighted_sum(past):
    trainer = make(past=past, config=replace(AMP, task_weight=0.7, style_weight=0.2))
    style = trainer.style
    assert isinstance(style, Amp)
    seen: list[torch.Tensor] = []
    mix = style.reward

    def spy(task: torch.Tensor) -> torch.Tensor:
        seen.append(task.clone())
        return mix(task)

    style.reward = spy  # type: ignore[method-assign]
    stats = trainer.iterate()
    given = style.style_rewards
    # Windows fill after FRAMES steps.
    assert given[: FRAMES - 1].isnan().all() and not given[FRAMES - 1].isnan().any()
    filled = given.nan_to_num(float(given[~given.isnan()].mean()))
    torch.testing.assert_close(trainer.rollout.reward, 0.7 * seen[0] + 0.2 * filled)
    assert stats.reward == pytest.approx(float(seen[0].mean()))
    row = stats.row()
    assert row["update/style_reward"] == pytest.approx(float(filled.mean()), rel=1e-5)
    assert 0 <= row["update/demo_accuracy"] <= 1 and row["update/style_gradient"] >= 0
    # The statistics of observations took 16 steps, so all episodes of 20 end together here.
    env = trainer.env
    assert isinstance(env, StyleEnv) and len(env.asked) == 1 and len(env.asked[0]) == 32
    at = trainer.rollout.truncated[:, 0].nonzero().flatten().tolist()
    after = given[at[0] + 1, 0]
    assert bool(after.isnan()) != past


@pytest.mark.parametrize("demos", [0, 100])
def test_resume_is_bit_exact(demos, tmp_path):
    config = replace(AMP, demos=demos, fresh_demos=16)
    through = make(config=config)
    whole = [through.iterate().row() for _ in range(5)]
    first = make(config=config)
    parts = [first.iterate().row() for _ in range(2)]
    first.save(tmp_path / "c")
    second = make(seed=9, config=config)
    second.load(tmp_path / "c")
    parts += [second.iterate().row() for _ in range(3)]
    a, b = through.state(), second.state()
    assert a.keys() == b.keys() and any(k.startswith("style/own/replay") for k in a)
    for name in a.keys() - {"trainer/counters"}:
        assert torch.equal(a[name].nan_to_num(-1), b[name].nan_to_num(-1)), name
    for x, y in zip(whole, parts, strict=True):
        for name in x:
            same = x[name] == y[name] or (math.isnan(x[name]) and math.isnan(y[name]))
            assert name.startswith("time/") or same, name
    with refused("checkpoint-unfit"):
        Trainer(StyleEnv(32), PPO, character="point").load(tmp_path / "c")
    with refused("checkpoint-unfit", says="style"):
        make(config=replace(config, hidden=(8,))).load(tmp_path / "c")
    # A later stage, here of fewer environments, goes on with the discriminator.
    later = make(envs=8, config=config).style
    assert isinstance(later, Amp)
    later.load_learned({k[6:]: v for k, v in a.items() if k.startswith("style/")})
    assert torch.equal(later.net.net.last.weight, a["style/net/net.layers.2.weight"])


def test_the_prior_teaches_a_direction_that_the_task_does_not_know():
    config = replace(AMP, lr=3e-3, steps=8, kept=512, task_weight=0.0, style_weight=1.0, scale=1.0)
    env = StyleEnv(64, 1)
    trainer = Trainer(
        env, replace(PPO, gamma=0.8, policy_lr=3e-3), 1, style=Amp(env, to_the_right, config, 1)
    )
    trainer.iterate()
    policy = trainer.policy()
    obs = torch.rand(200, 4, generator=rng(5)) * 2 - 1
    before = policy.act(obs).mean(0)
    stats = [trainer.iterate() for _ in range(25)]
    after = trainer.policy().act(obs).mean(0)
    # 0.1 per step is the action 0.5 along x.
    wish = torch.tensor([0.5, 0.0])
    assert float((after - wish).norm()) < 0.5 * float((before - wish).norm())
    assert stats[0].style["demo_accuracy"] > 0.6


class Pair:
    """One of two "processes" in two threads, which wait for each other at every sum."""

    size, local_size = 2, 2

    def __init__(self, rank: int, shared: dict[int, torch.Tensor], gate: threading.Barrier):
        self.rank, self.shared, self.gate = rank, shared, gate

    def sum_(self, x: torch.Tensor) -> torch.Tensor:
        self.shared[self.rank] = x.clone()
        self.gate.wait(20)
        x.copy_(self.shared[0] + self.shared[1])
        self.gate.wait(20)
        return x

    def gather(self, data: bytes) -> list[bytes]:
        return [data]


def test_processes_share_one_discriminator():
    gate, shared, amps = threading.Barrier(2), {}, {}

    def work(rank: int) -> None:
        env = StyleEnv(16, seed=rank)
        amp = Amp(env, to_the_right, AMP, seed=3, comm=Pair(rank, shared, gate))
        env.reset()
        for _ in range(2):
            amp.begin(6)
            for _ in range(6):
                step = env.step(torch.zeros(16, 2) + rank)
                amp.step(step.terminated | step.truncated)
            amp.reward(torch.zeros(6, 16))
            numbers = amp.update()
        amps[rank] = (amp, numbers)

    threads = [threading.Thread(target=work, args=(r,)) for r in range(2)]
    for t in threads:
        t.start()
    for t in threads:
        t.join()
    (a, numbers), (b, same) = amps[0], amps[1]
    assert numbers == same
    for name, value in a.net.state_dict().items():
        assert torch.equal(value, b.net.state_dict()[name]), name
    assert not torch.equal(a.replay.data, b.replay.data)


def test_what_cannot_be_is_refused():
    for bad, code in (
        ({"frames": 0}, "out-of-range"),
        ({"loss": "hinge"}, "unknown-choice"),
        ({"keep": 2.0}, "out-of-range"),
    ):
        with refused(code, says="AmpConfig"):
            AmpConfig(**bad)  # type: ignore[arg-type]
    with refused("wrong-shape"):
        Amp(StyleEnv(8), lambda n, g: torch.zeros(n, 3), AMP)
    trainer = make(config=replace(AMP, lr=1e30))
    style = trainer.style
    assert isinstance(style, Amp)
    weights = style.net.net.last.weight.detach().clone()
    policy = trainer.ppo.actor.policy.mean.last.weight.detach().clone()
    with refused("training-diverged"):
        trainer.iterate()
    assert torch.equal(style.net.net.last.weight, weights)
    assert torch.equal(trainer.ppo.actor.policy.mean.last.weight, policy)
