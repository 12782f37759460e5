"""A small human that walks in place, with feet that bear exactly: the truth of `kinematics.travel`."""

from __future__ import annotations

import numpy as np

from poise.kinematics.limbs import match_positions
from poise.motion import Clip
from poise.motion.rotations import euler_to_quat, forward_kinematics, quat_between, quat_mul
from toy_human import human

#: m: the pelvis, and the ankles of a foot that bears, whose toes are on the floor.
PELVIS_M, ANKLE_M = 0.76, 0.06


def foot_path(t: np.ndarray, period: float, duty: float, speed: float, turning: float, rise: float,
              side: float, lift: float) -> np.ndarray:  # fmt: skip
    """`(T, 3)` m of an ankle: while it bears exp(-xi s) of its place in the middle of its stance, and
    from its end to its begin on a smooth way through the air."""
    bears = duty * period

    def stance(s: np.ndarray) -> np.ndarray:
        # x_place = G(s)^-1 p, with G(s) a turn by w s and the arc v/w (sin w s, 1 - cos w s).
        angle = turning * s
        arc = speed * s * np.sinc(0.5 * angle / np.pi)
        x, y = -arc * np.cos(0.5 * angle), side - arc * np.sin(0.5 * angle)
        c, n = np.cos(angle), np.sin(angle)
        return np.stack((c * x + n * y, c * y - n * x, ANKLE_M - rise * s), -1)

    tau = np.mod(t, period)
    out = stance(np.clip(tau, 0, bears) - 0.5 * bears)
    air = tau > bears
    share = np.clip((tau - bears) / (period - bears), 0, 1)[:, None]
    ends = stance(np.array([0.5 * bears, -0.5 * bears]))
    ease = share**2 * (3 - 2 * share)
    swing = ends[0] * (1 - ease) + ends[1] * ease
    swing[:, 2] += lift * np.sin(np.pi * share[:, 0]) ** 2
    out[air] = swing[air]
    return out


def walker(
    speed: float = 1.0,
    turning: float = 0.0,
    rise: float = 0.0,
    period: float = 1.0,
    periods: int = 1,
    fps: float = 30.0,
    duty: float = 0.6,
    lift: float = 0.08,
    name: str = "walker",
) -> Clip:
    """A loop that walks in place along x; its last frame is its first again.

    The feet go at `speed` m/s backwards, about the root at `turning` rad/s, and sink at `rise` m/s.
    """
    skeleton, frames = human(), round(period * periods * fps) + 1
    t = np.arange(frames) / fps
    rot = np.zeros((frames, len(skeleton), 4))
    rot[..., 0] = 1.0
    # Bent knees, which tell the leg's plane.
    for side in ("Left", "Right"):
        bend = 0.35
        for joint, angle in (("UpLeg", -bend), ("Leg", 2 * bend), ("Foot", -bend)):
            j = skeleton.index(side + joint)
            rot[:, j, 0], rot[:, j, 2] = np.cos(angle / 2), np.sin(angle / 2)
    root = np.zeros((frames, 3))
    root[:, 2] = PELVIS_M
    goals: dict[int | str, np.ndarray] = {}
    for side, sign, phase in (("Left", 1.0, 0.0), ("Right", -1.0, 0.5)):
        path = foot_path(t + phase * period, period, duty, speed, turning, rise, 0.1 * sign, lift)
        goals[skeleton.index(f"{side}Foot")] = path
    out = match_positions(skeleton, rot, root, goals)
    offsets = skeleton.offsets
    quat = forward_kinematics(skeleton.parents, offsets, root, out)[1]
    for joint in goals:
        assert isinstance(joint, int)
        # The foot turns with the floor, and back in the air.
        tau = np.mod(t + (0.0 if "Left" in skeleton.names[joint] else 0.5) * period, period)
        bears = duty * period
        share = np.clip((tau - bears) / (period - bears), 0, 1)
        yaw = -turning * (np.clip(tau, 0, bears) - 0.5 * bears - bears * share**2 * (3 - 2 * share))
        flat = euler_to_quat(yaw[:, None], "Z")
        out[:, joint] = quat_mul(out[:, joint], quat_between(quat[:, joint], flat))
    return Clip(skeleton, root, out, fps, name)
