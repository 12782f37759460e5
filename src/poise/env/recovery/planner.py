"""Recovery motions: from where characters lie, up and over to a place, made of a library's own clips.

Getting up is hard to find by trial, and easy to learn from a clip of it. Of the recovery clips of a
library (`env.recovery.clips`) a recovery motion is planned for any start:

    lying -> blended (`env.recovery.get_up`) -> a clip that gets up -> the walk, steered -> at ease

Before a walk to a place farther than `NEAR` the character stands at ease, too.

It is a reference, not physics: blends float and sink, and feet slide in turns. A policy that learns to
track such motions (`jobs.perpetual.demonstrations`) finds what physics allows.

Turning follows a unicycle: the heading turns toward the place at no more than `TURN` rad/s, and the
walk's stride shortens by the cosine of what is left to turn. To a place that is near and behind, the
walk is played from its end to its start.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from poise.env.recovery.clips import RecoveryClips
from poise.env.recovery.get_up import GetUpPlanner, mixed, smooth
from poise.spatial import quat_mul
from poise.spatial.directions import facing, heading_angle, yaw_quat

#: rad/s, m and rad: how fast is turned, and how near has come back.
TURN, HERE, FACING = 2.0, 0.08, 0.1
#: Of a walk's pace: what is gained and lost in a step, and where all of the walk is seen; steps on the
#: spot while turning.
FASTER, SLOWER, WHOLE, ON_SPOT = 0.06, 0.08, 0.5, 0.6
#: Share of the root's height at ease; a character with its root below must get up.
DOWN = 0.6
#: m: what is no farther is come to at once. Cosine: backwards, where it is no more ahead.
NEAR, BEHIND = 1.2, -0.6
#: s: at ease at the end.
STAY_S = 1.0
#: Steps after which a walk gives up.
LONGEST = 600


def plan_recovery(
    get_up: GetUpPlanner, start: Tensor, place: Tensor, which: int = 0, phase: float = 0.0
) -> Tensor:
    """The frames `(T, 7 + n)` from `start (7 + n)` to standing at ease at `place (7 + n)`.

    Args:
        get_up: how this library gets up, and its other recovery clips.
        which: of the walks.
        phase: 0 to 1, where in its cycle the walk begins.
    """
    recovery_clips, body = get_up.recovery_clips, start[None]
    if float(start[2]) < DOWN * float(recovery_clips.ease[2]):
        body = get_up.up(start)
    stand = facing(recovery_clips.ease, heading_angle(body[-1, 3:7]))
    stand[:2] = body[-1, :2]
    walk = _walk(recovery_clips, stand, place, get_up.rate_hz, which, phase)
    if float((place[:2] - stand[:2]).norm()) > NEAR:
        # Stand first before a long walk: characters that set off while getting up fall more often.
        return torch.cat((body[:-1], get_up.blend(body[-1], stand)[:-1], walk))
    return torch.cat((body[:-1], get_up.out_of(body[-1], walk)))


def recovery_motions(
    get_up: GetUpPlanner, falls: Tensor, far: float, count: int, seed: int
) -> dict[str, np.ndarray]:
    """`count` recovery motions to standing at ease at the origin, by name: every other one from lying,
    of which two fifths are away, too, and the rest from standing up to `far` m away.

    falls: `(K, 7 + n)`, states that lie.
    """
    rng, recovery_clips = torch.Generator().manual_seed(seed), get_up.recovery_clips
    place = facing(recovery_clips.ease, heading_angle(recovery_clips.ease[3:7]))
    motions: dict[str, np.ndarray] = {}
    for i, u in enumerate(torch.rand(count, 6, dtype=torch.float64, generator=rng).tolist()):
        lies = i % 2 == 1
        away = far * u[0] ** 0.7 if not lies or u[1] < 0.4 else 0.0
        bearing = 2 * math.pi * u[2]
        start = (
            falls[i // 2 % len(falls)].clone()
            if lies
            else facing(recovery_clips.ease, 2 * math.pi * u[3])
        )
        start[0], start[1] = away * math.cos(bearing), away * math.sin(bearing)
        way = plan_recovery(get_up, start, place, int(u[5] * 1000), u[4])
        motions[f"{'fallen' if lies else 'far'}-{i // 2}"] = way.numpy()
    return motions


def _walk(
    recovery_clips: RecoveryClips, start: Tensor, place: Tensor, rate_hz: float, which: int, phase: float
) -> Tensor:
    """From standing at `start` to standing at `place`, by one of the walks."""
    cycle = recovery_clips.walks[which % len(recovery_clips.walks)]
    walk, count = cycle.numpy(), len(cycle) - 1
    length = float(walk[-1, 0])
    speed, faces = length * rate_hz / count, heading_angle(cycle[:-1, 3:7])
    at, goal, psi, aim = start[:2].numpy().copy(), place[:2].numpy(), heading_angle(start[3:7]), 0.0
    to, here, pace, stayed, k = phase * count, False, 0.0, 0, 0
    left = goal - at
    ahead = math.atan2(left[1], left[0]) - (psi - faces)
    # To what is near and behind it is walked backwards.
    way = -1 if math.hypot(*left) < NEAR and math.cos(ahead) < BEHIND else 1
    path, seen = [], []
    while stayed < STAY_S * rate_hz and k < LONGEST:
        left = goal - at
        apart = math.hypot(*left)
        here = here or apart < HERE
        toward = math.atan2(way * left[1], way * left[0])
        want = heading_angle(place[3:7]) if here else toward + faces
        error = math.remainder(want - psi, 2 * math.pi)
        turn = max(-TURN, min(TURN, 4 * error))
        psi += turn / rate_hz
        stride = 0.0 if here else max(0.0, math.cos(error)) * min(1.0, max(0.15, 2 * apart / speed))
        done = here and abs(error) < FACING
        aim = 0.0 if done else max(stride, ON_SPOT * min(1.0, abs(turn) / TURN))
        pace += max(-SLOWER, min(FASTER, aim - pace))
        forward = _along(walk, to + way * pace) - _along(walk, to)
        forward *= stride / aim if aim else 0.0
        to += way * pace
        heading = psi - faces
        at = at + forward * np.array([math.cos(heading), math.sin(heading)])
        path.append((*at, heading, psi))
        seen.append((to, pace))
        stayed, k = stayed + (pace <= 1e-9 and done), k + 1
    return _laid(recovery_clips.ease, cycle, torch.tensor(path), torch.tensor(seen))


def _along(walk: np.ndarray, to: float) -> float:
    """m that a walk has come after `to` frames."""
    count = len(walk) - 1
    cycle, rest = divmod(to, count)
    i = min(int(rest), count - 1)
    return cycle * walk[-1, 0] + walk[i, 0] + (rest - i) * (walk[i + 1, 0] - walk[i, 0])


def _laid(ease: Tensor, cycle: Tensor, path: Tensor, seen: Tensor) -> Tensor:
    """A walk's poses on a path (x, y, its direction, the heading), fading from and to standing."""
    (to, pace), count = seen.double().unbind(-1), len(cycle) - 1
    rest = to % count
    i = rest.long().clamp(max=count - 1)
    pose = mixed(cycle[i], cycle[i + 1], rest - i)
    x, y, direction, psi = path.double().unbind(-1)
    pose[:, 3:7] = quat_mul(yaw_quat(direction), pose[:, 3:7])
    pose[:, 0], pose[:, 1] = x - direction.sin() * pose[:, 1], y + direction.cos() * pose[:, 1]
    stand = ease.expand(len(pose), -1).clone()
    stand[:, 3:7] = quat_mul(yaw_quat(psi - heading_angle(ease[3:7])), stand[:, 3:7])
    stand[:, 0], stand[:, 1] = x, y
    return mixed(stand, pose, smooth((pace / WHOLE).clamp(max=1.0)))
