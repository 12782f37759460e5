"""A process of its own reads a file with OpenUSD; a script, see `formats.limited`."""

from __future__ import annotations

import importlib
import struct
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

Refuse = Callable[..., NoReturn]
_EVEN_TIME = 0.01
_CUT = "It seems cut off or is no USD file"
#: Frames that are made between uneven keys at most: of any file, and for each key.
FRAMES, FRAMES_EACH = 100_000, 20


def read(
    path: str, refuse: Refuse, joints: int, poses: int, value: float, fps: float | None, rest: bool
) -> dict[str, np.ndarray]:
    """The first animated skeleton, its joints' transforms at every frame, what the stage states.

    Args:
        joints, poses, value: limits. fps: a rate in place of the file's. rest: a skeleton without an
            animation is read as it rests.
    """
    for part in ("Gf", "Sdf", "Tf", "Usd", "UsdGeom", "UsdSkel", "Vt"):
        importlib.import_module(f"pxr.{part}")
    pxr: Any = importlib.import_module("pxr")
    try:
        return _read(pxr, path, refuse, (joints, poses, value), fps, rest)
    except (pxr.Tf.ErrorException, UnicodeDecodeError):
        refuse("USD cannot read the file", _CUT, code="file-damaged")


def _read(
    pxr: Any, path: str, refuse: Refuse, limits: tuple[int, int, float], fps: float | None, rest: bool
) -> dict[str, np.ndarray]:
    notes: list[str] = []
    stage = _stage(pxr, path, refuse)
    found, others = _skeletons(pxr, stage, refuse, rest, notes, limits[0])
    rig, query = found.rig, found.query
    count = len(query.GetJointOrder())
    if not 0 < count <= limits[0]:
        refuse(f"it has {count} joints; 1 to {limits[0]} are read", code="joint-count")
    order = [str(j) for j in query.GetJointOrder()]
    parents = [int(p) for p in query.GetTopology().GetParentIndices()]
    stated = [str(n) for n in rig.GetJointNamesAttr().Get() or []]
    codes, rate = _codes(stage, found, count, fps, limits, refuse, notes)
    local = [np.array(query.ComputeJointLocalTransforms(c)) for c in codes]
    if any(x.shape != (count, 4, 4) for x in local):
        refuse(
            "its animation and rest transforms do not give every joint a place", code="rest-pose-unknown"
        )
    form = pxr.UsdGeom.Xformable(rig)
    when = codes if any(len(s) > 1 for s in found.above) else codes[:1]
    animation = query.GetAnimQuery()
    custom = animation.GetPrim().GetCustomDataByKey("poise") if animation else None
    custom = custom if isinstance(custom, dict) else {}
    ends = custom.get("ends")
    return {
        "names": _texts(stated if len(stated) == count else [o.rsplit("/", 1)[-1] for o in order]),
        "parents": np.array(parents),
        "local": np.stack(local),
        "above": np.stack([np.array(form.ComputeLocalToWorldTransform(c)) for c in when]),
        "codes": codes,
        "fps": np.array(rate),
        "up": np.array("Y" if pxr.UsdGeom.GetStageUpAxis(stage) == pxr.UsdGeom.Tokens.y else "Z"),
        "unit": np.array(float(pxr.UsdGeom.GetStageMetersPerUnit(stage))),
        "ends": np.array(ends if isinstance(ends, str) else ""),
        "cyclic": np.array(custom.get("cyclic") is True),
        "whole": np.array(bool(custom)),
        "notes": _texts(notes),
        "skeleton": _texts([rig.GetPrim().GetName()]),
        "others": _texts([str(o.rig.GetPath()) for o in others]),
        "others_joints": np.array([len(o.query.GetJointOrder()) for o in others], dtype=int),
    }


def _texts(texts: list[str]) -> np.ndarray:
    # Lone surrogates have no code in UTF-32, which arrays of text are.
    return np.array([t.encode("utf-8", "replace").decode() for t in texts], dtype=str)


def _stage(pxr: Any, path: str, refuse: Refuse) -> Any:
    # Anonymous, so that a file that has changed is read anew.
    with Path(path).open("rb") as file:
        packed = file.read(4) == b"PK\x03\x04"
    layer = _packed(pxr, path, refuse) if packed else pxr.Sdf.Layer.OpenAsAnonymous(path)
    if layer is None:
        refuse("USD cannot read the file", _CUT, code="file-damaged")
    others = sorted(x for x in set(layer.GetCompositionAssetDependencies()) if x)
    if others:
        some = ", ".join(
            repr("".join(c if c.isprintable() else "?" for c in x[:30])) for x in others[:3]
        )
        more = f" and {len(others) - 3} more" if len(others) > 3 else ""
        refuse(
            f"it is put together from other files ({some}{more})",
            "Flatten it into one file first: usdcat --flatten IN -o OUT",
            code="layers-apart",
        )
    return pxr.Usd.Stage.Open(layer)


def _packed(pxr: Any, path: str, refuse: Refuse) -> Any:
    """The first file of a USDZ package, which is its layer; packages are zips without compression."""
    with Path(path).open("rb") as file:
        head = file.read(30)
        if len(head) < 30:
            refuse("USD cannot read the file", _CUT, code="file-damaged")
        flags, method = struct.unpack("<2H", head[6:10])
        size, whole, name_size, extra = struct.unpack("<2I2H", head[18:30])
        name = file.read(name_size).decode("utf-8", "replace").lower()
        suffix = next((s for s in (".usda", ".usdc", ".usd") if name.endswith(s)), None)
        if suffix is None or method or flags & 0x9 or size != whole:
            refuse(
                "its first file is no plain USD layer, as a USDZ package needs",
                _CUT,
                code="file-damaged",
            )
        file.seek(extra, 1)
        data = file.read(size)
    if len(data) < size:
        refuse("USD cannot read the file", _CUT, code="file-damaged")
    with tempfile.TemporaryDirectory() as folder:
        inner = Path(folder) / f"layer{suffix}"
        inner.write_bytes(data)
        return pxr.Sdf.Layer.OpenAsAnonymous(str(inner))


@dataclass(frozen=True)
class _Found:
    """A skeleton, its query, the time codes of its joints' samples and of each transform above."""

    rig: Any
    query: Any
    joints: np.ndarray
    above: tuple[np.ndarray, ...]

    def moves(self) -> bool:
        return any(len(s) > 1 for s in (self.joints, *self.above))


def _skeletons(
    pxr: Any, stage: Any, refuse: Refuse, rest: bool, notes: list[str], most: int
) -> tuple[_Found, list[_Found]]:
    """The skeleton to read, and the others that are animated too.

    It is the first with joints that move, or else the first that a transform above it moves, or else one
    that stands in a pose of its animation. One of more than `most` joints is passed over.
    """
    UsdSkel, UsdGeom = pxr.UsdSkel, pxr.UsdGeom
    prims = list(stage.Traverse())
    for prim in prims:
        rels = (prim.GetRelationship(f"skel:{n}") for n in ("animationSource", "skeleton"))
        if any(r and r.HasAuthoredTargets() for r in rels) and not prim.HasAPI(UsdSkel.BindingAPI):
            # USD passes over such bindings; they say clearly what is meant.
            UsdSkel.BindingAPI.Apply(prim)
            where = "".join(c if c.isprintable() else "?" for c in str(prim.GetPath())[-80:])
            notes.append(f"'{where}' is bound without SkelBindingAPI; its binding counts all the same")
        if prim.IsA(UsdSkel.Skeleton) and not _under_root(UsdSkel, prim):
            outer = prim
            while (parent := outer.GetParent()) and not parent.IsPseudoRoot():
                outer = parent
            if outer != prim:
                outer.SetTypeName("SkelRoot")
    cache, found = UsdSkel.Cache(), list[_Found]()
    for prim in prims:
        if prim.IsA(UsdSkel.Root):
            cache.Populate(UsdSkel.Root(prim), pxr.Usd.PrimDefaultPredicate)
    bare: list[Any] = []
    large = 0
    for prim in prims:
        if not prim.IsA(UsdSkel.Skeleton):
            continue
        if (count := len(UsdSkel.Skeleton(prim).GetJointsAttr().Get() or ())) > most:
            # OpenUSD's query of so many takes seconds.
            large = max(large, count)
            continue
        query = cache.GetSkelQuery(UsdSkel.Skeleton(prim))
        animation = query.GetAnimQuery() if query else None
        samples = animation.GetJointTransformTimeSamples() if animation else []
        above, up = [], prim
        while up and not up.IsPseudoRoot():
            form = UsdGeom.Xformable(up)
            above.append(np.array(form.GetTimeSamples() if form else [], dtype=np.float64))
            up = up.GetParent()
        one = _Found(UsdSkel.Skeleton(prim), query, np.array(samples, dtype=np.float64), tuple(above))
        bare.append(one.rig)
        if query and (animation or one.moves() or rest):
            found.append(one)
    if large and not found:
        refuse(f"it has {large} joints; 1 to {most} are read", code="joint-count")
    if large:
        notes.append(f"A skeleton of {large} joints was passed over; 1 to {most} are read")
    if not found and not all(_in_order(UsdSkel, rig) for rig in bare):
        refuse("its joints do not stand with parents before children", code="parent-order")
    if not found and bare:
        refuse(
            "the file holds no animation of a skeleton (UsdSkel): none is bound to its skeleton",
            "Bind one with skel:animationSource (SkelBindingAPI, below a SkelRoot); as it rests it "
            "serves `poise retarget --onto` alone",
            code="no-animation",
        )
    if not found:
        refuse("the file holds no animation of a skeleton (UsdSkel)", code="no-animation")
    moving = [f for f in found if len(f.joints) > 1] or [f for f in found if f.moves()] or found
    best = moving[0]
    if rest and not best.query.GetAnimQuery() and not best.moves():
        notes.append("The file holds no animation: it is read as it rests, in one pose")
    return best, [f for f in moving if f is not best]


def _in_order(UsdSkel: Any, rig: Any) -> bool:
    joints = rig.GetJointsAttr().Get()
    return not joints or bool(UsdSkel.Topology(joints).Validate()[0])


def _under_root(UsdSkel: Any, prim: Any) -> bool:
    while prim and not prim.IsPseudoRoot():
        if prim.IsA(UsdSkel.Root):
            return True
        prim = prim.GetParent()
    return False


def _codes(
    stage: Any, found: _Found, joints: int, fps: float | None, limits: tuple[int, int, float],
    refuse: Refuse, notes: list[str],
) -> tuple[np.ndarray, float]:  # fmt: skip
    """The time codes `(T,)` at which the pose is read, and frames per second.

    USD interpolates between samples. Joints and transforms above them may have samples of their own:
    the smallest even spacing of any of them is taken, or else the smallest spacing at all.
    """
    per_second = float(stage.GetTimeCodesPerSecond())
    sources = [s for s in (found.joints, *found.above) if len(s)]
    samples = np.unique(np.concatenate(sources)) if sources else np.zeros(1)
    if not (np.abs(samples) <= limits[2]).all() or not 0 < per_second <= limits[2]:
        refuse("its time codes are no usable numbers", code="times-unusable")
    if len(samples) == 1:
        return np.repeat(samples, 2), fps or per_second
    steady = [s for s in sources if len(s) > 2 and _even(s)] or [s for s in sources if len(s) > 1]
    lead = min(steady, key=lambda s: float(np.diff(s).min()))
    step = float(np.median(np.diff(lead)))
    whole = _even(samples) and len(samples) == len(lead)
    even = fps is None and whole
    start = samples[0]
    if fps is not None:
        step = per_second / fps
    elif _even(lead):
        # The frames fall on the samples that set the pace, before their first one too.
        start = lead[0] - step * np.floor((lead[0] - samples[0]) / step + 1e-6)
    else:
        step = max(float(np.diff(samples).min()), per_second / 240.0)
        notes.append(
            f"The keys are not evenly spaced; they were read at {per_second / step:.6g} per second"
        )
    count = len(samples) if even else int(np.floor((samples[-1] - start) / step + 1e-6)) + 1
    if not even and count > FRAMES + FRAMES_EACH * len(samples):
        refuse(
            f"its {len(samples)} keys would become {count} frames at {per_second / step:.6g} per second",
            "State a lower rate with --fps F",
            code="clip-too-long",
        )
    if count * joints > limits[1]:
        refuse(
            f"it has {count} frames of {joints} joints, more than the {limits[1]} poses that are read",
            "Cut it shorter, or state a lower rate with --fps F",
            code="clip-too-long",
        )
    return samples if even else start + step * np.arange(count), per_second / step


def _even(samples: np.ndarray) -> bool:
    steps = np.diff(samples)
    step = float(np.median(steps))
    return not np.abs(steps - step).max() > _EVEN_TIME * step
