"""Proximal policy optimisation (Schulman et al. 2017) with a separate policy and critic."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Literal, NamedTuple

import torch
from torch import Tensor

from poise.errors import PoiseError
from poise.learn.adam import Adam
from poise.learn.checkpoint import (
    State,
    load_module,
    load_optimizer_state,
    make_generator,
    optimizer_state,
    prefixed,
    set_generator,
    take,
    under,
)
from poise.learn.networks import (
    MLP,
    GaussianPolicy,
    RunningNorm,
    bfloat16_is_fast,
    gaussian_entropy,
    gaussian_kl,
    gaussian_log_prob,
)
from poise.learn.parallel import (
    ALONE,
    Comm,
    ThreadedUpdate,
    average_gradients,
    mean_gradient,
    moments,
    noise_name,
    parts_of,
    shared_statistics,
)
from poise.learn.policy import PolicyBundle
from poise.learn.rollout import Rollout, TrainingError
from poise.settings import Count, Limit, NotNegative, Positive, Range, Share, validate


@dataclass(frozen=True)
class PPOConfig:
    """Settings of PPO (Schulman et al. 2017); the defaults are for minutes on a CPU."""

    horizon: Count = 16
    """Control steps per environment and iteration; the batch is horizon x num_envs samples."""
    epochs: Count = 5
    """Passes over the batch in one update."""
    minibatch: Count = 2048
    """Samples per gradient step; the batch is cut into parts of nearly this size."""
    gamma: Share = 0.95
    """Discount per control step."""
    lam: Share = 0.95
    """Lambda of the generalised advantage estimation."""
    clip: Positive = 0.2
    """The probability ratio counts only inside [1 - clip, 1 + clip]."""
    policy_lr: Positive = 2e-4
    """Adam's step size for the policy: 2e-4 from scratch, 1e-4 after a warm start."""
    value_lr: Positive = 5e-4
    """Adam's step size for the critic."""
    policy_grad_norm: Limit | None = 40.0
    """The policy's gradient is scaled down to this norm; None leaves it."""
    value_grad_norm: Limit | None = None
    """The same for the critic."""
    policy_hidden: tuple[int, ...] = (256, 128)
    """Widths of the policy's hidden layers."""
    value_hidden: tuple[int, ...] = (256, 128)
    """Widths of the critic's hidden layers."""
    activation: str = "relu"
    """relu, silu, gelu, elu or tanh."""
    std: float | tuple[float, ...] = 0.1
    """Standard deviation of the action noise, one number or one per action."""
    learn_std: bool = False
    """Whether the deviation is learned; else it stays as it starts."""
    entropy_weight: float = 0.0
    """Weight of the entropy bonus; it matters only with a learned deviation."""
    bound_weight: float = 0.0
    """Weight of the squared excess of the mean action over +-bound_limit."""
    bound_limit: Limit = 1.0
    """Mean actions inside +-bound_limit cost nothing."""
    smooth_weight: NotNegative = 0.0
    """Weight of KL(pi(s) || pi(s + n)), with n of `smooth_noise`: what makes the policy answer alike to
    states that are near (Shen et al. 2020, "Deep RL with robust and smooth policy")."""
    smooth_noise: NotNegative = 0.8
    """Deviation of n in normalised observations."""
    smooth_over: Annotated[tuple[int, int], Range(0)] | None = None
    """First column of the observations in which n is not 0, and the first after them; None: a recipe
    that knows better says which, else all."""
    kl_target: Limit | None = None
    """With a number, the policy's lr follows the KL per update (summed over the actions): divided
    by 1.5 above twice the target, multiplied by 1.5 below half of it. Use 0.03 to 0.1: with 38
    actions a target of 0.01 drives the lr to its floor at once and nothing is learned."""
    lr_range: Annotated[tuple[float, float], Range(0, above=True, rising=True)] = (1e-5, 1e-3)
    """Bounds of the adaptive lr."""
    kl_stop: Limit | None = 1.0
    """The remaining epochs train only the critic once an epoch's mean KL exceeds this. Healthy
    updates stay under 0.1; a step that destroys the policy reaches 10."""
    critic_warmup: int = 0
    """First iterations that train only the critic; a warm-started policy needs about 8, since a
    cold critic would undo it."""
    products: Literal["auto", "float32", "bfloat16"] = "auto"
    """How the update multiplies the hidden layers; weights, moments, output layers and the policy that
    acts are float32. auto takes bfloat16 where the processor multiplies it itself, at half the cost.
    float32 gives the same numbers on processors with and without."""
    normalise_returns: bool = True
    """The critic learns returns scaled to mean 0 and deviation 1 (PopArt, van Hasselt 2016)."""
    obs_clip: Limit = 5.0
    """Normalised observations are clipped to +-obs_clip."""
    norm_warmup: int = 16
    """Control steps before the first iteration that only gather the statistics of observations;
    skipped when the policy starts with statistics of its own."""
    bootstrap_timeouts: bool = True
    """Whether the value of the last state of a timed-out episode is bootstrapped; if not,
    time-outs count as failures, as in the code of the RFC authors."""

    def __post_init__(self) -> None:
        validate(self)
        if self.smooth_over is not None and self.smooth_over[0] >= self.smooth_over[1]:
            raise PoiseError(
                f"smooth_over must be (from, to), got {self.smooth_over}", "PPOConfig", code="not-rising"
            )

    def check_columns(self, num_obs: int) -> None:
        """Whether `smooth_over` names columns that `num_obs` observations have.

        Raises:
            PoiseError: it ends beyond them.
        """
        if self.smooth_over is not None and self.smooth_over[1] > num_obs:
            raise PoiseError(
                f"smooth_over ends at {self.smooth_over[1]} of {num_obs} observations",
                code="index-outside",
            )

    @classmethod
    def paper(cls, num_envs: int = 512, faithful: Literal["paper", "code"] = "paper") -> PPOConfig:
        """The settings of Residual Force Control (Yuan & Kitani 2020, supplementary).

        Batch 50,000 (the horizon rounds up), minibatch 2,048, 10 epochs, plain MSE value loss, no
        entropy bonus. Where both differ, `faithful` picks: the paper states the covariance
        diag(0.1), deviation 0.316; the authors' code uses the deviation 0.1 and treats time-outs
        as failures.
        """
        return cls(
            horizon=math.ceil(50_000 / num_envs),
            epochs=10,
            minibatch=2048,
            gamma=0.95,
            lam=0.95,
            clip=0.2,
            policy_lr=5e-5,
            value_lr=3e-4,
            policy_grad_norm=40.0,
            policy_hidden=(512, 256),
            value_hidden=(512, 256),
            std=math.sqrt(0.1) if faithful == "paper" else 0.1,
            kl_stop=None,
            normalise_returns=False,
            bootstrap_timeouts=faithful == "paper",
        )


@torch.no_grad()
def gae(
    reward: Tensor,
    value: Tensor,
    next_value: Tensor,
    terminated: Tensor,
    truncated: Tensor,
    gamma: float,
    lam: float,
) -> tuple[Tensor, Tensor]:
    """Advantages and lambda-returns, each `(T, N)` (Schulman et al. 2016).

    Args:
        reward: `(T, N)` r_t.
        value: `(T, N)` V(s_t).
        next_value: `(T, N)` V of the state that the step reached, before any reset.
        terminated: `(T, N)` bool, the state reached is a failure: its value counts as 0.
        truncated: `(T, N)` bool, the episode was cut there: its value is bootstrapped.
        gamma, lam: the discount and the mixing of n-step advantages.
    """
    # delta_t = r_t + gamma V(s_{t+1}) [not terminated] - V(s_t)
    delta = reward + gamma * next_value * ~terminated - value
    # A_t = delta_t + gamma lambda [episode goes on] A_{t+1}
    decay = gamma * lam * (~(terminated | truncated)).to(delta.dtype)
    advantage = torch.empty_like(delta)
    following = torch.zeros_like(delta[0])
    for t in range(len(delta) - 1, -1, -1):
        following = torch.addcmul(delta[t], decay[t], following, out=advantage[t])
    # The return that the critic learns: R_t = A_t + V(s_t)
    return advantage, advantage + value


class Draws(NamedTuple):
    """What the old policy drew.

    Attributes:
        action: `(B, D)`.
        log_prob: `(B,)`, log-probability of the action.
        mean: `(B, D)`.
        log_std: log sigma, `(D,)` where it is the same for all samples or `(B, D)`.
    """

    action: Tensor
    log_prob: Tensor
    mean: Tensor
    log_std: Tensor

    def take(self, index: Tensor) -> Draws:
        """Some of the samples."""
        action, log_prob, mean = (x.index_select(0, index) for x in self[:3])
        own = self.log_std.dim() > 1
        return Draws(
            action, log_prob, mean, self.log_std.index_select(0, index) if own else self.log_std
        )


def clipped_surrogate(log_prob: Tensor, old_log_prob: Tensor, advantage: Tensor, clip: float) -> Tensor:
    """The policy loss: -mean min(r A, clip(r, 1 - e, 1 + e) A) with r = pi / pi_old; a scalar."""
    ratio = (log_prob - old_log_prob).exp()
    clipped = ratio.clamp(1 - clip, 1 + clip)
    return -torch.minimum(ratio * advantage, clipped * advantage).mean()


def policy_loss(
    config: PPOConfig, mean: Tensor, log_std: Tensor, advantage: Tensor, old: Draws
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The loss to descend, and for the log: itself, the KL and the share of clipped ratios.

    `mean (B, D)` and `log_std`, `(D,)` or `(B, D)`, are the present policy's.
    """
    log_prob = gaussian_log_prob(old.action, mean, log_std)
    loss = clipped_surrogate(log_prob, old.log_prob, advantage, config.clip)
    if config.entropy_weight:
        loss = loss - config.entropy_weight * gaussian_entropy(log_std).mean()
    if config.bound_weight:
        excess = (mean.abs() - config.bound_limit).relu()
        loss = loss + config.bound_weight * excess.square().sum(-1).mean()
    with torch.no_grad():
        kl = gaussian_kl(old.mean, old.log_std, mean, log_std).mean()
        # |r - 1| > e
        clipped = ((log_prob - old.log_prob).expm1().abs() > config.clip).float().mean()
    return loss, loss.detach(), kl, clipped


def explained_variance(comm: Comm, returns: Tensor, value: Tensor) -> float:
    """1 - Var(R - V) / Var(R) over all processes."""
    spread = float(moments(comm, returns)[1])
    return 1 - (float(moments(comm, returns - value)[1]) / spread) ** 2 if spread > 0 else 0.0


_SUMS: tuple[str, ...] = ("policy loss", "kl", "clip fraction", "policy gradient")
_LOGGED = (*_SUMS, "value loss")
COLD = 0.1  # What is left of the policy's lr at the end of a training that cools.
NEAR = 1024  # Displacements of observations that an update draws for `PPOConfig.smooth_weight`.
EVERY = 4  # Of so many samples one is looked at for it.
RETURN_WINDOW = 10  # Batches over which the scale of the returns is remembered.


@dataclass(frozen=True)
class UpdateStats:
    """What one update did. Means are over its minibatches; 0 for the policy while it waits."""

    policy_loss: float
    value_loss: float
    """Squared error of the critic, in units of the normalised return if returns are normalised."""
    kl: float
    """KL(old || new) in nats, summed over the actions, mean over the last trained epoch."""
    clip_fraction: float
    policy_grad_norm: float
    """Before clipping."""
    explained_variance: float
    """1 - Var(R - V) / Var(R) of the critic before the update."""
    std: float
    """Mean deviation of the action noise."""
    policy_lr: float


class _Batch(NamedTuple):
    """What the minibatches are taken from, `(T N, ...)` each."""

    obs: Tensor
    advantage: Tensor
    target: Tensor
    old: Draws
    context: Tensor | None
    near: Tensor | None


class PPO:
    """Policy, critic, normalisers and optimiser; learns from one filled `Rollout` at a time.

    Args:
        num_obs, num_actions: O and A.
        config: the settings.
        seed: seeds the first weights, the action noise and the shuffling, each apart.
        device: where everything lives.
        comm: the processes that learn together; the config's `minibatch` counts all of them.
        actor: the policy that learns, of which a copy is made, in place of the config's perceptron.
    """

    def __init__(
        self,
        num_obs: int,
        num_actions: int,
        config: PPOConfig,
        seed: int,
        device: torch.device | str = "cpu",
        comm: Comm = ALONE,
        actor: PolicyBundle | None = None,
    ):
        self.config, self.comm = config, comm
        config.check_columns(num_obs)
        init = make_generator(seed, "weights")
        if actor is None:
            sizes = (config.policy_hidden, config.activation, config.std, config.learn_std)
            self.actor = PolicyBundle.make(num_obs, num_actions, *sizes, config.obs_clip, generator=init)
        else:
            found, want = (actor.num_obs, actor.num_actions), (num_obs, num_actions)
            if found != want:
                raise PoiseError(
                    f"the policy has {found} observations and actions, the task {want}",
                    code="policy-unfit",
                )
            self.actor = actor.copy()
        self.critic = MLP(num_obs, config.value_hidden, 1, config.activation, generator=init).to(device)
        self.return_norm = RunningNorm(1, clip=math.inf).to(device)
        self.actor.norm.to(device)
        self.actor.policy.to(device)
        self.noise = make_generator(seed, noise_name(comm), device)
        self.shuffle = make_generator(seed, "shuffle", device)
        self._policy_params = [p for p in self.actor.policy.parameters() if p.requires_grad]
        self._value_params = list(self.critic.parameters())
        # Policy and critic share nothing, so that each can be trained in a thread of its own.
        self.optimizer = Adam(self._policy_params, lr=config.policy_lr)
        self.value_optimizer = Adam(self._value_params, lr=config.value_lr)
        here = torch.device(device).type == "cpu"
        self._half = config.products == "bfloat16" or (
            config.products == "auto" and here and bfloat16_is_fast()
        )
        self._beside = ThreadedUpdate()

    def value(self, obs: Tensor) -> Tensor:
        """V of normalised observations `(..., O)` in units of reward, `(...)`."""
        return self.return_norm.inverse(self.critic(obs)).squeeze(-1)

    @torch.no_grad()
    def _value(self, obs: Tensor) -> Tensor:
        return self.value(obs)

    @torch.no_grad()
    def estimate(self, rollout: Rollout, parallel: bool = False) -> None:
        """Fills the rollout's values, advantages and returns."""
        config = self.config
        rows = rollout.obs.tensor_split(2)
        second = self._beside(parallel, self._value, rows[1])
        value = torch.cat((self._value(rows[0]), second()))
        rollout.value.copy_(value[:-1])
        rollout.next_value.copy_(value[1:])
        terminated = rollout.terminated
        if config.bootstrap_timeouts:
            # Where the episode was cut, s_{t+1} is the state reached and not the next start.
            if len(rollout.cut_at):
                rollout.next_value.view(-1)[rollout.cut_at] = self.value(rollout.cut_obs)
        else:
            terminated = terminated | rollout.truncated
        advantage, returns = gae(
            rollout.reward,
            rollout.value,
            rollout.next_value,
            terminated,
            rollout.truncated,
            config.gamma,
            config.lam,
        )
        rollout.advantage.copy_(advantage)
        rollout.returns.copy_(returns)

    def update(self, rollout: Rollout, train_policy: bool = True, threads: int = 1) -> UpdateStats:
        """Learns from a collected rollout, then takes the new observation statistics into use.

        With more than one of `threads`, policy and critic are trained at the same time, to the same
        numbers.

        A loss or weight that is not finite raises a `TrainingError` and puts back the weights,
        moments and generators from before this update.
        """
        before = self.state()
        try:
            self.estimate(rollout, threads > 1)
            explained = explained_variance(self.comm, rollout.returns, rollout.value)
            if self.config.normalise_returns:
                self._rescale_critic(rollout.returns)
            sums, kl = self._fit(rollout, train_policy, threads > 1)
            self._adapt_lr(kl)
        except TrainingError:
            self.load_state(before)
            raise
        self.actor.norm.freeze()
        return UpdateStats(
            policy_loss=sums["policy loss"],
            value_loss=sums["value loss"],
            kl=kl,
            clip_fraction=sums["clip fraction"],
            policy_grad_norm=sums["policy gradient"],
            explained_variance=explained,
            std=float(_noise(self.actor.policy, rollout).detach().exp().mean()),
            policy_lr=self.optimizer.param_groups[0]["lr"],
        )

    def _fit(
        self, rollout: Rollout, train_policy: bool, parallel: bool
    ) -> tuple[dict[str, float], float]:
        """All epochs; the mean of each sum and the KL of the last epoch of the policy."""
        config, kl = self.config, 0.0
        advantage = rollout.advantage.flatten()
        obs, policy = rollout.obs[:-1].flatten(0, 1), self.actor.policy
        old = Draws(
            rollout.action.flatten(0, 1),
            rollout.log_prob.flatten(),
            rollout.mean.flatten(0, 1),
            _noise(policy, rollout).detach().clone(),
        )
        with torch.no_grad():
            # What never changes in an update is looked up in it.
            context = policy.context(obs)
            if self._half:
                obs = obs.bfloat16()
        mean, std = moments(self.comm, advantage)
        target = self.return_norm(rollout.returns.view(-1, 1))
        batch = _Batch(obs, (advantage - mean) / (std + 1e-8), target, old, context, self.near(obs))
        parts = max(1, round(rollout.samples * self.comm.size / config.minibatch))
        # Processes that share gradients make the same calls in the same order, so in one thread.
        parallel = parallel and self.comm.size == 1
        means: list[dict[str, float]] = []
        for _ in range(config.epochs):
            order = torch.randperm(rollout.samples, generator=self.shuffle, device=obs.device)
            indices = order.tensor_split(parts)
            value = self._beside(parallel and train_policy, self._fit_value, batch, indices)
            try:
                sums = advantage.new_zeros(len(_SUMS))
                if train_policy:
                    sums = self._fit_policy(batch, indices, parallel)
            finally:
                # The critic's thread never outlives the epoch.
                value_loss = value()
            # The only wait for the numbers, once per epoch.
            sums = self.comm.sum_(torch.cat((sums, value_loss.view(1)))) / (parts * self.comm.size)
            epoch: dict[str, float] = dict(zip(_LOGGED, sums.tolist(), strict=True))
            self._check(epoch)
            means.append(epoch)
            if train_policy:
                kl = epoch["kl"]
                train_policy = config.kl_stop is None or kl <= config.kl_stop
        return {name: sum(m[name] for m in means) / len(means) for name in means[0]}, kl

    def near(self, obs: Tensor) -> Tensor | None:
        """`(NEAR, O)` by which states near those of the batch lie off them; None where none are seen."""
        if not self.config.smooth_weight:
            return None
        first, last = self.config.smooth_over or (0, obs.shape[1])
        near = obs.new_zeros(NEAR, obs.shape[1])
        size = near[:, first:last].shape
        drawn = torch.randn(size, generator=self.shuffle, device=obs.device)
        near[:, first:last] = drawn * self.config.smooth_noise
        return near

    def distribution(self, obs: Tensor, context: Tensor | None) -> tuple[Tensor, Tensor]:
        """The policy's own of normalised `obs (N, O)`, by the products of the update, so that the policy
        that collects and the one that learns are equal at first."""
        return self.actor.policy.distribution(obs.bfloat16() if self._half else obs, context)

    def mean(self, obs: Tensor) -> Tensor:
        """Mean actions of normalised `obs (N, O)` by the products of the update, with gradients."""
        context = self.actor.policy.context(obs)
        return self.actor.policy.drive(self.distribution(obs, context)[0], context)

    def _fit_value(self, batch: _Batch, indices: Sequence[Tensor]) -> Tensor:
        """One epoch of the critic; the sum of its losses."""
        total = batch.target.new_zeros(())
        for index in indices:
            obs = batch.obs.index_select(0, index)
            value = self.critic(obs)
            loss = (value - batch.target.index_select(0, index)).square().mean()
            self.value_optimizer.zero_grad(set_to_none=True)
            loss.backward()
            average_gradients(self.comm, self._value_params)
            if (limit := self.config.value_grad_norm) is not None:
                torch.nn.utils.clip_grad_norm_(self._value_params, limit, foreach=True)
            self.value_optimizer.step()
            total += loss.detach()
        return total

    def _fit_policy(self, batch: _Batch, indices: Sequence[Tensor], parallel: bool) -> Tensor:
        """One epoch of the policy; the sums of `_SUMS`."""
        sums = batch.advantage.new_zeros(len(_SUMS))
        given = self.config.policy_grad_norm
        limit = math.inf if given is None else given
        params = self._policy_params
        weights = sum(p.numel() for p in params)

        def loss_and_terms(index: Tensor) -> tuple[Tensor, Tensor]:
            obs = batch.obs.index_select(0, index)
            context = None if batch.context is None else batch.context.index_select(0, index)
            mean, log_std = self.actor.policy.distribution(obs, context)
            advantage, old = batch.advantage.index_select(0, index), batch.old.take(index)
            loss, *terms = policy_loss(self.config, mean, log_std, advantage, old)
            if batch.near is not None:
                rows = slice(None, None, EVERY)
                moved = obs[rows] + batch.near.index_select(0, index[rows] % NEAR)
                near = self.actor.policy.distribution(moved, None if context is None else context[rows])
                here = mean[rows], log_std[rows] if log_std.dim() > 1 else log_std
                loss = loss + self.config.smooth_weight * gaussian_kl(*here, *near).mean()
            return loss, torch.stack(terms)

        for index in indices:
            parts = parts_of(index, weights, self.comm.size)
            terms = mean_gradient(parts, params, loss_and_terms, self._beside, parallel)
            average_gradients(self.comm, params)
            norm = torch.nn.utils.clip_grad_norm_(params, limit, foreach=True)
            self.optimizer.step()
            sums += torch.cat((terms, norm.view(1)))
        return sums

    @torch.no_grad()
    def _rescale_critic(self, returns: Tensor) -> None:
        """Updates the scale of the returns and leaves what the critic predicts unchanged."""
        norm, last = self.return_norm, self.critic.last
        first, (mean, std) = float(norm.count) == 0, (norm.shift.clone(), norm.std.clone())
        norm.window = RETURN_WINDOW * returns.numel() * self.comm.size
        with shared_statistics(self.comm, norm):
            norm.observe(returns.reshape(-1, 1))
        norm.freeze()
        if not first:
            # std' (w' h + b') + mean' = std (w h + b) + mean
            last.weight.mul_(std / norm.std)
            last.bias.mul_(std).add_(mean - norm.shift).div_(norm.std)

    def cool(self, left: float, cooling: float) -> None:
        """Lets the policy's lr, unless it adapts itself, fall evenly to a share `COLD` in the last
        share `cooling` of a training of which a share `left` is left."""
        if self.config.kl_target is None:
            factor = min(1.0, max(left / cooling, COLD))
            self.optimizer.param_groups[0]["lr"] = self.config.policy_lr * factor

    def _adapt_lr(self, kl: float) -> None:
        """Moves the policy's lr so that the KL of an update stays near its target."""
        target, (low, high) = self.config.kl_target, self.config.lr_range
        if target is None or kl == 0.0:
            return
        group = self.optimizer.param_groups[0]
        if kl > 2 * target:
            group["lr"] = max(low, group["lr"] / 1.5)
        elif kl < target / 2:
            group["lr"] = min(high, group["lr"] * 1.5)

    def _check(self, means: Mapping[str, float]) -> None:
        bad = [name for name, value in means.items() if not math.isfinite(value)]
        params = [*self._policy_params, *self._value_params]
        if not bad and not math.isfinite(sum(float(p.detach().sum()) for p in params)):
            bad = ["sum of the weights"]
        if bad:
            raise TrainingError(
                f"the {' and the '.join(bad)} became infinite or not a number in the update",
                hint="The weights before it are kept; lower policy_lr or value_lr, or bound the reward",
                code="training-diverged",
            )

    def state(self) -> State:
        """Copies of weights, normalisers, moments and generators."""
        return (
            self.actor.state()
            | prefixed("critic", self.critic.state_dict())
            | prefixed("return_norm", self.return_norm.state_dict())
            | prefixed("adam/policy", optimizer_state(self.optimizer))
            | prefixed("adam/value", optimizer_state(self.value_optimizer))
            | {"generator/noise": self.noise.get_state(), "generator/shuffle": self.shuffle.get_state()}
        )

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Restores what `state` returned; other network sizes raise a `PoiseError`.

        What the config fixes (the learning rates unless they adapt, the deviation unless it is
        learned) stays as the config has it, so that a resumed run may change it.
        """
        fixed_log_std = self.actor.policy.log_std.detach().clone()
        self.actor.load_state(state)
        load_module(self.critic, state, "critic")
        load_module(self.return_norm, state, "return_norm")
        load_optimizer_state(self.optimizer, under("adam/policy", state))
        load_optimizer_state(self.value_optimizer, under("adam/value", state))
        self.value_optimizer.param_groups[0]["lr"] = self.config.value_lr
        if self.config.kl_target is None:
            self.optimizer.param_groups[0]["lr"] = self.config.policy_lr
        if not self.config.learn_std:
            self.actor.policy.log_std.data.copy_(fixed_log_std)
        set_generator(self.noise, take(state, "generator/noise"))
        set_generator(self.shuffle, take(state, "generator/shuffle"))


def _noise(policy: GaussianPolicy, rollout: Rollout) -> Tensor:
    """log sigma of the actions: the policy's own `(D,)`, or what followed from each state `(T N, D)`."""
    return policy.log_std if rollout.log_std is None else rollout.log_std.flatten(0, 1)
