"""The data of a report, and its compact, NaN-safe encoding for the page.

Positions travel as float32 roots plus int16 offsets from the root (a tenth of a millimetre per
step for a character within three metres of its root), quaternions as int16, both in base64.
"""

from __future__ import annotations

import base64
import json
import math
import re
from dataclasses import dataclass
from typing import Any

import numpy as np

from poise.errors import PoiseError
from poise.motion.rotations import GRAVITY

_KINDS = ("capsule", "box", "sphere")
_INT16 = 32767


@dataclass(frozen=True)
class Shape:
    """One rigid geom of a body, in MuJoCo's conventions.

    Attributes:
        body: index into `Report.bodies`.
        kind: "capsule", "box" or "sphere".
        size: m; capsule (radius, half length, 0) along local z, box half sizes, sphere (radius, 0, 0).
        pos: m, the geom's place in the body's frame.
        quat: wxyz, its rotation there.
    """

    body: int
    kind: str
    size: tuple[float, float, float]
    pos: tuple[float, float, float] = (0.0, 0.0, 0.0)
    quat: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True, eq=False)
class Track:
    """One character's motion.

    Attributes:
        name: shown in the legend.
        pos: `(T, B, 3)` m, world positions of the bodies.
        quat: `(T, B, 4)` wxyz, their rotations.
    """

    name: str
    pos: np.ndarray
    quat: np.ndarray


@dataclass(frozen=True, eq=False)
class Mover:
    """A thing that moves, such as a ball that is thrown.

    Attributes:
        shape: its form in the thing's own frame; its `body` counts for nothing.
        pos: `(T, 3)` m, world.
        quat: `(T, 4)` wxyz.
    """

    shape: Shape
    pos: np.ndarray
    quat: np.ndarray


@dataclass(frozen=True, eq=False)
class Report:
    """Everything one report page shows; optional parts may be None or empty.

    Attributes:
        title: heading of the page.
        subtitle: line below it.
        shapes: geoms of the bodies.
        bodies: B names, the root first.
        reference: the clip on the body.
        simulated: the simulation.
        fps: frames per second of every per-frame array.
        force: `(T, 3)` N, residual force on the root in the world's axes.
        torque: `(T, 3)` N m, residual torque on the root in the world's axes.
        error_mm: `(T,)` mm, mean joint error relative to the root.
        error_global_mm: `(T,)` mm, mean joint error in the world.
        contacts: `(T, 2)` bool, left and right foot on the ground.
        score: the content of score.json.
        curve: columns of the learning curve, e.g. samples, seconds, reward.
        notes: sentences on what was guessed, repaired or limited.
        facts: name to text.
        things: what stands in the world, such as a chair; their `body` counts for nothing.
        movers: what moves in the simulation's world beside the character.
        pushes: of each frame `(K, 6)`, points in the world, m, and the forces that touch the character
            there, N; () where none were recorded.
        pushed: whether `pushes` are a push that is the point of the page, which then opens with them,
            overlaid on the goal that gives way; else contacts, shown on demand.
        helps: of each frame `(K, 6)`, points and residual forces of several bodies in the same way; they
            are drawn in place of `force`, which is their sum. () where the root alone is helped.
        others: other characters of the same body in the simulation's world.
        keys: frames of the reference that stay visible, such as keyframes.
        lost: s, when the motion was lost; the replay marks it and leads there.
    """

    title: str
    subtitle: str
    shapes: tuple[Shape, ...]
    bodies: tuple[str, ...]
    reference: Track
    simulated: Track
    fps: float
    force: np.ndarray | None
    torque: np.ndarray | None
    error_mm: np.ndarray
    error_global_mm: np.ndarray
    contacts: np.ndarray | None
    score: dict[str, Any]
    curve: dict[str, np.ndarray]
    notes: tuple[str, ...]
    facts: dict[str, str]
    things: tuple[Shape, ...] = ()
    movers: tuple[Mover, ...] = ()
    pushes: tuple[np.ndarray, ...] = ()
    pushed: bool = False
    helps: tuple[np.ndarray, ...] = ()
    others: tuple[Track, ...] = ()
    keys: tuple[int, ...] = ()
    lost: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if not (math.isfinite(self.fps) and self.fps > 0):
            raise PoiseError(
                f"the frame rate must be above 0, got {self.fps}", self.title, code="rate-out-of-range"
            )
        frames, bodies = len(self.reference.pos), len(self.bodies)
        if frames == 0 or bodies == 0:
            raise PoiseError(
                f"a report needs frames and bodies, got {frames} and {bodies}",
                self.title,
                code="no-frames",
            )
        wanted: list[tuple[str, np.ndarray | None, tuple[int, ...]]] = [
            ("force", self.force, (frames, 3)),
            ("torque", self.torque, (frames, 3)),
            ("error_mm", self.error_mm, (frames,)),
            ("error_global_mm", self.error_global_mm, (frames,)),
            ("contacts", self.contacts, (frames, 2)),
        ]
        for track in (self.reference, self.simulated, *self.others):
            wanted.append((f"track '{track.name}' pos", track.pos, (frames, bodies, 3)))
            wanted.append((f"track '{track.name}' quat", track.quat, (frames, bodies, 4)))
        for mover in self.movers:
            wanted += [("a mover's pos", mover.pos, (frames, 3)), ("its quat", mover.quat, (frames, 4))]
        for name, array, shape in wanted:
            if array is not None and np.shape(array) != shape:
                raise PoiseError(
                    f"{name} must have shape {shape}, got {np.shape(array)}",
                    self.title,
                    code="wrong-shape",
                )
        where = self.title
        for k, shape in enumerate((*self.shapes, *(m.shape for m in self.movers))):
            if shape.kind not in _KINDS:
                raise PoiseError(
                    f"shape {k} is a '{shape.kind}'; known: {', '.join(_KINDS)}",
                    where,
                    code="unknown-shape",
                )
            if not 0 <= shape.body < bodies:
                raise PoiseError(
                    f"shape {k} belongs to body {shape.body} of {bodies}", where, code="index-outside"
                )


def safe_json(value: object) -> str:
    """JSON that may stand inside a script element: NaN and infinity become null, `<` is escaped."""
    text = json.dumps(_plain(value), ensure_ascii=True, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if value is None or isinstance(value, bool | int | str) else str(value)


def number(value: Any) -> float | None:
    """`value` as a finite float, or None for anything else (missing, NaN, text)."""
    if value is None or isinstance(value, str | dict | list | tuple):
        return None
    try:
        out = float(value)
    except (TypeError, ValueError):
        return None
    return out if math.isfinite(out) else None


def body_weight(report: Report) -> float | None:
    """The character's weight in N, from `facts["mass"]` or from the score's own share of it."""
    mass = re.match(r"\s*(\d+(?:\.\d+)?)", str(report.facts.get("mass", "")))
    if mass and float(mass[1]) > 0:
        return float(mass[1]) * GRAVITY
    table = report.score.get("help")
    table = table if isinstance(table, dict) else {}
    mean, share = number(table.get("force_mean_n")), number(table.get("share_of_body_weight"))
    return mean / share if mean and share and mean > 0 and share > 0 else None


def foot_bodies(names: tuple[str, ...]) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Indices of the left and the right foot's bodies (foot, ankle, toe), judged by their names."""
    found: tuple[list[int], list[int]] = ([], [])
    for k, name in enumerate(names):
        low = name.lower()
        if not re.search(r"foot|ankle|toe", low):
            continue
        if "left" in low or re.match(r"l(?!o)|.*[_. ]l$", low):
            found[0].append(k)
        elif "right" in low or re.match(r"r|.*[_. ]r$", low):
            found[1].append(k)
    return tuple(found[0]), tuple(found[1])


def hold_finite(array: np.ndarray) -> tuple[np.ndarray, int]:
    """The array with frames that are not finite replaced by the last finite one, and their count."""
    array = np.asarray(array, dtype=np.float64)
    good = np.isfinite(array).reshape(len(array), -1).all(axis=1)
    if good.all():
        return array, 0
    if not good.any():
        return np.zeros_like(array), len(array)
    last = np.maximum.accumulate(np.where(good, np.arange(len(array)), -1))
    return array[np.where(last >= 0, last, np.argmax(good))], int((~good).sum())


def _b64(array: np.ndarray, kind: str) -> str:
    return base64.b64encode(np.ascontiguousarray(array, dtype=kind).tobytes()).decode("ascii")


def encode_track(track: Track) -> dict[str, Any]:
    """One track as base64 text, within 0.1 mm for one character; the page's script decodes it."""
    pos, bad = hold_finite(track.pos)
    quat, worse = hold_finite(track.quat)
    norm = np.linalg.norm(quat, axis=-1, keepdims=True)
    quat = np.where(norm > 1e-9, quat / np.maximum(norm, 1e-9), np.array([1.0, 0.0, 0.0, 0.0]))
    offset = pos - pos[:, :1]
    step = max(1e-4, float(np.abs(offset).max()) / _INT16)
    return {
        "name": track.name,
        "step": step,
        "held": max(bad, worse),
        "root": _b64(pos[:, 0], "<f4"),
        "offset": _b64(np.rint(offset / step), "<i2"),
        "quat": _b64(np.rint(quat * _INT16), "<i2"),
    }


def _pushes(frames: tuple[np.ndarray, ...]) -> dict[str, str] | None:
    """All rows of all frames, and before which row each frame begins; None without any."""
    rows = np.concatenate(frames) if frames else np.zeros((0, 6))
    if not len(rows):
        return None
    first = np.cumsum([0, *(len(f) for f in frames)])
    rows = np.nan_to_num(rows.astype(np.float64))
    return {"rows": _b64(rows, "<f4"), "first": _b64(first.astype(np.float64), "<f4")}


def payload(report: Report) -> dict[str, Any]:
    """The replay's data: shapes, both tracks and the per-frame arrays, ready for `safe_json`."""

    def floats(array: np.ndarray | None) -> str | None:
        return None if array is None else _b64(np.asarray(array, dtype=np.float64), "<f4")

    contacts = None
    if report.contacts is not None:
        contacts = _b64(np.nan_to_num(np.asarray(report.contacts, dtype=np.float64)) > 0.5, "u1")
    return {
        "fps": float(report.fps),
        "frames": len(report.reference.pos),
        "bodies": list(report.bodies),
        "shapes": [
            {"body": s.body, "kind": s.kind, "size": s.size, "pos": s.pos, "quat": s.quat}
            for s in report.shapes
        ],
        "things": [
            {"kind": s.kind, "size": s.size, "pos": s.pos, "quat": s.quat} for s in report.things
        ],
        "movers": [
            {
                **{k: getattr(m.shape, k) for k in ("kind", "size", "pos", "quat")},
                "way": floats(np.concatenate((m.pos, m.quat), 1)),
            }
            for m in report.movers
        ],
        "pushes": _pushes(report.pushes),
        "pushed": report.pushed,
        "helps": _pushes(report.helps),
        "lost": [t for t in report.lost if 0 <= t * report.fps < len(report.reference.pos)],
        "keys": [k for k in report.keys if 0 <= k < len(report.reference.pos)],
        "others": [encode_track(track) for track in report.others],
        "feet": foot_bodies(report.bodies),
        "weight": body_weight(report),
        "reference": encode_track(report.reference),
        "simulated": encode_track(report.simulated),
        "force": floats(report.force),
        "torque": floats(report.torque),
        "error": floats(report.error_mm),
        "errorGlobal": floats(report.error_global_mm),
        "contacts": contacts,
    }
