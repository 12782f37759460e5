"""Control laws: what turns a state and an action into a `Drive`."""

from poise.control.compliance import Compliance, Stiffness
from poise.control.pd import PDTargets, range_scale, stable_pd_torque
from poise.control.residual import (
    ExplicitResidual,
    HelpSchedule,
    ImplicitResidual,
    LinearHelp,
    Residual,
    SuccessHelp,
    Wrench,
)

__all__ = [
    "Compliance",
    "ExplicitResidual",
    "HelpSchedule",
    "ImplicitResidual",
    "LinearHelp",
    "PDTargets",
    "Residual",
    "Stiffness",
    "SuccessHelp",
    "Wrench",
    "range_scale",
    "stable_pd_torque",
]
