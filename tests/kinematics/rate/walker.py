"""Motions of the toy human whose physics is known: a walk over an inverted pendulum, hops, a leap."""

from __future__ import annotations

import math

import numpy as np

from poise.motion import Clip
from poise.motion.rotations import euler_to_quat, quat_conj, quat_mul
from toy_human import human, swing

G, THIGH, SHIN, ANKLE, HIP = 9.81, 0.42, 0.40, 0.05, 0.1


def walk(fps: float = 120.0, step: float = 0.66, seconds: float = 0.5, steps: int = 9) -> Clip:
    """A walk of `steps` steps of `step` m and `seconds` s over the linear inverted pendulum.

    Above the standing foot the hips go with x'' = g (x - p) / h, so that the floor's force acts in it,
    forwards and aside; they rise on an arc over the foot, as over a stiff leg.
    """
    t = np.arange(round(steps * seconds * fps)) / fps
    k = np.minimum((t / seconds).astype(int), steps - 1)
    u = t - (k + 0.5) * seconds
    side = np.where(k % 2 == 0, 1.0, -1.0)
    w = math.sqrt(G / 1.0)
    over = step / 2 * np.sinh(w * u) / math.sinh(w * seconds / 2)
    root = np.stack(
        (
            k * step + over,
            side * HIP * (1 - np.cosh(w * u) / math.cosh(w * seconds / 2)),
            ANKLE + np.sqrt(0.8**2 - over**2),
        ),
        -1,
    )
    share = np.clip(u / seconds + 0.5, 0.0, 1.0)
    ease = share**3 * (10 - 15 * share + 6 * share**2)
    swinging = (k - 1) * step + 2 * step * ease
    skeleton = human()
    rot = np.zeros((len(t), len(skeleton), 4))
    rot[..., 0] = 1.0
    for name, sign in (("Left", 1.0), ("Right", -1.0)):
        stands = side == sign
        lift = np.where(stands, 0.0, 0.06 * np.sin(math.pi * share) ** 2)
        foot = np.stack(
            (np.where(stands, k * step, swinging), np.full(len(t), sign * HIP), ANKLE + lift), -1
        )
        _bend(rot, skeleton.names, name, foot - (root + np.array([0.0, sign * HIP, 0.0])))
    return Clip(skeleton, root, rot, fps, "walk")


def _bend(rot: np.ndarray, names: tuple[str, ...], side: str, way: np.ndarray) -> None:
    """Turns a leg so that its ankle lies `way (T, 3)` m from its hip, the foot level."""
    far = np.minimum(np.linalg.norm(way, axis=-1), THIGH + SHIN - 1e-6)
    hip = np.arccos((THIGH**2 + far**2 - SHIN**2) / (2 * THIGH * far))
    knee = np.pi - np.arccos((THIGH**2 + SHIN**2 - far**2) / (2 * THIGH * SHIN))
    # About x first (aside), then about y: minus y swings the leg forwards.
    aside = np.arctan2(way[:, 1], -way[:, 2])
    ahead = np.arctan2(way[:, 0], np.hypot(way[:, 1], way[:, 2]))
    thigh = quat_mul(_turn("X", aside), _turn("Y", -ahead - hip))
    shin = _turn("Y", knee)
    for part, turn in (("UpLeg", thigh), ("Leg", shin), ("Foot", quat_conj(quat_mul(thigh, shin)))):
        rot[:, names.index(side + part)] = turn


def _turn(axis: str, angle: np.ndarray) -> np.ndarray:
    return euler_to_quat(angle[:, None], axis)


def in_place(clip: Clip) -> Clip:
    """The clip without its mean travel."""
    path = np.array(clip.root_pos)
    path[:, :2] -= np.linspace(0, 1, clip.frames)[:, None] * (path[-1, :2] - path[0, :2])
    return clip.replaced(root_pos=path)


def hops(fps: float = 120.0, air: float = 0.14, ground: float = 0.22, count: int = 8) -> Clip:
    """A stiff runner: hops that are too low to be flights (2.4 cm), each landing as a spring does."""
    period = air + ground
    t = np.arange(round(count * period * fps)) / fps
    u, w = t % period, math.pi / ground
    high = np.where(
        u < air, G * u * (air - u) / 2, -G * air / 2 / w * np.sin(w * np.clip(u - air, 0, ground))
    )
    return _raised(fps, high, 3.0 * t)


def leap(fps: float = 120.0, seconds: float = 0.5) -> Clip:
    """A run-up of a second at 3 m/s, a leap of `seconds` s, and a second after it."""
    t = np.arange(round((2 + seconds) * fps)) / fps
    u = t - 1.0
    return _raised(fps, np.where((u > 0) & (u < seconds), G * u * (seconds - u) / 2, 0.0), 3.0 * t)


def _raised(fps: float, high: np.ndarray, ahead: np.ndarray) -> Clip:
    still = swing(len(high) / fps, fps)
    pose = np.repeat(still.rot[:1], len(high), 0)
    path = np.stack((ahead, 0 * high, 0.9 + high), -1)
    return still.replaced(root_pos=path, rot=pose)


def played(clip: Clip, times: float) -> Clip:
    """The same frames, `times` as fast."""
    return clip.replaced(fps=clip.fps * times)
