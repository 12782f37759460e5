"""Physics settings, checked before they reach the model."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco

from poise.errors import PoiseError, did_you_mean

INTEGRATORS = {
    "euler": mujoco.mjtIntegrator.mjINT_EULER,
    "implicitfast": mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
    "discrete": mujoco.mjtIntegrator.mjINT_DISCRETE,
}
CONES = {"pyramidal": mujoco.mjtCone.mjCONE_PYRAMIDAL, "elliptic": mujoco.mjtCone.mjCONE_ELLIPTIC}
SOLVERS = {"newton": mujoco.mjtSolver.mjSOL_NEWTON, "cg": mujoco.mjtSolver.mjSOL_CG}

#: Above these a run of seconds would take days.
MOST = {"rate_hz": 20_000.0, "control_hz": 20_000.0, "iterations": 10_000, "ls_iterations": 10_000,
        "tolerance": 1.0}  # fmt: skip


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

    rate_hz: float = 60.0
    control_hz: float = 30.0
    integrator: str = "discrete"
    solver: str = "newton"
    cone: str = "pyramidal"
    iterations: int = 100
    ls_iterations: int = 50
    tolerance: float = 1e-8

    def __post_init__(self) -> None:
        for name, known in (("integrator", INTEGRATORS), ("solver", SOLVERS), ("cone", CONES)):
            value = getattr(self, name)
            if value not in known:
                hint = did_you_mean(value, list(known))
                raise PoiseError(f"unknown {name} '{value}'", "SimConfig", hint)
        for name in ("rate_hz", "control_hz", "iterations", "ls_iterations", "tolerance"):
            value = getattr(self, name)
            if not 0 < value < float("inf"):
                raise PoiseError(f"{name} must be above 0, got {value}", "SimConfig")
            if value > MOST[name]:
                raise PoiseError(f"{name} must be at most {MOST[name]:g}, got {value:g}", "SimConfig")
        ratio = self.rate_hz / self.control_hz
        if round(ratio) < 1 or abs(ratio - round(ratio)) > 1e-6 * ratio:
            nearest = max(1, round(ratio)) * self.control_hz
            raise PoiseError(
                f"a control step must be a whole number of physics steps, but {self.rate_hz:g} Hz "
                f"physics and {self.control_hz:g} Hz control give {ratio:.4g}",
                "SimConfig",
                f"With {self.control_hz:g} Hz control, use for example rate_hz={nearest:g}.",
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
