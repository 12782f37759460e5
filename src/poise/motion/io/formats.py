"""The one table of readers and writers, and how a file finds its own."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from poise.errors import PoiseError
from poise.motion.clip import Clip
from poise.motion.io.amc import read_amc
from poise.motion.io.bvh_read import read_bvh
from poise.motion.io.bvh_write import write_bvh
from poise.motion.io.deepmimic import read_deepmimic
from poise.motion.io.motion_csv import looks_like_csv, read_csv, write_csv
from poise.motion.io.numpy_files import (
    looks_like_npz,
    looks_like_pickle,
    read_npz,
    read_pickled,
    write_npz,
)
from poise.motion.io.raw import Options, check_options
from poise.motion.io.robots import looks_like_robot, refuse_robot
from poise.motion.io.text import read_head, shown


@dataclass(frozen=True)
class Reader:
    """A format: its name, its suffixes, whether a file's first bytes look like it, its reader.

    asks: the file is read only when it is named (and a flag allows it), never found in a folder.
    """

    name: str
    suffixes: tuple[str, ...]
    looks_like: Callable[[bytes], bool]
    read: Callable[[Path, Options], Clip]
    asks: bool = False


def _looks_like_bvh(head: bytes) -> bool:
    return head[:9].upper() == b"HIERARCHY"


def _looks_like_asf(head: bytes) -> bool:
    lines = [line.strip().lower() for line in head.splitlines()]
    return any(x.split()[:1] in ([b":bonedata"], [b":units"], [b":version"]) for x in lines if x)


def _looks_like_amc(head: bytes) -> bool:
    marks = (b"#!oml", b":fully-specified", b":degrees", b":radians", b":force-all")
    lines = [line.strip().lower() for line in head.splitlines()]
    plain = [x for x in lines if x and x[:1] != b"#"]
    return any(x.startswith(marks) for x in lines) or (
        len(plain) > 1 and plain[0].isdigit() and plain[1].startswith(b"root ")
    )


def _looks_like_json(head: bytes) -> bool:
    return head[:1] == b"{" and (b'"Frames"' in head or b'"Loop"' in head)


def _refuse_asf(path: Path, options: Options) -> Clip:
    raise PoiseError(
        "an ASF file holds a skeleton without motion", path, "Give the AMC file, with --skeleton FILE"
    )


READERS = (
    Reader("BVH", (".bvh",), _looks_like_bvh, read_bvh),
    Reader("ASF", (".asf",), _looks_like_asf, _refuse_asf),
    Reader("AMC with ASF", (".amc",), _looks_like_amc, read_amc),
    Reader("DeepMimic", (".txt", ".json"), _looks_like_json, read_deepmimic),
    Reader("npz of AMASS, SMPL or Poise", (".npz",), looks_like_npz, read_npz),
    Reader("pickled SMPL or poselib", (".pkl", ".npy"), looks_like_pickle, read_pickled, asks=True),
    Reader("CSV of Poise", (".csv",), looks_like_csv, read_csv),
    Reader("robot", (".csv", ".h5"), looks_like_robot, refuse_robot, asks=True),
)
READABLE = "Formats that can be read: " + ", ".join(
    f"{r.name} ({', '.join(r.suffixes)})" for r in READERS if r.name not in ("ASF", "robot")
)
_MAGIC = (
    (b"Kaydara FBX", "FBX"),
    (b"glTF", "glTF"),
    (b"PK\x03\x04", "zip"),
    (b"\x89HDF", "HDF5"),
)
_NOT_YET = {
    ".fbx": "FBX",
    ".c3d": "C3D",
    ".glb": "glTF",
    ".gltf": "glTF",
    ".trc": "TRC",
    ".mot": "OpenSim",
    ".h5": "HDF5",
    ".usd": "USD",
    ".usda": "USD",
    ".vmd": "VMD",
}


def read_clip(
    path: str | Path,
    *,
    skeleton: str | Path | None = None,
    fps: float | None = None,
    unit_m: float | None = None,
    up_axis: str | None = None,
    allow_pickle: bool = False,
) -> Clip:
    """Reads a motion file as a clip in metres, Z up; its content decides more than its suffix.

    Everything that was guessed or repaired stands in `clip.skeleton.source.notes`.

    Args:
        skeleton: the ASF file of an AMC; by default the one beside it that bears its subject's name.
        fps, unit_m, up_axis: frames per second, metres per file unit and "Y" or "Z", stated
            instead of read or guessed.
        allow_pickle: reads pickled files too (AIST++, poselib); what they hold is rebuilt as plain
            arrays, and no code of theirs runs.

    Raises:
        PoiseError: one sentence with the file, the line, joint or frame, and what to do.
    """
    path = Path(path)
    asf = None if skeleton is None else Path(skeleton)
    options = Options(asf, fps, unit_m, up_axis, allow_pickle=allow_pickle)
    check_options(options)
    reader = _reader_of(path)
    try:
        return reader.read(path, options)
    except PoiseError as error:
        # A clip's own checks know its name only; the user needs the file.
        if error.where == path.stem or error.where is None:
            raise PoiseError(error.what, path, error.hint) from None
        raise
    except MemoryError:
        raise PoiseError("the file needs more memory than there is", path, "Cut it shorter") from None


def _reader_of(path: Path) -> Reader:
    head = read_head(path)
    text = head.removeprefix(b"\xef\xbb\xbf").lstrip()
    for reader in READERS:
        if reader.looks_like(text):
            return reader
    suffix = path.suffix.lower()
    other = next((name for magic, name in _MAGIC if head.startswith(magic)), _NOT_YET.get(suffix))
    if other is not None:
        raise PoiseError(f"{other} files are not read yet", path, READABLE)
    for reader in READERS:
        if suffix in reader.suffixes:
            return reader
    what = f"the suffix {shown(path.suffix)}" if path.suffix else "a file without suffix"
    raise PoiseError(f"{what} and its content belong to no known motion format", path, READABLE)


WRITERS: dict[str, Callable[[Clip, Path], None]] = {
    ".bvh": write_bvh,
    ".npz": write_npz,
    ".csv": write_csv,
}


def write_clip(clip: Clip, path: str | Path) -> None:
    """Writes a clip in the format of the file's suffix; see `write_bvh`, `write_csv`.

    `.npz`: a clip that came from the SMPL family is written with the keys of AMASS, any other as
    Poise's own npz, which loses nothing; `.amass.npz` and `.poise.npz` force the one or the other.

    Raises:
        PoiseError: an unknown suffix (the known ones are listed) or a folder that cannot be written.
    """
    path = Path(path)
    writer = WRITERS.get(path.suffix.lower())
    if writer is None:
        raise PoiseError(
            f"a clip cannot be written as {shown(path.suffix or path.name)}",
            path,
            f"Suffixes that can be written: {', '.join(WRITERS)}",
        )
    writer(clip, path)
