"""The CPU backend: `mujoco.batch` steps all worlds on C threads, with no copy to torch."""

from __future__ import annotations

import mujoco
import numpy as np
import torch
from mujoco.batch import DATA_FIELDS, MODEL_FIELDS, Batch, SimulationError
from torch import Tensor

from poise.errors import PoiseError, did_you_mean
from poise.sim.worlds import Worlds, check_state, compile_model, row_index

State = tuple[Tensor, Tensor]
_NONE = int(mujoco.mjtStage.mjSTAGE_NONE)
_VEL = int(mujoco.mjtStage.mjSTAGE_VEL)
_BAD = [
    int(mujoco.mjtWarning.mjWARN_BADQPOS),
    int(mujoco.mjtWarning.mjWARN_BADQVEL),
    int(mujoco.mjtWarning.mjWARN_BADQACC),
    int(mujoco.mjtWarning.mjWARN_BADCTRL),
]


class CpuBackend(Worlds):
    """`num_envs` worlds of one model on `threads` threads (0: all cores); see `Backend`.

    All numbers are float64 and the same, bit for bit, at any number of threads and as in a
    plain `mj_step` loop. The drive's tensors are views of the state rows, so a snapshot holds
    what was applied as well.
    """

    def __init__(
        self, spec_or_model: mujoco.MjSpec | mujoco.MjModel, num_envs: int, threads: int = 0
    ) -> None:
        if threads < 0:
            raise PoiseError(f"threads must not be below 0, got {threads}", code="out-of-range")
        super().__init__(compile_model(spec_or_model), num_envs, torch.device("cpu"))
        self._batch: Batch | None = Batch(self._model, num_envs, min(threads, num_envs))
        self._rows = torch.from_numpy(self._live.state)
        self._outputs: dict[str, Tensor] = {}
        self._show()
        self._warmstart = self._view("qacc_warmstart")

    def write(self, rows: Tensor | None, qpos: Tensor, qvel: Tensor) -> None:
        ids, order = self._ids(rows)
        n = self._num_envs if ids is None else len(ids)
        check_state(self._model, n, qpos, qvel)
        if n == 0:
            return
        self._run("reset", ids, stage=_NONE)
        to = slice(None) if ids is None else torch.from_numpy(ids).long()
        source = slice(None) if order is None else order
        self._state.qpos[to] = qpos.detach()[source].to(self._state.qpos)
        self._state.qvel[to] = qvel.detach()[source].to(self._state.qvel)
        self._run("forward", ids)

    def step(self, nstep: int = 1) -> None:
        # The velocity stage afterwards makes positions, velocities and what depends on them
        # describe the new state, where mj_step alone leaves them one physics step behind.
        self._run("step", None, nstep=nstep, stage=_VEL)

    def successors(self, qpos: Tensor, qvel: Tensor, ctrl: Tensor, applied: Tensor, nstep: int) -> State:
        """What n <= `num_envs` states come to in `nstep` physics steps, positions and velocities.

        qpos `(n, nq)`, qvel `(n, nv)`; ctrl `(n, nu)` and applied `(n, nv)`, generalized forces, are
        held. The first n worlds are used for it: afterwards they stand there, with fields of `state`
        that still describe where they were. Nothing of what a world did before has a part in it.
        """
        n = len(qpos)
        for view, value in (
            (self._state.qpos, qpos),
            (self._state.qvel, qvel),
            (self._drive.ctrl, ctrl),
            (self._drive.qfrc_applied, applied),
            (self._drive.xfrc_applied, None),
            (self._warmstart, None),
        ):
            view[:n] = 0.0 if value is None else value
        self._run("step", np.arange(n, dtype=np.int32), nstep=nstep, stage=_NONE)
        return self._state.qpos[:n].clone(), self._state.qvel[:n].clone()

    def forward(self, rows: Tensor | None = None) -> None:
        self._run("forward", self._ids(rows)[0])

    def snapshot(self, derived: bool = True, out: Tensor | None = None) -> Tensor:
        parts = [self._rows]
        if derived:
            outputs = (self._outputs[name] for name in sorted(self._outputs))
            parts += [value.reshape(self._num_envs, -1).to(torch.float64) for value in outputs]
        return torch.cat(parts, 1, out=out)

    def restore(self, snapshot: Tensor, rows: Tensor | None = None) -> None:
        ids, order = self._ids(rows)
        n = self._num_envs if ids is None else len(ids)
        names = sorted(self._outputs)
        widths = [self._rows.shape[1], *(self._outputs[name][0].numel() for name in names)]
        derived = self._holds_derived(snapshot, n, sum(widths), widths[0])
        to = slice(None) if ids is None else torch.from_numpy(ids).long()
        source = snapshot if order is None else snapshot[order]
        self._rows[to] = source[:, : widths[0]].to(self._rows)
        if not derived:
            self._run("forward", ids)
            return
        for name, value in zip(names, source.split(widths, dim=1)[1:], strict=True):
            target = self._outputs[name]
            target[to] = value.reshape(n, *target.shape[1:]).to(target.dtype)

    def expand(self, field: str) -> Tensor:
        if field not in MODEL_FIELDS:
            raise PoiseError(
                f"'{field}' is not a model field that can differ between worlds",
                hint=did_you_mean(field, sorted(MODEL_FIELDS)),
                code="unknown-field",
            )
        return torch.from_numpy(self._live.expand(field))

    def set_const(self, rows: Tensor | None = None) -> None:
        self._run("set_const", self._ids(rows)[0])

    def unstable(self) -> Tensor:
        counts = self._live.warning[:, _BAD, 1]
        bad = counts.any(axis=1)
        if bad.any():
            # MuJoCo's reset of a bad world sets its counters back to one, so that a second
            # failure would not show as a rise: they are cleared here instead.
            self._live.warning[bad] = 0
        return torch.from_numpy(bad)

    def get_model(self, env: int) -> mujoco.MjModel:
        return self._live.get_model(env)

    def get_data(self, env: int, data: mujoco.MjData | None = None) -> mujoco.MjData:
        return self._live.get_data(env, data)

    def close(self) -> None:
        self._batch = None

    @property
    def _live(self) -> Batch:
        if self._batch is None:
            raise PoiseError("the backend is closed", code="backend-closed")
        return self._batch

    def _views(self, names: list[str]) -> dict[str, Tensor]:
        views = {name: self._view(name) for name in names}
        if not self._outputs.keys().isdisjoint(names):
            # A new output reads zero until the next call, so it is computed now.
            self._run("forward", None)
        return views

    def _view(self, name: str) -> Tensor:
        if name not in DATA_FIELDS:
            raise PoiseError(
                f"'{name}' is not a MuJoCo data field that can be bound",
                hint=did_you_mean(name, sorted(DATA_FIELDS)),
                code="unknown-field",
            )
        array = self._live.bind(name)
        if array.flags.writeable:
            return torch.from_numpy(array)  # A part of the state rows.
        # Outputs of a call are marked read-only for users; torch knows no such mark and would
        # warn, and restore() has to write them.
        array = array.view()
        array.flags.writeable = True
        self._outputs[name] = torch.from_numpy(array)
        return self._outputs[name]

    def _ids(self, rows: Tensor | None) -> tuple[np.ndarray | None, Tensor | None]:
        """Sorted int32 ids for Batch, and the order that sorts the caller's rows likewise."""
        if rows is None:
            return None, None
        if rows.dtype == torch.int64 and rows.ndim == 1:
            ids = rows.numpy()
            # Of sorted ids the first and the last tell the range; resets of few worlds come this way.
            if len(ids) and ids[0] >= 0 and ids[-1] < self._num_envs and (ids[1:] > ids[:-1]).all():
                return ids.astype(np.int32), None
        rows = row_index(rows, self._num_envs)
        if bool((rows.diff() > 0).all()):
            return rows.to(torch.int32).numpy(), None
        values, order = rows.sort()
        return values.to(torch.int32).numpy(), order

    def _run(self, call: str, ids: np.ndarray | None, **options: int) -> None:
        try:
            getattr(self._live, call)(ids, **options)
        except SimulationError as error:
            raise PoiseError(
                f"MuJoCo failed in {call}: {error}", f"worlds {error.ids.tolist()[:8]}",
                "These worlds kept their state from before the call.", code="physics-failed",
            ) from error  # fmt: skip
