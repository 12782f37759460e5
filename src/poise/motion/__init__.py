"""Motion data: skeletons, frozen clips, libraries of clips, and the files they come from."""

from poise.formats import read_clip, write_bvh, write_clip
from poise.motion.clip import Clip, ClipLibrary, ground_shift, resample, shifted, trim
from poise.motion.info import describe, standing_height
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
    "read_clip",
    "resample",
    "shifted",
    "standing_height",
    "trim",
    "write_bvh",
    "write_clip",
]
