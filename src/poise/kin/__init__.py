"""Kinematics of a humanoid: clips cleaned and healed, to generalized coordinates and back, ground."""

from poise.kin.clean import CleanReport, Faults, clean_clip, find_faults
from poise.kin.contacts import contact_labels
from poise.kin.coords import clip_to_qpos, qpos_to_clip
from poise.kin.cycle import Cycle, close_cycle, cycle_step, cycle_velocity
from poise.kin.doctor import Examination, examine, heal
from poise.kin.faults import Fault, by_kind
from poise.kin.fit import FitReport, fit_humanoid
from poise.kin.fk import Kinematics
from poise.kin.ground import GroundFit, fit_ground, lowest_height
from poise.kin.guesses import Guess, find_guesses, grounded
from poise.kin.hinges import chain_angles, chain_quat
from poise.kin.limbs import Limb, TwoBone, limb_of, match_positions, shortest_arc, two_bone
from poise.kin.sides import swap_sides
from poise.kin.support import Support, anatomy_of, support_of
from poise.kin.velocity import qpos_velocity

__all__ = [
    "CleanReport",
    "Cycle",
    "Examination",
    "Fault",
    "Faults",
    "FitReport",
    "GroundFit",
    "Guess",
    "Kinematics",
    "Limb",
    "Support",
    "TwoBone",
    "anatomy_of",
    "by_kind",
    "chain_angles",
    "chain_quat",
    "clean_clip",
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
    "limb_of",
    "lowest_height",
    "match_positions",
    "qpos_to_clip",
    "qpos_velocity",
    "shortest_arc",
    "support_of",
    "swap_sides",
    "two_bone",
]
