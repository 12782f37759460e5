"""BVH: hierarchy and rows of channels, read with any channel order and written as it came."""

from poise.motion.io.bvh.read import read_bvh
from poise.motion.io.bvh.write import write_bvh

__all__ = ["read_bvh", "write_bvh"]
