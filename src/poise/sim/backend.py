"""The protocol of a simulator, the state that it shows, and physics settings."""

# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false
from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Annotated, Literal, Protocol, runtime_checkable

import mujoco
import torch
from torch import Tensor

from poise.errors import PoiseError, did_you_mean
from poise.settings import Range, validate
from poise.sim.drive import Drive

STANDARD_FIELDS = ("qpos", "qvel", "time", "xpos", "xquat", "xipos", "subtree_com", "cvel")


class SimState:
    """Live views of the simulator's state, under MuJoCo's own field names.

    The tensors stay the same objects and change in place with every `step`, `write` and
    `forward`; clone what must outlive the next step. Only `qpos` and `qvel` may be written, and
    then by `Backend.write`, which also brings the rest up to date.

    qpos: `(N, nq)`; a free joint is position (m, world) then wxyz quaternion (body to world).
    qvel: `(N, nv)`; a free joint is linear velocity of the body's origin (m/s, world axes), then
        angular velocity (rad/s, in the BODY's axes).
    time: `(N,)` s since the row was written.
    xpos: `(N, nbody, 3)` m, world position of each body's frame.
    xquat: `(N, nbody, 4)` wxyz, body to world.
    xipos: `(N, nbody, 3)` m, world position of each body's inertial centre.
    subtree_com: `(N, nbody, 3)` m, world centre of mass of each body's subtree.
    cvel: `(N, nbody, 6)` rad/s then m/s, world axes: the rotation FIRST, then the velocity of the
        body-fixed point that is just now at the tree's centre of mass, `subtree_com[root]`. Use
        `body_linear_velocity_w` and `body_angular_velocity_w` for the body's own frame.

    Body 0 is the world. All of these describe the state after the last physics step. Fields
    that depend on forces (`qacc`, `actuator_force`, force sensors) describe the last physics
    step itself, the one that led here. Other MuJoCo fields come by `bind(names)` and `state[name]`.
    """

    qpos: Tensor
    qvel: Tensor
    time: Tensor
    xpos: Tensor
    xquat: Tensor
    xipos: Tensor
    subtree_com: Tensor
    cvel: Tensor

    def __init__(self, make_views: Callable[[list[str]], dict[str, Tensor]]):
        self._make_views = make_views
        self._views: dict[str, Tensor] = {}
        self.bind(STANDARD_FIELDS)

    def bind(self, names: Iterable[str]) -> None:
        """Make further MuJoCo data fields available as `state[name]`.

        Do it before stepping: the fields are filled by a `forward` of all worlds.
        """
        new = self._make_views([name for name in dict.fromkeys(names) if name not in self._views])
        self._views.update(new)
        for name in new.keys() & set(STANDARD_FIELDS):
            setattr(self, name, new[name])

    @property
    def names(self) -> tuple[str, ...]:
        """The fields that are bound."""
        return tuple(self._views)

    def __contains__(self, name: str) -> bool:
        return name in self._views

    def __getitem__(self, name: str) -> Tensor:
        if name not in self._views:
            raise PoiseError(
                f"the state field '{name}' is not bound",
                hint=f"Call state.bind(['{name}']) first. {did_you_mean(name, list(self._views))}",
                code="field-unbound",
            )
        return self._views[name]


@runtime_checkable
class Backend(Protocol):
    """N worlds of one model, stepped together; built as `Backend(spec_or_model, num_envs)`.

    `rows` is None for all worlds, a boolean mask `(N,)`, or distinct indices.
    """

    @property
    def model(self) -> mujoco.MjModel:
        """The compiled model that all worlds share, but for expanded fields."""
        ...

    @property
    def num_envs(self) -> int:
        """The number of worlds N."""
        ...

    @property
    def device(self) -> torch.device:
        """Where its tensors live."""
        ...

    @property
    def state(self) -> SimState:
        """Live views of the state."""
        ...

    @property
    def drive(self) -> Drive:
        """What will be applied in the next step."""
        ...

    def write(self, rows: Tensor | None, qpos: Tensor, qvel: Tensor) -> None:
        """Reset rows to `qpos (n, nq)` and `qvel (n, nv)`.

        Time, warm start, applied forces, controls, mocap poses and warnings of those rows
        return to the model's defaults, and all fields are brought up to date.
        """
        ...

    def step(self, nstep: int = 1) -> None:
        """Run nstep physics steps with the drive held; the state is current afterwards."""
        ...

    def forward(self, rows: Tensor | None = None) -> None:
        """Recompute all derived fields from the state, without moving it."""
        ...

    def snapshot(self, derived: bool = True, out: Tensor | None = None) -> Tensor:
        """A copy `(N, width)` of the state, into `out` where given, to continue from bit for bit.

        It holds positions, velocities, time, the solver's warm start and the drive; with
        `derived` also every bound field, since forces of the last step cannot be recomputed.
        Values of expanded model fields are not part of it.
        """
        ...

    def restore(self, snapshot: Tensor, rows: Tensor | None = None) -> None:
        """Return rows to a snapshot `(N, width)` (or `(n, width)` for n rows).

        The continuation is exact. Derived fields come back as they were, or, from a snapshot
        without them, by `forward`.
        """
        ...

    def expand(self, field: str) -> Tensor:
        """A live, writable `(N, ...)` tensor of per-world values of a model field ("opt.x" too)."""
        ...

    def set_const(self, rows: Tensor | None = None) -> None:
        """Recompute what the model derives from expanded fields (after masses, inertias, ...)."""
        ...

    def contacts(self) -> Tensor:
        """Net contact force on each body, `(N, nbody, 3)` N in world axes, in the last physics step."""
        ...

    def unstable(self) -> Tensor:
        """`(N,)` bool: worlds with a bad state or control (not finite, huge) since the last call.

        MuJoCo returns such a world to the model's defaults in the midst of a step, so that its
        state may look sound afterwards.
        """
        ...

    def get_model(self, env: int) -> mujoco.MjModel:
        """A copy of one world's model, with its expanded fields, for dumps and rendering."""
        ...

    def get_data(self, env: int, data: mujoco.MjData | None = None) -> mujoco.MjData:
        """One world's state as MjData (derived fields by `mj_forward`), for rendering."""
        ...

    def close(self) -> None:
        """Free the worlds; the backend is not usable afterwards."""
        ...


def body_angular_velocity_w(state: SimState) -> Tensor:
    """Angular velocity of every body, `(N, nbody, 3)` rad/s in world axes."""
    return state.cvel[..., :3]


def body_linear_velocity_w(state: SimState, model: mujoco.MjModel) -> Tensor:
    """Velocity of every body frame's origin, `(N, nbody, 3)` m/s in world axes.

    v(xpos) = v(c) + omega x (xpos - c), with c = subtree_com of the body's tree, to which
    MuJoCo's cvel refers.
    """
    return _velocity_at(state, model, state.xpos)


def body_com_velocity_w(state: SimState, model: mujoco.MjModel) -> Tensor:
    """Velocity of every body's inertial centre, `(N, nbody, 3)` m/s in world axes."""
    return _velocity_at(state, model, state.xipos)


def _velocity_at(state: SimState, model: mujoco.MjModel, point: Tensor) -> Tensor:
    root = torch.as_tensor(model.body_rootid, dtype=torch.long, device=point.device)
    arm = point - state.subtree_com[:, root]
    return state.cvel[..., 3:] + torch.linalg.cross(state.cvel[..., :3], arm)


INTEGRATORS = {
    "euler": mujoco.mjtIntegrator.mjINT_EULER,
    "implicitfast": mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
    "discrete": mujoco.mjtIntegrator.mjINT_DISCRETE,
}
CONES = {"pyramidal": mujoco.mjtCone.mjCONE_PYRAMIDAL, "elliptic": mujoco.mjtCone.mjCONE_ELLIPTIC}
SOLVERS = {"newton": mujoco.mjtSolver.mjSOL_NEWTON, "cg": mujoco.mjtSolver.mjSOL_CG}


@dataclass(frozen=True)
class SimConfig:
    """How finely and by which rules the physics runs.

    Attributes:
        rate_hz: physics steps per second.
        control_hz: control steps per second; a control step must be a whole number of physics steps.
        integrator: "discrete" (implicit in actuator stiffness, damping and contacts: MuJoCo's form of
            stable PD, Tan et al. 2011), "implicitfast" or "euler". With the first two, put the PD
            damping into the joints
            and not into the actuators: a saturated actuator loses its implicit derivative and chatters.
        solver: MuJoCo's constraint solver.
        cone: friction cones, "pyramidal" or "elliptic".
        iterations: the solver's most iterations.
        ls_iterations: its most line search iterations.
        tolerance: at which it stops.
    """

    # Above these limits a run of seconds would take days.
    rate_hz: Annotated[float, Range(0, 20_000, above=True, unit="Hz")] = 60.0
    control_hz: Annotated[float, Range(0, 20_000, above=True, unit="Hz")] = 30.0
    integrator: Literal["discrete", "implicitfast", "euler"] = "discrete"
    solver: Literal["newton", "cg"] = "newton"
    cone: Literal["pyramidal", "elliptic"] = "pyramidal"
    iterations: Annotated[int, Range(0, 10_000, above=True)] = 100
    ls_iterations: Annotated[int, Range(0, 10_000, above=True)] = 50
    tolerance: Annotated[float, Range(0, 1, above=True)] = 1e-8

    def __post_init__(self) -> None:
        validate(self)
        ratio = self.rate_hz / self.control_hz
        if round(ratio) < 1 or abs(ratio - round(ratio)) > 1e-6 * ratio:
            nearest = max(1, round(ratio)) * self.control_hz
            raise PoiseError(
                f"a control step must be a whole number of physics steps, but {self.rate_hz:g} Hz "
                f"physics and {self.control_hz:g} Hz control give {ratio:.4g}",
                "SimConfig",
                f"With {self.control_hz:g} Hz control, use for example rate_hz={nearest:g}.",
                code="not-a-multiple",
            )

    @property
    def substeps(self) -> int:
        """Physics steps per control step."""
        return round(self.rate_hz / self.control_hz)

    @property
    def timestep(self) -> float:
        """Seconds per physics step."""
        return 1.0 / self.rate_hz

    def apply(self, target: mujoco.MjSpec | mujoco.MjModel) -> None:
        """Write these settings into a model description or a compiled model, in place."""
        option = target.option if isinstance(target, mujoco.MjSpec) else target.opt
        option.timestep = self.timestep
        option.integrator = int(INTEGRATORS[self.integrator])
        option.solver = int(SOLVERS[self.solver])
        option.cone = int(CONES[self.cone])
        option.iterations, option.ls_iterations = self.iterations, self.ls_iterations
        option.tolerance = self.tolerance
