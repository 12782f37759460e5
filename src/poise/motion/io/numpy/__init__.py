"""NumPy files: named arrays from `.npz`, `.npy` and `.pkl`, read with bounds and without code of theirs,
and what is stored so: the SMPL family (AMASS, AIST++) and poselib.
"""

from poise.motion.io.numpy.arrays import Archive
from poise.motion.io.numpy.pickles import load_restricted
from poise.motion.io.numpy.poselib import is_poselib, read_poselib
from poise.motion.io.numpy.smpl import is_smpl, read_smpl
from poise.motion.io.numpy.smpl_write import is_amass_clip, write_amass

__all__ = [
    "Archive",
    "is_amass_clip",
    "is_poselib",
    "is_smpl",
    "load_restricted",
    "read_poselib",
    "read_smpl",
    "write_amass",
]
