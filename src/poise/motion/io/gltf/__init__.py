"""glTF 2.0: the animated node tree of a .glb or .gltf, and back with a figure to look at."""

from poise.motion.io.gltf.read import read_gltf
from poise.motion.io.gltf.write import write_gltf

__all__ = ["read_gltf", "write_gltf"]
