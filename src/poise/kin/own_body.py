"""Clips brought onto a body of the user's own."""

from __future__ import annotations

from dataclasses import replace

from poise.body import BodyConfig, BodyTable, read_mjcf
from poise.kin.retarget.transfer import retarget
from poise.motion import ClipLibrary


def on_own_body(library: ClipLibrary, config: BodyConfig) -> tuple[ClipLibrary, BodyTable | None]:
    """The clips on the skeleton of `config.mjcf` and its table; without such a file all as it is.

    Clips that are on that skeleton already stay as they are. Others are retargeted by the roles of their
    joints, all with the first one as the example of how their skeleton stands.

    Raises:
        PoiseError: a file or a skeleton that does not fit, see `read_mjcf` and `retarget`.
    """
    if config.mjcf is None:
        return library, None
    own = read_mjcf(config.mjcf, config.damping)
    table = own.table.overridden({"friction": config.friction, **dict(config.overrides)})
    first = library.clips[0]
    if first.skeleton.names == own.skeleton.names:
        return library, table
    moved = (retarget(c, own.skeleton, example=first)[0] for c in library)
    return replace(library, clips=tuple(moved)), table
