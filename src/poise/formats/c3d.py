"""C3D files: labelled markers of a motion capture system."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

import numpy as np

from poise.errors import PoiseError
from poise.formats.guess import UPS
from poise.formats.limited import read_limited
from poise.formats.one_person import chosen
from poise.formats.point_raw import UNITS_M, RawPoints
from poise.formats.raw import UNSTATED, ReadOptions
from poise.formats.text import CUT_OFF, check_file, shown

_KEY = 0x50
_BLOCK = 512
_SCRIPT = Path(__file__).with_name("c3d_file.py")
# What Vicon writes beside markers: lists of labels that are no places.
_NO_PLACES = ("ANGLES", "FORCES", "MOMENTS", "POWERS", "SCALARS", "EVENTS", "REACTIONS")


def looks_like_c3d(head: bytes) -> bool:
    """Whether a file's first bytes are a C3D header: parameter block, key 0x50, plausible counts."""
    if len(head) < _BLOCK or head[1] != _KEY or not 2 <= head[0] <= 50:
        return False
    points = int.from_bytes(head[2:4], "little")
    return 0 < points < 2048


def c3d_points(path: Path, options: ReadOptions = UNSTATED) -> RawPoints:
    """The markers of a C3D file: unit, rate and vertical as it states them; NaN where the residual is
    negative. Model outputs (angles, forces) are left out.

    Raises:
        PoiseError: damage, no labelled markers; ezc3d is not installed.
    """
    if find_spec("ezc3d") is None:
        raise PoiseError(
            "C3D files need the package ezc3d",
            path,
            "Install it with pip install 'poise-motion[c3d]'",
            code="extra-missing",
        )
    size = _check_header(path)
    # Damaged files make the C++ library loop without end or take any memory.
    point = read_limited(_SCRIPT, path, size, "C3D file")
    points, residuals = np.asarray(point.pop("points")), np.asarray(point.pop("residuals"))
    rate = float(point.pop("rate").ravel()[0])
    labels = _labels(point)
    if points.shape[1] < len(labels) or not labels:
        raise PoiseError(
            f"it holds {points.shape[1]} points and {len(labels)} labels",
            path,
            "Label the markers in the capture software and export again",
            code="count-differs",
        )
    missing = residuals[0, : len(labels)] < 0
    positions = np.where(missing.T[..., None], np.nan, points[:3, : len(labels)].transpose(2, 1, 0))
    keep, notes = _chosen(labels, point, options.take, path)
    unit_name = _text(point, "UNITS").lower()
    if unit_name not in UNITS_M:
        notes.append(f"The unit {shown(unit_name)} is not known" if unit_name else "No unit is stated")
    if not rate > 0:
        raise PoiseError(
            f"the frame rate is {rate:g}", path, "The file seems damaged", code="rate-out-of-range"
        )
    return RawPoints(
        "c3d",
        path,
        tuple(labels[k] for k in keep),
        positions[:, keep],
        rate,
        UNITS_M.get(unit_name),
        _vertical(point),
        notes=tuple(notes),
    )


def _check_header(path: Path) -> int:
    """The file's size; a header with counts that do not fit into it is refused before it is read."""
    size = check_file(path)
    with path.open("rb") as file:
        head = file.read(_BLOCK)
    if len(head) < _BLOCK or head[1] != _KEY:
        raise PoiseError(
            "this is not a C3D file (its second byte is not 0x50)", path, code="wrong-format"
        )
    points = int.from_bytes(head[2:4], "little")
    first, last = (int.from_bytes(head[k : k + 2], "little") for k in (6, 8))
    start = int.from_bytes(head[16:18], "little")
    frames = last - first + 1
    # Eight bytes for a point of 16-bit integers are the least; beyond 65535 frames the header says less.
    if last != 0xFFFF and points * max(frames, 0) * 8 > size:
        raise PoiseError(
            f"its header states {frames} frames of {points} points, which do not fit into {size} bytes",
            path,
            CUT_OFF,
            code="file-cut-off",
        )
    if (start - 1) * _BLOCK > size or (head[0] - 1) * _BLOCK >= size:
        raise PoiseError(
            "its header points beyond the end of the file", path, CUT_OFF, code="file-cut-off"
        )
    return size


def _labels(point: dict[str, np.ndarray]) -> list[str]:
    """All labels; files with more than 255 continue in LABELS2, LABELS3."""
    out: list[str] = []
    for key in ("LABELS", "LABELS2", "LABELS3", "LABELS4"):
        out += [str(x).strip() for x in point.get(key, ())]
    return out


def _text(point: dict[str, np.ndarray], key: str) -> str:
    value = [str(x) for x in point.get(key, ())]
    return value[0].strip() if value else ""


def _vertical(point: dict[str, np.ndarray]) -> str | None:
    """The file's vertical, where it says which axis points up on the screen."""
    axis = _text(point, "Y_SCREEN").upper().lstrip("+")
    return axis if axis in UPS else None


def _chosen(
    labels: list[str], point: dict[str, np.ndarray], take: str | None, path: Path
) -> tuple[list[int], list[str]]:
    """Columns of labelled markers, of one subject, each label once."""
    outputs = {str(x).strip() for key in _NO_PLACES for x in point.get(key, ())}
    subjects = dict.fromkeys(x.rsplit(":", 1)[0] for x in labels if ":" in x and not x.startswith("*"))
    notes: list[str] = []
    only = None
    if len(subjects) > 1:
        only, notes = chosen(list(subjects), take, path)
    seen: set[str] = set()
    keep = []
    for k, label in enumerate(labels):
        # Vicon writes unlabelled trajectories as *1, *2, ...
        if not label or label.startswith("*") or label in outputs or label in seen:
            continue
        if only is not None and not label.startswith(only + ":"):
            continue
        seen.add(label)
        keep.append(k)
    return keep, notes
