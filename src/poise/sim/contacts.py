"""Contact forces per body, by MuJoCo's contact sensors."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np

from poise.errors import PoiseError, did_you_mean

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
            raise PoiseError(f"there is no body '{name}' to sense", hint=did_you_mean(name, known))
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
