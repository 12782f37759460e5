"""Adam without torch's compiler.

The first optimiser of `torch.optim` that a process makes imports that compiler, which Poise has no use
for: more than two seconds, for which a training of one motion, or the adaptation of a network to a
clip's keyframes, would wait.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import torch
from torch import Tensor

Groups = Iterable[Tensor] | Iterable[Mapping[str, Any]]


class Adam:
    """Adam (Kingma and Ba 2015, Algorithm 1), number for number as `torch.optim.Adam` has it.

    With decay it is `torch.optim.AdamW`, whose decay is no part of the moments (Loshchilov and Hutter
    2019, Algorithm 2).

    Args:
        params: parameters, or groups of them with a `weight_decay` of their own.
        lr, betas, eps: alpha, (beta_1, beta_2) and epsilon.
        weight_decay: lambda.
        fused: one kernel steps all parameters of a group, which have one type and lie on one device.
        amsgrad: steps are by the largest second moment so far (Reddi et al. 2018, Algorithm 2), unfused.

    Attributes:
        param_groups: of each group its `params`, and its `lr` and `weight_decay`, which may be changed.
        state: of each parameter that was stepped its moments, and the count of its steps.
    """

    def __init__(
        self,
        params: Groups,
        lr: float = 1e-3,
        betas: tuple[float, float] = (0.9, 0.999),
        eps: float = 1e-8,
        weight_decay: float = 0.0,
        fused: bool = True,
        amsgrad: bool = False,
    ):
        given: list[Any] = list(params)
        groups = [{"params": given}] if given and isinstance(given[0], Tensor) else given
        plain = {"lr": lr, "weight_decay": weight_decay}
        self.param_groups: list[dict[str, Any]] = [
            {**plain, **group, "params": list(group["params"])} for group in groups
        ]
        self.betas, self.eps, self.amsgrad = betas, eps, amsgrad
        # The kernels are no promise of torch's.
        kernels = ("_fused_adam_", "_fused_adamw_", "_foreach_add_")
        self.fused = fused and not amsgrad and all(hasattr(torch, name) for name in kernels)
        self.state: dict[Tensor, dict[str, Tensor]] = {}

    def zero_grad(self, set_to_none: bool = True) -> None:
        """Forgets all gradients."""
        for group in self.param_groups:
            for p in group["params"]:
                if set_to_none:
                    p.grad = None
                elif p.grad is not None:
                    p.grad.zero_()

    @torch.no_grad()
    def step(self) -> None:
        """One step along the gradients that there are."""
        for group in self.param_groups:
            params = [p for p in group["params"] if p.grad is not None]
            for p in params:
                if p not in self.state:
                    names = ("exp_avg", "exp_avg_sq", *(("max_exp_avg_sq",) if self.amsgrad else ()))
                    own = {"step": torch.zeros((), device=p.device)}
                    self.state[p] = own | {name: torch.zeros_like(p) for name in names}
            (self._all_at_once if self.fused else self._each)(params, group)

    def _all_at_once(self, params: list[Tensor], group: Mapping[str, Any]) -> None:
        if not params:
            return
        first, second, steps = (
            [self.state[p][name] for p in params] for name in ("exp_avg", "exp_avg_sq", "step")
        )
        torch._foreach_add_(steps, 1)
        (b1, b2), decay = self.betas, group["weight_decay"]
        kernel = torch._fused_adamw_ if decay > 0 else torch._fused_adam_
        own = {"lr": group["lr"], "beta1": b1, "beta2": b2, "weight_decay": decay, "eps": self.eps}
        grads = [p.grad for p in params if p.grad is not None]
        kernel(params, grads, first, second, [], steps, amsgrad=False, maximize=False, **own)

    def _each(self, params: list[Tensor], group: Mapping[str, Any]) -> None:
        (b1, b2), lr = self.betas, group["lr"]
        for p in params:
            assert p.grad is not None
            own = self.state[p]
            own["step"] += 1
            t = float(own["step"])
            if group["weight_decay"] > 0:
                p.mul_(1 - lr * group["weight_decay"])
            # m_t and v_t, then theta_t = theta_{t-1} - alpha m^_t / (sqrt(v^_t) + epsilon).
            own["exp_avg"].lerp_(p.grad, 1 - b1)
            own["exp_avg_sq"].mul_(b2).addcmul_(p.grad, p.grad, value=1 - b2)
            second = own["exp_avg_sq"]
            if self.amsgrad:
                second = torch.maximum(own["max_exp_avg_sq"], second, out=own["max_exp_avg_sq"])
            root = (second.sqrt() / (1 - b2**t) ** 0.5).add_(self.eps)
            p.addcdiv_(own["exp_avg"], root, value=-lr / (1 - b1**t))


#: Optimisers whose state a checkpoint keeps.
Optimizer = Adam | torch.optim.Optimizer
