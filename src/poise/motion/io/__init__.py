"""Motion files: BVH and glTF (read and write), ASF/AMC, DeepMimic; all conversion to metres and Z up."""

from poise.motion.io.bvh_write import write_bvh
from poise.motion.io.formats import READERS, WRITERS, read_clip, write_clip
from poise.motion.io.gltf_write import write_gltf

__all__ = ["READERS", "WRITERS", "read_clip", "write_bvh", "write_clip", "write_gltf"]
