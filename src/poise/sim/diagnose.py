"""Which quantity of which joint went bad first, found by stepping one world slowly."""

from __future__ import annotations

import copy
from dataclasses import dataclass

import mujoco
import numpy as np

_STATE = mujoco.mjtState.mjSTATE_INTEGRATION
_HUGE = 1e10  # MuJoCo's mjMAXVAL.
_ROTARY = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_BALL))


@dataclass(frozen=True)
class Cause:
    """What went bad: a MuJoCo quantity, where, and its value.

    Attributes:
        quantity: "qvel", "qpos", "qacc", "ctrl", "qfrc_applied" or "xfrc_applied".
        part: joint, body or actuator by name.
        value: the bad number (NaN allowed), in `unit`.
        substep: the physics step after which it was seen, from 1; 0 means before the first, so it was
            put in from outside.
    """

    quantity: str
    part: str
    value: float
    unit: str
    substep: int
    nstep: int

    def __str__(self) -> str:
        when = "before the step began"
        if self.substep:
            when = f"in physics step {self.substep} of {self.nstep}"
        number = f"{self.value:.4g} {self.unit}".strip()
        return f"{self.quantity} of {self.part} became {number} {when}"

    @property
    def hint(self) -> str:
        """What to do about it."""
        if self.quantity in ("ctrl", "qfrc_applied", "xfrc_applied"):
            return "What was added to the drive is bad: look at the policy's action and the forces."
        if self.substep == 0:
            return "The state was bad when it was written: look at the reference at this frame."
        return "Raise SimConfig.rate_hz, or lower the gains and forces on this joint."


def diagnose(model: mujoco.MjModel, state: np.ndarray, nstep: int, speed_limit: float) -> Cause:
    """Run nstep physics steps from an integration state and name the first bad quantity.

    MuJoCo's automatic reset is off here, so that the bad numbers stay to be seen. When nothing
    is found, the fastest joint after the last step is named.
    """
    model = copy.copy(model)
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    data = mujoco.MjData(model)
    mujoco.mj_setState(model, data, state, _STATE)
    cause = _bad_input(model, data, nstep) or _bad_state(model, data, data.qvel, 0, nstep, speed_limit)
    for substep in range(1, nstep + 1):
        if cause is not None:
            return cause
        speeds = data.qvel.copy()
        mujoco.mj_step(model, data)
        cause = _bad_state(model, data, speeds, substep, nstep, speed_limit)
    if cause is not None:
        return cause
    dof = int(np.argmax(np.abs(data.qvel)))
    unit = _speed_unit(model, dof)
    return Cause("qvel", _dof_name(model, dof), float(data.qvel[dof]), unit, nstep, nstep)


def _bad_input(model: mujoco.MjModel, data: mujoco.MjData, nstep: int) -> Cause | None:
    for name, values in (
        ("ctrl", data.ctrl),
        ("qfrc_applied", data.qfrc_applied),
        ("xfrc_applied", data.xfrc_applied),
    ):
        bad = np.argwhere(~(np.abs(values) < _HUGE))
        if not len(bad):
            continue
        index = tuple(int(i) for i in bad[0])
        if name == "ctrl":
            part = f"actuator '{_name(model, mujoco.mjtObj.mjOBJ_ACTUATOR, index[0])}'"
        elif name == "qfrc_applied":
            part = _dof_name(model, index[0])
        else:
            part = f"body '{_name(model, mujoco.mjtObj.mjOBJ_BODY, index[0])}'"
        return Cause(name, part, float(values[index]), "", 0, nstep)
    return None


def _bad_state(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    speeds: np.ndarray,
    substep: int,
    nstep: int,
    limit: float,
) -> Cause | None:
    """The worst bad number; where all are NaN at once, the joint that was fastest before is named."""
    candidates: tuple[tuple[str, np.ndarray, float], ...] = (
        ("qvel", data.qvel, limit),
        ("qacc", data.qacc, _HUGE),
    )
    for quantity, values, bound in candidates[: 1 if substep == 0 else 2]:
        lost = ~np.isfinite(values)
        over = lost | ~(np.abs(values) < bound)
        if over.any():
            size = np.where(lost, np.nan_to_num(np.abs(speeds)), -1.0) if lost.any() else np.abs(values)
            dof = int(np.argmax(size))
            unit = _speed_unit(model, dof) + ("/s" if quantity == "qacc" else "")
            return Cause(quantity, _dof_name(model, dof), float(values[dof]), unit, substep, nstep)
    bad = np.flatnonzero(~(np.abs(data.qpos) < _HUGE))
    if not len(bad):
        return None
    joint = int(np.searchsorted(model.jnt_qposadr, bad[0], side="right")) - 1
    return Cause("qpos", _joint_name(model, joint), float(data.qpos[bad[0]]), "", substep, nstep)


def _name(model: mujoco.MjModel, kind: mujoco.mjtObj, index: int) -> str:
    return mujoco.mj_id2name(model, kind, index) or str(index)


def _joint_name(model: mujoco.MjModel, joint: int) -> str:
    body = _name(model, mujoco.mjtObj.mjOBJ_BODY, int(model.jnt_bodyid[joint]))
    return f"joint '{_name(model, mujoco.mjtObj.mjOBJ_JOINT, joint)}' (body '{body}')"


def _dof_name(model: mujoco.MjModel, dof: int) -> str:
    return _joint_name(model, int(model.dof_jntid[dof]))


def _speed_unit(model: mujoco.MjModel, dof: int) -> str:
    joint = int(model.dof_jntid[dof])
    kind = model.jnt_type[joint]
    turns = kind == int(mujoco.mjtJoint.mjJNT_FREE) and dof - model.jnt_dofadr[joint] >= 3
    return "rad/s" if turns or kind in _ROTARY else "m/s"
