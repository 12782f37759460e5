"""Collects T control steps of N environments into buffers that are made once."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import torch
from torch import Tensor

from poise.errors import PoiseError
from poise.learn.networks import GaussianPolicy, RunningNorm, gaussian_log_prob
from poise.learn.protocols import Style, VecEnv


class TrainingError(PoiseError):
    """Training met a number that is not finite; the weights are those before the fault."""


def check_finite(name: str, x: Tensor, log: Mapping[str, float] | None = None) -> None:
    """Raises a `TrainingError` with the first bad row of `x (N, ...)`.

    Args:
        name: what `x` is, such as "observation".
        log: the step's terms; those that are not finite are named too.
    """
    # One sum finds NaN and infinity alike at a fraction of the cost of a mask.
    if math.isfinite(float(x.sum())):
        return
    bad = (~torch.isfinite(x)).nonzero()
    if len(bad) == 0:
        return
    row, *entry = bad[0].tolist()
    place = f", entry {entry[0]}" if entry else ""
    terms = [k for k, v in (log or {}).items() if not math.isfinite(v)]
    named = f" (faulty terms: {', '.join(terms)})" if terms else ""
    raise TrainingError(
        f"the {name} is not finite{named}",
        f"environment row {row}{place}",
        "The simulation or a term has diverged there; the weights are those of the last good iteration",
        code="training-diverged",
    )


class Rollout:
    """One batch of experience: T steps by N rows, reused every iteration.

    Attributes:
        obs: `(T + 1, N, O)` normalised; the last row follows the last step.
        action: `(T, N, D)` as it was drawn.
        mean: `(T, N, D)` of the policy.
        log_std: `(T, N, D)`, or None where the deviation is the same in all states.
        log_prob, reward, value, next_value, advantage, returns: `(T, N)`.
        terminated, truncated: `(T, N)` bool.
        cut_at: `(K,)` flat indices t N + n of the steps that were truncated.
        cut_obs: `(K, O)` normalised observations that these steps reached.
        terms: means of the environment's log.
    """

    def __init__(self, horizon: int, num_envs: int, num_obs: int, num_drawn: int, device: torch.device):
        def make(*shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
            return torch.zeros(*shape, dtype=dtype, device=device)

        T, N = horizon, num_envs
        self.obs = make(T + 1, N, num_obs)
        self.action, self.mean = make(T, N, num_drawn), make(T, N, num_drawn)
        self.log_std: Tensor | None = None
        self.log_prob, self.reward = make(T, N), make(T, N)
        self.value, self.next_value = make(T, N), make(T, N)
        self.advantage, self.returns = make(T, N), make(T, N)
        self.terminated, self.truncated = make(T, N, dtype=torch.bool), make(T, N, dtype=torch.bool)
        self.cut_at = make(0, dtype=torch.int64)
        self.cut_obs = make(0, num_obs)
        self.terms: dict[str, float] = {}

    @property
    def samples(self) -> int:
        """T x N."""
        return self.reward.numel()


class Episodes:
    """Counts the running episodes; what it holds is part of the trainer's state."""

    def __init__(self, num_envs: int, device: torch.device):
        self.length = torch.zeros(num_envs, dtype=torch.int64, device=device)
        self.total = torch.zeros(num_envs, dtype=torch.float64, device=device)
        self.finished_length = self.finished_total = self.failures = 0.0
        self.finished = 0

    def begin(self) -> None:
        """Forgets the finished episodes, at the start of an iteration."""
        self.finished_length = self.finished_total = self.failures = 0.0
        self.finished = 0

    def count(self, reward: Tensor, terminated: Tensor, truncated: Tensor, failed: Tensor) -> None:
        """Adds one step of every row, `(N,)` each."""
        self.length += 1
        self.total += reward
        done = terminated | truncated
        ended = int(done.sum())
        if ended:
            self.finished += ended
            self.finished_length += float(self.length[done].sum())
            self.finished_total += float(self.total[done].sum())
            self.failures += float(failed.sum())
            self.length[done] = 0
            self.total[done] = 0.0


def standard_normal(out: Tensor, noise: torch.Generator) -> None:
    """Fills `out (T, N, A)` with draws of mean 0 and deviation 1."""
    torch.randn(out.shape, generator=noise, out=out)


@torch.no_grad()
def collect(
    env: VecEnv,
    policy: GaussianPolicy,
    norm: RunningNorm,
    rollout: Rollout,
    obs: Tensor,
    episodes: Episodes,
    noise: torch.Generator,
    style: Style | None = None,
    distribution: Callable[[Tensor, Tensor | None], tuple[Tensor, Tensor]] | None = None,
) -> Tensor:
    """Fills the rollout's `obs` to `truncated` with on-policy steps from the raw `obs (N, O)`.

    Raw observations are gathered in `norm`, which is not frozen here. Returns the raw observation
    to go on from. A number that is not finite raises a `TrainingError`. `style` watches; the rewards are
    the environment's. `distribution` gives what is drawn from, by default the policy's own.
    """
    episodes.begin()
    logs: list[Mapping[str, float]] = []
    cut_at: list[Tensor] = []
    cut_obs: list[Tensor] = []
    log_stds: list[Tensor] = []
    horizon, num_envs = rollout.reward.shape
    distribution = distribution or policy.distribution
    std, started = policy.log_std.exp(), float(norm.count) > 0
    if style is not None:
        style.begin(horizon)
    # All noise of the iteration at once, into the place where the actions will stand.
    standard_normal(rollout.action, noise)
    check_finite("observation", obs)
    for t in range(horizon):
        if started:
            rollout.obs[t], sums = norm.normalise(obs)
            norm.add(num_envs, sums)
        else:
            norm.observe(obs)
            rollout.obs[t] = norm(obs)
        context = policy.context(rollout.obs[t])
        rollout.mean[t], log_std = distribution(rollout.obs[t], context)
        if log_std.dim() > 1:
            log_stds.append(log_std)
            std = log_std.exp()
        # a = mean + sigma z
        drawn = rollout.action[t].mul_(std).add_(rollout.mean[t])
        step = env.step(policy.drive(drawn, context))
        check_finite("observation", step.obs)
        check_finite("reward", step.reward, step.log)
        rollout.reward[t], rollout.terminated[t] = step.reward, step.terminated
        rollout.truncated[t] = step.truncated
        rows = (step.truncated & ~step.terminated).nonzero().squeeze(-1)
        if len(rows):
            reached = step.final_obs[rows]
            check_finite("final observation of a timed-out episode", reached)
            cut_at.append(rows + t * num_envs)
            cut_obs.append(norm(reached))
        if style is not None:
            style.step(step.terminated | step.truncated)
        failed = step.terminated if step.failed is None else step.failed
        episodes.count(step.reward, step.terminated, step.truncated, failed)
        logs.append(step.log)
        obs = step.obs
    rollout.obs[horizon] = norm(obs)
    rollout.log_std = torch.stack(log_stds) if log_stds else None
    spread = policy.log_std if rollout.log_std is None else rollout.log_std
    rollout.log_prob.copy_(gaussian_log_prob(rollout.action, rollout.mean, spread))
    rollout.cut_at = torch.cat([rollout.cut_at[:0], *cut_at])
    rollout.cut_obs = torch.cat([rollout.cut_obs[:0], *cut_obs])
    rollout.terms = {name: sum(log[name] for log in logs) / horizon for name in logs[0]}
    # The environment may fill its own tensor again before the next iteration.
    return obs.clone()
