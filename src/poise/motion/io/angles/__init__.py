"""Joint angles of a published model: DeepMimic and OpenSim; a robot's are refused by name."""

from poise.motion.io.angles.deepmimic import read_deepmimic
from poise.motion.io.angles.opensim import is_opensim, looks_like_mot, read_loco, read_mot
from poise.motion.io.angles.robots import looks_like_robot, refuse_robot

__all__ = [
    "is_opensim",
    "looks_like_mot",
    "looks_like_robot",
    "read_deepmimic",
    "read_loco",
    "read_mot",
    "refuse_robot",
]
