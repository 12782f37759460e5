"""The GPU backend: `mujoco_warp` steps thousands of worlds, seen through torch without a copy."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import mujoco
import numpy as np
import torch
from mujoco.batch import MODEL_FIELDS
from torch import Tensor

from poise.errors import PoiseError, did_you_mean
from poise.sim.backend import STANDARD_FIELDS
from poise.sim.warp_setup import (
    Capacity,
    bytes_per_world,
    capacity,
    check_memory,
    free_memory,
    load_warp,
    resolve_device,
)
from poise.sim.worlds import Worlds, check_state, compile_model, row_index

_RK4 = int(mujoco.mjtIntegrator.mjINT_RK4)


class WarpModel:
    """A model on the current Warp device; `m` is mujoco_warp's; its fields may differ by world."""

    def __init__(self, model: mujoco.MjModel, num_envs: int, deterministic: bool) -> None:
        self._wp, mjw = load_warp()
        if model.opt.integrator == _RK4:
            raise PoiseError(
                "the GPU backend steps with the integrators discrete, implicitfast and euler, not RK4",
                hint="Set SimConfig.integrator.",
                code="physics-unsupported",
            )
        try:
            self.m: Any = mjw.put_model(model)
        except (RuntimeError, ValueError) as error:
            raise PoiseError(
                f"mujoco-warp cannot run this model: {error}", code="physics-unsupported"
            ) from error
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
                code="unknown-field",
            )
        old: Any = self._shared_array(field)
        new = self._wp.empty((self._num_envs, *old.shape[1:]), dtype=old.dtype, device=old.device)
        view = self._wp.to_torch(new)
        view.copy_(self._wp.to_torch(old).expand_as(view))
        # mujoco_warp's own mark for arrays with the world as first axis; it has no public one.
        new._is_batched = True  # noqa: SLF001
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


_STATE = (
    "time", "qpos", "qvel", "act", "history", "plastic", "qacc_warmstart", "ctrl", "qfrc_applied",
    "xfrc_applied", "eq_active", "mocap_pos", "mocap_quat", "userdata",
)  # fmt: skip
#: Fields that describe the last physics step: they depend on forces.
_FORCES = (
    "qacc", "qacc_smooth", "act_dot", "actuator_force", "qfrc_actuator", "qfrc_smooth",
    "qfrc_constraint", "cacc", "cfrc_int", "cfrc_ext", "sensordata",
)  # fmt: skip
#: Fields that follow from positions and velocities, beside those that every state shows.
_DERIVED = (
    "xmat", "ximat", "xanchor", "xaxis", "geom_xpos", "geom_xmat", "site_xpos", "site_xmat", "cam_xpos",
    "cam_xmat", "light_xpos", "light_xdir", "cdof", "cinert", "crb", "M", "ten_length", "ten_velocity",
    "actuator_length", "actuator_velocity", "cdof_dot", "qfrc_bias", "qfrc_spring", "qfrc_damper",
    "qfrc_gravcomp", "qfrc_fluid", "qfrc_passive",
)  # fmt: skip
_RNE = ("cacc", "cfrc_int", "cfrc_ext")
_BINDABLE: frozenset[str] = frozenset((*STANDARD_FIELDS, *_STATE, *_FORCES, *_DERIVED))
_HUGE = 1e10  # MuJoCo's mjMAXVAL, above which it calls a value bad.


class WarpBackend(Worlds):
    """`num_envs` worlds of one model on a GPU, or on the CPU for tests; see `Backend`.

    All numbers are float32. The state, the drive and the bound fields are Warp's own arrays.
    `step(n)` is one captured graph from its second call on (the first one compiles), launched on
    torch's current stream. A bad world (not finite) stays bad until it is written: unlike MuJoCo,
    Warp does not reset it. Contacts and constraint rows have fixed room; a step that needs more
    raises, since its result would be wrong.

    Args:
        device: "cuda", "cuda:1" or "cpu".
        contacts_per_world: room for contacts, on average over the worlds; None: from the model.
        constraints_per_world: room for constraint rows in each world; None: from the model.
        deterministic: the same bits in every run on a GPU, at some cost; the CPU always gives that.
    """

    def __init__(
        self,
        spec_or_model: mujoco.MjSpec | mujoco.MjModel,
        num_envs: int,
        device: str | torch.device = "cuda",
        *,
        contacts_per_world: int | None = None,
        constraints_per_world: int | None = None,
        deterministic: bool = False,
    ) -> None:
        super().__init__(compile_model(spec_or_model), num_envs, resolve_device(device))
        self._wp, self._mjw = load_warp()
        self._room = capacity(self._model, contacts_per_world, constraints_per_world)
        self._check_room()
        with self._stream():
            self._shared = WarpModel(self._model, num_envs, deterministic)
            self._d: Any = self._make_data()
        self._graphs: dict[int, Any] = {}
        self._stepped: set[int] = set()
        self._states = {n: self._tensor(n) for n in _STATE if self._tensor(n).numel()}
        self._defaults = {name: view[0].clone() for name, view in self._states.items()}
        self._outputs: dict[str, Tensor] = {}
        # Warp clears its sensors in mid-step, so that ours are kept apart.
        self._sensors = torch.zeros_like(self._tensor("sensordata"))
        self._step_sensors = self._wp.zeros_like(self._d.sensordata)
        self._felt = self._force_sensors()
        self._show()
        self.forward()

    @property
    def capacity(self) -> Capacity:
        """The room that each world has for contacts and constraint rows."""
        return self._room

    def write(self, rows: Tensor | None, qpos: Tensor, qvel: Tensor) -> None:
        to = self._rows(rows)
        n = len(to) if isinstance(to, Tensor) else self._num_envs
        check_state(self._model, n, qpos, qvel)
        if n == 0:
            return
        for name, view in self._states.items():
            view[to] = self._defaults[name]
        for name in ("M", "qacc", "act_dot"):
            # What a bad world left behind must not meet its new state.
            self._tensor(name)[to] = 0.0
        self._tensor("overflow")[to] = 0
        self._state.qpos[to] = qpos.detach().to(self._state.qpos)
        self._state.qvel[to] = qvel.detach().to(self._state.qvel)
        self._forward(to)

    def step(self, nstep: int = 1) -> None:
        live = self._live
        with self._stream():
            if self._shared.expanded:
                # Written model fields take effect at once.
                self._mjw.step1(self._shared.m, live)
            self._launch(nstep)
        if "sensordata" in self._outputs:
            last = self._wp.to_torch(self._step_sensors)
            self._sensors.copy_(torch.where(self._felt, last, self._tensor("sensordata")))
        self._check_overflow()

    def forward(self, rows: Tensor | None = None) -> None:
        self._forward(self._rows(rows))

    def snapshot(self, derived: bool = True, out: Tensor | None = None) -> Tensor:
        return torch.cat(
            [v.reshape(self._num_envs, -1).float() for v in self._kept(derived)], 1, out=out
        )

    def restore(self, snapshot: Tensor, rows: Tensor | None = None) -> None:
        to = self._rows(rows)
        n = len(to) if isinstance(to, Tensor) else self._num_envs
        widths = [[v[0].numel() for v in self._kept(derived)] for derived in (False, True)]
        short, full = (sum(w) for w in widths)
        derived = self._holds_derived(snapshot, n, full, short)
        parts = list(zip(self._kept(derived), snapshot.split(widths[derived], dim=1), strict=True))

        def put() -> None:
            for view, value in parts:
                view[to] = value.reshape(n, *view.shape[1:]).to(view)

        put()
        if not derived:
            self._forward(to)
            return
        with self._stream():
            self._mjw.step1(self._shared.m, self._live)
        put()

    def expand(self, field: str) -> Tensor:
        self._graphs.clear()  # They hold the addresses of the shared arrays.
        return self._shared.expand(field)

    def set_const(self, rows: Tensor | None = None) -> None:
        ids = range(self._num_envs) if rows is None else row_index(rows, self._num_envs).tolist()
        self._graphs.clear()
        self._shared.set_const(ids)
        self.forward()

    def unstable(self) -> Tensor:
        bad = torch.zeros(self._num_envs, dtype=torch.bool, device=self._device)
        for name in ("qpos", "qvel", "qacc", "ctrl"):
            # A comparison with NaN is false.
            bad |= ~(self._tensor(name).abs() < _HUGE).all(1)
        return bad

    def get_model(self, env: int) -> mujoco.MjModel:
        return self._shared.get_model(env)

    def get_data(self, env: int, data: mujoco.MjData | None = None) -> mujoco.MjData:
        out: Any = mujoco.MjData(self._model) if data is None else data
        for name, view in self._states.items():
            value = view[env].cpu().numpy()
            if name == "time":
                out.time = float(value)
            else:
                getattr(out, name)[:] = value.reshape(getattr(out, name).shape)
        return out

    def close(self) -> None:
        self._d = None
        self._graphs.clear()

    @property
    def _live(self) -> Any:
        if self._d is None:
            raise PoiseError("the backend is closed", code="backend-closed")
        return self._d

    @contextmanager
    def _stream(self) -> Iterator[None]:
        """Warp's work goes to this device, in order with torch's."""
        if self._device.type == "cpu":
            with self._wp.ScopedDevice("cpu"):
                yield
            return
        with self._wp.ScopedStream(self._wp.stream_from_torch(torch.cuda.current_stream(self._device))):
            yield

    def _make_data(self) -> Any:
        room, n = self._room, self._num_envs
        try:
            return self._mjw.make_data(
                self._model, n, nconmax=room.contacts, njmax=room.rows, nccdmax=room.convex
            )
        except (RuntimeError, MemoryError) as error:
            raise PoiseError(
                f"{self._device} has no room for {n} worlds: {error}", code="out-of-memory"
            ) from error

    def _check_room(self) -> None:
        per_world = bytes_per_world(self._model, self._room)
        check_memory(self._num_envs, per_world, free_memory(self._device), self._device)

    def _steps(self, nstep: int) -> None:
        """nstep times: forces and integration, then positions and velocities of the new state.

        Positions and velocities are current on entry, so that this costs no more than mujoco_warp's own
        `step` and leaves nothing a step behind.
        """
        for _ in range(nstep):
            self._mjw.step2(self._shared.m, self._live)
            self._wp.copy(self._step_sensors, self._live.sensordata)
            self._mjw.step1(self._shared.m, self._live)

    def _launch(self, nstep: int) -> None:
        if nstep not in self._graphs:
            # The first run compiles and loads the kernels, which a capture cannot.
            if nstep in self._stepped and self._can_capture():
                self._graphs[nstep] = self._captured(nstep)
            else:
                self._steps(nstep)
                self._stepped.add(nstep)
                return
        self._wp.capture_launch(self._graphs[nstep])

    def _can_capture(self) -> bool:
        """Whether what steps allocate in passing may be part of a graph: it needs memory pools."""
        return self._device.type == "cpu" or self._wp.is_mempool_enabled(str(self._device))

    def _captured(self, nstep: int) -> Any:
        """The launches of `_steps(nstep)` as one graph; nothing runs meanwhile."""
        if self._device.type == "cpu":
            with self._wp.ScopedCapture("cpu") as capture:
                self._steps(nstep)
            return capture.graph
        # The legacy stream, torch's default, cannot be captured, but one of our own can.
        torch.cuda.synchronize(self._device)
        own = self._wp.Stream(str(self._device))
        with self._wp.ScopedStream(own), self._wp.ScopedCapture(stream=own) as capture:
            self._steps(nstep)
        return capture.graph

    def _forward(self, to: Tensor | slice) -> None:
        """Derived fields of these worlds; force fields of the others still tell of their last step."""
        forces = [view for name, view in self._outputs.items() if name in _FORCES]
        kept = [view.clone() for view in forces]
        with self._stream():
            if forces:
                self._mjw.forward(self._shared.m, self._live)
                self._sensors.copy_(self._tensor("sensordata"))
            # Last, since the next step begins from what it leaves.
            self._mjw.step1(self._shared.m, self._live)
        for view, old in zip(forces, kept, strict=True):
            old[to] = view[to]
            view.copy_(old)

    def _check_overflow(self) -> None:
        kinds = self._mjw.OverflowType
        ignored = kinds.ITERATIONS | kinds.LS_ITERATIONS
        flags = self._tensor("overflow") & int(kinds.ALL & ~ignored)
        if not bool(flags.any()):
            return
        world = int(flags.nonzero()[0])
        flag, rows = int(flags[world]), int(self._tensor("nefc")[world])
        self._tensor("overflow").zero_()
        if flag & (kinds.NEFC | kinds.NJMAX_NNZ):
            raise PoiseError(
                f"{rows} constraint rows do not fit into the {self._room.rows} set aside",
                f"world {world}", "Make the WarpBackend with a larger constraints_per_world.",
                code="over-capacity",
            )  # fmt: skip
        raise PoiseError(
            f"the worlds have more contacts than the {self._room.contacts} per world set aside "
            f"({kinds(flag).name})",
            f"world {world}", "Make the WarpBackend with a larger contacts_per_world.",
            code="over-capacity",
        )  # fmt: skip

    def _rows(self, rows: Tensor | None) -> Tensor | slice:
        return slice(None) if rows is None else row_index(rows, self._num_envs).to(self._device)

    def _kept(self, derived: bool) -> list[Tensor]:
        outputs = [self._outputs[name] for name in sorted(self._outputs)] if derived else []
        return [*self._states.values(), *outputs]

    def raw(self, name: str) -> Tensor:
        """mujoco_warp's own array of that name, of any field, for diagnosis and benchmarks."""
        return self._tensor(name)

    def _tensor(self, name: str) -> Tensor:
        array = getattr(self._live, name)
        if not array.size:
            # An empty array has no address on a GPU, which torch may refuse.
            return torch.empty(self._num_envs, 0, device=self._device)
        return self._wp.to_torch(array)

    def _views(self, names: list[str]) -> dict[str, Tensor]:
        views = {name: self._view(name) for name in names}
        if not set(_FORCES).isdisjoint(names):
            self._forward(slice(None))  # Otherwise a new force field shows what came before it.
        return views

    def _view(self, name: str) -> Tensor:
        if name not in _BINDABLE:
            known: list[str] = sorted(_BINDABLE)
            raise PoiseError(
                f"'{name}' is not a MuJoCo data field that can be bound",
                hint=did_you_mean(name, known),
                code="unknown-field",
            )
        if name in self._states:
            return self._states[name]
        if name in _RNE and not self._shared.m.opt.run_rne_postconstraint:
            self._shared.m.opt.run_rne_postconstraint = True
            self._graphs.clear()
        view = self._sensors if name == "sensordata" else self._tensor(name)
        shape = np.shape(getattr(mujoco.MjData(self._model), name))
        self._outputs[name] = view.view(self._num_envs, *shape)
        return self._outputs[name]

    def _force_sensors(self) -> Tensor:
        """`(nsensordata,)` bool: columns of sensors that depend on forces."""
        model, felt = self._model, np.zeros(self._model.nsensordata, bool)
        for i in np.flatnonzero(model.sensor_needstage == int(mujoco.mjtStage.mjSTAGE_ACC)):
            felt[model.sensor_adr[i] : model.sensor_adr[i] + model.sensor_dim[i]] = True
        return torch.from_numpy(felt).to(self._device)
