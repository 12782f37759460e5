"""Kinematics of a humanoid: clips cleaned, to generalized coordinates and back, cycles, ground."""

from poise.kin.clean import CleanReport, Faults, clean_clip, find_faults
from poise.kin.contacts import contact_labels
from poise.kin.coords import clip_to_qpos, qpos_to_clip
from poise.kin.cycle import Cycle, close_cycle, cycle_step, cycle_velocity
from poise.kin.fit import FitReport, fit_humanoid
from poise.kin.fk import Kinematics
from poise.kin.ground import GroundFit, fit_ground, lowest_height
from poise.kin.hinges import chain_angles, chain_quat
from poise.kin.ik import analytic_ik, clip_ik
from poise.kin.ik_body import IkBody, ik_body
from poise.kin.ik_config import CORRECTIONS, IkConfig
from poise.kin.limbs import Limb, TwoBone, limb_of, match_positions, shortest_arc, two_bone
from poise.kin.retarget import RetargetConfig, retarget
from poise.kin.retarget_report import RetargetReport
from poise.kin.velocity import qpos_velocity

__all__ = [
    "CORRECTIONS",
    "CleanReport",
    "Cycle",
    "Faults",
    "FitReport",
    "GroundFit",
    "IkBody",
    "IkConfig",
    "Kinematics",
    "Limb",
    "RetargetConfig",
    "RetargetReport",
    "TwoBone",
    "analytic_ik",
    "chain_angles",
    "chain_quat",
    "clean_clip",
    "clip_ik",
    "clip_to_qpos",
    "close_cycle",
    "contact_labels",
    "cycle_step",
    "cycle_velocity",
    "find_faults",
    "fit_ground",
    "fit_humanoid",
    "ik_body",
    "limb_of",
    "lowest_height",
    "match_positions",
    "qpos_to_clip",
    "qpos_velocity",
    "retarget",
    "shortest_arc",
    "two_bone",
]
