"""From a skeleton to a MuJoCo humanoid: parts, parameters, model."""

from __future__ import annotations

from typing import TYPE_CHECKING

from poise.lazy import lazy

if TYPE_CHECKING:
    from poise.body.body_table import BodyRow, BodyTable, Geom
    from poise.body.generate import BodyConfig, body_of, generate_table
    from poise.body.humanoid import Humanoid, make_humanoid, make_spec
    from poise.body.mjcf import MjcfBody, read_mjcf
    from poise.body.parts import Anatomy, Part, find_anatomy

__all__ = [
    "Anatomy",
    "BodyConfig",
    "BodyRow",
    "BodyTable",
    "Geom",
    "Humanoid",
    "MjcfBody",
    "Part",
    "body_of",
    "find_anatomy",
    "generate_table",
    "make_humanoid",
    "make_spec",
    "read_mjcf",
]

__getattr__ = lazy(
    __name__,
    {
        "body_table": "BodyRow BodyTable Geom",
        "generate": "BodyConfig body_of generate_table",
        "humanoid": "Humanoid make_humanoid make_spec",
        "mjcf": "MjcfBody read_mjcf",
        "parts": "Anatomy Part find_anatomy",
    },
)
