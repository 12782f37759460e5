"""States as flat dictionaries of tensors, "part/name" by "part/name", ready for one file."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping

import torch
from torch import Tensor, nn

from poise.errors import PoiseError

State = dict[str, Tensor]


def prefixed(prefix: str, tensors: Mapping[str, Tensor]) -> State:
    """The tensors as clones under "prefix/name"."""
    return {f"{prefix}/{k}": v.detach().clone() for k, v in tensors.items()}


def under(prefix: str, tensors: Mapping[str, Tensor]) -> State:
    """The tensors with names that start with "prefix/", without it."""
    start = f"{prefix}/"
    return {k[len(start) :]: v for k, v in tensors.items() if k.startswith(start)}


def take(state: Mapping[str, Tensor], name: str) -> Tensor:
    """One tensor of a state, or a `PoiseError` that names it."""
    if name not in state:
        raise PoiseError(
            f"the saved state has no '{name}'", hint="Another kind of run saved it; start a new one"
        )
    return state[name]


def load_module(module: nn.Module, state: Mapping[str, Tensor], name: str) -> None:
    """Copies "name/..." into a module; shapes and names must be the same."""
    own, saved = module.state_dict(), under(name, state)
    for key, value in own.items():
        if key in saved and saved[key].shape == value.shape:
            continue
        found = f"has the shape {tuple(saved[key].shape)}" if key in saved else "is missing"
        raise PoiseError(
            f"'{name}/{key}' {found} in the saved state where {tuple(value.shape)} is expected",
            hint="Use the layer sizes and the environment with which the state was saved",
        )
    with torch.no_grad():
        for key, value in own.items():
            value.copy_(saved[key])


def optimizer_state(optimizer: torch.optim.Optimizer) -> State:
    """Learning rates and moments, numbered in the order of the parameters."""
    lr = [group["lr"] for group in optimizer.param_groups]
    out = {"lr": torch.tensor(lr, dtype=torch.float64)}
    params = [p for group in optimizer.param_groups for p in group["params"]]
    for i, p in enumerate(params):
        # A parameter that was never stepped has no moments yet.
        out |= {f"{i}/{k}": v.detach().clone() for k, v in optimizer.state.get(p, {}).items()}
    return out


def load_optimizer_state(optimizer: torch.optim.Optimizer, state: Mapping[str, Tensor]) -> None:
    """Restores what `optimizer_state` returned."""
    rates, hint = take(state, "lr"), "Use the layer sizes with which the state was saved"
    if rates.shape != (len(optimizer.param_groups),):
        raise PoiseError(
            f"the saved optimiser has learning rates of shape {tuple(rates.shape)}", hint=hint
        )
    for group, lr in zip(optimizer.param_groups, rates.tolist(), strict=True):
        group["lr"] = lr
    optimizer.state.clear()
    params = [p for group in optimizer.param_groups for p in group["params"]]
    for i, p in enumerate(params):
        moments = {k: v.detach().clone() for k, v in under(str(i), state).items()}
        for name, value in moments.items():
            # A moment is as its parameter, the count of steps a number.
            if value.shape != p.shape and (name != "step" or value.numel() != 1):
                what = f"the saved optimiser's '{i}/{name}' has the shape {tuple(value.shape)}"
                raise PoiseError(f"{what} where {tuple(p.shape)} is expected", hint=hint)
        if moments:
            optimizer.state[p] = {k: v.to(p.device) for k, v in moments.items()}


def make_generator(seed: int, purpose: str, device: torch.device | str = "cpu") -> torch.Generator:
    """A generator of its own for each purpose, so that one draw more here moves nothing there."""
    digest = hashlib.sha256(f"{seed}:{purpose}".encode()).digest()
    return torch.Generator(device=device).manual_seed(int.from_bytes(digest[:8], "little") >> 1)


def set_generator(generator: torch.Generator, state: Tensor) -> None:
    """Goes on from a generator's state.

    The state of another kind of device cannot be taken over; it becomes a seed, so that the same
    run resumed there twice is the same.
    """
    if generator.get_state().shape == state.shape:
        generator.set_state(state.cpu())
        return
    digest = hashlib.sha256(state.cpu().numpy().tobytes()).digest()
    generator.manual_seed(int.from_bytes(digest[:8], "little") >> 1)
