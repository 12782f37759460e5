"""Motion data: skeletons, frozen clips, libraries of clips, and the files they come from."""

from poise.motion.clip import Clip
from poise.motion.edits import ground_shift, resample, shifted, trim
from poise.motion.library import ClipLibrary
from poise.motion.skeleton import Channel, Skeleton, Source

__all__ = [
    "Channel",
    "Clip",
    "ClipLibrary",
    "Skeleton",
    "Source",
    "ground_shift",
    "resample",
    "shifted",
    "trim",
]
