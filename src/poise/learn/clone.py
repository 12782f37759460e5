"""Behaviour cloning with DAgger (Ross et al. 2011), and lessons of a teacher beside PPO."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Annotated

import torch
from torch import Tensor

from poise.learn.adam import Adam
from poise.learn.checkpoint import (
    State,
    load_optimizer_state,
    make_generator,
    optimizer_state,
    prefixed,
    set_generator,
    take,
    under,
)
from poise.learn.policy import PolicyBundle, WarmStart
from poise.learn.ppo import PPO, PPOConfig
from poise.learn.protocols import Lessons, Teacher, VecEnv
from poise.learn.rollout import Episodes, Rollout, TrainingError, check_finite, collect
from poise.machine import one_thread
from poise.settings import Checked, Count, Length, Positive, Range, Share


@dataclass(frozen=True)
class CloneConfig(Checked):
    """Settings of cloning; the defaults take half a minute on two cores with 512 environments."""

    steps: Count = 56
    """Control steps per environment and round."""
    rounds: Annotated[int, Range(0)] = 3
    """DAgger rounds after the teacher's own."""
    beta: Share = 0.3
    """Share of the episodes of round k that the teacher drives: beta^k, so all of them in round 0."""
    noise: Annotated[tuple[float, ...], Range(0), Length(1)] = (0.0, 1.0, 2.0)
    """Exploration of the teacher's episodes in units of the policy's action noise; every
    environment keeps one of these levels through a round. The student explores with 1."""
    epochs: tuple[int, int] = (6, 4)
    """Passes over all data after round 0 and after each later one."""
    minibatch: Count = 2048
    most: Annotated[int, Range(0)] = 0
    """A pass takes so many samples of all at most, drawn anew; 0 takes all."""
    lr: Positive = 1e-3
    """Adam's step size; it falls to a tenth over each round's fit."""
    critic_steps: Annotated[int, Range(0)] = 32
    """Control steps per environment that teach the critic by their returns; 0 leaves it untrained."""
    critic_passes: int = 3
    """Times that the critic learns from them, with returns estimated anew."""


@dataclass(frozen=True)
class CloneStats:
    """What one round did."""

    round: int
    """0 is the teacher's own."""
    samples: int
    """Control steps seen so far."""
    loss: float
    """Mean squared error of the actions, in units of the action noise, in the last pass."""
    reward: float
    """Mean reward per control step of the round's rollout."""
    failure_rate: float
    """Share of the round's finished episodes that failed; NaN where none finished."""
    seconds: float
    """Since the start."""


@one_thread()
def clone(
    env: VecEnv,
    teacher: Teacher,
    config: CloneConfig | None = None,
    ppo: PPOConfig | None = None,
    seed: int = 0,
    on_round: Callable[[CloneStats], bool | None] | None = None,
    start: PolicyBundle | None = None,
) -> tuple[WarmStart, tuple[CloneStats, ...]]:
    """A policy (and critic) that acts like `teacher`, ready for `Trainer(warm_start=...)`.

        min E |(mean(s) - teacher(s)) / sigma|^2 over the states that teacher and student visit

    The teacher drives round 0 with noise, so that the data hold returns to the clip. In each later round
    the student drives most episodes itself, and the teacher says what it would have done there. The last
    round's returns teach a critic, so that reinforcement learning can go on at once.

    Args:
        env: is reset here; its episodes must restart by themselves.
        teacher: acts for the environment's present state.
        ppo: the network sizes, action noise sigma, discount and critic settings.
        on_round: called after each round; returning False ends the cloning there.
        start: the policy that is taught, of which a copy is made, such as a column or a composer of
            `poise.learn.primitives` (frozen parts stay); by default a new perceptron.

    The same seed on the same environment gives the same bits. Numbers that are not finite raise a
    `TrainingError`.
    """
    config, ppo = config or CloneConfig(), ppo or PPOConfig()
    begun = time.perf_counter()
    device = torch.device(env.device)
    learner = PPO(env.num_obs, env.num_actions, ppo, seed, device, actor=start)
    fitter = _Fitter(learner, config, (config.rounds + 1) * config.steps * env.num_envs, seed)
    stats: list[CloneStats] = []
    obs = env.reset()
    for k in range(config.rounds + 1):
        obs, reward, failures = _gather(env, teacher, learner.actor, fitter, config, k, obs, seed)
        loss = fitter.fit(config.epochs[min(k, 1)])
        elapsed = time.perf_counter() - begun
        stats.append(CloneStats(k, fitter.seen, loss, reward, failures, elapsed))
        if on_round is not None and on_round(stats[-1]) is False:
            break
    policy, samples, critic = learner.actor.copy(), fitter.seen, None
    if config.critic_steps:
        critic = _fit_critic(env, learner, config, obs, seed)
        samples += config.critic_steps * env.num_envs
    return WarmStart(policy, critic, samples, time.perf_counter() - begun), tuple(stats)


class _Fitter:
    """All states seen so far with the teacher's actions, and the regression on them."""

    def __init__(self, learner: PPO, config: CloneConfig, capacity: int, seed: int):
        actor = learner.actor
        # States learned from; control steps seen.
        self.actor, self.config, self.size, self.seen = actor, config, 0, 0
        # The products of the hidden layers are those of the learner.
        self.mean = learner.mean
        device = actor.norm.shift.device
        self.obs = torch.empty(capacity, actor.num_obs, device=device)
        self.action = torch.empty(capacity, actor.num_actions, device=device)
        self.shuffle = make_generator(seed, "clone shuffle", device)
        # The action noise is not taught.
        names = actor.policy.named_parameters()
        self.params = [p for name, p in names if p.requires_grad and name != "log_std"]
        self.optimizer = Adam(self.params, lr=config.lr)

    def add(self, obs: Tensor, action: Tensor) -> None:
        """Keeps one step of every environment."""
        rows = slice(self.size, self.size + len(obs))
        self.obs[rows], self.action[rows] = obs, action
        self.size += len(obs)
        self.actor.norm.observe(obs)

    def fit(self, epochs: int) -> float:
        """Some passes over everything; the loss of the last one."""
        if not self.size:
            raise TrainingError("the teacher knew in no state what to do", code="teacher-knows-nothing")
        policy, norm = self.actor.policy, self.actor.norm
        norm.freeze()
        scale = (-policy.action_log_std.detach()).exp()
        taken = min(self.size, self.config.most or self.size)
        parts = max(1, round(taken / self.config.minibatch))
        mean = 0.0
        for epoch in range(epochs):
            order = torch.randperm(self.size, generator=self.shuffle, device=self.obs.device)[:taken]
            # From lr to lr / 10, geometrically.
            for group in self.optimizer.param_groups:
                group["lr"] = self.config.lr * 0.1 ** (epoch / max(1, epochs - 1))
            total = torch.zeros((), device=self.obs.device)
            for index in order.tensor_split(parts):
                error = self.mean(norm(self.obs.index_select(0, index)))
                error = (error - self.action.index_select(0, index)) * scale
                loss = error.square().mean()
                self.optimizer.zero_grad(set_to_none=True)
                loss.backward()
                torch.nn.utils.clip_grad_norm_(self.params, 10.0, foreach=True)
                self.optimizer.step()
                total += loss.detach()
            mean = float(total) / parts
            if not mean < float("inf"):
                raise TrainingError(
                    "the loss of cloning is not finite",
                    hint="Lower CloneConfig.lr",
                    code="training-diverged",
                )
        return mean


@torch.no_grad()
def _gather(
    env: VecEnv,
    teacher: Teacher,
    student: PolicyBundle,
    data: _Fitter,
    config: CloneConfig,
    round_: int,
    obs: Tensor,
    seed: int,
) -> tuple[Tensor, float, float]:
    """One round of steps from the raw `obs (N, O)`; where it ended, mean reward, failure rate."""
    noise = make_generator(seed, f"clone noise {round_}", obs.device)
    n, beta = env.num_envs, config.beta**round_
    levels = torch.tensor(config.noise, device=obs.device)[torch.arange(n) % len(config.noise)]
    std = student.policy.action_log_std.exp()

    def drawn(count: int) -> Tensor:
        return torch.rand(count, generator=noise, device=obs.device) < beta

    taught = drawn(n)
    reward, ended, failed = 0.0, 0, 0
    for _ in range(config.steps):
        check_finite("observation", obs)
        wish = teacher.act(obs)
        check_finite("teacher's action", wish)
        known: Tensor | None = getattr(teacher, "known", None)
        data.add(*((obs, wish) if known is None else (obs[known], wish[known])))
        data.seen += n
        action, level = wish, levels
        if round_:
            action = torch.where(taught[:, None], wish, student.act(obs))
            level = torch.where(taught, levels, torch.ones_like(levels))
        draw = torch.randn(action.shape, generator=noise, device=obs.device)
        step = env.step(action + draw * std * level[:, None])
        check_finite("reward", step.reward, step.log)
        reward += float(step.reward.mean()) / config.steps
        done = step.terminated | step.truncated
        if count := int(done.sum()):
            lost = step.terminated if step.failed is None else step.failed
            ended, failed = ended + count, failed + int(lost.sum())
            # Teacher or student drives a whole episode, so that errors of the student can grow.
            taught[done] = drawn(count)
        obs = step.obs
    return obs, reward, failed / ended if ended else float("nan")


def _fit_critic(env: VecEnv, learner: PPO, config: CloneConfig, obs: Tensor, seed: int) -> State:
    """The critic's state after learning the lambda-returns of the student's own episodes."""
    device = torch.device(env.device)
    drawn = learner.actor.policy.num_drawn
    rollout = Rollout(config.critic_steps, env.num_envs, env.num_obs, drawn, device)
    episodes = Episodes(env.num_envs, device)
    policy, norm = learner.actor.policy, learner.actor.norm
    collect(env, policy, norm, rollout, obs, episodes, make_generator(seed, "clone critic", device))
    for _ in range(config.critic_passes):
        learner.update(rollout, train_policy=False)
    return prefixed("critic", learner.critic.state_dict()) | prefixed(
        "return_norm", learner.return_norm.state_dict()
    )


@dataclass(frozen=True)
class LessonConfig(Checked):
    """How labels are learned."""

    kept: Count = 40_000
    """Labels that are kept, the newest ones."""
    batches: Count = 8
    """Steps of Adam in an iteration."""
    batch: Count = 1024
    """Labels of each."""
    lr: Positive = 5e-5
    """Adam's step size."""
    grad_norm: Annotated[float, Range(0, above=True, infinite=True)] = 1.0
    """Gradients are scaled down to this norm."""
    reinforce: bool = False
    """Whether PPO trains the policy, too; without, it trains the critic alone."""


class Student:
    """Takes lessons: asks the teacher, keeps the labels, learns from them, beside PPO or alone.

        min E |pi(o) - label(o)|^2  over the labels kept

    A label is the action that the teacher named when it was asked. Older labels are of an older policy
    and are forgotten.

    Args:
        ppo: the policy that learns, and the critic by which the teacher looks ahead.
        lessons: the teacher.
        config: see `LessonConfig`.
        seed: of the draws.
    """

    def __init__(self, ppo: PPO, lessons: Lessons, config: LessonConfig, seed: int):
        self.ppo, self.lessons, self.config = ppo, lessons, config
        names = ppo.actor.policy.named_parameters()
        self._params = [p for name, p in names if p.requires_grad and name != "log_std"]
        self._adam = Adam(self._params, lr=config.lr)
        self._draws = make_generator(seed, "lessons")
        self._obs = torch.zeros(0, ppo.actor.num_obs)
        self._action = torch.zeros(0, ppo.actor.num_actions)

    def learn(self) -> dict[str, float]:
        """Takes one more lesson and learns; numbers for the log.

        Raises:
            TrainingError: the loss is not finite.
        """
        c, actor = self.config, self.ppo.actor
        obs, action, log = self.lessons.teach(actor, self._value)
        self._obs = torch.cat((self._obs, obs))[-c.kept :]
        self._action = torch.cat((self._action, action))[-c.kept :]
        total, count = 0.0, len(self._obs)
        for _ in range(c.batches if count >= c.batch else 0):
            index = torch.randint(count, (c.batch,), generator=self._draws)
            error = self.ppo.mean(actor.norm.forward(self._obs[index])) - self._action[index]
            loss = error.square().sum(-1).mean()
            self._adam.zero_grad(set_to_none=True)
            loss.backward()
            torch.nn.utils.clip_grad_norm_(self._params, c.grad_norm, foreach=True)
            self._adam.step()
            total += float(loss.detach()) / c.batches
        if not total < float("inf"):
            raise TrainingError(
                "the loss of the lessons is not finite",
                hint="Lower LessonConfig.lr",
                code="training-diverged",
            )
        return {"lesson_loss": total, "labels": float(len(obs)), **log}

    @torch.no_grad()
    def _value(self, obs: Tensor) -> Tensor:
        return self.ppo.value(self.ppo.actor.norm.forward(obs))

    def state(self) -> State:
        """Copies of everything that a bit-exact continuation needs."""
        own = {"obs": self._obs.clone(), "action": self._action.clone()}
        kept = prefixed("adam", optimizer_state(self._adam)) | prefixed("teacher", self.lessons.state())
        return own | kept | {"draws": self._draws.get_state()}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Continues from `state()`."""
        self._obs, self._action = take(state, "obs").clone(), take(state, "action").clone()
        load_optimizer_state(self._adam, under("adam", state))
        for group in self._adam.param_groups:
            group["lr"] = self.config.lr
        set_generator(self._draws, take(state, "draws"))
        self.lessons.load_state(under("teacher", state))
