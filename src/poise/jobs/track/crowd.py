"""Several characters in one world: they stand on one floor, and those that meet collide.

One MuJoCo model holds N copies of the body. To the environment each copy looks like a world of its own,
since all arrays of a copy lie side by side: its views are strides of the one world's state.
"""

from __future__ import annotations

import math

import mujoco
import numpy as np
import torch
from torch import Tensor

from poise.body import Humanoid
from poise.body.humanoid import make_spec
from poise.errors import PoiseError
from poise.sim import CpuBackend, Drive, SimConfig
from poise.sim.backend import SimState

#: Metres between characters that begin side by side.
APART_M = 2.0
#: State fields with a row per body, and with a number per degree of freedom.
_BODIES = ("xpos", "xquat", "xipos", "subtree_com", "cvel")
_DOFS = ("qpos", "qvel", "qfrc_actuator", "qfrc_damper")


def places(count: int) -> np.ndarray:
    """`(N, 2)` m, where each of N characters begins: rows and columns about the first one's place."""
    wide = math.ceil(math.sqrt(count))
    at = np.arange(count)
    return APART_M * np.stack((at // wide, at % wide), 1).astype(float)


def crowd_model(humanoid: Humanoid, sim: SimConfig, count: int) -> mujoco.MjModel:
    """N copies of a body on one floor; names of all but the first begin with "2@", "3@", ..."""
    spec = make_spec(humanoid.table)
    sim.apply(spec)
    for k in range(1, count):
        copy = make_spec(humanoid.table)
        frame = spec.worldbody.add_frame()
        frame.attach_body(copy.worldbody.first_body(), f"{k + 1}@", "")
    model = spec.compile()
    names = [f"{k + 1}@{name}" if k else name for k in range(count) for name in humanoid.bodies]
    single, bodies = humanoid.model, [model.body(i + 1).name for i in range(model.nbody - 1)]
    sizes = (model.nq, model.nv, model.nu, model.nexclude)
    if bodies != names or sizes != tuple(
        count * n for n in (single.nq, single.nv, single.nu, single.nexclude)
    ):
        raise PoiseError(f"{count} copies of the body do not lie side by side in one model")
    return model


class Crowd:
    """N characters of one world as the N worlds of a `Backend`, for an environment without help.

    Row 0 of what has a row per body is not the world but the character before, and is not to be read;
    forces on bodies (`drive.xfrc_applied`) have no effect. A restart of some characters begins the
    solver anew for all.
    """

    def __init__(self, humanoid: Humanoid, sim: SimConfig, count: int):
        self.model, self.num_envs = humanoid.model, count
        self.world = CpuBackend(crowd_model(humanoid, sim, count), 1, threads=1)
        self.device = self.world.device
        self.state = SimState(self._views)
        single = humanoid.model
        drive = self.world.drive
        self.drive = Drive(
            drive.ctrl.view(count, single.nu),
            drive.qfrc_applied.view(count, single.nv),
            torch.zeros(count, single.nbody, 6, dtype=drive.ctrl.dtype),
        )

    def write(self, rows: Tensor | None, qpos: Tensor, qvel: Tensor) -> None:
        """Sets some characters down; the others stay where they are."""
        new = [self.state.qpos.clone(), self.state.qvel.clone()]
        for held, given in zip(new, (qpos, qvel), strict=True):
            held[slice(None) if rows is None else rows] = given.to(held)
        self.world.write(None, *(x.reshape(1, -1) for x in new))

    def step(self, nstep: int = 1) -> None:
        """Physics steps of the one world.

        Raises:
            PoiseError: the simulation went bad.
        """
        self.world.step(nstep)
        if bool(self.world.unstable().any()):
            raise PoiseError(
                "the simulation of the characters went bad", hint="Try fewer characters, or another clip"
            )

    def forward(self, rows: Tensor | None = None) -> None:
        """Recomputes what follows from the state."""
        self.world.forward()

    def snapshot(self, derived: bool = True, out: Tensor | None = None) -> Tensor:
        """Positions and velocities `(N, nq + nv)`."""
        return torch.cat((self.state.qpos, self.state.qvel), 1, out=out)

    def restore(self, snapshot: Tensor, rows: Tensor | None = None) -> None:
        """Sets characters down as a snapshot has them."""
        self.write(rows, *snapshot.split((self.model.nq, self.model.nv), 1))

    def expand(self, field: str) -> Tensor:
        """Characters of one world share its model."""
        raise PoiseError(f"characters in one world share '{field}'")

    def set_const(self, rows: Tensor | None = None) -> None:
        """Nothing was changed."""

    def contacts(self) -> Tensor:
        """One world's sensors are not told apart."""
        raise PoiseError("contacts are not measured where several characters share a world")

    def unstable(self) -> Tensor:
        """`(N,)` bool; the one world is all of theirs."""
        return self.world.unstable().expand(self.num_envs)

    def get_model(self, env: int) -> mujoco.MjModel:
        """The model with all characters."""
        return self.world.get_model(0)

    def get_data(self, env: int, data: mujoco.MjData | None = None) -> mujoco.MjData:
        """The state of all characters."""
        return self.world.get_data(0, data)

    def close(self) -> None:
        """Frees the world."""
        self.world.close()

    def _views(self, names: list[str]) -> dict[str, Tensor]:
        unknown = [n for n in names if n not in (*_BODIES, *_DOFS, "time")]
        if unknown:
            raise PoiseError(f"'{unknown[0]}' is not known per character of one world")
        self.world.state.bind(names)
        return {name: self._view(name) for name in names}

    def _view(self, name: str) -> Tensor:
        whole = self.world.state[name]
        if name == "time":
            return whole.expand(self.num_envs)
        if name in _DOFS:
            return whole.view(self.num_envs, -1)
        # Character i has the rows after 1 + i (B - 1); the row before them stands for the world's.
        bodies, width = self.model.nbody, whole.shape[-1]
        shape, strides = (self.num_envs, bodies, width), ((bodies - 1) * width, width, 1)
        return whole.as_strided(shape, strides, whole.storage_offset())
