"""FBX files as clips: the largest animated skeleton; needs the package `ufbx`."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

from poise.errors import PoiseError
from poise.formats.limited import read_limited
from poise.formats.raw import ReadOptions, assemble
from poise.formats.text import MAX_JOINTS, MAX_VALUE, check_file
from poise.formats.usd import raw_of_matrices
from poise.motion.clip import MAX_POSES, Clip

_SCRIPT = Path(__file__).with_name("fbx_scene.py")
_MISSING = "Install it with: pip install ufbx; or export BVH, glTF or USD"


def looks_like_fbx(head: bytes) -> bool:
    """Whether a file begins as binary FBX does, or with the comment that exporters of text write."""
    return head.startswith(b"Kaydara FBX") or head.startswith(b"; FBX ")


def read_fbx(path: Path, options: ReadOptions) -> Clip:
    """The largest skeleton of a binary or ASCII FBX file, in metres, in the take that is asked for.

    ufbx reads it in a process of its own, see `limited`; other files that it names are not opened.

    Raises:
        PoiseError: ufbx is not installed, the file is damaged, or holds no bones or no animation.
    """
    if find_spec("ufbx") is None:
        raise PoiseError("FBX files need the package ufbx", path, _MISSING, code="extra-missing")
    size = check_file(path)
    limits = {"joints": MAX_JOINTS, "poses": MAX_POSES, "value": MAX_VALUE}
    stated = {"fps": options.fps, "take": options.take, "rest": options.rest}
    held = read_limited(_SCRIPT, path, size, "FBX file", **limits, **stated)
    return assemble(raw_of_matrices(held, "FBX", path, options), options)
