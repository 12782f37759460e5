"""What OpenUSD reads of a file; a script of its own, see `motion.io.limited`."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any, NoReturn

import numpy as np

Refuse = Callable[..., NoReturn]
_EVEN_TIME = 0.01
#: Frames that are made between uneven keys at most: of any file, and for each key.
FRAMES, FRAMES_EACH = 100_000, 20


def read(
    path: str, refuse: Refuse, joints: int, poses: int, value: float, fps: float | None
) -> dict[str, np.ndarray]:
    """The first animated skeleton, its joints' transforms at every frame, what the stage states.

    Args:
        joints, poses, value: limits. fps: a rate in place of the file's.
    """
    for part in ("Gf", "Sdf", "Tf", "Usd", "UsdGeom", "UsdSkel", "Vt"):
        importlib.import_module(f"pxr.{part}")
    pxr: Any = importlib.import_module("pxr")
    try:
        return _read(pxr, path, refuse, (joints, poses, value), fps)
    except (pxr.Tf.ErrorException, UnicodeDecodeError):
        refuse("USD cannot read the file", "It seems cut off or is no USD file")


def _read(
    pxr: Any, path: str, refuse: Refuse, limits: tuple[int, int, float], fps: float | None
) -> dict[str, np.ndarray]:
    notes: list[str] = []
    stage = _stage(pxr, path, refuse)
    rig, query = _animated_skeleton(pxr, stage, refuse, notes)
    order = [str(j) for j in query.GetJointOrder()]
    parents = [int(p) for p in query.GetTopology().GetParentIndices()]
    if not order or len(order) > limits[0]:
        refuse(f"it has {len(order)} joints; 1 to {limits[0]} are read")
    if parents[0] != -1 or any(p >= j or p < 0 for j, p in enumerate(parents) if j):
        refuse("its joints are not one tree with parents before children")
    stated = [str(n) for n in rig.GetJointNamesAttr().Get() or []]
    codes, rate = _codes(stage, query, len(order), fps, limits, refuse, notes)
    local = [np.array(query.ComputeJointLocalTransforms(c)) for c in codes]
    if any(x.shape != (len(order), 4, 4) for x in local):
        refuse("its animation and rest transforms do not give every joint a place")
    custom = query.GetAnimQuery().GetPrim().GetCustomDataByKey("poise")
    custom = custom if isinstance(custom, dict) else {}
    ends = custom.get("ends")
    return {
        "names": _texts(stated if len(stated) == len(order) else [o.rsplit("/", 1)[-1] for o in order]),
        "parents": np.array(parents),
        "local": np.stack(local),
        "above": np.array(pxr.UsdGeom.Xformable(rig).ComputeLocalToWorldTransform(codes[0])),
        "codes": codes,
        "fps": np.array(rate),
        "up": np.array("Y" if pxr.UsdGeom.GetStageUpAxis(stage) == pxr.UsdGeom.Tokens.y else "Z"),
        "unit": np.array(float(pxr.UsdGeom.GetStageMetersPerUnit(stage))),
        "ends": np.array(ends if isinstance(ends, str) else ""),
        "cyclic": np.array(custom.get("cyclic") is True),
        "whole": np.array(bool(custom)),
        "notes": _texts(notes),
    }


def _texts(texts: list[str]) -> np.ndarray:
    # Lone surrogates have no code in UTF-32, which arrays of text are.
    return np.array([t.encode("utf-8", "replace").decode() for t in texts], dtype=str)


def _stage(pxr: Any, path: str, refuse: Refuse) -> Any:
    # Anonymous, so that a file that has changed is read anew.
    layer = pxr.Sdf.Layer.OpenAsAnonymous(path)
    if layer is None:
        refuse("USD cannot read the file", "It seems cut off or is no USD file")
    others = sorted(x for x in set(layer.GetCompositionAssetDependencies()) if x)
    if others:
        some = ", ".join(
            repr("".join(c if c.isprintable() else "?" for c in x[:30])) for x in others[:3]
        )
        more = f" and {len(others) - 3} more" if len(others) > 3 else ""
        refuse(
            f"it is put together from other files ({some}{more})",
            "Flatten it into one file first: usdcat --flatten IN -o OUT",
        )
    return pxr.Usd.Stage.Open(layer)


def _animated_skeleton(pxr: Any, stage: Any, refuse: Refuse, notes: list[str]) -> tuple[Any, Any]:
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
        refuse("the file holds no animation of a skeleton (UsdSkel)")
    if len(found) > 1:
        notes.append(f"Of {len(found)} animated skeletons the first was taken")
    return found[0]


def _codes(
    stage: Any, query: Any, joints: int, fps: float | None, limits: tuple[int, int, float],
    refuse: Refuse, notes: list[str],
) -> tuple[np.ndarray, float]:  # fmt: skip
    """The time codes `(T,)` at which the pose is read, and frames per second.

    USD interpolates between samples, so unevenly spaced ones are read at the smallest spacing.
    """
    per_second = float(stage.GetTimeCodesPerSecond())
    samples = np.array(query.GetAnimQuery().GetJointTransformTimeSamples(), dtype=np.float64)
    if not (np.abs(samples) <= limits[2]).all() or not 0 < per_second <= limits[2]:
        refuse("its time codes are no usable numbers")
    steps = np.diff(samples)
    step = float(np.median(steps))
    even = fps is None and not np.abs(steps - step).max() > _EVEN_TIME * step
    if fps is not None:
        step = per_second / fps
    elif not even:
        step = max(float(steps.min()), per_second / 240.0)
        notes.append(
            f"The keys are not evenly spaced; they were read at {per_second / step:.6g} per second"
        )
    count = len(samples) if even else int(np.floor((samples[-1] - samples[0]) / step + 1e-6)) + 1
    if not even and count > FRAMES + FRAMES_EACH * len(samples):
        refuse(
            f"its {len(samples)} keys would become {count} frames at {per_second / step:.6g} per second",
            "State a lower rate with --fps F",
        )
    if count * joints > limits[1]:
        refuse(
            f"it has {count} frames of {joints} joints, more than the {limits[1]} poses that are read",
            "Cut it shorter, or state a lower rate with --fps F",
        )
    return samples if even else samples[0] + step * np.arange(count), per_second / step
