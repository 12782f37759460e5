"""Checkpoints: one file of weights with its JSON inside, written whole or not at all.

The file is safetensors; its metadata holds one JSON object, so weights and settings can never
belong to different moments. It is written beside its place, flushed to the disk and renamed.

Files come from strangers, too: `load_checkpoint(path, TrainerMeta)` refuses, in a sentence, metadata in
which something is missing or of another type.
"""

from __future__ import annotations

import contextlib
import json
import os
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, TypedDict

import torch
from safetensors import SafetensorError
from safetensors.torch import load as parse_tensors
from safetensors.torch import save as serialise_tensors
from torch import Tensor

from poise.errors import PoiseError
from poise.settings import check_data
from poise.version import __version__

FORMAT = 1
LATEST = "checkpoint.safetensors"
LAST_GOOD = "last_good.safetensors"
_TEMPORARY = ".partial"


def save_checkpoint(path: str | Path, tensors: Mapping[str, Tensor], meta: Mapping[str, Any]) -> None:
    """Writes a checkpoint atomically: a crash leaves either the old file or the new one.

    Args:
        path: the file to write; its folder is made.
        tensors: named tensors of any device and dtype.
        meta: JSON data; "format" and "poise" (the version) are added.
    """
    path = Path(path)
    own = {k: v.detach().to("cpu", copy=True).contiguous() for k, v in tensors.items()}
    record = {**meta, "format": FORMAT, "poise": __version__, "crc32": _checksum(own)}
    data = serialise_tensors(own, {"poise": json.dumps(record)})
    try:
        write_atomic(path, data)
    except OSError as error:
        raise PoiseError(
            f"the checkpoint could not be written ({error.strerror})", path, "Check the disk"
        ) from error


def load_checkpoint(
    path: str | Path, schema: type | None = None
) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """The tensors (on the CPU) and the metadata of a checkpoint.

    schema: a `TypedDict` of what must stand in the metadata, such as `TrainerMeta`.

    Raises:
        PoiseError: the file is missing, damaged, foreign or of another format version, or its
            metadata is not what the schema says.
    """
    path = Path(path)
    try:
        data = path.read_bytes()
    except OSError as error:
        raise PoiseError(
            f"the checkpoint could not be read ({error.strerror})", path, "Check the path"
        ) from error
    damaged = PoiseError(
        "the file is damaged or no checkpoint of Poise", path, "Use another checkpoint or train again"
    )
    try:
        size = int.from_bytes(data[:8], "little")
        meta = json.loads(json.loads(data[8 : 8 + size])["__metadata__"]["poise"])
        version = meta["format"]
    except (ValueError, KeyError, TypeError):
        raise damaged from None
    if version != FORMAT:
        raise PoiseError(
            f"the checkpoint has format {version} (written by Poise {meta.get('poise', 'unknown')}) and "
            f"this version, {__version__}, reads format {FORMAT}",
            path,
            "Install the version that wrote it, or train again",
        )
    try:
        # Clones own aligned memory, where views into the file's bytes would not.
        tensors = {k: v.clone() for k, v in parse_tensors(data).items()}
    except (SafetensorError, ValueError, RuntimeError):
        raise damaged from None
    if _checksum(tensors) != meta.get("crc32"):
        raise damaged
    if schema is not None:
        check_data(schema, meta, path)
    return tensors, meta


def check_fits(meta: Mapping[str, Any], path: str | Path | None = None, **expected: Any) -> None:
    """Raises a `PoiseError` unless each given, not None, entry of `meta` is as expected."""
    for name, want in expected.items():
        found = meta.get(name)
        if want is None or found == want:
            continue
        words = {
            "processes": f"the checkpoint was saved by {found} processes together, this run has {want}",
            "character": f"the checkpoint belongs to the character '{found}', not to '{want}'",
            "num_obs": f"the checkpoint's policy takes {found} observations, the environment has {want}",
            "num_actions": f"the checkpoint's policy gives {found} actions, the environment has {want}",
        }
        raise PoiseError(
            words.get(name, f"the checkpoint was made with {name} = {found}, not {want}"),
            path,
            "Use the settings it was made with, or start a new run in another folder",
        )


def write_atomic(path: Path, data: bytes) -> None:
    """Replaces a file by `data`, durably: temporary file, fsync, rename, fsync of the folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.{os.getpid()}{_TEMPORARY}")
    try:
        with partial.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
    except BaseException:
        with contextlib.suppress(OSError):
            partial.unlink()
        raise
    if os.name == "posix":
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


def remove_partial(folder: Path) -> None:
    """Removes what a killed process left half written."""
    for file in folder.glob(f".*{_TEMPORARY}"):
        with contextlib.suppress(OSError):
            file.unlink()


def _checksum(tensors: Mapping[str, Tensor]) -> int:
    """CRC-32 over all names and bytes: safetensors itself does not notice a flipped bit."""
    crc = 0
    for name in sorted(tensors):
        crc = zlib.crc32(name.encode(), crc)
        flat = tensors[name].reshape(-1)
        if flat.numel():
            crc = zlib.crc32(flat.view(torch.uint8).numpy().data, crc)
    return crc


# --- what stands in the metadata ---------------------------------------------------------------


class _Shape(TypedDict):
    hidden: list[int]
    activation: str
    obs_clip: float


class PolicyShape(_Shape, total=False):
    """What rebuilds the networks of a policy, see `PolicyBundle.shape`."""

    kind: str
    columns: int
    lateral: bool
    composer_hidden: list[int]
    combine: str
    weights: str
    joint: bool


class _Policy(TypedDict):
    num_obs: int
    num_actions: int
    policy: PolicyShape


class PolicyMeta(_Policy, total=False):
    """A checkpoint that holds a policy: alone, or with its trainer."""

    kind: str
    character: str
    metadata: dict[str, Any]
    samples: int
    seconds: float
    iteration: int


class TrainerMeta(_Policy):
    """A checkpoint of a whole trainer, from which a run goes on."""

    metadata: dict[str, Any]
    config: dict[str, Any]
    iteration: int
    samples: int
    seconds: float


class _Layout(TypedDict):
    parents: list[int]
    feet: list[int]
    facing: list[float]


class _Model(TypedDict):
    net: Literal["transformer", "rtn"]
    config: dict[str, Any]
    layout: _Layout
    names: list[str]
    fps: float
    longest: int
    past: int
    meta: dict[str, Any]


class ModelMeta(_Model, total=False):
    """The file of an in-betweening network."""

    example: list[dict[str, Any]]
