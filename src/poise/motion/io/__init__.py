"""Motion files: BVH, glTF and USD in and out, ASF/AMC, DeepMimic; all conversion to metres, Z up."""

from poise.motion.io.bvh_write import write_bvh
from poise.motion.io.formats import READERS, WRITERS, read_clip, write_clip
from poise.motion.io.gltf_write import write_gltf

__all__ = ["READERS", "WRITERS", "read_clip", "write_bvh", "write_clip", "write_gltf"]
