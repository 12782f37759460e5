"""Recovery motions: from where characters lie, up and over to where a motion is entered again.

The recovery clips of a library (`env.recovery.get_up`) give a recovery motion for any start:

    lying -> blended -> a clip that gets up -> the walk, steered -> at ease

It is a reference, not physics: blends float and sink, and feet slide in turns. A policy that learns to
track such motions finds what physics allows. Turning follows a unicycle: the heading turns toward the
place at no more than `Pace.turn` rad/s, and the walk's stride shortens by the cosine of the turn that is
left. To a place that is near and behind, the walk is played from its end to its start.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from poise.env.recovery.get_up import GetUpPlanner, mixed, smooth
from poise.env.reference import Reference
from poise.motion.rotations import facing, heading_angle, quat_mul, yaw_quat
from poise.sim import displaced

#: m and rad: how near has come back.
HERE, FACING = 0.08, 0.1
#: Of a walk's pace: what is lost in a step, and where all of the walk is seen; steps on the spot while
#: turning.
SLOWER, WHOLE, ON_SPOT = 0.08, 0.5, 0.6
#: m to what is more than a step away.
STEP = 1.0
#: m: what is no farther and behind is come to backwards. Cosine: of what is behind.
NEAR, BEHIND = 1.2, -0.6
#: s: at ease at the end.
STAY_S = 1.0
#: Steps after which a walk gives up.
LONGEST = 600
#: m/s above which a body moves; cosine between that and how it faces, from which it is a walk.
MOVING, AHEAD = 0.5, 0.5
#: Times the walk's own speed, with which it begins at most; what it loses of that in a step; m/s^2 to
#: the side that it turns with meanwhile.
FASTEST, CALMER, CURVES = 2.0, 0.04, 1.0


def plan_recovery(
    get_up: GetUpPlanner,
    start: Tensor,
    place: Tensor,
    which: int = 0,
    phase: float = 0.0,
    moves: Tensor | None = None,
    again: int = 0,
    up: Tensor | None = None,
) -> Tensor:
    """The frames `(T, 7 + n)` from `start (7 + n)` to standing at ease at `place (7 + n)`.

    Args:
        get_up: how this library gets up, and its other recovery clips.
        which: of the walks.
        phase: 0 to 1, where in its cycle the walk begins.
        moves: m/s `(2)`, how the body moves at the start; it walks on if that is how it faces.
        again: how often a motion from there was lost in a row; it gets up in other ways then.
        up: `get_up.up(start, again)`, where that is known already.
    """
    recovery_clips, body = get_up.recovery_clips, start[None]
    if bool(get_up.lies(start)):
        body, moves = get_up.up(start, again) if up is None else up, None
    stand = facing(recovery_clips.ease, heading_angle(body[-1, 3:7]))
    stand[:2] = body[-1, :2]
    pace = 0.0 if moves is None else _pace(get_up, body[-1], moves, which)
    if pace and moves is not None:
        phase, direction = nearest_phase(get_up, body[-1], which), math.atan2(*moves.flip(0).tolist())
        stand = facing(stand, direction + walk_of(get_up, which)[2])
        stand[:2] = body[-1, :2]
        walk = _walk(get_up, stand, place, which, phase, pace)
        return get_up.out_of(body[-1], walk, moves)
    walk = _walk(get_up, stand, place, which, phase)
    return torch.cat((body[:-1], get_up.out_of(body[-1], walk)))


def walk_of(get_up: GetUpPlanner, which: int) -> tuple[Tensor, float, float]:
    """A walk's closed cycle along +X, its speed in m/s, and how its frames are turned off that, rad."""
    walks = get_up.recovery_clips.walks
    cycle = walks[which % len(walks)]
    speed = float(cycle[-1, 0]) * get_up.rate_hz / (len(cycle) - 1)
    return cycle, speed, heading_angle(cycle[:-1, 3:7])


def nearest_phase(get_up: GetUpPlanner, pose: Tensor, which: int) -> float:
    """0 to 1, where in a walk's cycle the body is most as in `pose (7 + n)`."""
    cycle = walk_of(get_up, which)[0]
    apart = get_up.poses(pose[None]).apart(get_up.poses(cycle[:-1]))[0]
    return int(apart.argmin()) / (len(cycle) - 1)


def _pace(get_up: GetUpPlanner, pose: Tensor, moves: Tensor, which: int) -> float:
    """Share of a walk's speed at which a body that moves with `moves (2)` m/s walks already."""
    _, speed, faces = walk_of(get_up, which)
    heading = heading_angle(pose[3:7]) - faces
    ahead = float(moves[0]) * math.cos(heading) + float(moves[1]) * math.sin(heading)
    walks = ahead > max(MOVING, AHEAD * float(moves.norm()))
    return min(FASTEST, ahead / speed) if walks else 0.0


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
    get_up: GetUpPlanner, start: Tensor, place: Tensor, which: int, phase: float, pace: float = 0.0
) -> Tensor:
    """From standing, or walking at a `pace`, at `start` to standing at `place`, by one of the walks."""
    (cycle, speed, faces), hurry = walk_of(get_up, which), get_up.recovery_clips.pace
    walk, count, rate_hz = cycle.numpy(), len(cycle) - 1, get_up.rate_hz
    at, goal, psi, aim = start[:2].numpy().copy(), place[:2].numpy(), heading_angle(start[3:7]), 0.0
    to, here, stayed, k, rest = phase * count, False, 0, 0, pace
    left = goal - at
    ahead = math.atan2(left[1], left[0]) - (psi - faces)
    # To what is near and behind it is walked backwards.
    way = -1 if not pace and math.hypot(*left) < NEAR and math.cos(ahead) < BEHIND else 1
    path, seen = [], []
    while stayed < STAY_S * rate_hz and k < LONGEST:
        left = goal - at
        apart = math.hypot(*left)
        here = here or (apart < HERE and not rest)
        toward = math.atan2(way * left[1], way * left[0])
        want = heading_angle(place[3:7]) if here else toward + faces
        error = math.remainder(want - psi, 2 * math.pi)
        most = min(hurry.turn, CURVES / (rest * speed)) if rest else hurry.turn
        turn = max(-most, min(most, 4 * error))
        psi += turn / rate_hz
        top = hurry.walk if apart > STEP else 1.0
        stride = 0.0 if here else max(0.0, math.cos(error)) * min(top, max(0.15, 2 * apart / speed))
        # What walks already slows down step by step.
        rest = max(0.0, rest - CALMER)
        stride = max(stride, rest)
        done = here and abs(error) < FACING
        aim = 0.0 if done else max(stride, ON_SPOT * min(1.0, abs(turn) / hurry.turn))
        pace += max(-SLOWER, min(hurry.gain, aim - pace))
        forward = _along(walk, to + way * pace) - _along(walk, to)
        forward *= stride / aim if aim else 0.0
        to += way * pace
        heading = psi - faces
        at = at + forward * np.array([math.cos(heading), math.sin(heading)])
        path.append((*at, heading, psi))
        seen.append((to, pace))
        stayed, k = stayed + (pace <= 1e-9 and done), k + 1
    return on_path(get_up.recovery_clips.ease, cycle, torch.tensor(path), torch.tensor(seen))


def _along(walk: np.ndarray, to: float) -> float:
    """m that a walk has come after `to` frames."""
    count = len(walk) - 1
    cycle, rest = divmod(to, count)
    i = min(int(rest), count - 1)
    return cycle * walk[-1, 0] + walk[i, 0] + (rest - i) * (walk[i + 1, 0] - walk[i, 0])


def on_path(ease: Tensor, cycle: Tensor, path: Tensor, seen: Tensor) -> Tensor:
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


#: m/s^2 with which it speeds up; s in which the walk passes into the motion; s in which the motion's own
#: joint velocities fade, back from its first frame.
SPEEDS_UP, PASSES_S, FADES_S = 2.0, 0.4, 0.1


def run_up(get_up: GetUpPlanner, place: Tensor, velocity: Tensor, which: int = 0) -> Tensor:
    """The frames `(T, 7 + n)` from standing at ease to `place (7 + n)`, at which a body moves with
    `velocity (6 + n)`; `place` alone where that is no walk or run, forwards or backwards.

    Back from the place, t s before it, the body moves with max(0, v - a t), a = `SPEEDS_UP`, straight
    on. It walks; in the last `PASSES_S` that passes into the motion as it was before its first frame,
    x(-t) = x - v t, and for the joints q(-t) = q - v tau (1 - e^(-t / tau)) with tau = `FADES_S`.

    which: of the library's walks.
    """
    rate = get_up.rate_hz
    speed, direction = float(velocity[:2].norm()), math.atan2(float(velocity[1]), float(velocity[0]))
    cycle, pace, faces = walk_of(get_up, which)
    ahead = math.cos(direction + faces - heading_angle(place[3:7]))
    if speed < MOVING or abs(ahead) < AHEAD:
        return place[None]
    way = 1 if ahead > 0 else -1
    toward = direction if way > 0 else direction + math.pi
    time = torch.arange(math.ceil(speed / SPEEDS_UP * rate) + 1, dtype=torch.float64) / rate
    moves = (speed - SPEEDS_UP * time).clamp(min=0.0)
    # Trapezoids, so that it ends at rest.
    left = torch.cat((time[:1], torch.cumsum((moves[1:] + moves[:-1]) / (2 * rate), 0)))
    # What is faster than the walk has longer and quicker steps in equal shares.
    share = moves / pace
    quick = torch.minimum(share, share.sqrt())
    begun = nearest_phase(get_up, place, which) * (len(cycle) - 1)
    to = begun - way * torch.cat((time[:1], torch.cumsum((quick[1:] + quick[:-1]) / 2, 0)))
    along = torch.tensor([math.cos(direction), math.sin(direction)], dtype=torch.float64)
    at = place[:2] - left[:, None] * along
    turns = torch.tensor([[toward, toward + faces]], dtype=torch.float64).expand(len(at), 2)
    seen = torch.stack((to, quick.clamp(max=1.0 / WHOLE)), 1)
    walk = on_path(get_up.recovery_clips.ease, cycle, torch.cat((at, turns), 1), seen)
    fade = FADES_S * (1.0 - torch.exp(-time / FADES_S))
    before = displaced(place.expand(len(walk), -1), -velocity * fade[:, None])
    before[:, :2] = at
    count = round(PASSES_S * rate)
    return mixed(before, walk, smooth((time * rate / count).clamp(max=1.0))).flip(0)


#: s that is stood at ease before a motion is entered.
CALM_S = 0.3
#: Where a motion is entered: m for each m/s of its bodies, and for each s of it that is left out or that
#: is walked to it.
MOVES, SKIPS = 0.3, 0.05
#: s of it among which is chosen; later frames cost more than any pose can gain.
FIRST_S = 30.0
#: m/s^2 with which what moves comes to stand.
STOPS = 1.7


def entry(get_up: GetUpPlanner, motions: Reference, clip: int, frame: int, qpos: Tensor) -> int:
    """The frame of a clip, `frame` or a later one, that is most easily come to and gone on from: it
    nearly stands at ease, hardly moves, and is near in time and on foot.

    Args:
        motions: the clips.
        qpos: `(7 + n)`, where the character is.
    """
    first, end = int(motions.start[clip]) + frame, int(motions.start[clip] + motions.length[clip])
    rows = slice(first, min(end, first + round(FIRST_S * motions.rate_hz)))
    if rows.stop - rows.start < 2:
        return frame
    poses = motions.qpos[rows].cpu()
    apart = get_up.poses(get_up.recovery_clips.ease[None]).apart(get_up.poses(poses))[0]
    speed = motions.pose.linvel[rows].norm(dim=-1).mean(-1).cpu()
    later = torch.arange(len(apart)) / motions.rate_hz
    walked = (poses[:, :2] - qpos[:2]).norm(dim=-1) / walk_of(get_up, 0)[1]
    return frame + int((apart + MOVES * speed + SKIPS * (later + walked)).argmin())


def way_into(
    get_up: GetUpPlanner,
    qpos: Tensor,
    place: Tensor,
    velocity: Tensor,
    moves: Tensor | None = None,
    again: int = 0,
) -> Tensor:
    """The frames `(T, 7 + n)` from `qpos (7 + n)` to `place (7 + n)`, at which a motion moves with
    `velocity (6 + n)`; over standing at ease for `CALM_S` before it.

    moves, again: see `plan_recovery`.
    """
    into = run_up(get_up, place, velocity)
    way = plan_recovery(get_up, qpos, into[0], moves=moves, again=again)
    way = way[: len(way) - round((STAY_S - CALM_S) * get_up.rate_hz)]
    return torch.cat((way[:-1], get_up.blend(way[-1], into[0]), into[1:]))


def way_to_stand(
    get_up: GetUpPlanner,
    qpos: Tensor,
    place: Tensor | None = None,
    moves: Tensor | None = None,
    again: int = 0,
) -> Tensor:
    """The frames `(T, 7 + n)` from `qpos (7 + n)` to standing at ease at `place (7 + n)`, by default
    where it gets up, or where it can stop.

    moves, again: see `plan_recovery`.
    """
    up = None
    if place is None:
        up = get_up.up(qpos, again) if bool(get_up.lies(qpos)) else None
        place = (qpos if up is None else up[-1]).clone()
        if moves is not None and up is None:
            # x = v |v| / 2a: where what moves can stand.
            place[:2] += moves * float(moves.norm()) / (2 * STOPS)
    stand = facing(get_up.recovery_clips.ease, heading_angle(place[3:7]))
    stand[:2] = place[:2]
    return plan_recovery(get_up, qpos, stand, moves=moves, again=again, up=up)
