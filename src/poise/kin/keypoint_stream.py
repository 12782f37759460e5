"""Keypoints as they come, from a file or live, as the goal of a keypoint policy at the control rate.

    body = PointBody.calibrate(first_seconds, humanoid_skeleton, humanoid.table)
    stream = KeypointStream(body, rate_hz=30.0)
    for frame in stream.follow(points):     # or: stream.push(positions, time_s) for every frame
        frame.pos, frame.linvel             # (B, 3) m and m/s

Nothing is known of the future beyond `lookahead` control steps, 0 or 1.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from poise.errors import PoiseError
from poise.kin.keypoint_body import PointBody
from poise.motion.keypoints import Keypoints


@dataclass(frozen=True)
class StreamConfig:
    """How a stream of keypoints is filtered.

    smooth_s: time constant of the filter on the keypoints, 0 for none (`FadingFilter`). lookahead: 1
        takes velocities from the frames before and after, one control step late; 0 from the last two.
    max_gap_s: how long a missing keypoint travels along with the others before the stream says so.
    max_speed: m/s, a keypoint that jumps faster is taken as missing (sprinters' feet reach 20).
    """

    smooth_s: float = 0.0
    lookahead: int = 1
    max_gap_s: float = 0.5
    max_speed: float = 25.0

    def __post_init__(self) -> None:
        if self.lookahead not in (0, 1):
            raise PoiseError(f"a stream looks 0 or 1 control steps ahead, not {self.lookahead}")
        if not (self.smooth_s >= 0 and self.max_gap_s >= 0 and self.max_speed > 0):
            raise PoiseError("times and speeds of a stream must not be negative")


@dataclass(frozen=True, eq=False)
class GoalFrame:
    """The goal at one control step.

    time_s: when it was. pos: `(B, 3)` m of the humanoid's bodies. linvel: `(B, 3)` m/s. stale_s: for how
    long the keypoint that is longest missing has been so; beyond `max_gap_s` it is a guess.
    """

    time_s: float
    pos: np.ndarray
    linvel: np.ndarray
    stale_s: float


class FadingFilter:
    """A line through the past, its weights fading by theta per sample (Morrison 1969, degree 1).

    With theta = exp(-dt / tau), g = 1 - theta^2, h = (1 - theta)^2 and the residual r = z - (x + v dt):
    x' = x + v dt + g r, v' = v + h r / dt. A constant velocity is followed without any lag; tau = 0
    gives the sample itself.
    """

    def __init__(self, tau_s: float):
        self.tau = tau_s
        self._state: tuple[np.ndarray, np.ndarray] | None = None

    def __call__(self, z: np.ndarray, dt: float) -> np.ndarray:
        """The filtered value after sample `z`, `dt` s after the one before."""
        theta = np.exp(-dt / self.tau) if self.tau > 0 else 0.0
        if self._state is None:
            self._state = z.copy(), np.zeros_like(z)
            return z.copy()
        x, v = self._state
        r = z - (x + v * dt)
        x = x + v * dt + (1 - theta**2) * r
        self._state = x, v + (1 - theta) ** 2 * r / dt
        return x


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
        self._gaps = _Gaps(len(body.names), self.config.max_speed)
        self._filter = FadingFilter(self.config.smooth_s)
        self._last: tuple[float, np.ndarray, float] | None = None
        self._begin = 0.0
        self._steps = 0
        self._held: list[tuple[float, np.ndarray, float]] = []

    def push(self, positions: np.ndarray, time_s: float) -> list[GoalFrame]:
        """The goals that keypoints `(K, 3)` m seen at `time_s` make known; NaN where one is missing.

        Nothing is given before every needed keypoint was seen once. Raises a PoiseError for another
        number of keypoints, or a time that is not later than the one before.
        """
        if positions.shape != (len(self.body.names), 3):
            raise PoiseError(
                f"a frame of this stream has shape ({len(self.body.names)}, 3), got {positions.shape}"
            )
        if self._last is not None and not time_s > self._last[0]:
            raise PoiseError(
                f"the frame at {time_s:g} s is not later than the one at {self._last[0]:g} s"
            )
        dt = 0.0 if self._last is None else time_s - self._last[0]
        whole, stale = self._gaps(positions, dt)
        if whole is None:
            return []
        now = self._filter(whole, dt)
        out: list[GoalFrame] = []
        if self._last is None:
            self._begin, self._last = time_s, (time_s, now, stale)
            return self._step(time_s, now, stale)
        before, then, _ = self._last
        # A millionth of a step of slack, since times are sums of rounded steps.
        while (at := self._begin + self._steps / self.rate_hz) <= time_s + 1e-6 / self.rate_hz:
            share = min(max((at - before) / (time_s - before), 0.0), 1.0)
            out += self._step(at, then + share * (now - then), stale)
        self._last = (time_s, now, stale)
        return out

    def finish(self) -> list[GoalFrame]:
        """The goal that still waits for a step after it, once no more keypoints will come."""
        if self.config.lookahead == 0 or not self._held:
            return []
        time_s, pos, stale = self._held[-1]
        back = self._held[-2][1] if len(self._held) > 1 else pos
        self._held = []
        return [GoalFrame(time_s, pos, (pos - back) * self.rate_hz, stale)]

    def follow(self, points: Keypoints) -> Iterator[GoalFrame]:
        """The goals of a whole recording, one after another.

        Raises:
            PoiseError: other keypoints than the calibration's.
        """
        if points.names != self.body.names:
            raise PoiseError(
                "its keypoints are not those of the calibration", points.source.path or points.name
            )
        for t, positions in enumerate(points.positions):
            yield from self.push(positions, t / points.fps)
        yield from self.finish()

    def _step(self, at: float, points: np.ndarray, stale: float) -> list[GoalFrame]:
        """What one more control step makes known."""
        self._steps += 1
        pos = self.body.solve(points[None])[0]
        self._held = [*self._held[-2:], (at, pos, stale)]
        if self.config.lookahead == 0:
            back = self._held[-2][1] if len(self._held) > 1 else pos
            return [GoalFrame(at, pos, (pos - back) * self.rate_hz, stale)]
        if len(self._held) == 1:
            return []
        time_s, middle, its_stale = self._held[-2]
        first = len(self._held) == 2
        span = pos - (middle if first else self._held[-3][1])
        return [GoalFrame(time_s, middle, span * self.rate_hz / (1 if first else 2), its_stale)]


class _Gaps:
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
