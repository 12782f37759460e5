"""The recovery clips of a library: a body at ease, steady walks, and clips that get up."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from poise.env.reference import Reference
from poise.kin import close_cycle
from poise.spatial import heading_quat, into_heading, quat_angle, quat_between
from poise.spatial.directions import heading_angle, turned

#: Shares of the standing height: a body that is lower lies, one that is at least so high stands again.
LIES, STANDS = 0.5, 0.9
#: m/s: no part of a body that lies moves faster, on average; s: getting up lasts no longer.
STILL, UP_S = 0.6, 6.0
#: s of a walk's cycle, m/s of its travel, rad that it may turn.
CYCLE_S, TRAVEL, STRAIGHT = (0.8, 1.5), (0.7, 1.4), 0.35
#: What a m/s counts beside a m, where two frames of a cycle are compared, and m within which it closes.
SPEED_COUNTS, CLOSES = 0.1, 0.02


class Pace(NamedTuple):
    """How quickly recovery clips are played, and what is done with them.

    up: times their own speed at which clips get up. walk: times a walk's own speed at which it goes to a
    place that is more than a step away. turn: rad/s. gain: of a walk's speed, what is gained in a step.
    up_s: s that getting up lasts at most; a clip that is longer is played faster.
    """

    up: float = 1.25
    walk: float = 1.0
    turn: float = 2.0
    gain: float = 0.06
    up_s: float = 10.0


#: At which every policy can come back, and, a second sooner, one that learns it so.
CALM, QUICK = Pace(), Pace(1.75, 1.3, 2.5, 0.06, 1.7)


@dataclass(frozen=True, eq=False)
class RecoveryClips:
    """The recovery clips of a library, coordinates `(F, 7 + n)` float64.

    Attributes:
        ease: `(7 + n)`, a body that stands.
        walks: each a closed cycle along +X.
        ups: from lying to standing.
        pace: at which a policy learned to come back by them.
    """

    ease: Tensor
    walks: tuple[Tensor, ...]
    ups: tuple[Tensor, ...]
    pace: Pace = CALM

    def state(self) -> dict[str, Tensor]:
        """All of it by name, for `of`."""
        named = {f"walk {k:03}": q for k, q in enumerate(self.walks)}
        named |= {f"up {k:03}": q for k, q in enumerate(self.ups)}
        return {"ease": self.ease, "pace": torch.tensor(self.pace, dtype=torch.float64), **named}

    @classmethod
    def of(cls, state: Mapping[str, Tensor]) -> RecoveryClips:
        """From `state()`."""
        walks, ups = (
            tuple(state[k] for k in sorted(state) if k.startswith(kind)) for kind in ("walk ", "up ")
        )
        # Half and single precision know no 0.06.
        told = [round(x, 4) for x in state["pace"].tolist()] if "pace" in state else ()
        return cls(state["ease"], walks, ups, Pace(*told))


def find_recovery_clips(
    reference: Reference, ease: tuple[int, int], walking: Tensor, most: int = 2
) -> RecoveryClips | None:
    """The recovery clips of a library; None if none of its clips walks steadily or none gets up.

    Args:
        ease: (clip, frame) that stands.
        walking: `(C,)` bool, clips that walk or stand.
        most: walks, the fastest of those that close and face as walks mostly do, which leaves out walks
            backwards.
    """
    clip, frame = ease
    stand = reference.qpos[int(reference.start[clip]) + frame].cpu()
    walks = [found for c in walking.nonzero().squeeze(-1).tolist() if (found := _cycle(reference, c))]
    clips = range(len(reference.length))
    ups = [up for c in clips if (up := _gets_up(reference, c, stand)) is not None]
    if not walks or not ups:
        return None
    faces = [heading_angle(q[:, 3:7]) for _, q in walks]
    usual = math.atan2(sum(map(math.sin, faces)), sum(map(math.cos, faces)))
    ahead = [w for w, face in zip(walks, faces, strict=True) if math.cos(face - usual) > 0]
    ahead.sort(key=lambda w: (max(w[0], CLOSES), -float(w[1][-1, 0]) / len(w[1])))
    return RecoveryClips(stand, tuple(q for _, q in ahead[:most]), tuple(ups))


def _cycle(reference: Reference, clip: int) -> tuple[float, Tensor] | None:
    """How well the best cycle of a clip closes, m, and that cycle."""
    rows, rate = _rows(reference, clip), reference.rate_hz
    qpos, pose = reference.qpos[rows].cpu(), reference.pose
    low, high = (round(s * rate) for s in CYCLE_S)
    if len(qpos) <= low:
        return None
    heading = heading_quat(qpos[:, 3:7])
    pos = pose.pos[rows].cpu().double() - qpos[:, None, :3] * torch.tensor([1.0, 1.0, 0.0])
    seen = into_heading(heading, torch.cat((pos, SPEED_COUNTS * pose.linvel[rows].cpu().double()), 1))
    best: tuple[float, int, int] | None = None
    for n in range(low, min(high, len(qpos) - 1) + 1):
        travel = (qpos[n:, :2] - qpos[:-n, :2]).norm(dim=-1) * rate / n
        turn = quat_angle(quat_between(heading[:-n], heading[n:]))
        gap = (seen[n:] - seen[:-n]).norm(dim=-1).mean(-1)
        fit = (travel > TRAVEL[0]) & (travel < TRAVEL[1]) & (turn < STRAIGHT)
        gap = torch.where(fit, gap, math.inf)
        k = int(gap.argmin())
        if float(gap[k]) < (best[0] if best else math.inf):
            best = float(gap[k]), k, n
    if best is None:
        return None
    gap, k, n = best
    closed = torch.tensor(close_cycle(qpos[k : k + n + 1].numpy())[0])
    return gap, _along_x(closed)


def _gets_up(reference: Reference, clip: int, stand: Tensor) -> Tensor | None:
    """A clip's frames from where it lies most still until it stands; None if it never does."""
    rows, rate = _rows(reference, clip), reference.rate_hz
    pos, vel = reference.pose.pos[rows].cpu(), reference.pose.linvel[rows].cpu()
    top, height = pos[..., 2].amax(-1), float(stand[2])
    speed, upright = vel.norm(dim=-1).mean(-1), pos[:, 0, 2] > STANDS * height
    down = (top < LIES * height) & (speed < STILL)
    best: tuple[float, int, int] | None = None
    for k in down.nonzero().squeeze(-1).tolist():
        ups = upright[k : k + round(UP_S * rate)].nonzero().squeeze(-1)
        if len(ups) and float(speed[k]) < (best[0] if best else math.inf):
            best = float(speed[k]), k, k + int(ups[0])
    if best is None:
        return None
    # Until it stands still, or the clip ends.
    end = best[2] + int(speed[best[2] : best[2] + round(rate)].argmin())
    return reference.qpos[rows][best[1] : end + 1].cpu()


def _rows(reference: Reference, clip: int) -> slice:
    start = int(reference.start[clip])
    return slice(start, start + int(reference.length[clip]))


def _along_x(qpos: Tensor) -> Tensor:
    """A cycle that begins at the origin and travels along +X without drifting aside."""
    travel = qpos[-1, :2] - qpos[0, :2]
    out = turned(qpos, -math.atan2(float(travel[1]), float(travel[0])), qpos[0, :2], torch.zeros(2))
    out[:, 1] -= out[:, 1].mean()
    return out
