"""DeepMimic motion files: JSON with 44 numbers per frame on the published humanoid."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from poise.errors import PoiseError
from poise.formats.guess import check_radians
from poise.formats.raw import RawMotion, ReadOptions, assemble
from poise.formats.text import MAX_JSON_BYTES, MAX_VALUE, json_object, read_bytes
from poise.motion.clip import Clip, blended
from poise.motion.rotations import axis_angle_to_quat
from poise.motion.skeleton import Channel

COLUMNS = 44
"""Frame duration, root position, root quaternion, then the joints below."""

# Joint, parent, offset (m, facing +X, Y up, right +Z), values per frame: 4 quaternion, 1 angle
# about +Z, 0 fixed. A negative knee angle bends the shin back, a positive elbow the forearm forth.
_SIDE = (
    ("hip", "root", (0.0, 0.0, 0.084887), 4),
    ("knee", "hip", (0.0, -0.421546, 0.0), 1),
    ("ankle", "knee", (0.0, -0.409870, 0.0), 4),
    ("shoulder", "chest", (-0.02405, 0.24350, 0.18311), 4),
    ("elbow", "shoulder", (0.0, -0.274788, 0.0), 1),
    ("wrist", "elbow", (0.0, -0.258947, 0.0), 0),
)
_ENDS = {
    "neck": (0.0, 0.278, 0.0),
    "right_ankle": (0.1335, -0.05, 0.0),
    "left_ankle": (0.1335, -0.05, 0.0),
}
_NORM_SLACK = 0.5
_NORM_NOTE = 1e-3
_TIME_SLACK = 0.01


def _humanoid() -> list[tuple[str, str | None, tuple[float, float, float], int]]:
    rows: list[tuple[str, str | None, tuple[float, float, float], int]] = [
        ("root", None, (0.0, 0.0, 0.0), 4),
        ("chest", "root", (0.0, 0.236151, 0.0), 4),
        ("neck", "chest", (0.0, 0.223894, 0.0), 4),
    ]
    for side, sign in (("right", 1.0), ("left", -1.0)):
        for name, parent, (x, y, z), size in _SIDE:
            up = parent if parent in ("root", "chest") else f"{side}_{parent}"
            rows.append((f"{side}_{name}", up, (x, y, sign * z), size))
    return rows


def read_deepmimic(path: Path, options: ReadOptions) -> Clip:
    """A DeepMimic clip: metres, Y up; `Loop: wrap` makes it cyclic.

    Quaternions off unit length are normalised and told; where frame durations differ by more
    than 1 %, the clip is resampled at the median one.
    """
    data = json_object(read_bytes(path, MAX_JSON_BYTES), path)
    if not isinstance(data.get("Frames"), list):
        raise PoiseError(
            "the JSON has no list named 'Frames'", path, "DeepMimic files need one", code="key-missing"
        )
    table = _table(data["Frames"], path)
    loop = data.get("Loop", "none")
    if loop not in ("wrap", "none"):
        raise PoiseError(
            f"Loop must be wrap or none, got {str(loop)[:30]!r}", path, code="unknown-choice"
        )
    notes: list[str] = []
    joints = _humanoid()
    names = tuple(j[0] for j in joints)
    rot, mended = _rotations(table, joints, path, notes)
    times, uneven = _times(table[:, 0], path)
    step = float(np.median(times))
    raw = RawMotion(
        format="deepmimic",
        path=path,
        names=names,
        parents=tuple(-1 if up is None else names.index(up) for _, up, _, _ in joints),
        offsets=np.array([j[2] for j in joints]),
        ends=tuple((names.index(n), tip) for n, tip in _ENDS.items()),
        root_pos=table[:, 1:4],
        rot=rot,
        fps=1.0 / step,
        channels=tuple(Channel(order=("quat",) if s == 4 else ("rz",) * s) for *_, s in joints),
        frame_time=step,
        unit_m=1.0,
        up_axis="Y",
        cyclic=loop == "wrap",
        mended=mended,
    )
    clip = assemble(raw, options)
    if uneven and options.fps is None:
        notes.append(
            f"Frame durations run from {times.min():.4g} to {times.max():.4g} s; the clip was resampled "
            f"at {1.0 / step:.4g} frames per second"
        )
        clip = _even(clip, times, path)
    source = clip.skeleton.source
    return clip.replaced(skeleton=clip.skeleton.with_source(notes=(*notes, *source.notes)))


def _table(frames: list[Any], path: Path) -> np.ndarray:
    """`(T, 44)` finite numbers; every refusal names the frame."""
    for i, row in enumerate(frames):
        count = len(row) if isinstance(row, list) else 0
        if count != COLUMNS:
            raise PoiseError(
                f"it has {count} numbers, not {COLUMNS}", f"{path}, frame {i}", code="row-width"
            )
        for k, value in enumerate(row):
            if type(value) not in (int, float) or not abs(value) <= MAX_VALUE:
                raise PoiseError(
                    f"column {k} holds {str(value)[:30]!r}, no usable number",
                    f"{path}, frame {i}",
                    code="number-unusable",
                )
    if not frames:
        raise PoiseError("the list 'Frames' is empty", path, code="no-frames")
    return np.array(frames, dtype=np.float64)


def _rotations(
    table: np.ndarray,
    joints: list[tuple[str, str | None, tuple[float, float, float], int]],
    path: Path,
    notes: list[str],
) -> tuple[np.ndarray, tuple[tuple[str, str, int, int, float], ...]]:
    """`(T, J, 4)` local rotations, and where their quaternions were off unit length by how much."""
    mended: list[tuple[str, str, int, int, float]] = []
    out = np.zeros((len(table), len(joints), 4))
    out[..., 0] = 1.0
    column, worst = 4, (0.0, "", 0)
    for j, (name, _, _, size) in enumerate(joints):
        if size == 4:
            quat = table[:, column : column + 4]
            norm = np.linalg.norm(quat, axis=-1)
            frame = int(np.abs(norm - 1).argmax())
            if abs(norm[frame] - 1) > _NORM_SLACK:
                raise PoiseError(
                    f"the quaternion of joint '{name}' has length {norm[frame]:.3g}, no rotation",
                    f"{path}, frame {frame}",
                    code="not-a-rotation",
                )
            worst = max(worst, (float(abs(norm[frame] - 1)), name, frame))
            off = np.flatnonzero(np.abs(norm - 1) > _NORM_NOTE)
            if len(off):
                span = (int(off[0]), int(off[-1]))
                mended.append(("quaternion length", name, *span, float(abs(norm[frame] - 1))))
            out[:, j] = quat / norm[:, None]
        elif size == 1:
            hint = "Convert the angles to radians"
            check_radians({name: table[:, column]}, "DeepMimic's files hold", path, hint)
            axis = np.array([0.0, 0.0, 1.0], dtype=float)
            out[:, j] = axis_angle_to_quat(axis, table[:, column])
        column += size
    if worst[0] > _NORM_NOTE:
        notes.append(
            f"Quaternions off unit length were normalised, at most by {worst[0]:.3f} (joint "
            f"'{worst[1]}' at frame {worst[2]})"
        )
    return out, tuple(mended)


def _times(durations: np.ndarray, path: Path) -> tuple[np.ndarray, bool]:
    """The durations that count, and whether they differ.

    The last frame's duration leads nowhere unless the clip wraps, and files often set it to 0.
    """
    times = durations[:-1] if len(durations) > 1 else durations
    bad = np.flatnonzero(~(times > 0))
    if len(bad):
        raise PoiseError(
            f"its duration is {times[bad[0]]:g} s, which must be above 0",
            f"{path}, frame {bad[0]}",
            code="out-of-range",
        )
    step = np.median(times)
    return times, bool(np.abs(times / step - 1).max() > _TIME_SLACK)


def _even(clip: Clip, times: np.ndarray, path: Path) -> Clip:
    """The clip, with frames that last `times (T - 1)` s, at even steps of their median."""
    at = np.concatenate(([0.0], np.cumsum(times)))
    count = max(2, int(np.floor(at[-1] * clip.fps + 1e-3)) + 1)
    if count > 100 * clip.frames:
        raise PoiseError(
            "its frame durations differ too much to be evened out", path, code="times-uneven"
        )
    wanted = np.minimum(np.arange(count) / clip.fps, at[-1])
    low = np.clip(np.searchsorted(at, wanted, side="right") - 1, 0, clip.frames - 2)
    t = np.clip((wanted - at[low]) / times[low], 0.0, 1.0)
    return blended(clip, low, t)
