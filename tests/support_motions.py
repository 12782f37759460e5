"""Twelve motions that sit, lean, kneel and step up, made from key poses of a body at ease.

A key pose is a time with places of pelvis, feet and hands and two angles; between two of them everything
goes with least jerk, feet in an arc. Legs and arms follow by two-bone inverse kinematics. x is forward.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

from poise.jobs.tracker import Tracker
from poise.kinematics import lowest_height, match_positions, qpos_to_clip
from poise.motion import Clip
from poise.motion.rotations import (
    axis_angle_to_quat,
    forward_kinematics,
    quat_conj,
    quat_mul,
    quat_rotate,
)

FPS = 30.0
Place = tuple[float, float, float]


@dataclass(frozen=True)
class Key:
    """A pose at `t` s, relative to standing at ease at the origin; m and degrees.

    pelvis: how far it is moved. pitch, bend: how far pelvis and spine lean forward. left, right: how far
    the feet are moved. toes: how far the feet point down. hands: (left, right) in the world, None where
    they hang.
    """

    t: float
    pelvis: Place = (0.0, 0.0, 0.0)
    pitch: float = 0.0
    bend: float = 0.0
    left: Place = (0.0, 0.0, 0.0)
    right: Place = (0.0, 0.0, 0.0)
    toes: tuple[float, float] = (0.0, 0.0)
    hands: tuple[Place | None, Place | None] = (None, None)


STAND = Key(0.0)


def sit(low: float, back: float, bend: float = 0.0, seconds: float = 2.5) -> list[Key]:
    """Sits down with the pelvis `low` m lower and `back` m behind, and gets up again."""
    seated = Key(2.2, (-back, 0.0, -low), -8.0, 5.0 + bend)
    lean = Key(1.4, (-0.8 * back, 0.0, -0.72 * low), 32.0, 28.0)
    there = 2.2 + seconds
    return [
        STAND, replace(STAND, t=0.6), lean, seated, replace(seated, t=there),
        replace(lean, t=there + 0.8, pitch=36.0, bend=32.0), replace(STAND, t=there + 1.8),
        replace(STAND, t=there + 2.3),
    ]  # fmt: skip


def step_up(high: float, deep: float = 0.50, stairs: int = 1) -> list[Key]:
    """Steps onto one or more steps, one foot after the other, and stands there."""
    keys, t = [STAND, replace(STAND, t=0.5)], 0.5
    for k in range(stairs):
        x, z = k * deep, k * high
        lean = Key(t + 0.4, (x - 0.02, -0.08, z), 4.0, 4.0, (x, 0.0, z), (x, 0.0, z))
        up = replace(lean, t=t + 1.0, pelvis=(x + 0.02, -0.08, z), left=(x + deep, 0.0, z + high))
        over = replace(
            up, t=t + 1.6, pelvis=(x + deep - 0.03, 0.07, z + 0.12 * high), pitch=14.0, bend=14.0
        )
        push = replace(over, t=t + 2.2, pelvis=(x + deep, 0.08, z + high - 0.02), pitch=5.0, bend=5.0)
        push = replace(push, toes=(0.0, 20.0), right=(x - 0.04, 0.0, z + high + 0.06))
        top = Key(
            t + 2.8, (x + deep, 0.0, z + high), 0.0, 0.0, (x + deep, 0.0, z + high),
            (x + deep, 0.0, z + high),
        )  # fmt: skip
        keys += [lean, up, over, push, top]
        t += 2.8
    return [*keys, replace(keys[-1], t=t + 1.2)]


def lean_on_wall(side: bool, far: float) -> list[Key]:
    """Leans against a wall with both hands, or with the back."""
    if side:
        at = Key(1.8, (-far, 0.0, -0.10), -12.0, 0.0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    else:
        reach = 0.62 + far
        at = Key(1.8, (far, 0.0, -0.12), 14.0, 0.0, hands=((reach, 0.22, 1.25), (reach, -0.22, 1.25)))
    return [
        STAND, replace(STAND, t=0.5), at, replace(at, t=4.3), replace(STAND, t=5.8),
        replace(STAND, t=6.3),
    ]  # fmt: skip


def on_table(far: float) -> list[Key]:
    """Leans on a table with both hands."""
    reach = 0.52 + far
    hands = ((reach, 0.25, 0.80), (reach, -0.25, 0.80))
    at = Key(1.8, (far, 0.0, -0.10), 28.0, 22.0, hands=hands)
    return [
        STAND, replace(STAND, t=0.5), at, replace(at, t=4.3), replace(STAND, t=5.8),
        replace(STAND, t=6.3),
    ]  # fmt: skip


#: The motions by name, and what a person would put there.
MOTIONS: dict[str, tuple[str, list[Key]]] = {
    "sit_chair": ("seat", sit(0.42, 0.42)),
    "sit_low": ("seat", sit(0.52, 0.44)),
    "sit_stool": ("seat", sit(0.30, 0.46)),
    "sit_bent": ("seat", sit(0.42, 0.48, 8.0)),
    "sit_long": ("seat", sit(0.42, 0.46, seconds=6.0)),
    "step_15": ("step", step_up(0.15)),
    "step_25": ("step", step_up(0.25)),
    "step_35": ("step", step_up(0.35)),
    "stairs": ("step", step_up(0.17, 0.40, 3)),
    "wall_hands": ("wall", lean_on_wall(False, 0.42)),
    "wall_back": ("wall", lean_on_wall(True, 0.38)),
    "table": ("table", on_table(0.36)),
}


def motion(name: str, tracker: Tracker) -> Clip:
    """One of `MOTIONS` on the skeleton of a policy's body."""
    keys, skeleton = MOTIONS[name][1], tracker.humanoid.skeleton
    base = _at_ease(tracker)
    times = np.arange(round(keys[-1].t * FPS) + 1) / FPS
    joints = {(k, s): _joint(tracker, k, s) for k in ("foot", "hand") for s in ("left", "right")}
    rot = torch.tensor(base.rot[:1]).expand(len(times), -1, -1).clone()
    root = torch.tensor(base.root_pos[:1]) + torch.tensor(_path(keys, times, lambda k: k.pelvis))
    offsets = torch.tensor(skeleton.offsets)
    pos, quat = forward_kinematics(skeleton.parents, offsets, torch.tensor(base.root_pos[:1]), rot[:1])
    pitch = torch.tensor(_path(keys, times, lambda k: (k.pitch,)))[:, 0].deg2rad()
    bend = torch.tensor(_path(keys, times, lambda k: (k.bend,)))[:, 0].deg2rad()
    rot[:, 0] = quat_mul(_about_y(pitch), rot[:, 0])
    spine = [r.joint for r in tracker.humanoid.table.rows if r.kind == "spine"]
    for j in spine:
        _turn_in_world(skeleton.parents, offsets, rot, root, j, _about_y(bend / len(spine)))
    up, low = torch.tensor([0.0, 0.0, 1.0], dtype=torch.double), _soles(tracker, pos, quat)
    targets: dict[int | str, torch.Tensor] = {}
    feet: dict[int, torch.Tensor] = {}
    for side, sign in (("left", 0), ("right", 1)):
        foot = joints["foot", side]
        move = _path(keys, times, lambda k, side=side: getattr(k, side), arc=0.06)
        targets[foot] = pos[:, foot] + torch.tensor(move) - up * low[foot]
        toes = torch.tensor(_path(keys, times, lambda k, sign=sign: (k.toes[sign],)))[:, 0].deg2rad()
        feet[foot] = quat_mul(_about_y(toes), quat[:, foot].expand(len(times), -1))
    now, _ = forward_kinematics(skeleton.parents, offsets, root, rot)
    for sign, side in enumerate(("left", "right")):
        hand = joints["hand", side]
        share = torch.tensor(_path(keys, times, lambda k, s=sign: (float(k.hands[s] is not None),)))
        held = next((k.hands[sign] for k in keys if k.hands[sign] is not None), None)
        if held is not None:
            targets[hand] = now[:, hand] + share * (torch.tensor(held) - now[:, hand])
    goals = {j: goal.numpy() for j, goal in targets.items()}
    rot = torch.from_numpy(match_positions(skeleton, rot.numpy(), root.numpy(), goals))
    for foot, wanted in feet.items():
        _, world = forward_kinematics(skeleton.parents, offsets, root, rot)
        above = world[:, skeleton.parents[foot]]
        rot[:, foot] = quat_mul(quat_conj(above), wanted)
    return Clip(skeleton, root.numpy(), rot.numpy(), FPS, name)


def _at_ease(tracker: Tracker) -> Clip:
    clips = tracker.recovery_clips
    assert clips is not None
    qpos = clips.ease.double().numpy().copy()
    qpos[:2] = 0.0
    forward = quat_rotate(torch.tensor(qpos[3:7]), _front(tracker, qpos))
    yaw = torch.atan2(forward[1], forward[0])
    qpos[3:7] = quat_mul(
        axis_angle_to_quat(torch.tensor([0.0, 0.0, 1.0], dtype=torch.double), -yaw),
        torch.tensor(qpos[3:7]),
    ).numpy()
    table = tracker.humanoid.table
    return qpos_to_clip(np.tile(qpos, (2, 1)), table, tracker.humanoid.skeleton, FPS, None, "ease")


def _front(tracker: Tracker, qpos: np.ndarray) -> torch.Tensor:
    """Forward in the pelvis's frame: across the hips, turned about the vertical."""
    table = tracker.humanoid.table
    left, right = (
        next(r for r in table.rows if r.kind == "thigh" and r.side == s) for s in ("left", "right")
    )
    quat = torch.tensor(qpos[3:7])
    across = quat_rotate(quat, torch.tensor(left.pos, dtype=torch.double) - torch.tensor(right.pos))
    ahead = torch.linalg.cross(across, torch.tensor([0.0, 0.0, 1.0], dtype=torch.double))
    return quat_rotate(quat_conj(quat), ahead)


def _soles(tracker: Tracker, pos: torch.Tensor, quat: torch.Tensor) -> dict[int, float]:
    """Height of each foot's lowest point at ease, by its joint."""
    rows = tracker.humanoid.table.rows
    joints = [r.joint for r in rows]
    low = lowest_height(tracker.humanoid.table, pos[:, joints], quat[:, joints])[0]
    return {r.joint: float(h) for r, h in zip(rows, low, strict=True) if r.kind == "foot"}


def _joint(tracker: Tracker, kind: str, side: str) -> int:
    return next(r.joint for r in tracker.humanoid.table.rows if r.kind == kind and r.side == side)


def _path(keys: list[Key], times: np.ndarray, of, arc: float = 0.0) -> np.ndarray:
    """`(T, n)`, least jerk between the keys; where it moves forward, lifted by `arc`."""
    at = np.array([k.t for k in keys])
    values = np.array([of(k) for k in keys], dtype=float)
    i = np.clip(np.searchsorted(at, times, "right") - 1, 0, len(at) - 2)
    u = np.clip((times - at[i]) / (at[i + 1] - at[i]), 0.0, 1.0)
    s = u**3 * (10 - 15 * u + 6 * u * u)
    out = values[i] + s[:, None] * (values[i + 1] - values[i])
    if arc:
        moved = np.linalg.norm(values[i + 1] - values[i], axis=-1) > 1e-6
        out[:, 2] += arc * moved * 16 * (s * (1 - s)) ** 2
        # A foot rises before it goes ahead, so that it does not pass through the edge.
        rises = moved & (values[i + 1, 2] > values[i, 2])
        early = np.clip(2.0 * s, 0.0, 1.0)
        out[rises, 2] += ((early - s)[:, None] * (values[i + 1] - values[i]))[rises, 2]
        late = np.clip(2.0 * s - 1.0, 0.0, 1.0) ** 1.0
        out[rises, 0] += ((0.5 * (late - s))[:, None] * (values[i + 1] - values[i]))[rises, 0]
    return out


def _about_y(angle: torch.Tensor) -> torch.Tensor:
    return axis_angle_to_quat(
        torch.tensor([0.0, 1.0, 0.0], dtype=torch.double).expand(len(angle), 3), angle
    )


def _turn_in_world(parents, offsets, rot, root, joint: int, turn: torch.Tensor) -> None:
    _, world = forward_kinematics(parents, offsets, root, rot)
    above = world[:, parents[joint]]
    rot[:, joint] = quat_mul(quat_conj(above), quat_mul(turn, world[:, joint]))
