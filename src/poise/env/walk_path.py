"""A path on the floor: the place at each of its metres, and motions that are bent to follow it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated

import torch
from torch import Tensor

from poise.errors import PoiseError
from poise.motion.rotations import quat_mul, yaw_quat
from poise.settings import Length, Range, validate

#: Most distance (m) of a point from the origin.
FAR = 10_000.0
#: m between the places that are compared, and m by which the last point of a path that closes may miss
#: the first one.
FINE_M, CLOSES_M = 0.05, 0.05
#: m of a path, behind and ahead of where a character was, on which it can be now.
BEHIND_M, AHEAD_M = 0.5, 2.0
#: m ahead of it on the path that a character looks at; rad/s for a rad by which it is off that; s over
#: which the way that it goes is told.
LOOKS_M, TURNS, GOES_S = 0.8, 2.5, 0.5
#: m/s at which nobody goes along it.
FASTEST = 4.0


@dataclass(frozen=True)
class WalkPath:
    """Straight lines from point to point; it closes where the last one is the first one again.

    Attributes:
        points: x and y in m, world.
        speed: m/s at which it is followed; None for whatever is at hand.
    """

    points: Annotated[tuple[tuple[float, float], ...], Length(2), Range(-FAR, FAR, unit="m")]
    speed: Annotated[float | None, Range(0.3, 3, unit="m/s")] = None

    def __post_init__(self) -> None:
        validate(self, "the path")
        if self.length < 1.0:
            raise PoiseError(
                f"a path is at least 1 m long, got {self.length:.2f} m", "the path", code="out-of-range"
            )

    @cached_property
    def closed(self) -> bool:
        """Whether it goes round and round."""
        return len(self.points) > 3 and math.dist(self.points[0], self.points[-1]) <= CLOSES_M

    @cached_property
    def _ends(self) -> tuple[Tensor, Tensor]:
        """Its points `(P, 2)`, and how far along it each is, `(P)` m."""
        at = torch.tensor(self.points, dtype=torch.float64)
        along = torch.cat((torch.zeros(1).double(), at.diff(dim=0).norm(dim=-1).cumsum(0)))
        return at, along

    @property
    def length(self) -> float:
        """m."""
        return float(self._ends[1][-1])

    def at(self, along: Tensor) -> Tensor:
        """`(..., 2)` m, the places so many metres `(...)` along it; an open path goes on straight on
        beyond its ends."""
        points, starts = self._ends
        along = along.remainder(self.length) if self.closed else along
        k = torch.searchsorted(starts, along.contiguous(), right=True).clamp(1, len(starts) - 1) - 1
        wide = (starts[k + 1] - starts[k]).clamp_min(1e-9)
        share = ((along - starts[k]) / wide).unsqueeze(-1)
        return points[k] + share * (points[k + 1] - points[k])

    def nearest(self, places: Tensor, along: Tensor) -> tuple[Tensor, Tensor]:
        """How far along the path, `(K)` m, and how far from it, `(K)` m, places `(K, 2)` are that were
        `along (K)` m before."""
        steps = torch.arange(-BEHIND_M, AHEAD_M + FINE_M, FINE_M, dtype=torch.float64)
        tried = along[:, None] + steps
        if not self.closed:
            tried = tried.clamp(0.0, self.length)
        off = (self.at(tried) - places[:, None]).norm(dim=-1)
        least, k = off.min(1)
        return tried.gather(1, k[:, None]).squeeze(1), least

    def over(self, along: float) -> bool:
        """Whether it is done so many metres along it."""
        return not self.closed and along >= self.length - BEHIND_M

    def bent(
        self, futures: Tensor, last: Tensor, along: float, fps: float, most: float, walks: float
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Motions that turn toward the path as far as the character walks.

        The way p goes on by the motion's own steps d, turned by the angle a,

            p' = p + R(a) d,  a' = a + min(most, TURNS e) min(1, |d| fps / walks) / fps,

        with the angle e from where it goes to the place `LOOKS_M` ahead of it on the path.

        Args:
            futures: `(K, f, 7 + n)` that follow `last (7 + n)`. along: m, where that is on the path.
            fps: frames a second. most: rad/s. walks: m/s from which on it turns as fast as that.

        Returns:
            the motions; how far along the path each frame is, and how far from it, `(K, f)` m.
        """
        steps = futures[..., :2].diff(dim=1, prepend=last[:2].expand(len(futures), 1, 2))
        goes = _smoothed(steps, max(1, round(GOES_S * fps)))
        pace = (goes.norm(dim=-1) * fps / walks).clamp_max(1.0)
        own = torch.atan2(goes[..., 1], goes[..., 0])
        at, angle = last[:2].expand(len(futures), 2), torch.zeros(len(futures), dtype=torch.float64)
        # All places that may be come to, looked up once.
        tried = torch.arange(along - BEHIND_M, along + FASTEST * futures.shape[1] / fps, FINE_M).double()
        if not self.closed:
            tried = tried.clamp(0.0, self.length)
        there, here = self.at(tried), torch.full_like(angle, along)
        places, angles, alongs, offs = list[Tensor](), list[Tensor](), list[Tensor](), list[Tensor]()
        for t in range(futures.shape[1]):
            to = self.at(here + LOOKS_M) - at
            error = torch.atan2(to[:, 1], to[:, 0]) - own[:, t] - angle
            error = (error + math.pi).remainder(2 * math.pi) - math.pi
            angle = angle + (TURNS * error).clamp(-most, most) * pace[:, t] / fps
            cos, sin, d = angle.cos(), angle.sin(), steps[:, t]
            at = at + torch.stack((cos * d[:, 0] - sin * d[:, 1], sin * d[:, 0] + cos * d[:, 1]), -1)
            apart = torch.cdist(at, there)
            # A path that crosses itself is not left for its other branch.
            off, k = apart.masked_fill((tried - here[:, None]).abs() > AHEAD_M, torch.inf).min(1)
            here = tried[k]
            for kept, value in ((places, at), (angles, angle), (alongs, here), (offs, off)):
                kept.append(value)
        out = futures.clone()
        out[..., :2] = torch.stack(places, 1)
        out[..., 3:7] = quat_mul(yaw_quat(torch.stack(angles, 1)), futures[..., 3:7])
        return out, torch.stack(alongs, 1), torch.stack(offs, 1)


def _smoothed(steps: Tensor, wide: int) -> Tensor:
    """Means over `wide` frames about each of `steps (K, f, 2)`, those at the ends over fewer."""
    sums = torch.nn.functional.pad(steps.cumsum(1), (0, 0, 1, 0))
    t = torch.arange(steps.shape[1])
    first, stop = (t - wide // 2).clamp_min(0), (t + wide // 2 + 1).clamp_max(steps.shape[1])
    return (sums[:, stop] - sums[:, first]) / (stop - first)[:, None]
