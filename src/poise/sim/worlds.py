"""The common base of all backends: the state they show, and their checks before worlds change."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence

import mujoco
import numpy as np
import torch
from torch import Tensor

from poise.errors import PoiseError, did_you_mean
from poise.sim.backend import SimState
from poise.sim.drive import Drive

_FORCE = 1 << int(mujoco.mjtConDataField.mjCONDATA_FORCE)
_NETFORCE = 3  # The position of "netforce" in the sensor's list of reductions.
_BODY = int(mujoco.mjtObj.mjOBJ_BODY)


def add_contact_sensors(
    spec: mujoco.MjSpec, bodies: Sequence[str] | None = None, against: str | None = None
) -> None:
    """Add one net contact force sensor per body, which `Backend.contacts` then reads.

    Args:
        spec: the model description, changed in place.
        bodies: names of bodies; None means every named moving body that has a geom.
        against: count only contacts with this body ("world" for the ground); None means all.
    """
    known = [b.name for b in spec.bodies if b.name]
    if bodies is None:
        bodies = [b.name for b in spec.bodies if b.name and b.name != "world" and b.geoms]
    for name in [*bodies, *([against] if against else [])]:
        if name not in known:
            raise PoiseError(
                f"there is no body '{name}' to sense",
                hint=did_you_mean(name, known),
                code="unknown-body",
            )
    for name in bodies:
        sensor = spec.add_sensor(
            name=f"contact_force/{name}", type=mujoco.mjtSensor.mjSENS_CONTACT,
            objtype=mujoco.mjtObj.mjOBJ_BODY, objname=name, intprm=[_FORCE, _NETFORCE, 1],
        )  # fmt: skip
        if against:
            sensor.reftype, sensor.refname = mujoco.mjtObj.mjOBJ_BODY, against


def contact_columns(model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
    """Bodies `(K,)` that have a net force sensor, and their columns of sensordata `(K, 3)`."""
    chosen = [
        i
        for i in range(model.nsensor)
        if model.sensor_type[i] == int(mujoco.mjtSensor.mjSENS_CONTACT)
        and model.sensor_objtype[i] == _BODY
        and tuple(model.sensor_intprm[i, :3]) == (_FORCE, _NETFORCE, 1)
    ]
    return model.sensor_objid[chosen].astype(np.int64), model.sensor_adr[chosen][:, None] + np.arange(3)


def compile_model(spec_or_model: mujoco.MjSpec | mujoco.MjModel) -> mujoco.MjModel:
    """The compiled model; a mistake in a description becomes a PoiseError."""
    if isinstance(spec_or_model, mujoco.MjModel):
        return spec_or_model
    try:
        return spec_or_model.compile()
    except ValueError as error:
        raise PoiseError(
            f"MuJoCo cannot compile the model: {error}", code="model-not-compiled"
        ) from error


def check_state(model: mujoco.MjModel, n: int, qpos: Tensor, qvel: Tensor) -> None:
    """Raise unless `qpos (n, nq)` and `qvel (n, nv)` have these shapes and are finite."""
    if qpos.shape != (n, model.nq) or qvel.shape != (n, model.nv):
        raise PoiseError(
            f"write needs qpos ({n}, {model.nq}) and qvel ({n}, {model.nv}), "
            f"got {tuple(qpos.shape)} and {tuple(qvel.shape)}",
            code="wrong-shape",
        )
    for name, value in (("qpos", qpos), ("qvel", qvel)):
        # A sum that is finite costs less than a mask and vouches for every number.
        if not math.isfinite(float(value.sum())) and not bool(value.isfinite().all()):
            row, column = torch.nonzero(~value.isfinite())[0].tolist()
            raise PoiseError(
                f"{name} is not finite in row {row}, column {column}", "write", code="not-finite"
            )


def row_index(rows: Tensor, num_envs: int) -> Tensor:
    """Rows as int64 indices `(n,)`, in the caller's order; a mask `(N,)` gives the true ones."""
    rows = torch.as_tensor(rows)
    if rows.dtype == torch.bool:
        if rows.shape != (num_envs,):
            raise PoiseError(
                f"a row mask must be ({num_envs},), got {tuple(rows.shape)}", code="wrong-shape"
            )
        return torch.nonzero(rows)[:, 0]
    rows = rows.reshape(-1).long()
    values = rows.sort().values
    # One comparison decides, so that a GPU is waited for once.
    wrong = (values < 0).any() | (values >= num_envs).any() | (values.diff() == 0).any()
    if len(values) and bool(wrong):
        raise PoiseError(
            f"rows must be distinct and in 0 to {num_envs - 1}, got {rows.tolist()[:12]}",
            code="index-outside",
        )
    return rows


class Worlds(ABC):
    """The members that are the same in all backends; see `Backend`."""

    def __init__(self, model: mujoco.MjModel, num_envs: int, device: torch.device) -> None:
        if num_envs < 1:
            raise PoiseError(f"num_envs must be above 0, got {num_envs}", code="out-of-range")
        self._model, self._num_envs, self._device = model, num_envs, device

    def _show(self) -> None:
        """Makes state and drive, once the worlds are there."""
        self._state = SimState(self._views)
        self._drive = Drive(**self._views(["ctrl", "qfrc_applied", "xfrc_applied"]))
        self._contact_bodies, self._contact_columns = (
            torch.from_numpy(x).to(self._device) for x in contact_columns(self._model)
        )
        if len(self._contact_bodies):
            self._state.bind(["sensordata"])

    @abstractmethod
    def _views(self, names: list[str]) -> dict[str, Tensor]:
        """Live views of the state's fields by name, see `SimState.bind`."""

    @property
    def model(self) -> mujoco.MjModel:
        return self._model

    @property
    def num_envs(self) -> int:
        return self._num_envs

    @property
    def device(self) -> torch.device:
        return self._device

    @property
    def state(self) -> SimState:
        return self._state

    @property
    def drive(self) -> Drive:
        return self._drive

    def contacts(self) -> Tensor:
        if not len(self._contact_bodies):
            raise PoiseError(
                "the model has no contact force sensors",
                hint="Call poise.sim.add_contact_sensors(spec) before making the backend.",
                code="sensors-missing",
            )
        sensed = self._state["sensordata"]
        out = sensed.new_zeros(self._num_envs, self._model.nbody, 3)
        # The sensed force is what the first body exerts on the others, so the sign turns.
        out[:, self._contact_bodies] = -sensed[:, self._contact_columns]
        return out

    @staticmethod
    def _holds_derived(snapshot: Tensor, n: int, full: int, short: int) -> bool:
        """Whether a snapshot of n worlds has derived fields, `(n, full)`, or none, `(n, short)`."""
        if snapshot.shape not in ((n, full), (n, short)):
            raise PoiseError(
                f"the snapshot has shape {tuple(snapshot.shape)}, but this backend needs "
                f"({n}, {full}), or ({n}, {short}) without derived fields",
                hint="Restore into the same model, with the same state fields bound.",
                code="snapshot-differs",
            )
        return snapshot.shape[1] == full
