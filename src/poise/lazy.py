"""Names of a package that are imported when they are first used: a verb pays for its own alone."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any


def lazy(package: str, places: Mapping[str, str]) -> Callable[[str], Any]:
    """The `__getattr__` of a package.

    Args:
        package: `__name__` of the package.
        places: what each module of the package gives, names apart by spaces; `read=read_clip` where the
            package names it `read` and the module `read_clip`.
    """
    known = dict[str, tuple[str, str]]()
    for module, names in places.items():
        for name in names.split():
            here, _, there = name.partition("=")
            known[here] = f"{package}.{module}", there or here

    def find(name: str) -> Any:
        if name not in known:
            raise AttributeError(f"module '{package}' has no attribute '{name}'")
        module, there = known[name]
        found = getattr(import_module(module), there)
        setattr(sys.modules[package], name, found)
        return found

    return find
