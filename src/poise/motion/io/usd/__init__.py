"""USD: an animated UsdSkel skeleton, and back with a figure to look at; needs `usd-core`."""

from poise.motion.io.usd.read import pxr_package, read_usd
from poise.motion.io.usd.write import write_usd

__all__ = ["pxr_package", "read_usd", "write_usd"]
