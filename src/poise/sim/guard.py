"""A guard that notices a simulation gone bad, and tells which joint went bad first."""

from __future__ import annotations

import copy
import json
import math
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import mujoco
import numpy as np
import torch
from safetensors import safe_open
from safetensors.numpy import save_file
from torch import Tensor

from poise.errors import PoiseError
from poise.sim.backend import Backend

_STATE = mujoco.mjtState.mjSTATE_INTEGRATION
_HUGE = 1e10  # MuJoCo's mjMAXVAL, above which it calls a position bad.
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


@dataclass(frozen=True)
class Failure:
    """One world that went bad.

    Attributes:
        env: the world.
        step: the guard's count of control steps, from 0.
        where: what the environment's callback said of it (clip and frame).
        cause: what was found.
        dump: the file that `replay_dump` reads, or None.
    """

    env: int
    step: int
    where: str
    cause: Cause
    dump: Path | None = None

    def __str__(self) -> str:
        return f"{self.place}: {self.cause}"

    @property
    def place(self) -> str:
        """Environment, control step and clip frame."""
        at = f"environment {self.env}, control step {self.step}"
        return f"{at}, {self.where}" if self.where else at


class UnstableError(PoiseError):
    """The simulation of one or more worlds went bad; `failures` has the details."""

    def __init__(self, failures: list[Failure]):
        self.failures = failures
        first = failures[0]
        what = str(first.cause)
        if len(failures) > 1:
            what += f" ({len(failures)} environments failed in this step)"
        dumped = f" Replay it with poise.sim.replay_dump('{first.dump}')." if first.dump else ""
        super().__init__(what, first.place, first.cause.hint + dumped, code="unstable")


class NanGuard:
    """Steps a backend and checks that positions and velocities stay finite and speeds sane.

    Looking at the state alone does not do: MuJoCo puts a world with a bad state back to the
    model's defaults within the step (its warning counters tell), and with the "discrete"
    integrator a NaN among the applied forces makes the world stand still without a warning (so
    what goes into the step is checked, too).

    Args:
        backend: the worlds.
        folder: where to save what replays a failure (made when needed); None saves nothing.
        speed_limit: a joint speed above it is a failure (rad/s, or m/s for a sliding or free joint).
        where: given a world, says where it is ("walk.bvh, clip frame 57"), for the message.
        seed: the run's seed, noted in the dump.
        max_dumps: save no more files than this, since one bad setting can fail thousands of worlds.
    """

    def __init__(
        self,
        backend: Backend,
        folder: str | Path | None = None,
        *,
        speed_limit: float = 1000.0,
        where: Callable[[int], str] | None = None,
        seed: int | None = None,
        max_dumps: int = 4,
    ) -> None:
        if not speed_limit > 0:
            raise PoiseError(
                f"speed_limit must be above 0, got {speed_limit}", "NanGuard", code="out-of-range"
            )
        self.backend, self.speed_limit, self.seed = backend, float(speed_limit), seed
        self.folder = None if folder is None else Path(folder)
        self.where, self.max_dumps = where, max_dumps
        self.count, self._dumps = 0, 0
        self._before = backend.snapshot(derived=False)

    def step(self, nstep: int = 1) -> None:
        """One control step of nstep physics steps.

        Raises:
            UnstableError: worlds went bad; its failures are in the order of the worlds.
        """
        self.backend.snapshot(derived=False, out=self._before)
        self.backend.step(nstep)
        failures = [self._report(env, nstep) for env in self._bad_envs()]
        self.count += 1
        if failures:
            raise UnstableError(failures)

    def _bad_envs(self) -> list[int]:
        qpos, qvel = self.backend.state.qpos, self.backend.state.qvel
        flagged = self.backend.unstable()
        # One NaN or infinity makes the sum one.
        sane = math.isfinite(float(self._before.sum())) and not bool(flagged.any())
        if sane and self._within(qpos, _HUGE) and self._within(qvel, self.speed_limit):
            return []
        good = (qpos.abs() < _HUGE).all(1) & (qvel.abs() < self.speed_limit).all(1)
        good &= self._before.isfinite().all(1)
        return torch.nonzero(flagged | ~good)[:, 0].tolist()

    @staticmethod
    def _within(values: Tensor, limit: float) -> bool:
        """Whether all lie within the limit; one NaN makes both ends NaN, which compare as false."""
        low, high = torch.aminmax(values)
        return bool(low > -limit) and bool(high < limit)

    def _report(self, env: int, nstep: int) -> Failure:
        model, before, after = self.backend.get_model(env), *self._states(env)
        cause = diagnose(model, before, nstep, self.speed_limit)
        where = "" if self.where is None else self.where(env)
        failure = Failure(env, self.count, where, cause)
        if self.folder is None or self._dumps >= self.max_dumps:
            return failure
        path = self.folder / f"unstable_step{self.count}_env{env}.safetensors"
        self._dumps += 1
        _save(path, failure, model, before, after, nstep, self.speed_limit, self.seed)
        return Failure(env, self.count, where, cause, path)

    def _states(self, env: int) -> tuple[np.ndarray, np.ndarray]:
        """MuJoCo's integration state of a world before and after the step."""
        row, now = torch.tensor([env]), self.backend.snapshot()
        after = _integration_state(self.backend, env)
        self.backend.restore(self._before[env : env + 1], row)
        before = _integration_state(self.backend, env)
        self.backend.restore(now)
        # The forward pass of a bad state raised the counters again.
        self.backend.unstable()
        return before, after


@dataclass(frozen=True)
class Replay:
    """A failing step, run again.

    Attributes:
        description: what happened, in a sentence.
        cause: the same in parts.
        exact: whether the replay ended in the recorded state bit for bit.
        model: of the world.
        data: the world before the failing step, to look at.
        nstep: its number of physics steps.
        info: the notes saved with it (environment, step, seed).
    """

    description: str
    cause: Cause
    exact: bool
    model: mujoco.MjModel
    data: mujoco.MjData
    nstep: int
    info: dict[str, object]


def replay_dump(path: str | Path) -> Replay:
    """Run the failing step of a dump again, in one world, and say what happens."""
    path = Path(path)
    if not path.is_file():
        raise PoiseError("there is no such dump", path, code="file-missing")
    with safe_open(path, framework="np") as file:
        if "model" not in file.keys():  # noqa: SIM118
            raise PoiseError("this file is not a dump of the NaN guard", path, code="wrong-file-kind")
        info = json.loads(file.metadata()["info"])
        model_bytes = file.get_tensor("model").tobytes()
        before, after = file.get_tensor("before"), file.get_tensor("after")
    if info["mujoco"] != mujoco.__version__:
        raise PoiseError(
            f"the dump was made by MuJoCo {info['mujoco']}, this is {mujoco.__version__}", path,
            f"Install mujoco=={info['mujoco']} to replay it.", code="version-differs",
        )  # fmt: skip
    model = mujoco.MjModel.from_binary_path("model.mjb", {"model.mjb": model_bytes})
    nstep = int(info["nstep"])
    data, again = mujoco.MjData(model), np.empty_like(after)
    mujoco.mj_setState(model, data, before, _STATE)
    mujoco.mj_step(model, data, nstep)
    mujoco.mj_getState(model, data, again, _STATE)
    mujoco.mj_resetData(model, data)
    mujoco.mj_setState(model, data, before, _STATE)
    cause = diagnose(model, before, nstep, float(info["speed_limit"]))
    failure = Failure(info["env"], info["step"], info["where"], cause, path)
    exact = bool(np.array_equal(again, after, equal_nan=True))
    return Replay(str(failure), cause, exact, model, data, nstep, info)


def _integration_state(backend: Backend, env: int) -> np.ndarray:
    model = backend.model
    state = np.empty(mujoco.mj_stateSize(model, _STATE))
    mujoco.mj_getState(model, backend.get_data(env), state, _STATE)
    return state


def _save(
    path: Path, failure: Failure, model: mujoco.MjModel, before: np.ndarray, after: np.ndarray,
    nstep: int, speed_limit: float, seed: int | None,
) -> None:  # fmt: skip
    binary = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, binary)
    info = {
        "env": failure.env, "step": failure.step, "where": failure.where, "nstep": nstep, "seed": seed,
        "speed_limit": speed_limit, "mujoco": mujoco.__version__, "cause": asdict(failure.cause),
    }  # fmt: skip
    path.parent.mkdir(parents=True, exist_ok=True)
    save_file({"model": binary, "before": before, "after": after}, path, {"info": json.dumps(info)})
