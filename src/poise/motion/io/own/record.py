"""A clip's skeleton and source as plain JSON, for the formats that keep all of it."""

from __future__ import annotations

import json
from dataclasses import asdict, is_dataclass, replace
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, get_args, get_origin, get_type_hints

import numpy as np

from poise.errors import PoiseError, did_you_mean
from poise.motion.io.raw import ReadOptions
from poise.motion.io.text import CUT_OFF, MAX_JOINTS, MAX_VALUE, shown
from poise.motion.skeleton import Skeleton, Source, triple

MAX_RECORD = 16 << 20
"""Longer records are refused, characters."""
MAX_NOTE = 2000
LEAST_BONE_M = 1e-6
"""A skeleton of several joints has one bone at least that is as long."""


def source_to_json(source: Source) -> str:
    """All of a `Source` as one line of JSON."""
    # NumPy's numbers, which readers may leave in a source, become plain ones.
    return json.dumps(asdict(source), separators=(",", ":"), default=lambda value: value.item())


def source_from_json(text: str, path: Path) -> Source:
    """The `Source` that `source_to_json` wrote; a damaged one is refused in one sentence.

    Fields that this version does not know are left out, fields that are not there get defaults. Notes
    longer than Poise writes are cut.
    """
    try:
        source = fitted(loads(text, path, "source"), Source)
        cut = (n if len(n) <= MAX_NOTE else n[: MAX_NOTE - 3] + "..." for n in source.notes)
        # What was taken off its keypoints is no fault of the file that was written then.
        mended = (m for m in source.mended if m[0] != "tremble")
        return replace(source, notes=tuple(cut), mended=tuple(mended))
    except (KeyError, TypeError, ValueError) as error:
        raise PoiseError(
            f"the record of the clip's source is damaged ({shown(error)})", path, CUT_OFF
        ) from None


def fitted(value: Any, kind: Any) -> Any:
    """JSON data as a value of the annotated type `kind`, where tuples are lists; else a ValueError."""
    origin, inner = get_origin(kind), get_args(kind)
    if origin is UnionType:
        return None if value is None and NoneType in inner else fitted(value, inner[0])
    if origin is tuple and isinstance(value, list | tuple):
        kinds = [inner[0]] * len(value) if inner[-1] is ... else inner
        return tuple(fitted(v, k) for v, k in zip(value, kinds, strict=True))
    if is_dataclass(kind) and isinstance(value, dict):
        fields = get_type_hints(kind)
        return kind(**{k: fitted(value[k], fields[k]) for k in fields if k in value})  # type: ignore[operator]
    if kind is float and type(value) in (int, float):
        try:
            return float(value)
        except OverflowError:
            raise ValueError("a number beyond all bounds") from None
    if type(value) is not kind:
        raise ValueError(f"{type(value).__name__} in the wrong place")
    return value


def loads(text: str, path: Path, what: str) -> dict[str, Any]:
    """A JSON object, or one sentence about why there is none."""
    try:
        if len(text) > MAX_RECORD:
            raise ValueError("it is too long")
        record = json.loads(text)
        if not isinstance(record, dict):
            raise ValueError("it is no JSON object")
    except (ValueError, RecursionError) as error:
        raise PoiseError(f"the {what} record is damaged ({shown(error)})", path, CUT_OFF) from None
    return record


def make_skeleton(
    names: list[str],
    parents: np.ndarray,
    offsets: np.ndarray,
    end_joints: np.ndarray,
    ends: np.ndarray,
    source: Source,
    path: Path,
) -> Skeleton:
    """A skeleton from arrays of a file; whatever does not fit together is refused.

    parents `(J,)`, offsets `(J, 3)` m, end_joints `(E,)` joint indices, ends `(E, 3)` m.
    """
    count = len(names)
    if not 0 < count <= MAX_JOINTS:
        raise PoiseError(f"it has {count} joints; 1 to {MAX_JOINTS} are allowed", path)
    if len(parents) != count or len(offsets) != count or len(end_joints) != len(ends):
        raise PoiseError(
            f"{count} names, {len(parents)} parents, {len(offsets)} offsets, {len(end_joints)} end "
            f"joints and {len(ends)} ends do not fit together",
            path,
        )
    for what, table in (("offsets", offsets), ("ends", ends)):
        if not (np.abs(table) <= MAX_VALUE).all():
            raise PoiseError(f"array '{what}' holds a number that is not usable", path)
    if count > 1 and not np.abs(offsets[1:]).max() >= LEAST_BONE_M:
        raise PoiseError("no bone of the skeleton has any length", path)
    if not ((end_joints >= 0) & (end_joints < count)).all():
        raise PoiseError("array 'end_joints' names a joint that does not exist", path)
    tips = tuple((int(j), triple(e)) for j, e in zip(end_joints, ends.tolist(), strict=True))
    if source.travel_joint is not None and source.travel_joint not in names:
        raise PoiseError(
            f"there is no joint '{source.travel_joint}'. {did_you_mean(source.travel_joint, names)}",
            path,
        )
    return Skeleton(tuple(names), tuple(int(p) for p in parents), offsets, tips, source)


def refuse_overrides(options: ReadOptions, path: Path) -> None:
    """Unit and vertical are stated in Poise's own files, so nothing may override them."""
    for flag, value in (("--unit", options.unit_m), ("--up", options.up_axis)):
        if value is not None:
            raise PoiseError(f"{flag} is not for Poise's own files, which are in metres, Z up", path)
