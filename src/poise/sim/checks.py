"""What every backend checks before it touches its worlds."""

from __future__ import annotations

import math

import mujoco
import torch
from torch import Tensor

from poise.errors import PoiseError


def compile_model(spec_or_model: mujoco.MjSpec | mujoco.MjModel) -> mujoco.MjModel:
    """The compiled model; a mistake in a description becomes a PoiseError."""
    if isinstance(spec_or_model, mujoco.MjModel):
        return spec_or_model
    try:
        return spec_or_model.compile()
    except ValueError as error:
        raise PoiseError(f"MuJoCo cannot compile the model: {error}") from error


def check_state(model: mujoco.MjModel, n: int, qpos: Tensor, qvel: Tensor) -> None:
    """Raise unless `qpos (n, nq)` and `qvel (n, nv)` have these shapes and are finite."""
    if qpos.shape != (n, model.nq) or qvel.shape != (n, model.nv):
        raise PoiseError(
            f"write needs qpos ({n}, {model.nq}) and qvel ({n}, {model.nv}), "
            f"got {tuple(qpos.shape)} and {tuple(qvel.shape)}"
        )
    for name, value in (("qpos", qpos), ("qvel", qvel)):
        # A sum that is finite costs less than a mask and vouches for every number.
        if not math.isfinite(float(value.sum())) and not bool(value.isfinite().all()):
            row, column = torch.nonzero(~value.isfinite())[0].tolist()
            raise PoiseError(f"{name} is not finite in row {row}, column {column}", "write")


def row_index(rows: Tensor, num_envs: int) -> Tensor:
    """Rows as int64 indices `(n,)`, in the caller's order; a mask `(N,)` gives the true ones."""
    rows = torch.as_tensor(rows)
    if rows.dtype == torch.bool:
        if rows.shape != (num_envs,):
            raise PoiseError(f"a row mask must be ({num_envs},), got {tuple(rows.shape)}")
        return torch.nonzero(rows)[:, 0]
    rows = rows.reshape(-1).long()
    values = rows.sort().values
    # One comparison decides, so that a GPU is waited for once.
    wrong = (values < 0).any() | (values >= num_envs).any() | (values.diff() == 0).any()
    if len(values) and bool(wrong):
        raise PoiseError(f"rows must be distinct and in 0 to {num_envs - 1}, got {rows.tolist()[:12]}")
    return rows
