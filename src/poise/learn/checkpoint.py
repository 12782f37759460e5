"""Checkpoints: one file of weights with its JSON inside, written whole or not at all, by one writer."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import importlib
import json
import os
import time
import zlib
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Concatenate, Literal, ParamSpec, TypedDict, TypeVar

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import load as parse_tensors
from safetensors.torch import save as serialise_tensors
from torch import Tensor, nn

from poise.errors import PoiseError
from poise.learn.adam import Optimizer
from poise.settings import check_data
from poise.version import __version__

FORMAT = 1
LATEST = "checkpoint.safetensors"
LAST_GOOD = "last_good.safetensors"
_TEMPORARY = ".partial"


def save_checkpoint(path: str | Path, tensors: Mapping[str, Tensor], meta: Mapping[str, Any]) -> None:
    """Writes a checkpoint atomically: a crash leaves either the old file or the new one.

    The file is safetensors. Its metadata hold one JSON object, so that weights and settings never belong
    to different moments.

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
            f"the checkpoint could not be written ({error.strerror})",
            path,
            "Check the disk",
            code="cannot-write",
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
            f"the checkpoint could not be read ({error.strerror})",
            path,
            "Check the path",
            code="file-unreadable",
        ) from error
    damaged = PoiseError(
        "the file is damaged or no checkpoint of Poise",
        path,
        "Use another checkpoint or train again",
        code="file-damaged",
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
            code="version-differs",
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
            code="checkpoint-unfit",
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


State = dict[str, Tensor]


def prefixed(prefix: str, tensors: Mapping[str, Tensor]) -> State:
    """The tensors as clones under "prefix/name"."""
    return {f"{prefix}/{k}": v.detach().clone() for k, v in tensors.items()}


def tensors_of(arrays: Mapping[str, np.ndarray]) -> State:
    """NumPy arrays as tensors, by their names."""
    return {k: torch.from_numpy(v) for k, v in arrays.items()}


def under(prefix: str, tensors: Mapping[str, Tensor]) -> State:
    """The tensors with names that start with "prefix/", without it."""
    start = f"{prefix}/"
    return {k[len(start) :]: v for k, v in tensors.items() if k.startswith(start)}


def take(state: Mapping[str, Tensor], name: str) -> Tensor:
    """One tensor of a state, or a `PoiseError` that names it."""
    if name not in state:
        raise PoiseError(
            f"the saved state has no '{name}'",
            hint="Another kind of run saved it; start a new one",
            code="state-differs",
        )
    return state[name]


def load_module(module: nn.Module, state: Mapping[str, Tensor], name: str) -> None:
    """Copies "name/..." into a module; shapes and names must be the same."""
    own, saved = module.state_dict(), under(name, state)
    for key, value in own.items():
        if key in saved and saved[key].shape == value.shape:
            continue
        found = f"has the shape {tuple(saved[key].shape)}" if key in saved else "is missing"
        raise PoiseError(
            f"'{name}/{key}' {found} in the saved state where {tuple(value.shape)} is expected",
            hint="Use the layer sizes and the environment with which the state was saved",
            code="state-differs",
        )
    with torch.no_grad():
        for key, value in own.items():
            value.copy_(saved[key])


def optimizer_state(optimizer: Optimizer) -> State:
    """Learning rates and moments, numbered in the order of the parameters."""
    lr = [group["lr"] for group in optimizer.param_groups]
    out = {"lr": torch.tensor(lr, dtype=torch.float64)}
    params = [p for group in optimizer.param_groups for p in group["params"]]
    for i, p in enumerate(params):
        # A parameter that was never stepped has no moments yet.
        out |= {f"{i}/{k}": v.detach().clone() for k, v in optimizer.state.get(p, {}).items()}
    return out


def load_optimizer_state(optimizer: Optimizer, state: Mapping[str, Tensor]) -> None:
    """Restores what `optimizer_state` returned."""
    rates, hint = take(state, "lr"), "Use the layer sizes with which the state was saved"
    if rates.shape != (len(optimizer.param_groups),):
        raise PoiseError(
            f"the saved optimiser has learning rates of shape {tuple(rates.shape)}",
            hint=hint,
            code="state-differs",
        )
    for group, lr in zip(optimizer.param_groups, rates.tolist(), strict=True):
        group["lr"] = lr
    optimizer.state.clear()
    params = [p for group in optimizer.param_groups for p in group["params"]]
    for i, p in enumerate(params):
        moments = {k: v.detach().clone() for k, v in under(str(i), state).items()}
        for name, value in moments.items():
            # A moment is as its parameter, the count of steps a number.
            if value.shape != p.shape and (name != "step" or value.numel() != 1):
                what = f"the saved optimiser's '{i}/{name}' has the shape {tuple(value.shape)}"
                raise PoiseError(
                    f"{what} where {tuple(p.shape)} is expected", hint=hint, code="state-differs"
                )
        if moments:
            optimizer.state[p] = {k: v.to(p.device) for k, v in moments.items()}


def make_generator(seed: int, purpose: str, device: torch.device | str = "cpu") -> torch.Generator:
    """A generator of its own for each purpose, so that one draw more here moves nothing there."""
    digest = hashlib.sha256(f"{seed}:{purpose}".encode()).digest()
    return torch.Generator(device=device).manual_seed(int.from_bytes(digest[:8], "little") >> 1)


def set_generator(generator: torch.Generator, state: Tensor) -> None:
    """Goes on from a generator's state.

    The state of another kind of device cannot be taken over; it becomes a seed, so that the same
    run resumed there twice is the same.
    """
    if generator.get_state().shape == state.shape:
        generator.set_state(state.cpu())
        return
    digest = hashlib.sha256(state.cpu().numpy().tobytes()).digest()
    generator.manual_seed(int.from_bytes(digest[:8], "little") >> 1)


#: Seconds in which the processes of a training that was killed just now may end.
PATIENCE_S = 3.0
_POLL_S = 0.1
P = ParamSpec("P")
T = TypeVar("T")
R = TypeVar("R")


@contextmanager
def only_writer(folder: Path) -> Generator[None]:
    """Holds a folder as its only writer; the system lets go of it however the process ends.

    Where folders cannot be locked (Windows, some network disks) nothing is held.

    Raises:
        PoiseError: another process holds it.
    """
    folder.mkdir(parents=True, exist_ok=True)
    if os.name != "posix":
        yield
        return
    fcntl: Any = importlib.import_module("fcntl")
    held = os.open(folder, os.O_RDONLY)
    end = time.monotonic() + PATIENCE_S
    try:
        while True:
            try:
                fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if time.monotonic() > end:
                    hint = "Wait until it ends, or choose another folder"
                    raise PoiseError(
                        "another training writes here", folder, hint, code="folder-in-use"
                    ) from None
                time.sleep(_POLL_S)
            except OSError:
                break
        yield
    finally:
        os.close(held)


def alone(train: Callable[Concatenate[T, Path, P], R]) -> Callable[Concatenate[T, Path, P], R]:
    """A training that takes its folder as second argument, as that folder's only writer."""

    @functools.wraps(train)
    def held(what: T, folder: Path, *args: P.args, **kwargs: P.kwargs) -> R:
        with only_writer(folder):
            return train(what, folder, *args, **kwargs)

    return held
