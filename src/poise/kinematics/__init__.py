"""Poses without forces: forward and inverse kinematics, feet and floor, retargeting, repair."""

from __future__ import annotations

from typing import TYPE_CHECKING

from poise.lazy import lazy

if TYPE_CHECKING:
    from poise.kinematics.coords import (
        chain_angles,
        chain_quat,
        clip_to_qpos,
        qpos_to_clip,
        qpos_velocity,
    )
    from poise.kinematics.feet import contact_labels, level_feet
    from poise.kinematics.fit import FitReport, fit_humanoid
    from poise.kinematics.forward import Kinematics, lowest_height
    from poise.kinematics.ground import fit_ground
    from poise.kinematics.hold import hold_feet
    from poise.kinematics.ik import analytic_ik, clip_ik, polish
    from poise.kinematics.ik_bodies import IkBody, ik_body
    from poise.kinematics.ik_frames import CORRECTIONS, IkConfig
    from poise.kinematics.limbs import limb_of, match_positions
    from poise.kinematics.loops import close_cycle, cycle_step, cycle_velocity
    from poise.kinematics.place import place_on_body
    from poise.kinematics.repair.estimate import clean_clip, find_faults
    from poise.kinematics.repair.faults import Fault, by_kind
    from poise.kinematics.repair.guesses import find_guesses, grounded
    from poise.kinematics.repair.motion_doctor import Examination, examine, heal, without_noise
    from poise.kinematics.repair.support import anatomy_of, sole_slide, support_of
    from poise.kinematics.repair.turns import swap_sides
    from poise.kinematics.retargeting.own_body import onto_own, own_body
    from poise.kinematics.retargeting.retarget_report import RetargetReport
    from poise.kinematics.retargeting.transfer import (
        RestPoseResult,
        RetargetConfig,
        retarget,
        with_rest_pose,
    )

__all__ = [
    "CORRECTIONS",
    "Examination",
    "Fault",
    "FitReport",
    "IkBody",
    "IkConfig",
    "Kinematics",
    "RestPoseResult",
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
    "with_rest_pose",
    "without_noise",
]

__getattr__ = lazy(
    __name__,
    {
        "coords": "chain_angles chain_quat clip_to_qpos qpos_to_clip qpos_velocity",
        "feet": "contact_labels level_feet",
        "fit": "FitReport fit_humanoid",
        "forward": "Kinematics lowest_height",
        "ground": "fit_ground",
        "hold": "hold_feet",
        "ik": "analytic_ik clip_ik polish",
        "ik_bodies": "IkBody ik_body",
        "ik_frames": "CORRECTIONS IkConfig",
        "limbs": "limb_of match_positions",
        "loops": "close_cycle cycle_step cycle_velocity",
        "place": "place_on_body",
        "repair.estimate": "clean_clip find_faults",
        "repair.faults": "Fault by_kind",
        "repair.guesses": "find_guesses grounded",
        "repair.motion_doctor": "Examination examine heal without_noise",
        "repair.support": "anatomy_of sole_slide support_of",
        "repair.turns": "swap_sides",
        "retargeting.own_body": "onto_own own_body",
        "retargeting.retarget_report": "RetargetReport",
        "retargeting.transfer": "RestPoseResult RetargetConfig retarget with_rest_pose",
    },
)
