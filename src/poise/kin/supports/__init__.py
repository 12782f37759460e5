"""What a motion leans, sits or steps on: found by inverse dynamics, and given a shape."""

from poise.kin.supports.find import find_supports
from poise.kin.supports.support import Support, read_supports

__all__ = ["Support", "find_supports", "read_supports"]
