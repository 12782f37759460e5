"""Perceptrons, columns of which only the last one learns, diagonal Gaussians, running normalisation."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Literal, cast

import torch
from torch import Tensor, nn
from torch.nn import functional

from poise.errors import PoiseError, did_you_mean

ACTIVATIONS: dict[str, type[nn.Module]] = {
    "relu": nn.ReLU,
    "silu": nn.SiLU,
    "gelu": nn.GELU,
    "elu": nn.ELU,
    "tanh": nn.Tanh,
}


def _activation(name: str) -> nn.Module:
    # In place, ReLU spares the largest arrays of an update a copy (a twentieth of its time).
    return nn.ReLU(inplace=True) if name == "relu" else ACTIVATIONS[name]()


def bare_linear(num_in: int, num_out: int, bias: bool = True) -> nn.Linear:
    """A layer with weights that are yet to be filled; nothing is drawn from the global generator.

    `nn.utils.skip_init` does the same by way of meta tensors, for which torch imports SymPy: half a
    second for a program that only runs a policy.
    """
    with torch.random.fork_rng(devices=[]):
        return nn.Linear(num_in, num_out, bias)


def bfloat16_is_fast() -> bool:
    """Whether this processor multiplies bfloat16 matrices in tiles (AMX). With the instructions of
    AVX-512 alone an update takes 1.7 times as long as in float32, and without either still longer."""
    return bool(torch.cpu.get_capabilities().get("amx_bf16", False))


def product(layer: nn.Module, x: Tensor, last: bool = False) -> Tensor:
    """A linear layer in the arithmetic of `x`; in float32 instead of bfloat16 if it is the `last` one.

    In bfloat16 values and gradients differ from float32's by about 0.4 % of their size, far less than
    one minibatch differs from the next. Weights stay float32, and so do their gradients.
    """
    assert isinstance(layer, nn.Linear)
    if last or x.dtype != torch.bfloat16:
        # The layer's own `forward`, since a module's call costs more than a layer of one character.
        return layer.forward(x.float() if x.dtype == torch.bfloat16 else x)
    bias = None if layer.bias is None else layer.bias.to(x.dtype)
    return functional.linear(x, layer.weight.to(x.dtype), bias)


class MLP(nn.Module):
    """Linear layers with an activation between them; the last layer is linear.

    Args:
        num_in, num_out: widths of the input and of the output.
        hidden: widths of the hidden layers; none gives a linear map.
        activation: relu, silu, gelu, elu or tanh.
        last_scale: the output layer's weights are multiplied by it and its bias is 0, so that a
            small value starts the network near the zero function.
        generator: source of the first weights, U(-1/sqrt(num_in), 1/sqrt(num_in)) per layer.
    """

    def __init__(
        self,
        num_in: int,
        hidden: Sequence[int],
        num_out: int,
        activation: str = "relu",
        last_scale: float = 1.0,
        *,
        generator: torch.Generator,
    ):
        super().__init__()
        if activation not in ACTIVATIONS:
            raise PoiseError(
                f"there is no activation '{activation}'",
                hint=did_you_mean(activation, list(ACTIVATIONS)),
                code="unknown-choice",
            )
        sizes = [num_in, *hidden, num_out]
        if min(sizes) < 1:
            raise PoiseError(
                f"every layer needs at least 1 unit, got the sizes {sizes}", code="out-of-range"
            )
        layers: list[nn.Module] = []
        for i, (a, b) in enumerate(pairwise(sizes)):
            linear = bare_linear(a, b)
            bound = a**-0.5
            with torch.no_grad():
                linear.weight.uniform_(-bound, bound, generator=generator)
                linear.bias.uniform_(-bound, bound, generator=generator)
            layers += [linear] if i == 0 else [_activation(activation), linear]
        self.layers = nn.Sequential(*layers)
        self.num_in, self.num_out = num_in, num_out
        with torch.no_grad():
            self.last.weight.mul_(last_scale)
            self.last.bias.zero_()

    @property
    def last(self) -> nn.Linear:
        """The output layer."""
        layer = self.layers[-1]
        assert isinstance(layer, nn.Linear)
        return layer

    def forward(self, x: Tensor) -> Tensor:
        """`(..., num_in)` to `(..., num_out)`.

        Inputs in bfloat16 pass the hidden layers in bfloat16, forward and backward, at half the cost of
        an update; outputs are float32.
        """
        *hidden, last = self.layers
        for layer in hidden:
            x = product(layer, x) if isinstance(layer, nn.Linear) else layer.forward(x)
        return product(last, x, last=True)


MIN_STD = 1e-4  # An entry that varies less is taken for a constant: it is shifted, not scaled.


class RunningNorm(nn.Module):
    """y = clip((x - mean) / std, -clip, clip) with statistics gathered in float64.

    `observe` only gathers; what `forward` uses changes at `freeze`, so that a rollout and the
    update that learns from it see the same function. Before the first `freeze`, y = clip(x).

    Args:
        size: width of the last dimension.
        clip: bound of |y|; infinity for none.
        window: number of samples that are remembered at most, for a stream that drifts; with None
            every sample counts the same for ever.

    With `fixed` set, new samples are ignored: networks that no longer learn keep what they were
    taught with.
    """

    count: Tensor
    mean: Tensor
    m2: Tensor
    shift: Tensor
    std: Tensor

    def __init__(self, size: int, clip: float = 5.0, window: float | None = None):
        super().__init__()
        self.clip, self.window, self.fixed = clip, window, False
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))
        self.register_buffer("mean", torch.zeros(size, dtype=torch.float64))
        self.register_buffer("m2", torch.zeros(size, dtype=torch.float64))
        self.register_buffer("shift", torch.zeros(size))
        self.register_buffer("std", torch.ones(size))

    @torch.no_grad()
    def observe(self, x: Tensor) -> None:
        """Merges the samples `x (..., size)` into the statistics (Chan et al. 1979)."""
        x = x.reshape(-1, x.shape[-1]).double()
        mean_b = x.mean(0)
        self.merge(float(len(x)), mean_b, ((x - mean_b) ** 2).sum(0))

    def normalise(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Normalised `x (N, size)`, and its sums for `add`, by fewer passes than `observe` takes.

        Sums `(2, size)` float32: of x - shift and of (x - shift)^2.
        """
        d = x - self.shift
        sums = torch.stack((d.sum(0), d.square().sum(0)))
        d.div_(self.std)
        return (d if math.isinf(self.clip) else d.clamp_(-self.clip, self.clip)), sums

    @torch.no_grad()
    def add(self, count: int, sums: Tensor) -> None:
        """Adds `count` samples by their sums `(2, size)`; the same as `observe` but for rounding.

        The rounding is that of float32 around the frozen mean, so there must have been a `freeze`.
        """
        first, second = sums.double() / count
        self.merge(count, self.shift + first, (second - first.square()).clamp_min(0.0) * count)

    @torch.no_grad()
    def merge(self, n_b: float, mean_b: Tensor, m2_b: Tensor) -> None:
        """Merges `n_b` samples of mean `mean_b` and summed squared deviation `m2_b`, `(size)` each."""
        if self.fixed:
            return
        # n = n_a + n_b;  d = mean_b - mean_a
        n_a = self.count
        n = n_a + n_b
        d = mean_b - self.mean
        # mean = mean_a + d n_b / n;  M2 = M2_a + M2_b + d^2 n_a n_b / n
        self.mean.add_(d * (n_b / n))
        self.m2.add_(m2_b + d * d * (n_a * n_b / n))
        if self.window is not None and float(n) > self.window:
            # Fewer samples with the same mean and variance: older ones fade away.
            self.m2.mul_(self.window / n)
            n = torch.full_like(n, self.window)
        self.count.copy_(n)

    @torch.no_grad()
    def freeze(self) -> None:
        """Takes the gathered statistics into use; without samples it changes nothing."""
        if self.fixed or float(self.count) == 0:
            return
        std = (self.m2 / self.count).sqrt()
        self.shift.copy_(self.mean)
        self.std.copy_(torch.where(std < MIN_STD, torch.ones_like(std), std))

    def forward(self, x: Tensor) -> Tensor:
        """Normalised values, the shape of `x (..., size)`."""
        y = (x - self.shift).div_(self.std)
        return y if math.isinf(self.clip) else y.clamp_(-self.clip, self.clip)

    def inverse(self, y: Tensor) -> Tensor:
        """x = y std + mean, for values inside the clip."""
        return y * self.std + self.shift


Start = Literal["copy", "random"]


class ProgressiveNet(nn.Module):
    """K perceptrons ("columns", PHC's primitives) of the same sizes; all but the last are frozen.

    Column k has layers i = 1 .. L with the activation f (the last layer is linear):

        h_i^k = f( W_i^k h_(i-1)^k + b_i^k + sum_(j<k) U_i^(k:j) h_(i-1)^j ),   i > 1     (Rusu, Eq. 1)

    PHC's paper describes the lateral connections U; its code has none (`lateral=False`) and starts a
    column as a copy of the one before it, which the paper calls weight sharing.

    Args:
        num_in, hidden, num_out, activation: sizes of each column, as of an `MLP`.
        lateral: whether there are the matrices U.
        generator: source of the first column's weights.
    """

    log_std: Tensor

    def __init__(
        self,
        num_in: int,
        hidden: Sequence[int],
        num_out: int,
        activation: str = "relu",
        lateral: bool = False,
        *,
        generator: torch.Generator,
    ):
        super().__init__()
        self.num_in, self.num_out, self.lateral = num_in, num_out, lateral
        self.hidden, self.activation = tuple(hidden), activation
        if lateral and not self.hidden:
            raise PoiseError(
                "lateral connections need at least one hidden layer", code="settings-conflict"
            )
        # Row k: log sigma with which the frozen column k was trained; the policy holds the last one's.
        self.register_buffer("log_std", torch.zeros(0, num_out))
        self.columns = nn.ModuleList()
        # laterals[k][j] holds the layers U_i^(k:j) of i = 2 .. L.
        self.laterals = nn.ModuleList()
        self._append(generator)

    def __len__(self) -> int:
        """K, the number of columns."""
        return len(self.columns)

    @property
    def last(self) -> nn.Linear:
        """The output layer of the column that learns."""
        return self.column(len(self) - 1).last

    def column(self, k: int) -> MLP:
        """Column k's own layers."""
        return cast(MLP, self.columns[k])

    def add(self, start: Start, generator: torch.Generator) -> None:
        """Freezes all columns and appends one that learns.

        Args:
            start: "copy" makes it the same function as the last column; "random" draws new weights, the
                lateral ones too.
            generator: source of random weights.
        """
        if start not in ("copy", "random"):
            raise PoiseError(
                f"a column cannot start as '{start}'", hint="Use copy or random", code="unknown-choice"
            )
        last = len(self) - 1
        self.requires_grad_(False)
        self._append(generator)
        if start == "random":
            return
        self.column(-1).load_state_dict(self.column(last).state_dict())
        for lateral, other in zip(self._laterals(last + 1), self._laterals(last), strict=False):
            lateral.load_state_dict(other.state_dict())
        if self.lateral:
            for p in self._laterals(last + 1)[last].parameters():
                nn.init.zeros_(p)

    def copy(self) -> ProgressiveNet:
        """An independent copy."""
        return copy.deepcopy(self)

    def keep(self, count: int) -> None:
        """Drops the columns after the first `count`; the last one left is as frozen as it was."""
        if not 1 <= count <= len(self):
            raise PoiseError(f"{count} of {len(self)} columns cannot be kept", code="out-of-range")
        self.columns, self.laterals = self.columns[:count], self.laterals[:count]
        self.log_std = self.log_std[:count].clone()

    def forward(self, x: Tensor) -> Tensor:
        """The last column's output, `(..., num_in)` to `(..., num_out)`.

        Inputs in bfloat16 pass the hidden layers in bfloat16, as in an `MLP`; outputs are float32.
        """
        if not self.lateral or len(self) == 1:
            return self.column(-1).forward(x)
        return self._outputs(x)[-1]

    def all(self, x: Tensor) -> Tensor:
        """The outputs of all columns, `(..., num_in)` to `(..., K, num_out)`."""
        return torch.stack(self._outputs(x), -2)

    def _outputs(self, x: Tensor) -> list[Tensor]:
        passes: list[list[Tensor]] = []
        for k in range(len(self)):
            passes.append(self._run(k, x, passes))
        return [layers[-1] for layers in passes]

    def _run(self, k: int, x: Tensor, before: Sequence[Sequence[Tensor]]) -> list[Tensor]:
        """What enters each layer of column k, and its output; `before` holds that of earlier columns."""
        layers = list(self.column(k).layers)
        linear, activation = layers[::2], layers[1::2]
        entered = [x]
        for i, layer in enumerate(linear):
            last = i == len(linear) - 1
            h = product(layer, entered[-1], last)
            if i and self.lateral:
                for lateral, other in zip(self._laterals(k), before, strict=True):
                    h = h + product(lateral[i - 1], other[i], last)
            entered.append(h if last else activation[i](h))
        return entered

    def _laterals(self, k: int) -> list[nn.ModuleList]:
        return [cast(nn.ModuleList, part) for part in cast(nn.ModuleList, self.laterals[k])]

    def _append(self, generator: torch.Generator) -> None:
        sizes = (self.num_in, self.hidden, self.num_out, self.activation)
        self.columns.append(MLP(*sizes, last_scale=0.1, generator=generator))
        device = self.column(0).last.weight.device
        widths = [*self.hidden, self.num_out]
        earlier = nn.ModuleList()
        for _ in range(len(self) - 1 if self.lateral else 0):
            matrices = [bare_linear(a, b, bias=False) for a, b in pairwise(widths)]
            for i, matrix in enumerate(matrices):
                # As of the column's own layers, with a small last one.
                bound = matrix.in_features**-0.5 * (0.1 if i == len(matrices) - 1 else 1.0)
                with torch.no_grad():
                    matrix.weight.uniform_(-bound, bound, generator=generator)
            earlier.append(nn.ModuleList(matrices))
        self.laterals.append(earlier)
        self.log_std = torch.cat((self.log_std, self.log_std.new_zeros(1, self.num_out)))
        self.to(device)


#: What may give the mean of a policy.
MeanNet = MLP | ProgressiveNet


def gaussian_log_prob(x: Tensor, mean: Tensor, log_std: Tensor) -> Tensor:
    """Log density of `x (..., A)` under N(mean, diag(exp(log_std))^2), summed over A: `(...)`.

    log p = -1/2 sum_i ((x_i - mu_i) / sigma_i)^2 - sum_i log sigma_i - A/2 log 2 pi

    `log_std` is one number, `(A,)` for all rows, or `(..., A)`.
    """
    z = (x - mean) * (-log_std).exp()
    # One deviation for all rows is summed once.
    logs = log_std.sum(-1) if log_std.dim() > 1 else log_std.expand(x.shape[-1]).sum()
    constant = logs + 0.5 * x.shape[-1] * math.log(2 * math.pi)
    return -0.5 * (z * z).sum(-1) - constant


def gaussian_entropy(log_std: Tensor) -> Tensor:
    """Entropy in nats, summed over the actions, `(...)` of `log_std (..., A)`:
    sum_i (log sigma_i + 1/2 log(2 pi e))."""
    return (log_std + 0.5 * math.log(2 * math.pi * math.e)).sum(-1)


def gaussian_kl(mean_p: Tensor, log_std_p: Tensor, mean_q: Tensor, log_std_q: Tensor) -> Tensor:
    """KL(p || q) of diagonal Gaussians in nats, summed over the last dimension: `(...)`.

    KL = sum_i [ log(sigma_q / sigma_p) + (sigma_p^2 + (mu_p - mu_q)^2) / (2 sigma_q^2) - 1/2 ]
    """
    square = (2 * log_std_p).exp() + (mean_p - mean_q) ** 2
    return (log_std_q - log_std_p + 0.5 * square * (-2 * log_std_q).exp() - 0.5).sum(-1)


class GaussianPolicy(nn.Module):
    """A policy pi(a | s) = N(mean(s), diag(sigma)^2) with a sigma that does not depend on s.

    PPO asks of a policy `context`, `distribution` and `drive`. Another kind (`Composer`) may draw
    something else than the action, of a sigma that depends on s.

    Args:
        mean: the network of the mean; its output layer should start small (`last_scale=0.1`).
        std: sigma, one number or one per action.
        learn_std: whether log sigma is a parameter to learn or a constant.
    """

    def __init__(self, mean: MeanNet, std: float | Sequence[float], learn_std: bool = False):
        super().__init__()
        stds = torch.as_tensor(std, dtype=torch.float64).reshape(-1)
        if len(stds) not in (1, mean.num_out) or not bool((stds > 0).all()):
            raise PoiseError(
                f"the action noise must be one positive number or one for each of the {mean.num_out} "
                f"actions, got {std}",
                code="out-of-range",
            )
        self.mean = mean
        log_std = stds.expand(mean.num_out).log().float().clone()
        self.log_std = nn.Parameter(log_std, requires_grad=learn_std)

    @property
    def num_obs(self) -> int:
        """O, the width of an observation."""
        return self.mean.num_in

    @property
    def num_drawn(self) -> int:
        """D, the width of what is drawn and learned."""
        return self.mean.num_out

    @property
    def num_actions(self) -> int:
        """A, the width of an action."""
        return self.num_drawn

    @property
    def action_log_std(self) -> Tensor:
        """log sigma `(A,)` of the actions, as a scale for errors; the same in all states."""
        return self.log_std

    def context(self, obs: Tensor) -> Tensor | None:
        """What parts that do not learn say of normalised `obs (N, O)`: `(N, C)`, or None if nothing.

        It is computed once where `distribution` is asked for again and again.
        """
        return None

    def distribution(self, obs: Tensor, context: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Mean `(N, D)` and log sigma, `(D,)` or `(N, D)`, of what is drawn, with gradients.

        Normalised `obs (N, O)` in bfloat16 are multiplied in bfloat16, see `MLP`.
        """
        return self.mean.forward(obs), self.log_std

    def drive(self, drawn: Tensor, context: Tensor | None = None) -> Tensor:
        """The action `(N, A)` that something drawn `(N, D)` stands for."""
        return drawn

    def forward(self, obs: Tensor) -> Tensor:
        """The mean `(..., D)` for normalised observations `(..., O)`."""
        return self.distribution(obs)[0]

    def act(self, obs: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """A drawn action `(..., A)`, or the mean action without a generator."""
        context = self.context(obs)
        drawn, log_std = self.distribution(obs, context)
        if generator is not None:
            noise = torch.randn(drawn.shape, generator=generator, device=drawn.device, dtype=drawn.dtype)
            drawn = drawn + noise * log_std.exp()
        return self.drive(drawn, context)
