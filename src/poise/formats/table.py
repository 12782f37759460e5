"""The one table of readers and writers, and how a file finds its own."""

from __future__ import annotations

import re
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from poise.errors import PoiseError, brief
from poise.formats.raw import ReadOptions, check_options
from poise.formats.text import below_comments, read_head, shown
from poise.motion.clip import Clip
from poise.settings import imported


@dataclass(frozen=True)
class Reader:
    """A format: its name, its suffixes, whether a file's first bytes look like it, its reader.

    asks: suffixes of files that are read only when they are named (and a flag allows it), never found
    in a folder.
    """

    name: str
    suffixes: tuple[str, ...]
    looks_like: Callable[[bytes], bool]
    read: Callable[[Path, ReadOptions], Clip]
    asks: tuple[str, ...] = ()


def _looks_like_bvh(head: bytes) -> bool:
    return head[:9].upper() == b"HIERARCHY"


def _looks_like_amc(head: bytes) -> bool:
    marks = (b"#!oml", b":fully-specified", b":degrees", b":radians", b":force-all")
    lines = [line.strip().lower() for line in head.splitlines()]
    plain = [x for x in lines if x and x[:1] != b"#"]
    return any(x.startswith(marks) for x in lines) or (
        len(plain) > 1 and plain[0].isdigit() and plain[1].startswith(b"root ")
    )


def _looks_like_json(head: bytes) -> bool:
    return head[:1] == b"{" and (b'"Frames"' in head or b'"Loop"' in head)


def _looks_like_gltf(head: bytes) -> bool:
    return head[:4] == b"glTF" or (head[:1] == b"{" and b'"asset"' in head and b'"version"' in head)


def _looks_like_usd(head: bytes) -> bool:
    # A package begins with the name of its layer.
    named = head[30 : 30 + int.from_bytes(head[26:28], "little")].lower()
    packed = head[:4] == b"PK\x03\x04" and named.endswith((b".usda", b".usdc", b".usd"))
    return packed or head.startswith((b"PXR-USDC", b"#usda"))


def _late(place: str) -> Callable[..., Any]:
    """A function that is imported when it is first called: who reads one format waits for no other."""
    return lambda *given: imported(place)(*given)


def _points(place: str) -> Callable[[Path, ReadOptions], Clip]:
    """A reader of keypoints, as that of a clip."""

    def read(path: Path, options: ReadOptions) -> Clip:
        from poise.formats.point_raw import as_clip

        return as_clip(_late(place))(path, options)

    return read


READERS = (
    Reader("BVH", (".bvh",), _looks_like_bvh, _late("poise.formats.bvh:read_bvh")),
    Reader(
        "ASF",
        (".asf",),
        _late("poise.formats.refused:looks_like_asf"),
        _late("poise.formats.refused:refuse_asf"),
    ),
    Reader("AMC with ASF", (".amc",), _looks_like_amc, _late("poise.formats.acclaim:read_amc")),
    Reader(
        "glTF",
        (".glb", ".gltf", ".vrm", ".vrma"),
        _looks_like_gltf,
        _late("poise.formats.gltf:read_gltf"),
    ),
    Reader(
        "USD", (".usd", ".usda", ".usdc", ".usdz"), _looks_like_usd, _late("poise.formats.usd:read_usd")
    ),
    Reader(
        "FBX", (".fbx",), _late("poise.formats.fbx:looks_like_fbx"), _late("poise.formats.fbx:read_fbx")
    ),
    Reader(
        "DeepMimic", (".txt", ".json"), _looks_like_json, _late("poise.formats.deepmimic:read_deepmimic")
    ),
    Reader(
        "npz of AMASS, SMPL, Kimodo, keypoints or Poise",
        (".npz",),
        _late("poise.formats.named_arrays:looks_like_npz"),
        _late("poise.formats.named_arrays:read_npz"),
    ),
    Reader(
        "pickled SMPL, poselib, MDM or SAM 3D Body",
        (".pkl", ".npy"),
        _late("poise.formats.named_arrays:looks_like_pickle"),
        _late("poise.formats.named_arrays:read_pickled"),
        asks=(".pkl",),
    ),
    Reader(
        "GVHMR and SAM 3D Body",
        (".pt", ".pth"),
        _late("poise.formats.named_arrays:looks_like_torch"),
        _late("poise.formats.named_arrays:read_torch"),
        asks=(".pt", ".pth"),
    ),
    Reader(
        "SAM 3D Body",
        (".json",),
        _late("poise.formats.sam3d:looks_like_sam3d"),
        _points("poise.formats.sam3d:json_points"),
    ),
    Reader(
        "TRC keypoints",
        (".trc",),
        _late("poise.formats.point_tables:looks_like_trc"),
        _points("poise.formats.point_tables:trc_points"),
    ),
    Reader(
        "C3D markers",
        (".c3d",),
        _late("poise.formats.c3d:looks_like_c3d"),
        _points("poise.formats.c3d:c3d_points"),
    ),
    Reader(
        "OpenPose",
        (),
        _late("poise.formats.refused:looks_like_openpose"),
        _late("poise.formats.refused:refuse_openpose"),
    ),
    Reader(
        "OpenSim",
        (".mot",),
        _late("poise.formats.opensim:looks_like_mot"),
        _late("poise.formats.opensim:read_mot"),
    ),
    Reader(
        "CSV of Poise",
        (".csv",),
        _late("poise.formats.own:looks_like_csv"),
        _late("poise.formats.own:read_csv"),
    ),
    Reader(
        "CSV keypoints",
        (".csv",),
        _late("poise.formats.point_tables:looks_like_points_csv"),
        _points("poise.formats.point_tables:csv_points"),
    ),
    Reader(
        "robot",
        (".csv", ".h5"),
        _late("poise.formats.refused:looks_like_robot"),
        _late("poise.formats.refused:refuse_robot"),
        asks=(".csv", ".h5"),
    ),
)
#: Readers that only say what to give instead.
_REFUSERS = ("ASF", "robot", "OpenPose")
READABLE = "Formats that can be read: " + ", ".join(r.name for r in READERS if r.name not in _REFUSERS)
_MAGIC = (
    (b"PK\x03\x04", "zip"),
    (b"\x89HDF", "HDF5"),
)
_TORCH = "Save it anew with a torch of this decade: torch.save writes a zip since 1.6"
_NOT_YET = {
    ".h5": "HDF5",
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
    smooth_hz: float | None = None,
    take: str | None = None,
    raw: bool = False,
) -> Clip:
    """Reads a motion file as a clip in metres, Z up; its content decides more than its suffix.

    Everything that was guessed or repaired stands in `clip.skeleton.source.notes`.

    Args:
        skeleton: the ASF file of an AMC; by default the one beside it that bears its subject's name.
        fps, unit_m, up_axis: frames per second, metres per file unit and the vertical ("Y", "Z", "X" or
            one of them with "-" where it points down), stated instead of read or guessed.
        allow_pickle: reads pickled files too (AIST++, poselib); what they hold is rebuilt as plain
            arrays, and no code of theirs runs.
        smooth_hz: cut-off of a low-pass on keypoints (TRC, C3D, ...), see `FitConfig`; other formats
            are read as they are.
        take: which animation of a file that holds several, by name or number (glTF, MDM).
        raw: the motion is followed as the file has it, see `Source.raw`: keypoints keep their noise and
            samples that jump out of their path, and no verb takes a tremble off or fills in joints that
            were lost.

    Raises:
        PoiseError: one sentence with the file, the line, joint or frame, and what to do.
    """
    asf = None if skeleton is None else Path(skeleton)
    options = ReadOptions(
        asf, fps, unit_m, up_axis, allow_pickle=allow_pickle, take=take, smooth_hz=smooth_hz, raw=raw
    )
    check_options(options)
    return _read(Path(path), options)


def _read(path: Path, options: ReadOptions) -> Clip:
    reader = _reader_of(path)
    try:
        clip = reader.read(path, options)
        # A file may tell of a flag with which it was once read: that of this reading counts.
        same = clip.skeleton.source.raw == options.raw
        return clip if same else clip.replaced(skeleton=clip.skeleton.with_source(raw=options.raw))
    except PoiseError as error:
        # A clip's own checks know its name only; what a file says may be long or obeyed by a terminal.
        raise brief(error, path) from None
    except MemoryError:
        raise PoiseError(
            "the file needs more memory than there is", path, "Cut it shorter", code="out-of-memory"
        ) from None


def read_skeleton(path: str | Path, skeleton: str | Path | None = None) -> Clip:
    """A clip that shows a skeleton and how it stands: that of a motion file, or its rest pose.

    An ASF has a rest pose alone, and so have BVH, glTF, USD and FBX files without an animation: two
    frames show it.

    Args:
        skeleton: the ASF file of an AMC, see `read_clip`.

    Raises:
        PoiseError: see `read_clip`.
    """
    path = Path(path)
    if path.suffix.lower() != ".asf" or path.is_dir():
        asf = None if skeleton is None else Path(skeleton)
        return _read(path, ReadOptions(asf, rest=True))
    try:
        return imported("poise.formats.acclaim:read_asf")(path)
    except PoiseError as error:
        raise brief(error, path) from None


def _reader_of(path: Path) -> Reader:
    with suppress(OSError):
        # A name that is too long, say; reading tells why.
        if path.is_dir():
            imported("poise.formats.refused:refuse_folder")(path)
    head = read_head(path)
    text = head.removeprefix(b"\xef\xbb\xbf").lstrip()
    for reader in READERS:
        if reader.looks_like(text):
            return reader
    if text[:1] == b"#":
        below = below_comments(path)
        for reader in READERS:
            if reader.looks_like(below):
                return reader
    suffix = path.suffix.lower()
    if suffix in (".pt", ".pth"):
        raise PoiseError("it is no zip that torch.save writes", path, _TORCH, code="pickle-refused")
    other = next((name for magic, name in _MAGIC if head.startswith(magic)), _NOT_YET.get(suffix))
    if other is not None:
        raise PoiseError(f"{other} files are not read yet", path, READABLE, code="format-not-read")
    for reader in READERS:
        if suffix in reader.suffixes:
            return reader
    what = f"the suffix {shown(path.suffix)}" if path.suffix else "a file without suffix"
    raise PoiseError(
        f"{what} and its content belong to no known motion format", path, READABLE, code="format-unknown"
    )


_BVH, _GLTF, _USD = (
    _late("poise.formats.bvh:write_bvh"),
    _late("poise.formats.gltf_write:write_gltf"),
    _late("poise.formats.usd:write_usd"),
)
WRITERS: dict[str, Callable[[Clip, Path], None]] = {
    ".bvh": _BVH,
    ".npz": _late("poise.formats.named_arrays:write_npz"),
    ".csv": _late("poise.formats.own:write_csv"),
    ".glb": _GLTF,
    ".gltf": _GLTF,
    ".usd": _USD,
    ".usda": _USD,
    ".usdc": _USD,
    ".fbx": _late("poise.formats.fbx_write:write_fbx"),
}


def write_clip(clip: Clip, path: str | Path) -> None:
    """Writes a clip in the format of the file's suffix, in place of a file that is there.

    See `write_bvh` and the like. `.npz`: a clip that came from the SMPL family is written with the keys
    of AMASS, any other as Poise's own npz, which loses nothing; `.amass.npz` and `.poise.npz` force the
    one or the other.

    Raises:
        PoiseError: an unknown suffix (the known ones are listed) or a folder that cannot be written.
    """
    path = Path(path)
    _writer(path)(clip, path)


#: Suffix of the format in which a motion goes back to where it came from, where it is not BVH.
_HOME = {"gltf": ".glb", "usd": ".usda", "smpl": ".npz"}


def home_suffix(clip: Clip) -> str:
    """The suffix of the format that keeps most of the file a clip came from.

    ".glb" for glTF, ".usda" for USD, ".npz" for AMASS, ".bvh" for all others.
    """
    return _HOME.get(clip.skeleton.source.format, ".bvh")


def names_file(path: Path) -> bool:
    """Whether a path is that of a file: its suffix is one of a motion format, or one to five letters as
    files have them. `run_v1.0` and `take.2` are folders."""
    suffix = path.suffix.lower()
    known = {*WRITERS, *(s for r in READERS for s in r.suffixes)}
    return suffix in known or re.fullmatch(r"\.([a-z]{1,5}|[a-z]{2,4}\d)", suffix) is not None


def check_writable(path: Path) -> None:
    """Refuses a file if its suffix names no format that can be written here, before any work is done."""
    if _writer(path) is _USD:
        imported("poise.formats.usd:pxr_package")()


def _writer(path: Path) -> Callable[[Clip, Path], None]:
    writer = WRITERS.get(path.suffix.lower())
    if writer is None:
        raise PoiseError(
            f"a clip cannot be written as {shown(path.suffix or path.name)}",
            path,
            f"Suffixes that can be written: {', '.join(WRITERS)}",
            code="format-not-written",
        )
    return writer
