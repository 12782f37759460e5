"""A guard that notices a simulation gone bad, says where, and keeps what replays it."""

from __future__ import annotations

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
from poise.sim.diagnose import Cause, diagnose

_STATE = mujoco.mjtState.mjSTATE_INTEGRATION
_HUGE = 1e10  # MuJoCo's mjMAXVAL, above which it calls a position bad.


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
        super().__init__(what, first.place, first.cause.hint + dumped)


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
            raise PoiseError(f"speed_limit must be above 0, got {speed_limit}", "NanGuard")
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
        raise PoiseError("there is no such dump", path)
    with safe_open(path, framework="np") as file:
        if "model" not in file.keys():  # noqa: SIM118
            raise PoiseError("this file is not a dump of the NaN guard", path)
        info = json.loads(file.metadata()["info"])
        model_bytes = file.get_tensor("model").tobytes()
        before, after = file.get_tensor("before"), file.get_tensor("after")
    if info["mujoco"] != mujoco.__version__:
        raise PoiseError(
            f"the dump was made by MuJoCo {info['mujoco']}, this is {mujoco.__version__}", path,
            f"Install mujoco=={info['mujoco']} to replay it.",
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
