"""Skeletons, frozen clips and their libraries, keypoints, rotations, noise and its measure."""

from poise.motion.clip import Clip, ClipLibrary, ground_shift, resample, shifted, trim
from poise.motion.clip_info import describe, standing_height
from poise.motion.roles import Role, Roles, find_roles
from poise.motion.skeleton import Channel, Skeleton, Source

__all__ = [
    "Channel",
    "Clip",
    "ClipLibrary",
    "Role",
    "Roles",
    "Skeleton",
    "Source",
    "describe",
    "find_roles",
    "ground_shift",
    "resample",
    "shifted",
    "standing_height",
    "trim",
]
