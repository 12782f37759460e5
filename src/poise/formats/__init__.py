"""Motion files: one reader and one writer per format; all conversion to metres, Z up."""

from __future__ import annotations

from typing import TYPE_CHECKING

from poise.lazy import lazy

if TYPE_CHECKING:
    from poise.formats.bvh import write_bvh
    from poise.formats.gltf_write import write_gltf
    from poise.formats.table import (
        READERS,
        WRITERS,
        check_writable,
        home_suffix,
        names_file,
        read_clip,
        read_skeleton,
        write_clip,
    )

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

__getattr__ = lazy(
    __name__,
    {
        "bvh": "write_bvh",
        "gltf_write": "write_gltf",
        "table": "READERS WRITERS check_writable home_suffix "
        "names_file read_clip read_skeleton write_clip",
    },
)
