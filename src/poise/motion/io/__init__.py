"""Motion files: one reader and one writer per format; all conversion to metres, Z up."""

from poise.motion.io.bvh.write import write_bvh
from poise.motion.io.formats import (
    READERS,
    WRITERS,
    check_writable,
    home_suffix,
    names_file,
    read_clip,
    read_skeleton,
    write_clip,
)
from poise.motion.io.gltf.write import write_gltf

__all__ = [
    "READERS",
    "WRITERS",
    "check_writable",
    "home_suffix",
    "names_file",
    "read_clip",
    "read_skeleton",
    "write_bvh",
    "write_clip",
    "write_gltf",
]
