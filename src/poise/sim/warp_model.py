"""The model that the worlds of a Warp backend share, and the fields in which they differ."""

from __future__ import annotations

import copy
from collections.abc import Iterable
from typing import Any

import mujoco
import numpy as np
import torch
from mujoco.batch import MODEL_FIELDS
from torch import Tensor

from poise.errors import PoiseError, did_you_mean
from poise.sim.warp_setup import load_warp

_RK4 = int(mujoco.mjtIntegrator.mjINT_RK4)


class WarpModel:
    """A model on the current Warp device; `m` is mujoco_warp's; its fields may differ by world."""

    def __init__(self, model: mujoco.MjModel, num_envs: int, deterministic: bool) -> None:
        self._wp, mjw = load_warp()
        if model.opt.integrator == _RK4:
            raise PoiseError(
                "the GPU backend steps with the integrators discrete, implicitfast and euler, not RK4",
                hint="Set SimConfig.integrator.",
            )
        try:
            self.m: Any = mjw.put_model(model)
        except (RuntimeError, ValueError) as error:
            raise PoiseError(f"mujoco-warp cannot run this model: {error}") from error
        self.m.opt.warn_overflow = 0  # The backend raises instead of printing.
        self.m.opt.deterministic = deterministic
        # The solver stops when all worlds have converged: in a CUDA graph by a conditional node, which
        # drivers older than 12.4 lack (then it makes all its iterations), on the CPU by itself.
        cuda = self._wp.get_device().is_cuda
        self.m.opt.graph_conditional = not cuda or self._wp.is_conditional_graph_supported()
        self._model, self._num_envs = model, num_envs
        self.expanded: dict[str, Tensor] = {}

    def expand(self, field: str) -> Tensor:
        """The live `(N, ...)` values of a model field ("opt.x" too), one row per world."""
        if field in self.expanded:
            return self.expanded[field]
        known = [name for name in sorted(MODEL_FIELDS) if self._shared_array(name) is not None]
        if field not in known:
            raise PoiseError(
                f"'{field}' is not a model field that can differ between worlds",
                hint=did_you_mean(field, known),
            )
        old: Any = self._shared_array(field)
        new = self._wp.empty((self._num_envs, *old.shape[1:]), dtype=old.dtype, device=old.device)
        view = self._wp.to_torch(new)
        view.copy_(self._wp.to_torch(old).expand_as(view))
        new._is_batched = True  # mujoco_warp's own mark for arrays with the world as first axis.
        setattr(*self._place(field), new)
        self.expanded[field] = view
        return view

    def set_const(self, ids: Iterable[int]) -> None:
        """Recompute derived constants of these worlds, in float64 by MuJoCo itself, world by world."""
        if not self.expanded:
            return
        data = mujoco.MjData(self._model)
        for env in ids:
            model = self.get_model(env)
            before = copy.copy(model)
            mujoco.mj_setConst(model, data)
            for name in MODEL_FIELDS:
                value = _field(model, name)
                if np.array_equal(value, _field(before, name)) or self._shared_array(name) is None:
                    continue
                row = self.expand(name)[env]
                row.copy_(torch.from_numpy(np.array(value)).to(row).view_as(row))

    def get_model(self, env: int) -> mujoco.MjModel:
        """A copy of one world's model; values that were not changed keep all their digits."""
        model = copy.copy(self._model)
        for name, values in self.expanded.items():
            mine, shared = values[env].cpu().numpy(), np.asarray(_field(self._model, name))
            mine = mine.reshape(shared.shape)
            value = np.where(mine == shared.astype(mine.dtype), shared, mine)
            if name.startswith("opt.") and not shared.shape:
                setattr(model.opt, name[4:], value.item())
            else:
                _field(model, name)[...] = value
        return model

    def _place(self, field: str) -> tuple[Any, str]:
        return (self.m.opt, field[4:]) if field.startswith("opt.") else (self.m, field)

    def _shared_array(self, field: str) -> Any | None:
        """Warp's array of a field with the world as first axis, or None."""
        array: Any = getattr(*self._place(field), None)
        if not isinstance(array, self._wp.array) or not array.ndim:
            return None
        if getattr(array.dtype, "_wp_scalar_type_", array.dtype) is not self._wp.float32:
            return None
        rows = self._num_envs if field in self.expanded else 1
        shape = (rows, *np.shape(_field(self._model, field)))
        return array if tuple(self._wp.to_torch(array).shape) == shape else None


def _field(model: mujoco.MjModel, name: str) -> Any:
    return getattr(model.opt, name[4:]) if name.startswith("opt.") else getattr(model, name)
