"""Adversarial motion prior (Peng et al. 2021): a reward for moving as the clips do."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor, nn
from torch.nn import functional

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
from poise.learn.networks import MLP, RunningNorm
from poise.learn.parallel import ALONE, Comm, any_of, average_gradients, shared_statistics, sums
from poise.learn.protocols import DemoSampler, FeatureSource
from poise.learn.rollout import TrainingError, check_finite
from poise.learn.window_sampler import History, WindowBuffer
from poise.settings import Checked, Count, Limit, Positive, Share


class Discriminator(nn.Module):
    """One logit D per window of W frames with F features: high for clips, low for the character.

    Args:
        frames, features: W and F.
        hidden, activation: of the perceptron over the W F normalised features.
        clip: bound of the normalised features. Their statistics are shared by the frames of a window.
        generator: source of the first weights.
    """

    def __init__(
        self,
        frames: int,
        features: int,
        hidden: Sequence[int] = (256, 128),
        activation: str = "relu",
        clip: float = 5.0,
        *,
        generator: torch.Generator,
    ):
        super().__init__()
        self.frames, self.features = frames, features
        self.norm = RunningNorm(features, clip)
        self.net = MLP(frames * features, hidden, 1, activation, generator=generator)

    def normalise(self, windows: Tensor) -> Tensor:
        """Windows `(N, W F)` or `(N, W, F)`, oldest frame first, as what the network sees `(N, W F)`."""
        return self.norm(windows.reshape(-1, self.frames, self.features)).flatten(1)

    def logit(self, x: Tensor) -> Tensor:
        """D `(N,)` of normalised windows `(N, W F)`."""
        return self.net(x).squeeze(-1)

    def forward(self, windows: Tensor) -> Tensor:
        """D `(N,)` of raw windows `(N, W F)` or `(N, W, F)`."""
        return self.logit(self.normalise(windows))

    def weights(self) -> list[Tensor]:
        """The weight matrices without the biases, the output layer's last."""
        return [p for name, p in self.net.named_parameters() if name.endswith("weight")]


def gradient_penalty(net: Discriminator, x: Tensor) -> tuple[Tensor, Tensor]:
    """mean_n ||dD/dx_n||^2 of normalised windows `x (N, W F)`, a scalar with gradients; and D `(N,)`."""
    x = x.detach().requires_grad_()
    logit = net.logit(x)
    (slope,) = torch.autograd.grad(logit.sum(), x, create_graph=True)
    return slope.square().sum(-1).mean(), logit


Loss = Literal["bce", "least_squares"]
LEAST = 1e-4  # Of 1 - sigmoid(D): no window is worth more than -log(LEAST) scale.


@dataclass(frozen=True)
class AmpConfig(Checked):
    """Settings of a motion prior; the defaults are for minutes on a CPU, `phc` has the authors'."""

    frames: Count = 10
    """W, consecutive control steps in a window."""
    hidden: tuple[int, ...] = (256, 128)
    """Widths of the discriminator's hidden layers."""
    activation: str = "relu"
    """relu, silu, gelu, elu or tanh."""
    clip: Limit = 5.0
    """Normalised features are clipped to +-clip."""
    loss: Loss = "bce"
    """bce as in PHC's code, or least_squares: (D - 1)^2 and (D + 1)^2 with the reward
    max(0, 1 - shape (D - 1)^2) scale, as in the AMP paper."""
    shape: Positive = 0.25
    """beta of least_squares' reward; Deep Compliant Control has 0.2 for few clips."""
    clamped: bool = True
    """Whether least_squares' reward ends at 0; in Deep Compliant Control it does not."""
    lr: Positive = 1e-4
    """Adam's step size."""
    steps: Count = 4
    """Gradient steps per iteration."""
    minibatch: Count = 512
    """Windows of the character per step, as many again from its replay, and as many demos."""
    kept: Count = 2048
    """Windows of the character that are kept of one iteration, drawn at random."""
    gradient_weight: float = 5.0
    """w_gp; the AMP paper writes 10 / 2."""
    logit_weight: float = 0.01
    """w_logit."""
    weight_decay: float = 1e-4
    """w_decay."""
    demos: int = 0
    """Windows in the buffer of demos; 0 draws fresh ones for every step."""
    fresh_demos: int = 512
    """Demos that are exchanged in the buffer per iteration."""
    replay: int = 4096
    """Windows of the character from earlier iterations that it is still shown; 0 for none."""
    keep: Share = 0.01
    """Probability with which a window enters the replay once that is full."""
    scale: float = 2.0
    """Of the style reward; the AMP paper has 1."""
    task_weight: float = 0.5
    """w_task."""
    style_weight: float = 0.5
    """w_style."""
    product: bool = False
    """r = r_task r_style in place of the weighted sum (Deep Compliant Control, Eq. 11)."""

    @classmethod
    def compliant(cls, few: bool = True, product: bool = True) -> AmpConfig:
        """The settings of Deep Compliant Control (Lee et al. 2022, Eqs. 12 and 13, Sec. 5.1): pairs of
        states, as many of the clips as of the character, without replay. What it does not state, the
        weights of gradient and last layer and the number of steps, is as by default.

        few: whether the clips are few, so that the discriminator learns too quickly: beta 0.2, not 0.25.
        product: r_q r_p; without, half of each, for a task that is paid for its pose, too.
        """
        return cls(
            frames=2, hidden=(256, 256, 256), loss="least_squares", shape=0.2 if few else 0.25,
            clamped=False, lr=1e-4, minibatch=16, replay=0, scale=1.0,
            product=product,
        )  # fmt: skip

    @classmethod
    def phc(cls, faithful: Literal["paper", "code"] = "paper") -> AmpConfig:
        """The settings of PHC (Luo et al. 2023), for a GPU: two buffers of 200,000 windows.

        | | paper | code |
        |---|---|---|
        | loss, reward | "the same as AMP": least squares, scale 1 | BCE, scale 2 |
        | gradient penalty | 10 / 2, as AMP | 5 |
        | logit, weight decay | not stated | 0.01, 1e-4 |
        | hidden | 1024, 512 | 1024, 512 |
        | demos, new per epoch; replay, keep | not stated | 200k, 512; 200k, 0.01 |
        | minibatch, steps, lr | not stated | 4096, 36 (6 x 6), 2e-5 |

        The code adds the loss five times to PPO's and shares its optimiser; here the discriminator
        has an Adam of its own, which such a factor does not change. What the paper leaves open is the
        code's.
        """
        return cls(
            hidden=(1024, 512),
            loss="least_squares" if faithful == "paper" else "bce",
            scale=1.0 if faithful == "paper" else 2.0,
            lr=2e-5,
            steps=36,
            minibatch=4096,
            kept=98_304,
            demos=200_000,
            replay=200_000,
        )


def style_reward(logit: Tensor, config: AmpConfig) -> Tensor:
    """r_style of D, any shape; `Amp` has the formula of bce, `AmpConfig.loss` that of least squares."""
    if config.loss == "least_squares":
        # r = 1 - beta (D - 1)^2
        reward = 1 - config.shape * (logit - 1).square()
        return config.scale * (reward.clamp_min(0.0) if config.clamped else reward)
    # 1 - sigmoid(D) = sigmoid(-D), and -log sigmoid(-D) = softplus(D).
    return config.scale * functional.softplus(logit).clamp_max(-math.log(LEAST))


def mixed_reward(task: Tensor, style: Tensor, config: AmpConfig) -> tuple[Tensor, Tensor]:
    """r of r_task and r_style, any shape, see `Amp` and `AmpConfig.product`; and the mean r_style, for
    which r_style counts where it is NaN."""
    known = style[~style.isnan()]
    mean = known.mean() if len(known) else style.new_zeros(())
    style = torch.where(style.isnan(), mean, style)
    if config.product:
        return task * style, mean
    # r = w_task r_task + w_style r_style
    return config.task_weight * task + config.style_weight * style, mean


def adversarial_loss(agent: Tensor, demo: Tensor, loss: Loss) -> Tensor:
    """1/2 of the losses of logits of the character `(M,)` and of the clips `(N,)`; a scalar."""
    if loss == "least_squares":
        return 0.5 * ((agent + 1).square().mean() + (demo - 1).square().mean())
    # BCE(D, 0) = -log(1 - sigmoid(D)) = softplus(D);  BCE(D, 1) = softplus(-D)
    return 0.5 * (functional.softplus(agent).mean() + functional.softplus(-demo).mean())


class Amp:
    """A motion prior as the `style` of a `Trainer`.

    A discriminator D tells windows of W frames of the clips ("demos") from those of the character:

        L = 1/2 [ BCE(D(agent), 0) + BCE(D(demo), 1) ] + w_gp mean ||dD/dx(demo)||^2
            + w_logit ||last weights||^2 + w_decay sum ||weights||^2

        r = w_task r_task + w_style r_style,     r_style = -log(max(1 - sigmoid(D), 1e-4)) scale

    PHC's Eq. 1 does not halve the energy penalty: an environment that counts the penalty in r_task gives
    it the weight 1 / w_task.

    Args:
        source: the trainer's environment, which also tells how the character moves.
        demos: draws windows of the clips.
        config: the settings.
        seed: seeds the weights and all draws, each apart.
        comm: the processes that train together; the same as the trainer's.

    Attributes:
        style_rewards: `(T, N)`, r_style of each step of this rollout; NaN before a window is full.
    """

    def __init__(
        self,
        source: FeatureSource,
        demos: DemoSampler,
        config: AmpConfig | None = None,
        seed: int = 0,
        comm: Comm = ALONE,
    ):
        self.config = config = config or AmpConfig()
        self.source, self.demos, self.comm = source, demos, comm
        device, features = torch.device(source.device), source.num_features
        init = make_generator(seed, "discriminator")
        sizes = (config.frames, features, config.hidden, config.activation, config.clip)
        self.net = Discriminator(*sizes, generator=init).to(device)
        self.optimizer = Adam(self.net.net.parameters(), lr=config.lr)
        # Draws live on the CPU, so that a seed means the same ones on every device.
        self.rng = make_generator(seed, f"style {comm.rank}")
        width = config.frames * features
        self.history = History(source.num_envs, config.frames, features, device)
        self.replay = WindowBuffer(config.replay, width, device)
        self.demo_buffer = WindowBuffer(config.demos, width, device)
        self.style_rewards = torch.zeros(0, source.num_envs, device=device)
        self._kept: list[Tensor] = []
        self._step = self._horizon = 0
        self._mean_style = 0.0
        first = self._fresh(max(config.minibatch, 1024))
        with shared_statistics(comm, self.net.norm):
            self.net.norm.observe(first.view(-1, features))
        self.net.norm.freeze()

    @property
    def shape(self) -> dict[str, Any]:
        """JSON data that a checkpoint must share: the sizes."""
        c = self.config
        sizes = {"frames": c.frames, "features": self.net.features, "hidden": list(c.hidden)}
        return sizes | {"activation": c.activation, "demos": c.demos, "replay": c.replay}

    def begin(self, horizon: int) -> None:
        """See `Style`."""
        self._kept, self._step, self._horizon = [], 0, horizon
        self.style_rewards = self.style_rewards.new_full(
            (horizon, self.style_rewards.shape[1]), math.nan
        )

    @torch.no_grad()
    def step(self, done: Tensor) -> None:
        """See `Style`."""
        features = self.source.features()
        check_finite("feature of the motion prior", features)
        self.history.add(features)
        full = self.history.full()
        if len(full):
            windows = self.history.windows(full)
            self.style_rewards[self._step, full] = style_reward(self.net(windows), self.config)
            # As many of each step that the whole rollout gives what is wanted.
            share = math.ceil(self.config.kept / self._horizon)
            pick = torch.randperm(len(full), generator=self.rng)[:share]
            self._kept.append(windows[pick.to(windows.device)])
        ended = done.nonzero().squeeze(-1)
        if len(ended):
            self.history.restart(ended, self.source.past(ended, self.config.frames))
        self._step += 1

    def reward(self, task: Tensor) -> Tensor:
        """See `Style`; where a window is not yet full, the style counts as its mean."""
        total, mean = mixed_reward(task, self.style_rewards, self.config)
        self._mean_style = float(mean)
        return total

    def update(self) -> dict[str, float]:
        """Some gradient steps on what the rollout showed; see `Style`.

        Raises:
            TrainingError: a number is not finite; the weights from before are put back.
        """
        config, net = self.config, self.net
        agent = torch.cat(self._kept) if self._kept else self.style_rewards.new_zeros(0, net.net.num_in)
        demos = self._demos()
        if any_of(self.comm, len(agent) == 0):
            # No character has moved for W frames yet, so there is nothing to tell apart.
            return self._means(dict.fromkeys(_LOGGED, 0.0))
        before = prefixed("net", net.state_dict()) | prefixed("adam", optimizer_state(self.optimizer))
        total = dict.fromkeys(_LOGGED, 0.0)
        for _ in range(config.steps):
            shown = agent[self._draw(len(agent))]
            if len(self.replay):
                shown = torch.cat((shown, self.replay.sample(len(shown), self.rng)))
            for name, value in self.descend(shown, self._some(demos, config.minibatch)).items():
                total[name] += value / config.steps
        total["style_reward"] = self._mean_style
        params = sum(float(p.detach().sum()) for p in net.parameters())
        if not math.isfinite(params + sum(total.values())):
            load_module(net, before, "net")
            load_optimizer_state(self.optimizer, under("adam", before))
            raise TrainingError(
                "the discriminator became infinite or not a number in the update",
                hint="The weights before it are kept; lower AmpConfig.lr",
                code="training-diverged",
            )
        with shared_statistics(self.comm, net.norm):
            for x in (agent, self._some(demos, len(agent))):
                net.norm.observe(x.view(-1, net.features))
        net.norm.freeze()
        self.replay.add(agent, config.keep, self.rng)
        self._kept = []
        return self._means(total)

    def descend(self, agent: Tensor, demo: Tensor) -> dict[str, float]:
        """One gradient step of the loss L on raw windows `(M, W F)` of the character and of the clips;
        its numbers for the log, before the step."""
        config, net = self.config, self.net
        penalty, real = gradient_penalty(net, net.normalise(demo))
        fake = net(agent)
        weights = net.weights()
        decay = sum((w.square().sum() for w in weights), penalty.new_zeros(()))
        loss = adversarial_loss(fake, real, config.loss)
        whole = loss + config.gradient_weight * penalty
        whole = whole + config.logit_weight * weights[-1].square().sum() + config.weight_decay * decay
        self.optimizer.zero_grad(set_to_none=True)
        whole.backward()
        average_gradients(self.comm, net.net.parameters())
        self.optimizer.step()
        numbers = torch.stack(
            [
                loss.detach(),
                penalty.detach(),
                (real > 0).float().mean(),
                (fake < 0).float().mean(),
                real.detach().mean(),
                fake.detach().mean(),
            ]
        ).tolist()
        return dict(zip(_LOGGED[1:], numbers, strict=True))

    def _draw(self, size: int) -> Tensor:
        index = torch.randint(size, (self.config.minibatch,), generator=self.rng)
        return index.to(self.style_rewards.device)

    def _fresh(self, count: int) -> Tensor:
        """New demos `(count, W F)`."""
        width, device = self.net.net.num_in, self.style_rewards.device
        drawn = self.demos(count, self.rng)
        if drawn.numel() != count * width:
            raise PoiseError(
                f"the demos have the shape {tuple(drawn.shape)} where ({count}, {width}) is expected",
                hint="A demo is frames x features of the environment, oldest frame first",
                code="wrong-shape",
            )
        return drawn.reshape(count, width).to(device)

    def _demos(self) -> WindowBuffer | None:
        """The buffer after its exchange, or None where demos are drawn as they are needed."""
        config, buffer = self.config, self.demo_buffer
        if not config.demos:
            return None
        # The first time it is filled whole, in parts, since all features together may be large.
        while (missing := config.demos - len(buffer)) > 0:
            buffer.add(self._fresh(min(missing, 8192)), 1.0, self.rng)
        buffer.add(self._fresh(min(config.fresh_demos, config.demos)), 1.0, self.rng)
        return buffer

    def _some(self, buffer: WindowBuffer | None, count: int) -> Tensor:
        return self._fresh(count) if buffer is None else buffer.sample(count, self.rng)

    def _means(self, numbers: dict[str, float]) -> dict[str, float]:
        means = sums(self.comm, list(numbers.values()))
        return {k: v / self.comm.size for k, v in zip(numbers, means, strict=True)}

    def load_learned(self, state: Mapping[str, Tensor]) -> None:
        """Goes on from another stage's `state`, but for its episodes; the learning rate is the config's.

        In a trainer's checkpoint that state lies under "style/".
        """
        load_module(self.net, state, "net")
        load_optimizer_state(self.optimizer, under("adam", state))
        self.optimizer.param_groups[0]["lr"] = self.config.lr
        self.replay.load_state(under("own/replay", state))
        self.demo_buffer.load_state(under("own/demos", state))
        set_generator(self.rng, take(state, "own/rng"))

    def state(self) -> State:
        """See `Style`."""
        return (
            prefixed("net", self.net.state_dict())
            | prefixed("adam", optimizer_state(self.optimizer))
            | prefixed("own/history", self.history.state())
            | prefixed("own/replay", self.replay.state())
            | prefixed("own/demos", self.demo_buffer.state())
            | {"own/rng": self.rng.get_state()}
        )

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """See `Style`."""
        self.load_learned(state)
        self.history.load_state(under("own/history", state))


_LOGGED: tuple[str, ...] = (
    "style_reward",
    "style_loss",
    "style_gradient",
    "demo_accuracy",
    "agent_accuracy",
    "demo_logit",
    "agent_logit",
)
