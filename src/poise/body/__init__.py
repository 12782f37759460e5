"""From a skeleton to a MuJoCo humanoid: parts, parameters, model."""

from poise.body.body_table import BodyRow, BodyTable, Geom
from poise.body.generate import BodyConfig, generate_table
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
    "find_anatomy",
    "generate_table",
    "make_humanoid",
    "make_spec",
    "read_mjcf",
]
