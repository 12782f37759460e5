"""A stream smoothed as much as it trembles, from its past alone.

    fading = FadingFilter(groups, weights)
    x = fading(z, dt)            # the newest sample as it is now known
    earlier = fading.before()    # the samples before it, by all that has come since

A channel is taken as z = x + n + e: motion x, a tremble n of one frequency, white noise e of variance R.
The stream itself tells the sizes of n and e (`StreamNoise`). x moves on by its velocity, which is driven
by white noise of power R dt (2 pi c)^4, so that c Hz is where a smoother by the same model lets half
pass. Kalman filters of several c run side by side; every group of channels takes the mean of them, each
weighted by how likely it made the group's last samples (Magill 1965, with a memory that fades):

    log w <- e^(-dt / tau) log w - |z - H x'|^2 / (2 R S) - d / 2 log S.

So quick motion is followed at once, and a joint at rest is smoothed most. The samples before the newest
are those of a Rauch-Tung-Striebel smoother. A stream that does not tremble passes as it is.
"""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

import numpy as np

from poise.kin.stream_noise import RATE, Places, StreamNoise

#: Hz, where the models let half pass; s within which weights forget.
CUTOFFS, FORGETS_S = (0.7, 1.3, 2.2, 3.5, 5.5, 9.0, 15.0), 0.25
#: Hz by which a tremble's frequency and size wander.
WANDER_HZ = 0.15
#: White noise of a pure tremble, as a share of its variance.
LEAST = 0.02
#: s in which smoothing fades in and out; s of which samples are kept to be known better.
FADE_S, KEPT_S = 0.3, 0.07
#: s by which a stream that trembles is kept back: one control step, since the sample before the newest
#: is known better by a third, and the one before that hardly more.
LATE_S = 1.0 / 30.0
#: Squares of an error, by their expected sum, beyond which a group did not move but is elsewhere.
ELSEWHERE = 9.0
_STATES = 4


class _Past(NamedTuple):
    """A sample as it came, `(C)`, the models' states `(M, S, C)` after and before it, and the gain
    `(M, S, S)` by which what is learned of it changes the one before."""

    dt: float
    raw: np.ndarray
    state: np.ndarray
    told: np.ndarray
    gain: np.ndarray


class FadingFilter:
    """Smooths channels `(C)` sample by sample.

    Args:
        groups, weights, places: as of `StreamNoise`.
        cutoff_hz: smooths by this alone, whether the stream trembles or not; None: by what it trembles.

    Attributes:
        noise: what the stream does now.
        share: 0 to 1, how far smoothing has faded in.
    """

    def __init__(
        self,
        groups: np.ndarray,
        weights: np.ndarray,
        places: Places | None = None,
        cutoff_hz: float | None = None,
    ):
        self.groups = np.asarray(groups)
        self.noise = StreamNoise(self.groups, weights, places)
        self.fixed = cutoff_hz is not None
        self.share = float(self.fixed)
        self._cutoffs = np.array(CUTOFFS if cutoff_hz is None else (cutoff_hz,))
        self._member = self.noise.member
        self._freedom = np.minimum(self._member.sum(0), 3.0)
        self._last: np.ndarray | None = None
        self._past: deque[_Past] = deque()
        self._hz: float | None = None
        self._model: tuple[tuple[float, float | None, float], np.ndarray, np.ndarray] | None = None

    @property
    def late_s(self) -> float:
        """s by which the stream is best kept back: `LATE_S` while it is smoothed, else none."""
        return LATE_S if self.share > 0.0 else 0.0

    def __call__(self, z: np.ndarray, dt: float) -> np.ndarray:
        """The newest sample, `dt` s after the one before; `z` itself where nothing trembles."""
        if self._last is None or not 0.0 < dt < 1.0:
            self.restart(z)
            return z
        if not self.fixed:
            self.noise(z, dt)
        noise, self._last = self.noise, z
        on = self.fixed or noise.trembles
        if not on and self.share == 0.0:
            self._past.clear()
            return z
        self.share = min(max(self.share + (dt if on else -dt) / FADE_S, 0.0), 1.0)
        self._step(z, dt)
        return self._mixed(z, self._past[-1].state)

    def before(self) -> list[np.ndarray]:
        """The samples before the newest, from the latest on, within `KEPT_S`; none where nothing
        trembles."""
        out, past = list[np.ndarray](), self._past
        if not past:
            return out
        state = past[-1].state
        for k in range(len(past) - 1, 0, -1):
            state = past[k - 1].state + past[k].gain @ (state - past[k].told)
            out.append(self._mixed(past[k - 1].raw, state))
        return out

    def restart(self, z: np.ndarray) -> None:
        """The stream is elsewhere, and goes on from `z`; what is known of its noise stays."""
        self._last = z
        self._past.clear()
        self.noise.elsewhere(z)

    def _mixed(self, raw: np.ndarray, state: np.ndarray) -> np.ndarray:
        x = np.einsum("mc,mc->c", self._weights, state[:, 0])
        return x if self.share == 1.0 else raw + self.share * (x - raw)

    def _step(self, z: np.ndarray, dt: float) -> None:
        noise = self.noise
        white = np.maximum(noise.white, LEAST * noise.tone)
        # Where the least is known of a group it is as good as its neighbours.
        white = np.maximum(white, 1e-3 * white.mean()) + 1e-18
        size = 0.0
        if noise.hz is not None:
            size = float(np.clip(np.median(noise.tone / white), 1.0, 1.0 / LEAST))
        if not self._past or (noise.hz != self._hz and (noise.hz is None or self._hz is None)):
            self._begin(z, dt, size)
            return
        self._hz = noise.hz
        f, q = self._motion(dt, size)
        told, cov = f @ self._past[-1].state, f @ self._cov @ f.T + q
        seen = cov[:, :, 0] + cov[:, :, 2]
        spread = seen[:, 0] + seen[:, 2] + 1.0
        gain = seen / spread[:, None]
        error = z - told[:, 0] - told[:, 2]
        back = np.linalg.solve(cov + 1e-9 * np.eye(_STATES), f @ self._cov).swapaxes(1, 2)
        state = told + gain[:, :, None] * error[:, None, :]
        self._cov = cov - spread[:, None, None] * gain[:, :, None] * gain[:, None, :]
        off = (error * error) @ self._member * (self._freedom / white) / spread[:, None]
        self._logs *= math.exp(-dt / FORGETS_S)
        self._logs -= 0.5 * (off + self._freedom * np.log(spread)[:, None])
        gone = off[-1] > ELSEWHERE * self._freedom
        if not self.fixed and gone.any():
            self._logs[:, gone] = 0.0
            self._logs[-1, gone] = 50.0
            there = gone[self.groups]
            state[:, 0, there], state[:, 1, there] = z[there] - state[:, 2, there], 0.0
            told[:, :, there] = state[:, :, there]
        self._weigh()
        self._past.append(_Past(dt, z, state, told, back))
        while sum(p.dt for p in list(self._past)[1:]) > KEPT_S + 1e-6 and len(self._past) > 2:
            self._past.popleft()

    def _begin(self, z: np.ndarray, dt: float, size: float) -> None:
        """From the newest sample on."""
        many = len(self._cutoffs)
        state = np.zeros((many, _STATES, len(z)))
        state[:, 0] = z
        self._cov = np.tile(np.diag([1.0, 100.0, size, size]), (many, 1, 1))
        self._logs = np.zeros((many, self._member.shape[1]))
        self._logs[-1] = 1.0
        self._hz = self.noise.hz
        self._past.clear()
        self._past.append(_Past(dt, z, state, state, np.zeros((many, _STATES, _STATES))))
        self._weigh()

    def _weigh(self) -> None:
        self._logs -= self._logs.max(0)
        weights = np.exp(self._logs)
        self._weights = (weights / weights.sum(0))[:, self.groups]

    def _motion(self, dt: float, size: float) -> tuple[np.ndarray, np.ndarray]:
        """What the models expect in `dt`, `(S, S)`, and what may come of it, `(M, S, S)` by R; time is
        in steps of `RATE`."""
        key = round(dt, 5), self._hz, size
        if self._model is not None and self._model[0] == key:
            return self._model[1], self._model[2]
        a = dt * RATE
        f, q = np.zeros((_STATES, _STATES)), np.zeros((len(self._cutoffs), _STATES, _STATES))
        f[:2, :2] = [[1.0, a], [0.0, 1.0]]
        power = a * (2.0 * np.pi * self._cutoffs / RATE) ** 4
        q[:, :2, :2] = power[:, None, None] * np.array([[a**3 / 3, a**2 / 2], [a**2 / 2, a]])
        if self._hz is not None:
            r, turn = math.exp(-math.pi * WANDER_HZ * dt), 2.0 * math.pi * self._hz * dt
            c, s = r * math.cos(turn), r * math.sin(turn)
            f[2:, 2:] = [[c, -s], [s, c]]
            q[:, 2, 2] = q[:, 3, 3] = (1.0 - r * r) * size
        self._model = key, f, q
        return f, q


def of_points(count: int, cutoff_hz: float | None = None) -> FadingFilter:
    """A filter of the places `(K, 3)` m of points, which is told them one after another, `(3 K)`."""
    weights = np.full(count, 1.0 / math.sqrt(count))
    return FadingFilter(np.repeat(np.arange(count), 3), weights, cutoff_hz=cutoff_hz)
