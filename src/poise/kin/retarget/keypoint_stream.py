"""Keypoints as they come, from a file or live, as the goal of a keypoint policy at the control rate.

    body = PointBody.calibrate(first_seconds, humanoid_skeleton, humanoid.table)
    stream = KeypointStream(body, rate_hz=30.0)
    for frame in stream.follow(points):     # or: stream.push(positions, time_s) for every frame
        frame.pos, frame.linvel             # (B, 3) m and m/s

Nothing is known of the future beyond `lookahead` control steps, 0 or 1.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from poise.errors import PoiseError
from poise.kin.fading import of_points
from poise.kin.retarget.keypoint_body import PointBody
from poise.motion.keypoints import Keypoints

#: Control steps of a recording that are solved at once.
BLOCK = 64


@dataclass(frozen=True)
class StreamConfig:
    """How a stream of keypoints is filtered.

    smooth_hz: cut-off of the filter on the keypoints; None smooths them as much as they tremble
        (`FadingFilter`). lookahead: 1 takes velocities from the frames before and after, one step
        late; 0 from the last two.
    max_speed: m/s, a keypoint that jumps faster is taken as missing (sprinters' feet reach 20).
    """

    smooth_hz: float | None = None
    lookahead: int = 1
    max_speed: float = 25.0

    def __post_init__(self) -> None:
        if self.lookahead not in (0, 1):
            raise PoiseError(f"a stream looks 0 or 1 control steps ahead, not {self.lookahead}")
        if not ((self.smooth_hz is None or self.smooth_hz > 0) and self.max_speed > 0):
            raise PoiseError("frequencies and speeds of a stream must be above 0")


@dataclass(frozen=True, eq=False)
class GoalFrame:
    """The goal at one control step.

    time_s: when it was. pos: `(B, 3)` m of the humanoid's bodies. linvel: `(B, 3)` m/s. stale_s: for how
    long the keypoint that is longest missing has been so and has travelled along with the others.
    """

    time_s: float
    pos: np.ndarray
    linvel: np.ndarray
    stale_s: float


class _Step(NamedTuple):
    """A control step: its time, positions of keypoints or bodies in m, and the oldest gap in s."""

    time_s: float
    pos: np.ndarray
    stale_s: float


class KeypointStream:
    """Keypoints one frame after another; goals at every control step that they reach.

    latency_s: how long after a control step its goal is given: until the next frame of the input is
    there, and `lookahead` steps more. The filter adds none at constant velocity.
    """

    def __init__(self, body: PointBody, rate_hz: float = 30.0, config: StreamConfig | None = None):
        if not (np.isfinite(rate_hz) and rate_hz > 0):
            raise PoiseError(f"the control rate must be above 0, got {rate_hz}")
        self.body, self.rate_hz, self.config = body, rate_hz, config or StreamConfig()
        self.latency_s = self.config.lookahead / rate_hz
        self._gaps = Gaps(len(body.names), self.config.max_speed)
        self._filter = of_points(len(body.names), self.config.smooth_hz)
        self._time: float | None = None
        self._last: _Step | None = None
        self._begin, self._count = 0.0, 0
        self._held: list[_Step] = []

    def push(self, positions: np.ndarray, time_s: float) -> list[GoalFrame]:
        """The goals that keypoints `(K, 3)` m seen at `time_s` make known; NaN where one is missing.

        Nothing is given before every needed keypoint was seen once. A frame costs some 300 small tensor
        operations; a recording goes faster through `follow`.

        Raises:
            PoiseError: another number of keypoints, or a time that is not later than the one before.
        """
        return self._goals(self._steps_at(positions, time_s))

    def finish(self) -> list[GoalFrame]:
        """The goal that still waits for a step after it, once no more keypoints will come."""
        if self.config.lookahead == 0 or not self._held:
            return []
        last, back = self._held[-1], self._held[-2] if len(self._held) > 1 else self._held[-1]
        self._held = []
        return [GoalFrame(last.time_s, last.pos, (last.pos - back.pos) * self.rate_hz, last.stale_s)]

    def follow(self, points: Keypoints) -> Iterator[GoalFrame]:
        """The goals of a whole recording, one after another: the same as `push` gives, sooner.

        Raises:
            PoiseError: other keypoints than the calibration's.
        """
        if points.names != self.body.names:
            raise PoiseError(
                "its keypoints are not those of the calibration", points.source.path or points.name
            )
        waiting: list[_Step] = []
        for t, positions in enumerate(points.positions):
            waiting += self._steps_at(positions, t / points.fps)
            if len(waiting) >= BLOCK:
                yield from self._goals(waiting)
                waiting = []
        yield from self._goals(waiting)
        yield from self.finish()

    def _steps_at(self, positions: np.ndarray, time_s: float) -> list[_Step]:
        """The keypoints without gaps at the control steps up to `time_s`."""
        if positions.shape != (len(self.body.names), 3):
            raise PoiseError(
                f"a frame of this stream has shape ({len(self.body.names)}, 3), got {positions.shape}"
            )
        if self._time is not None and not time_s > self._time:
            raise PoiseError(f"the frame at {time_s:g} s is not later than the one at {self._time:g} s")
        dt = 0.0 if self._time is None else time_s - self._time
        self._time = time_s
        whole, stale = self._gaps(positions, dt)
        if whole is None:
            return []
        now = self._filter(whole.ravel(), dt).reshape(whole.shape)
        if self._last is None:
            self._begin, self._last, self._count = time_s, _Step(time_s, now, stale), 1
            return [self._last]
        before, out = self._last, []
        # A millionth of a step of slack, since times are sums of rounded steps.
        while (at := self._begin + self._count / self.rate_hz) <= time_s + 1e-6 / self.rate_hz:
            share = min(max((at - before.time_s) / dt, 0.0), 1.0)
            out.append(_Step(at, before.pos + share * (now - before.pos), stale))
            self._count += 1
        self._last = _Step(time_s, now, stale)
        return out

    def _goals(self, steps: Sequence[_Step]) -> list[GoalFrame]:
        """What these control steps make known."""
        if not steps:
            return []
        solved = self.body.solve(np.stack([s.pos for s in steps]))
        return [g for s, pos in zip(steps, solved, strict=True) for g in self._goal(s._replace(pos=pos))]

    def _goal(self, step: _Step) -> list[GoalFrame]:
        """The goal of this step, or with a look ahead that of the one before; `pos` is the bodies'."""
        self._held = [*self._held[-2:], step]
        back = self._held[-2] if len(self._held) > 1 else step
        if self.config.lookahead == 0:
            return [GoalFrame(step.time_s, step.pos, (step.pos - back.pos) * self.rate_hz, step.stale_s)]
        if len(self._held) == 1:
            return []
        first = self._held[0]
        speed = (step.pos - first.pos) * self.rate_hz / (len(self._held) - 1)
        return [GoalFrame(back.time_s, back.pos, speed, back.stale_s)]


class Gaps:
    """Missing keypoints travel along with those that are seen."""

    def __init__(self, count: int, max_speed: float):
        self.last = np.full((count, 3), np.nan)
        self.since = np.zeros(count)
        self.max_speed = max_speed

    def __call__(self, positions: np.ndarray, dt: float) -> tuple[np.ndarray | None, float]:
        """The frame without gaps, None before each keypoint was seen once; the longest gap in s."""
        now = np.array(positions, dtype=float)
        known = np.asarray(~np.isnan(self.last).any(-1))
        self.since += dt
        far = np.linalg.norm(now - self.last, axis=-1) > self.max_speed * np.maximum(self.since, dt)
        now[known & far] = np.nan
        seen = np.asarray(~np.isnan(now).any(-1))
        both = seen & known
        shift = np.median(now[both] - self.last[both], axis=0) if both.any() else np.zeros(3)
        out = np.where(seen[:, None], now, self.last + shift)
        self.since[seen] = 0.0
        self.last = out
        if np.isnan(out).any():
            return None, float("inf")
        return out, float(self.since.max())
