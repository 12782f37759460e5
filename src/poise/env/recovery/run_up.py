"""A run-up: a walk from standing into the first frame of a motion that is on its way already."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from poise.env.recovery.get_up import GetUpPlanner, mixed, smooth
from poise.env.recovery.planner import AHEAD, MOVING, WHOLE, nearest_phase, on_path, walk_of
from poise.sim import displaced
from poise.spatial.directions import heading_angle

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
