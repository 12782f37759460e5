"""Where a motion that was lost is entered again, the way into it, and the way to standing alone."""

from __future__ import annotations

import torch
from torch import Tensor

from poise.env.recovery.get_up import GetUpPlanner
from poise.env.recovery.planner import STAY_S, plan_recovery, walk_of
from poise.env.recovery.run_up import run_up
from poise.env.reference import Reference
from poise.spatial.directions import facing, heading_angle

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
