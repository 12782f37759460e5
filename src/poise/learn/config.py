"""The settings of PPO."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from poise.errors import PoiseError
from poise.settings import validate


@dataclass(frozen=True)
class PPOConfig:
    """Settings of PPO (Schulman et al. 2017); the defaults are for minutes on a CPU."""

    horizon: int = 16
    """Control steps per environment and iteration; the batch is horizon x num_envs samples."""
    epochs: int = 5
    """Passes over the batch in one update."""
    minibatch: int = 2048
    """Samples per gradient step; the batch is cut into parts of nearly this size."""
    gamma: float = 0.95
    """Discount per control step."""
    lam: float = 0.95
    """Lambda of the generalised advantage estimation."""
    clip: float = 0.2
    """The probability ratio counts only inside [1 - clip, 1 + clip]."""
    policy_lr: float = 2e-4
    """Adam's step size for the policy: 2e-4 from scratch, 1e-4 after a warm start."""
    value_lr: float = 5e-4
    """Adam's step size for the critic."""
    policy_grad_norm: float | None = 40.0
    """The policy's gradient is scaled down to this norm; None leaves it."""
    value_grad_norm: float | None = None
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
    bound_limit: float = 1.0
    """Mean actions inside +-bound_limit cost nothing."""
    smooth_weight: float = 0.0
    """Weight of KL(pi(s) || pi(s + n)), with n of `smooth_noise`: what makes the policy answer alike to
    states that are near (Shen et al. 2020, "Deep RL with robust and smooth policy")."""
    smooth_noise: float = 0.8
    """Deviation of n in normalised observations."""
    smooth_over: tuple[int, int] | None = None
    """First column of the observations in which n is not 0, and the first after them; None: a recipe
    that knows better says which, else all."""
    kl_target: float | None = None
    """With a number, the policy's lr follows the KL per update (summed over the actions): divided
    by 1.5 above twice the target, multiplied by 1.5 below half of it. Use 0.03 to 0.1: with 38
    actions a target of 0.01 drives the lr to its floor at once and nothing is learned."""
    lr_range: tuple[float, float] = (1e-5, 1e-3)
    """Bounds of the adaptive lr."""
    kl_stop: float | None = 1.0
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
    obs_clip: float = 5.0
    """Normalised observations are clipped to +-obs_clip."""
    norm_warmup: int = 16
    """Control steps before the first iteration that only gather the statistics of observations;
    skipped when the policy starts with statistics of its own."""
    bootstrap_timeouts: bool = True
    """Whether the value of the last state of a timed-out episode is bootstrapped; if not,
    time-outs count as failures, as in the code of the RFC authors."""

    def __post_init__(self) -> None:
        validate(self)
        for name in ("horizon", "epochs", "minibatch", "policy_lr", "value_lr", "clip"):
            if not getattr(self, name) > 0:
                raise PoiseError(f"{name} must be above 0, got {getattr(self, name)}", "PPOConfig")
        for name in ("smooth_weight", "smooth_noise"):
            if not getattr(self, name) >= 0:
                raise PoiseError(f"{name} must be at least 0, got {getattr(self, name)}", "PPOConfig")
        if self.smooth_over is not None and not 0 <= self.smooth_over[0] < self.smooth_over[1]:
            raise PoiseError(f"smooth_over must be (from, to), got {self.smooth_over}", "PPOConfig")
        for name in ("gamma", "lam"):
            if not 0 <= getattr(self, name) <= 1:
                raise PoiseError(f"{name} must lie in [0, 1], got {getattr(self, name)}", "PPOConfig")
        if not 0 < self.lr_range[0] <= self.lr_range[1]:
            raise PoiseError(f"lr_range must be (low, high) above 0, got {self.lr_range}", "PPOConfig")

    def check_columns(self, num_obs: int) -> None:
        """Whether `smooth_over` names columns that `num_obs` observations have.

        Raises:
            PoiseError: it ends beyond them.
        """
        if self.smooth_over is not None and self.smooth_over[1] > num_obs:
            raise PoiseError(f"smooth_over ends at {self.smooth_over[1]} of {num_obs} observations")

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
