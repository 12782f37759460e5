"""Control laws: what turns a state and an action into a `Drive`."""

from poise.control.drive import Drive
from poise.control.pd import PDTargets, stable_pd_torque
from poise.control.residual import ExplicitResidual, ImplicitResidual, Residual, Wrench
from poise.control.schedule import HelpSchedule, LinearHelp, SuccessHelp

__all__ = [
    "Drive",
    "ExplicitResidual",
    "HelpSchedule",
    "ImplicitResidual",
    "LinearHelp",
    "PDTargets",
    "Residual",
    "SuccessHelp",
    "Wrench",
    "stable_pd_torque",
]
