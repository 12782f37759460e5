"""A made-up walk of a capsule character, so that the page can be tested without any clip."""

from __future__ import annotations

import numpy as np

from poise.score.report.data import Report, Shape, Track

BODIES = (
    "pelvis",
    "chest",
    "head",
    "left_hip",
    "left_knee",
    "left_foot",
    "right_hip",
    "right_knee",
    "right_foot",
    "left_shoulder",
    "left_elbow",
    "right_shoulder",
    "right_elbow",
)
_PARENTS = (-1, 0, 1, 0, 3, 4, 0, 6, 7, 1, 9, 1, 11)
_OFFSETS = np.array(
    [
        [0, 0, 0],
        [0, 0, 0.2],
        [0, 0, 0.38],
        [0, 0.09, -0.04],
        [0, 0, -0.42],
        [0, 0, -0.41],
        [0, -0.09, -0.04],
        [0, 0, -0.42],
        [0, 0, -0.41],
        [0, 0.19, 0.26],
        [0, 0, -0.28],
        [0, -0.19, 0.26],
        [0, 0, -0.28],
    ]
)


def _turn(angle: np.ndarray) -> np.ndarray:
    """Quaternions wxyz about y."""
    zero = np.zeros_like(angle)
    return np.stack([np.cos(angle / 2), zero, np.sin(angle / 2), zero], -1)


def _rotate(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    u, w = q[..., 1:], q[..., :1]
    t = 2 * np.cross(u, v)
    return v + w * t + np.cross(u, t)


def walk(frames: int, fps: float, name: str, shake: float = 0.0, seed: int = 0) -> Track:
    """A walk along x at 1.2 m/s; every joint turns about y only, so world angles add up."""
    t = np.arange(frames) / max(fps, 1.0)
    phase = 2 * np.pi * 0.9 * t
    rng = np.random.default_rng(seed)
    noise = np.cumsum(rng.normal(size=(frames, len(BODIES))), axis=0) * 0.1
    noise = shake * (np.sin(noise) + 0.5 * np.sin(3 * noise))
    local = np.zeros((frames, len(BODIES)))
    for side, lead in ((3, 0.0), (6, np.pi)):
        swing = np.sin(phase + lead)
        local[:, side] = -0.48 * swing
        local[:, side + 1] = 0.12 + 0.75 * np.clip(np.cos(phase + lead), 0, None)
        local[:, side + 2] = -local[:, side] - local[:, side + 1] + 0.25 * np.clip(-swing, 0, None)
    for side, lead in ((9, np.pi), (11, 0.0)):
        local[:, side] = -0.45 * np.sin(phase + lead)
        local[:, side + 1] = -0.45 - 0.2 * np.sin(phase + lead)
    local += noise
    world = np.zeros_like(local)
    pos = np.zeros((frames, len(BODIES), 3))
    pos[:, 0, 0] = 1.2 * t
    for b, parent in enumerate(_PARENTS):
        world[:, b] = local[:, b] + (world[:, parent] if parent >= 0 else 0)
        if parent >= 0:
            pos[:, b] = pos[:, parent] + _rotate(
                _turn(world[:, parent]), np.broadcast_to(_OFFSETS[b], (frames, 3))
            )
    pos[..., 2] -= pos[:, (5, 8), 2].min(axis=1, keepdims=True) - 0.075
    return Track(name, pos, _turn(world))


def shapes() -> tuple[Shape, ...]:
    side = (0.7071067811865476, 0.7071067811865476, 0.0, 0.0)
    out = [
        Shape(0, "capsule", (0.1, 0.07, 0), (0, 0, 0), side),
        Shape(1, "capsule", (0.11, 0.1, 0), (0, 0, 0.14)),
        Shape(2, "sphere", (0.105, 0, 0), (0, 0, 0.11)),
    ]
    for hip, knee, foot in ((3, 4, 5), (6, 7, 8)):
        out.append(Shape(hip, "capsule", (0.065, 0.16, 0), (0, 0, -0.21)))
        out.append(Shape(knee, "capsule", (0.052, 0.16, 0), (0, 0, -0.2)))
        out.append(Shape(foot, "box", (0.115, 0.045, 0.03), (0.055, 0, -0.045)))
    for shoulder, elbow in ((9, 10), (11, 12)):
        out.append(Shape(shoulder, "capsule", (0.045, 0.1, 0), (0, 0, -0.14)))
        out.append(Shape(elbow, "capsule", (0.038, 0.09, 0), (0, 0, -0.13)))
    return tuple(out)


def score() -> dict:
    return {
        "succ": 1.0,
        "succ_rule": "mean joint distance below 0.5 m to the end, 32 starts",
        "mpjpe_mm": 32.4,
        "mpjpe_global_mm": 48.1,
        "vel_mm_per_frame": 4.9,
        "acc_mm_per_frame2": 3.3,
        "foot_slide_mm_per_s": 14.2,
        "penetration_mm": 1.1,
        "float_mm": 0.8,
        "jerk": 212.0,
        "reward": {
            "total": 0.842,
            "pose": 0.81,
            "velocity": 0.74,
            "end effectors": 0.86,
            "root": 0.9,
            "residual force": 0.95,
        },
        "help": {
            "limit_n": 100,
            "limit_nm": 50,
            "force_mean_n": 11.0,
            "force_p95_n": 24.0,
            "torque_mean_nm": 3.1,
            "torque_p95_nm": 9.0,
            "work_j_per_s": 6.0,
            "share_of_body_weight": 0.0187,
        },
        "seconds": 361.0,
        "samples": 1_500_000,
        "seed": 0,
        "reference": {
            "foot_slide_mm_per_s": 41.0,
            "penetration_mm": 9.3,
            "float_mm": 4.0,
            "jerk": 455.0,
        },
    }


def make_report(frames: int = 300, fps: float = 30.0, **changes: object) -> Report:
    """A complete report; `changes` replaces fields."""
    a, b = walk(frames, fps, "Reference"), walk(frames, fps, "Simulation", 0.05, 1)
    rng = np.random.default_rng(2)
    slow = np.sin(np.arange(frames) / 9.0)
    force = np.stack([16 * slow, 6 * np.cos(np.arange(frames) / 5), 5 + 3 * slow], -1)
    error = 1000 * np.linalg.norm((a.pos - a.pos[:, :1]) - (b.pos - b.pos[:, :1]), axis=-1).mean(1)
    samples = np.linspace(0, 1.5e6, 120)
    fields: dict = {
        "title": "humanoid3d_walk",
        "subtitle": "Residual force control on a generated humanoid, 60 N help budget",
        "shapes": shapes(),
        "bodies": BODIES,
        "reference": a,
        "simulated": b,
        "fps": fps,
        "force": force,
        "torque": rng.normal(size=(frames, 3)) + 2 * slow[:, None],
        "error_mm": error,
        "error_global_mm": error + 12 + 5 * slow,
        "contacts": np.stack([a.pos[:, 5, 2] < 0.085, a.pos[:, 8, 2] < 0.085], -1),
        "score": score(),
        "curve": {
            "samples": samples,
            "seconds": samples / 4150,
            "reward": 0.87 * (1 - np.exp(-samples / 3e5)) + 0.02 * rng.normal(size=120),
        },
        "notes": (
            "The ground was moved by 12 mm so that the lowest foot touches it.",
            "The mass (60 kg) was guessed from the height.",
            "The clip has no fingers; the hands are rigid.",
        ),
        "facts": {
            "clip": "humanoid3d_walk.txt",
            "frames": str(frames),
            "fps": f"{fps:g}",
            "height": "1.68 m",
            "mass": "60.0 kg",
            "method": "residual force",
            "seed": "0",
            "version": "0.1.0",
        },
    }
    return Report(**{**fields, **changes})
