"""USD files (.usda, .usd, .usdc) as clips: an animated UsdSkel skeleton; needs `usd-core`."""

from __future__ import annotations

import importlib
import json
from pathlib import Path
from typing import Any

import numpy as np

from poise.errors import PoiseError
from poise.motion.clip import Clip, check_poses
from poise.motion.io.nodes import base_of, checked_unit, rigid_bones, turn_and_scale, unique_names
from poise.motion.io.raw import RawMotion, ReadOptions, assemble
from poise.motion.io.text import MAX_JOINTS, MAX_VALUE, check_file, listed, shown

_EVEN_TIME = 0.01
_DAMAGED = "It seems cut off or is no USD file"


def pxr_package() -> Any:
    """OpenUSD's Python package with the parts that are needed here, loaded late."""
    try:
        for part in ("Gf", "Sdf", "Tf", "Usd", "UsdGeom", "UsdSkel", "Vt"):
            importlib.import_module(f"pxr.{part}")
        return importlib.import_module("pxr")
    except ImportError:
        raise PoiseError(
            "USD files need the package usd-core",
            hint="Install it with: pip install 'poise-motion[usd]'",
        ) from None


def read_usd(path: Path, options: ReadOptions) -> Clip:
    """The first animated UsdSkel skeleton of a .usda, .usd or .usdc file.

    Unit and vertical are the stage's. The file must stand alone: layers, references and payloads
    in other files are refused, not opened.

    Raises:
        PoiseError: usd-core is not installed, the file is damaged, or it holds no skeleton in motion.
    """
    pxr = pxr_package()
    check_file(path)
    notes: list[str] = []
    try:
        stage = _stage(pxr, path)
        rig, query = _animated_skeleton(pxr, stage, path, notes)
        raw = _raw_motion(pxr, stage, rig, query, path, options, notes)
    except (pxr.Tf.ErrorException, UnicodeDecodeError):
        raise PoiseError("USD cannot read the file", path, _DAMAGED) from None
    return assemble(raw, options)


def _stage(pxr: Any, path: Path) -> Any:
    # Anonymous, so that a file that has changed is read anew.
    layer = pxr.Sdf.Layer.OpenAsAnonymous(str(path.resolve()))
    if layer is None:
        raise PoiseError("USD cannot read the file", path, _DAMAGED)
    others = sorted(set(layer.GetCompositionAssetDependencies()))
    if others:
        raise PoiseError(
            f"it is put together from other files ({listed((shown(o) for o in others), 3)})",
            path,
            "Flatten it into one file first: usdcat --flatten IN -o OUT",
        )
    return pxr.Usd.Stage.Open(layer)


def _animated_skeleton(pxr: Any, stage: Any, path: Path, notes: list[str]) -> tuple[Any, Any]:
    UsdSkel = pxr.UsdSkel
    cache, found = UsdSkel.Cache(), []
    for prim in stage.Traverse():
        if prim.IsA(UsdSkel.Root):
            cache.Populate(UsdSkel.Root(prim), pxr.Usd.PrimDefaultPredicate)
    for prim in stage.Traverse():
        if prim.IsA(UsdSkel.Skeleton):
            query = cache.GetSkelQuery(UsdSkel.Skeleton(prim))
            moving = (
                query and query.GetAnimQuery() and query.GetAnimQuery().GetJointTransformTimeSamples()
            )
            if moving and len(moving) > 1:
                found.append((UsdSkel.Skeleton(prim), query))
    if not found:
        raise PoiseError("the file holds no animation of a skeleton (UsdSkel)", path)
    if len(found) > 1:
        notes.append(f"Of {len(found)} animated skeletons the first was taken")
    return found[0]


def _raw_motion(
    pxr: Any, stage: Any, rig: Any, query: Any, path: Path, options: ReadOptions, notes: list[str]
) -> RawMotion:
    order = [str(j) for j in query.GetJointOrder()]
    parents = [int(p) for p in query.GetTopology().GetParentIndices()]
    if not order or len(order) > MAX_JOINTS:
        raise PoiseError(f"it has {len(order)} joints; 1 to {MAX_JOINTS} are read", path)
    if parents[0] != -1 or any(p >= j or p < 0 for j, p in enumerate(parents) if j):
        raise PoiseError("its joints are not one tree with parents before children", path)
    stated = [str(n) for n in rig.GetJointNamesAttr().Get() or []]
    given = stated if len(stated) == len(order) else [o.rsplit("/", 1)[-1] for o in order]
    names = unique_names(given, notes)
    codes, fps = _codes(stage, query, len(order), options, path, notes)
    local = np.stack([np.array(query.ComputeJointLocalTransforms(c)) for c in codes])
    if local.shape[1] != len(order):
        raise PoiseError("its animation and rest transforms do not give every joint a place", path)
    above = np.array(pxr.UsdGeom.Xformable(rig).ComputeLocalToWorldTransform(codes[0]))
    top = [x[0] for x in _parts(above[None], f"{path}, the skeleton's own transform", codes)]
    parts = [_parts(local[:, j], f"{path}, joint '{n}'", codes) for j, n in enumerate(names)]
    place, turn, scale = ([p[k] for p in parts] for k in range(3))
    steady = [np.median(s, axis=0) for s in scale]
    base = base_of([(top[0], top[1], top[2])])
    bones = rigid_bones(names, parents, place, turn, steady, base, notes)
    Y = pxr.UsdGeom.Tokens.y
    up = "Y" if pxr.UsdGeom.GetStageUpAxis(stage) == Y else "Z"
    unit = float(pxr.UsdGeom.GetStageMetersPerUnit(stage))
    custom = query.GetAnimQuery().GetPrim().GetCustomDataByKey("poise")
    custom = custom if isinstance(custom, dict) else {}
    return RawMotion(
        format="usd",
        path=path,
        names=names,
        parents=tuple(parents),
        offsets=bones.offsets,
        ends=_ends(custom.get("ends"), len(names)),
        root_pos=bones.root_pos,
        rot=bones.rot,
        fps=fps,
        channels=(),
        unit_m=checked_unit("USD", unit, up, names, parents, bones, options, path, notes),
        up_axis=up,
        travel_joint=None if bones.travel is None else names[bones.travel],
        cyclic=custom.get("cyclic") is True,
        notes=tuple(notes),
        strays=bones.strays,
        whole=bool(custom),
    )


def _codes(
    stage: Any, query: Any, joints: int, options: ReadOptions, path: Path, notes: list[str]
) -> tuple[np.ndarray, float]:
    """The time codes `(T,)` at which the pose is read, and frames per second.

    USD interpolates between samples, so unevenly spaced ones are read at the smallest spacing.
    """
    per_second = float(stage.GetTimeCodesPerSecond())
    samples = np.array(query.GetAnimQuery().GetJointTransformTimeSamples(), dtype=np.float64)
    if not (np.abs(samples) <= MAX_VALUE).all() or not 0 < per_second <= MAX_VALUE:
        raise PoiseError("its time codes are no usable numbers", path)
    steps = np.diff(samples)
    step = float(np.median(steps))
    if options.fps is not None:
        step = per_second / options.fps
    elif np.abs(steps - step).max() > _EVEN_TIME * step:
        step = max(float(steps.min()), per_second / 240.0)
        notes.append(
            f"The keys are not evenly spaced; they were read at {per_second / step:.6g} per second"
        )
    else:
        check_poses(len(samples), joints, path)
        return samples, per_second / step
    count = int(np.floor((samples[-1] - samples[0]) / step + 1e-6)) + 1
    check_poses(count, joints, path)
    return samples[0] + step * np.arange(count), per_second / step


def _parts(m: np.ndarray, where: str, codes: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Places `(T, 3)`, turns `(T, 4)` wxyz and scales `(T, 3)` of row-vector matrices `(T, 4, 4)`."""
    bad = ~(np.abs(m) <= MAX_VALUE).all((1, 2))
    if bad.any():
        raise PoiseError(
            f"its transform is no usable number at time code {codes[bad.argmax()]:g}", where
        )
    turn, scale = turn_and_scale(m[:, :3, :3].transpose(0, 2, 1), "transform", where)
    return m[:, 3, :3], turn, scale


def _ends(text: object, joints: int) -> tuple[tuple[int, tuple[float, float, float]], ...]:
    """Bone tips that Poise wrote beside the animation, in file units."""
    try:
        rows = json.loads(text) if isinstance(text, str) else []
        tips = [(int(j), (float(x), float(y), float(z))) for j, x, y, z in rows]
    except (TypeError, ValueError):
        return ()
    return tuple((j, tip) for j, tip in tips if 0 <= j < joints and max(map(abs, tip)) <= MAX_VALUE)
