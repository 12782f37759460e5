"""Control laws: what turns a state and an action into a `Drive`."""

from poise.control.drive import Drive
from poise.control.inverse import ContactRule, InverseDynamics, inverse_dynamics, step_midpoints
from poise.control.lqr import Regulator, regulate
from poise.control.pd import PDTargets, range_scale, stable_pd_torque
from poise.control.residual import ExplicitResidual, ImplicitResidual, Residual, Wrench
from poise.control.schedule import HelpSchedule, LinearHelp, SuccessHelp
from poise.control.touch import ClearanceRule, clearance

__all__ = [
    "ClearanceRule",
    "ContactRule",
    "Drive",
    "ExplicitResidual",
    "HelpSchedule",
    "ImplicitResidual",
    "InverseDynamics",
    "LinearHelp",
    "PDTargets",
    "Regulator",
    "Residual",
    "SuccessHelp",
    "Wrench",
    "clearance",
    "inverse_dynamics",
    "range_scale",
    "regulate",
    "stable_pd_torque",
    "step_midpoints",
]
