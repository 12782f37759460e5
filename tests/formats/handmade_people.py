"""People made of points, that stand, lie, crawl and turn upside down; metres, Z up."""

from __future__ import annotations

import numpy as np

from poise.formats.raw import vectors_from_z_up

NAMES = (
    *("RHip", "LHip", "RKnee", "LKnee", "RAnkle", "LAnkle", "RBigToe", "LBigToe", "RShoulder"),
    *("LShoulder", "RElbow", "LElbow", "RWrist", "LWrist", "Neck", "Head", "Nose"),
)
_SIDE = np.array([-1.0, 1.0])


def _points(**rows: np.ndarray) -> np.ndarray:
    """`(T, K, 3)` in the order of `NAMES`; pairs `(T, 2, 3)` are right and left."""
    pairs = ("Hip", "Knee", "Ankle", "BigToe", "Shoulder", "Elbow", "Wrist")
    columns = [rows[p][:, k] for p in pairs for k in (0, 1)]
    return np.stack([*columns, rows["Neck"], rows["Head"], rows["Nose"]], 1)


def _by(x: float, y: float, z: float) -> np.ndarray:
    """A step, m."""
    return np.array([x, y, z])


def _pair(half: float, middle: np.ndarray) -> np.ndarray:
    """Two points beside a middle one `(T, 3)`, along X."""
    return middle[:, None] + _SIDE[:, None] * np.array([half, 0.0, 0.0])


def push_ups(frames: int = 90, fps: float = 30.0) -> np.ndarray:
    """Toes and hands stay on the floor, the straight body lies along Y and turns about the toes."""
    t = np.arange(frames) / fps
    tilt = np.radians(14.0 + 8.0 * np.cos(2 * np.pi * 0.5 * t))
    along = np.stack((0 * t, np.cos(tilt), np.sin(tilt)), -1)
    out = np.stack((0 * t, -np.sin(tilt), np.cos(tilt)), -1)
    toe = np.broadcast_to([0.0, 0.0, 0.02], (frames, 3))
    at = {
        n: toe + d * along for n, d in (("Ankle", 0.12), ("Knee", 0.5), ("Hip", 0.92), ("Shoulder", 1.4))
    }
    hand = np.broadcast_to([0.0, 1.36, 0.03], (frames, 3))
    middle = (at["Shoulder"] + hand) / 2
    return _points(
        Hip=_pair(0.1, at["Hip"]), Knee=_pair(0.1, at["Knee"]), Ankle=_pair(0.1, at["Ankle"]),
        BigToe=_pair(0.1, toe), Shoulder=_pair(0.18, at["Shoulder"]), Elbow=_pair(0.35, middle),
        Wrist=_pair(0.25, hand), Neck=toe + 1.45 * along, Head=toe + 1.65 * along,
        Nose=toe + 1.6 * along - 0.1 * out,
    )  # fmt: skip


def crawl(frames: int = 120, fps: float = 30.0) -> np.ndarray:
    """On hands and knees along Y: opposite hand and knee go ahead together, the others stay."""
    t = np.arange(frames) / fps
    step, length = 0.8, 0.3

    def feet(phase: float) -> np.ndarray:
        # One half of each period it stays, in the other it gets `length` ahead, lifted a little.
        cycle = t / step + phase
        part = np.clip(2 * (cycle % 1.0) - 1.0, 0.0, 1.0)
        return np.stack((0 * t, length * (np.floor(cycle) + part), 0.03 * np.sin(np.pi * part)), -1)

    body = np.stack((0 * t, length * t / step, 0 * t), -1)
    by = (feet(0.0), feet(0.5))
    hands = np.stack((by[1] + _by(-0.18, 0.55, 0.04), by[0] + _by(0.18, 0.55, 0.04)), 1)
    knees = np.stack((by[0] + _by(-0.1, 0.0, 0.05), by[1] + _by(0.1, 0.0, 0.05)), 1)
    ankles = knees + _by(0.0, -0.42, 0.03)
    shoulders = _pair(0.18, body + _by(0.0, 0.6, 0.6))
    return _points(
        Hip=_pair(0.1, body + _by(0.0, 0.1, 0.5)), Knee=knees, Ankle=ankles,
        BigToe=ankles + _by(0.0, -0.15, -0.05), Shoulder=shoulders, Elbow=(shoulders + hands) / 2,
        Wrist=hands, Neck=body + _by(0.0, 0.65, 0.62), Head=body + _by(0.0, 0.85, 0.68),
        Nose=body + _by(0.0, 0.9, 0.6),
    )  # fmt: skip


def walk(frames: int = 90, fps: float = 30.0) -> np.ndarray:
    """Upright along -Y, which the person faces, with feet that stand while they bear."""
    t = np.arange(frames) / fps
    step, length = 1.0, 1.2

    def foot(phase: float, side: float) -> np.ndarray:
        cycle = t / step + phase
        part = np.clip(2 * (cycle % 1.0) - 1.0, 0.0, 1.0)
        y = -length * (np.floor(cycle) + part)
        return np.stack((side + 0 * t, y, 0.1 + 0.1 * np.sin(np.pi * part)), -1)

    ankles = np.stack((foot(0.0, -0.1), foot(0.5, 0.1)), 1)
    body = np.stack((0 * t, ankles[..., 1].mean(1), 0 * t), -1)
    swing = 0.25 * np.sin(2 * np.pi * t / step)
    hips = _pair(0.1, body + _by(0.0, 0.0, 0.88))
    shoulders = _pair(0.18, body + _by(0.0, 0.0, 1.4))
    wrists = shoulders + _by(0.0, 0.0, -0.54)
    wrists[:, 0, 1] += swing
    wrists[:, 1, 1] -= swing
    return _points(
        Hip=hips, Knee=(hips + ankles) / 2 + _by(0.0, -0.05, 0.0), Ankle=ankles,
        BigToe=ankles + _by(0.0, -0.18, -0.08), Shoulder=shoulders,
        Elbow=(shoulders + wrists) / 2 + _by(0.0, 0.02, 0.0), Wrist=wrists,
        Neck=body + _by(0.0, 0.0, 1.45), Head=body + _by(0.0, 0.0, 1.68),
        Nose=body + _by(0.0, -0.1, 1.6),
    )  # fmt: skip


def handstand(frames: int = 60, fps: float = 30.0) -> np.ndarray:
    """On the hands, the legs swaying above."""
    t = np.arange(frames) / fps
    sway = 0.06 * np.sin(2 * np.pi * 0.7 * t)

    def at(height: float) -> np.ndarray:
        return np.stack((0 * t, sway * height / 2.0, height + 0 * t), -1)

    hands, shoulders = _pair(0.2, at(0.03) * [1.0, 0.0, 1.0]), _pair(0.18, at(0.55))
    return _points(
        Hip=_pair(0.1, at(1.05)), Knee=_pair(0.1, at(1.47)), Ankle=_pair(0.1, at(1.88)),
        BigToe=_pair(0.1, at(2.05)), Shoulder=shoulders, Elbow=(hands + shoulders) / 2, Wrist=hands,
        Neck=at(0.5), Head=at(0.3), Nose=at(0.33) + _by(0.0, -0.1, 0.0),
    )  # fmt: skip


def in_file(points: np.ndarray, up: str) -> np.ndarray:
    """The points in the axes of a file with the vertical `up`."""
    return vectors_from_z_up(points, up)


def trc(points: np.ndarray, names: tuple[str, ...] = NAMES, fps: float = 30.0, mark: str = "\t") -> str:
    """A TRC file in metres; NaN is a blank cell."""
    head = "DataRate CameraRate NumFrames NumMarkers Units OrigDataRate OrigDataStartFrame OrigNumFrames"
    lines = [
        mark.join(("PathFileType", "4", "(X/Y/Z)", "x.trc")),
        mark.join(head.split()),
        mark.join(map(str, (fps, fps, len(points), len(names), "m", fps, 1, len(points)))),
        mark.join(("Frame#", "Time")) + mark + (mark * 3 if mark == "\t" else mark).join(names),
        mark.join(f"{a}{k + 1}" for k in range(len(names)) for a in "XYZ"),
    ]
    for t, row in enumerate(points):
        cells = ["" if np.isnan(v) else f"{v:.6f}" for v in row.ravel()]
        lines.append(mark.join((str(t + 1), f"{t / fps:.5f}", *cells)))
    return "\n".join(lines) + "\n"


def csv(points: np.ndarray, names: tuple[str, ...] = NAMES, fps: float = 30.0) -> str:
    """A table with times."""
    lines = [",".join(["time", *(f"{n}_{a}" for n in names for a in "xyz")])]
    lines += [
        ",".join([f"{t / fps:.5f}", *(f"{v:.6f}" for v in row.ravel())]) for t, row in enumerate(points)
    ]
    return "\n".join(lines) + "\n"
