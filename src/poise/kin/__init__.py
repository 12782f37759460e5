"""Kinematics of a humanoid: clips cleaned and healed, to generalized coordinates and back, ground."""

from poise.kin.coords import clip_to_qpos, qpos_to_clip, qpos_velocity
from poise.kin.cycle import close_cycle, cycle_step, cycle_velocity
from poise.kin.doctor.clean import clean_clip, find_faults
from poise.kin.doctor.doctor import Examination, examine, heal, without_noise
from poise.kin.doctor.faults import Fault, by_kind
from poise.kin.doctor.guesses import find_guesses, grounded
from poise.kin.doctor.sides import swap_sides
from poise.kin.doctor.support import anatomy_of, sole_slide, support_of
from poise.kin.feet.contact import contact_labels
from poise.kin.feet.hold import hold_feet
from poise.kin.feet.level import level_feet
from poise.kin.fit import FitReport, fit_humanoid
from poise.kin.fk import Kinematics
from poise.kin.ground import fit_ground
from poise.kin.hinges import chain_angles, chain_quat
from poise.kin.ik.analytic import analytic_ik, clip_ik
from poise.kin.ik.body import IkBody, ik_body
from poise.kin.ik.frames import CORRECTIONS, IkConfig
from poise.kin.ik.polish import polish
from poise.kin.limbs import limb_of, match_positions, two_bone
from poise.kin.place import place_on_body
from poise.kin.retarget.own_body import onto_own, own_body
from poise.kin.retarget.report import RetargetReport
from poise.kin.retarget.rest_pose import Rested, with_rest_pose
from poise.kin.retarget.transfer import RetargetConfig, retarget
from poise.kin.solids import lowest_height

__all__ = [
    "CORRECTIONS",
    "Examination",
    "Fault",
    "FitReport",
    "IkBody",
    "IkConfig",
    "Kinematics",
    "Rested",
    "RetargetConfig",
    "RetargetReport",
    "analytic_ik",
    "anatomy_of",
    "by_kind",
    "chain_angles",
    "chain_quat",
    "clean_clip",
    "clip_ik",
    "clip_to_qpos",
    "close_cycle",
    "contact_labels",
    "cycle_step",
    "cycle_velocity",
    "examine",
    "find_faults",
    "find_guesses",
    "fit_ground",
    "fit_humanoid",
    "grounded",
    "heal",
    "hold_feet",
    "ik_body",
    "level_feet",
    "limb_of",
    "lowest_height",
    "match_positions",
    "onto_own",
    "own_body",
    "place_on_body",
    "polish",
    "qpos_to_clip",
    "qpos_velocity",
    "retarget",
    "sole_slide",
    "support_of",
    "swap_sides",
    "two_bone",
    "with_rest_pose",
    "without_noise",
]
