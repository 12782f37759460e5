"""Checks before the Warp backend's first step: the packages, a device, enough room."""

from __future__ import annotations

import os
from dataclasses import dataclass
from importlib import import_module, metadata
from types import ModuleType

import mujoco
import numpy as np
import torch

from poise.errors import PoiseError

_G = mujoco.mjtGeom
#: The most points at which a geom of this kind touches a plane.
_POINTS = {int(_G.mjGEOM_SPHERE): 1, int(_G.mjGEOM_CAPSULE): 2, int(_G.mjGEOM_ELLIPSOID): 1}
_CORNERS = 4
#: Kinds of which mutual contacts are found by the general convex search, which needs scratch memory.
_CONVEX = (int(_G.mjGEOM_BOX), int(_G.mjGEOM_CYLINDER), int(_G.mjGEOM_ELLIPSOID), int(_G.mjGEOM_MESH))
#: Scratch bytes of that search per candidate and iteration (its polytope's faces and corners).
_CONVEX_BYTES = 200
#: Room left for what the solver allocates while it steps, as a share of the worlds' own arrays.
_SLACK = 1.4
_GIB = 2**30


def load_warp() -> tuple[ModuleType, ModuleType]:
    """The modules `warp` and `mujoco_warp`, imported when first needed; they must be 4.0 or newer."""
    try:
        warp, mujoco_warp = import_module("warp"), import_module("mujoco_warp")
    except ImportError as error:
        raise PoiseError(
            f"the GPU backend needs mujoco-warp, which cannot be imported ({error})",
            hint="Install the extra: pip install 'poise-motion[gpu]'.",
            code="extra-missing",
        ) from error
    check_versions(metadata.version("mujoco-warp"), mujoco.__version__)
    if warp.config.log_level == warp.LOG_INFO:
        # Its start-up notes are kept out of all output; warnings still come through.
        warp.config.log_level = warp.LOG_WARNING
    return warp, mujoco_warp


def check_versions(mujoco_warp: str, mujoco_core: str) -> None:
    """Raise unless both packages are of one release series, 4.0 or newer."""
    if int(mujoco_warp.split(".")[0]) < 4 or mujoco_warp.split(".")[0] != mujoco_core.split(".")[0]:
        raise PoiseError(
            f"mujoco-warp {mujoco_warp} and mujoco {mujoco_core} do not go together",
            hint="Install both from one release series: pip install -U 'poise-motion[gpu]'.",
            code="version-differs",
        )


def resolve_device(name: str | torch.device) -> torch.device:
    """The torch device that "cuda", "cuda:1" or "cpu" means, after checking that Warp can use it."""
    try:
        device = torch.device(name)
    except RuntimeError as error:
        raise PoiseError(
            f"unknown device '{name}'", hint="Use 'cpu', 'cuda' or 'cuda:0'.", code="unknown-device"
        ) from error
    if device.type not in ("cpu", "cuda"):
        raise PoiseError(
            f"device '{name}' is not supported",
            hint="Use 'cpu', 'cuda' or 'cuda:0'.",
            code="unknown-device",
        )
    if device.type == "cpu":
        return device
    check_torch_cuda(name, torch.version.cuda, torch.cuda.device_count())
    index = torch.cuda.current_device() if device.index is None else device.index
    if index >= torch.cuda.device_count():
        raise PoiseError(
            f"there is no device '{name}'",
            hint=f"This machine has {torch.cuda.device_count()} GPU(s).",
            code="device-missing",
        )
    warp, _ = load_warp()
    warp.init()
    check_driver(
        warp.config.version, warp.get_cuda_device_count(), warp.get_cuda_toolkit_version(),
        warp.get_cuda_driver_version(),
    )  # fmt: skip
    return torch.device("cuda", index)


def check_torch_cuda(name: str | torch.device, built_for: str | None, count: int) -> None:
    """Raise unless PyTorch was built for CUDA and sees a GPU."""
    if built_for is None:
        raise PoiseError(
            f"device '{name}' was asked for, but this PyTorch ({torch.__version__}) has no CUDA",
            hint="Install a CUDA build of PyTorch (pytorch.org), or use --device cpu.",
            code="device-missing",
        )
    if count == 0:
        raise PoiseError(
            f"device '{name}' was asked for, but PyTorch finds no CUDA GPU",
            hint="Check that `nvidia-smi` lists one, or use --device cpu.",
            code="device-missing",
        )


def check_driver(
    version: str, count: int, toolkit: tuple[int, int] | None, driver: tuple[int, int] | None
) -> None:
    """Raise where PyTorch sees a GPU and Warp does not, which is a mismatch of driver and package."""
    if count > 0:
        return
    built = "without CUDA" if toolkit is None else f"for CUDA {toolkit[0]}.{toolkit[1]}"
    has = "no driver that it can use" if driver is None else f"a driver for CUDA {driver[0]}.{driver[1]}"
    raise PoiseError(
        f"Warp {version} was built {built} and finds {has}, though PyTorch sees a GPU",
        hint="Update the NVIDIA driver, or install the warp-lang release that fits it.",
        code="driver-unfit",
    )


@dataclass(frozen=True)
class Capacity:
    """How much room a world gets; Warp allocates all of it beforehand.

    Attributes:
        contacts: contact points and candidate pairs per world, on average over the worlds.
        rows: constraint rows per world, a limit for each single world.
        convex: contacts per world that need the general convex search, on average.
    """

    contacts: int
    rows: int
    convex: int


def capacity(model: mujoco.MjModel, contacts: int | None = None, rows: int | None = None) -> Capacity:
    """Room for every moving geom flat on the ground and touching one other, unless given.

    rows = limits + frictions + equalities + contacts * (rows per contact), where a pyramidal
    contact of dimension c takes 2 (c - 1) rows.
    """
    for name, value in (("contacts_per_world", contacts), ("constraints_per_world", rows)):
        if value is not None and value < 1:
            raise PoiseError(f"{name} must be above 0, got {value}", code="out-of-range")
    solid = (model.geom_contype | model.geom_conaffinity) != 0
    moving = solid & (model.body_weldid[model.geom_bodyid] != 0)
    count, fixed = int(moving.sum()), int((solid & ~moving).sum())
    touching = sum(_POINTS.get(int(kind), _CORNERS) for kind in model.geom_type[moving]) if fixed else 0
    pairs = count * (count - 1) // 2 + count * fixed
    most = max(16, touching + count, min(pairs, 4 * count))
    convex_kind = np.isin(model.geom_type, _CONVEX)
    boxes, fixed_boxes = int((moving & convex_kind).sum()), int((solid & ~moving & convex_kind).sum())
    convex = _CORNERS * (boxes * (boxes - 1) // 2 + boxes * fixed_boxes)
    chosen = contacts or most
    dim = int(max([1, *model.geom_condim[solid], *model.pair_dim]))
    pyramidal = model.opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL
    per_contact = max(1, 2 * (dim - 1)) if pyramidal else dim
    others = int(model.jnt_limited.sum()) + int(model.tendon_limited.sum()) + 6 * int(model.neq)
    others += int((model.dof_frictionloss > 0).sum()) + int((model.tendon_frictionloss > 0).sum())
    # A contact with one other geom is shared by the two.
    enough = others + per_contact * (chosen if contacts else max(8, touching + count))
    return Capacity(chosen, rows or enough, min(convex, chosen))


def bytes_per_world(model: mujoco.MjModel, room: Capacity) -> int:
    """What one more world takes, bytes, scratch memory included: measured on small data, then scaled."""
    warp, mjw = load_warp()
    with warp.ScopedDevice("cpu"):
        one, two = (
            _bytes(mjw.make_data(model, n, room.contacts, njmax=room.rows, nccdmax=room.convex))
            for n in (1, 2)
        )
    scratch = room.convex * int(model.opt.ccd_iterations) * _CONVEX_BYTES
    return int(_SLACK * (two - one)) + scratch


def free_memory(device: torch.device) -> int | None:
    """Free bytes on the device, or None where the system does not tell."""
    if device.type == "cuda":
        return torch.cuda.mem_get_info(device)[0]
    try:
        return os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError, OSError):
        return None


def check_memory(num_envs: int, per_world: int, free: int | None, device: torch.device) -> None:
    """Raise, saying how many fit, when the worlds need more than nine tenths of what is free."""
    if free is None or num_envs * per_world <= 0.9 * free:
        return
    fit = int(0.9 * free / per_world)
    raise PoiseError(
        f"{num_envs} worlds of this model need about {num_envs * per_world / _GIB:.1f} GiB, but "
        f"{device} has {free / _GIB:.1f} GiB free",
        hint=f"About {fit} fit: ask for that many, or free some memory.",
        code="out-of-memory",
    )


def _bytes(data: object) -> int:
    """Bytes of all Warp arrays in a dataclass."""
    warp, _ = load_warp()
    total = 0
    for value in vars(data).values():
        if isinstance(value, warp.array):
            total += value.capacity
        elif hasattr(value, "__dataclass_fields__"):
            total += _bytes(value)
    return total
