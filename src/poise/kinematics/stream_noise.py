"""A stream smoothed as much as it trembles, which its last seconds tell."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from poise.motion.smoothing import ABOVE, HIGHEST_HZ, QUIETEST, TREMBLES, WHITE_HZ, WHITE_MM

#: Samples a second that are measured about; least s between two of them; s of gaps that are bridged.
RATE, APART_S, BRIDGED_S = 30.0, 0.7 / 30.0, 0.3
#: Order of differences, samples of which their median is, and the fewest.
ORDER, SAMPLES, FEWEST = 6, 75, 20
#: The median of a square of three normal components, by its mean.
MEDIAN = 0.789
#: Samples by which places tell how much of the noise is the body's, and after how many they do again.
ASKED, AGAIN = 48, 75
#: Share of `WHITE_MM` below which a stream that trembled does no more.
CALMS = 0.7
#: Samples of a spectrum in which a tremble is looked for, how often that is, and looks in vain until it
#: is gone; mixtures of all channels that are looked at.
LONG, EVERY, PATIENCE, MIXED = 128, 12, 4, 12
#: The slowest tremble (Hz) that is told from motion in so short a time; mm that it has at least.
SLOWEST_HZ, LEAST_MM = 2.5, 2.0
#: How far a tremble stands out of the octaves below and above in all mixtures but this share, for the
#: channels to be asked.
MAY, MOST = (0.25, 2.0), 0.4
#: Peaks that are looked at, those with the fastest motion.
FEW = 6


#: What white noise of variance 1 makes of the median square of a difference.
_THROUGH = math.comb(2 * ORDER, ORDER) * MEDIAN
#: Channels of some samples to places of joints.
Places = Callable[[np.ndarray], np.ndarray]


class StreamNoise:
    """Measures the noise of channels `(C)` sample by sample: white noise, a tremble of one frequency.

    White noise is what high differences are made of: those of order k of white noise of variance s^2
    have (2k choose k) s^2, while motion all but vanishes in them. Medians over time leave out its
    bursts. A tremble stands out of the octaves below and above it.

    Args:
        groups: `(C)` from 0 on, channels that move together, as those of a joint.
        weights: `(G)` m by which the whole body's joints are off (rms) for an error of 1 in a group,
            where groups err by themselves.
        places: `(T, C)` to the places `(T, K, 3)` m of joints. With it the body's white noise is theirs,
            since in a captured chain the error of a joint undoes that of the one above.

    Attributes:
        white: `(G)` variance of the white noise, the sum over a group's channels.
        tone: `(G)` that of the tremble.
        hz: its frequency, None without one.
        mm: rms over joints of all noise, 0 while the stream does not tremble.
    """

    def __init__(self, groups: np.ndarray, weights: np.ndarray, places: Places | None = None):
        count = int(groups.max()) + 1
        self.member = np.zeros((len(groups), count))
        self.member[np.arange(len(groups)), groups] = 1.0
        self.white, self.tone, self.hz, self.mm = np.zeros(count), np.zeros(count), None, 0.0
        self.hz: float | None
        self._square = np.asarray(weights) ** 2
        mixing = np.random.default_rng(0).normal(size=(len(groups), MIXED))
        self._mixing = mixing
        self._row = np.array([(-1.0) ** k * math.comb(ORDER, k) for k in range(ORDER + 1)])
        self._white_on, self._vain = False, 0
        self._lasts = deque[np.ndarray](maxlen=ORDER + 1)
        self._places, self._share, self._asks = places, 1.0, 0
        self._kept = deque[np.ndarray](maxlen=ASKED if places is not None else 0)
        self._squares = np.zeros((SAMPLES, count))
        self._steps = np.zeros((LONG, len(groups)))
        self._dts = deque[float](maxlen=LONG)
        self._last: np.ndarray | None = None
        self._since, self._seen, self._count, self._usual = 0.0, 0, 0, 0.0
        self._suspect: float | None = None
        self._phase = 0

    @property
    def trembles(self) -> bool:
        """Whether there is anything to be smoothed."""
        return self._white_on or self.hz is not None

    def __call__(self, z: np.ndarray, dt: float) -> None:
        """One more sample."""
        self._since += dt
        if self._last is None:
            self._last, self._since = z, 0.0
            # So that streams which begin together are not all looked at in one step.
            self._phase = int(1e6 * float(np.abs(z).sum())) % EVERY
            return
        if self._since < APART_S:
            return
        usual = self._usual or self._since
        count = max(1, min(round(self._since / usual), math.ceil(BRIDGED_S / usual)))
        step = (z - self._last) / count
        for k in range(1, count + 1):
            self._take(self._last + k * step if k < count else z, step)
        self._dts.append(self._since / count if self._since < BRIDGED_S else usual)
        if self._count % 16 == 5 or self._count < 5:
            self._usual = float(np.median(self._dts))
        self._last, self._since = z, 0.0

    def elsewhere(self, z: np.ndarray) -> None:
        """The stream goes on from `z`, from where it did not move to."""
        self._last, self._since = z, 0.0
        self._lasts.clear()
        self._kept.clear()

    def _take(self, z: np.ndarray, step: np.ndarray) -> None:
        self._count += 1
        self._steps[self._count % LONG] = step
        self._lasts.append(z)
        self._kept.append(z)
        if len(self._lasts) > ORDER:
            rough = self._row @ np.array(self._lasts)
            self._squares[self._seen % SAMPLES] = (rough * rough) @ self.member
            self._seen += 1
        # One thing in a sample, since each takes its time.
        turn = (self._count + self._phase) % EVERY
        if turn % 6 == 1 and self._seen >= FEWEST:
            self._level()
        elif turn == 3 and self._count >= LONG // 2:
            self._suspect = self._suspected()
        elif turn == 4 and self._count >= LONG // 2:
            self._judge(self._suspect)

    def _level(self) -> None:
        rate = 1.0 / self._usual
        if 0.35 * rate < WHITE_HZ:
            self._white_on, self.white[:] = False, 0.0
            return
        white = np.median(self._squares[: min(self._seen, SAMPLES)], axis=0) / _THROUGH
        if self.hz is not None:
            through = (2.0 * math.sin(math.pi * self.hz / rate)) ** (2 * ORDER)
            white = np.maximum(white - MEDIAN * self.tone * through / _THROUGH, 0.0)
        self.white = white
        size = 1e3 * math.sqrt(float(self._square @ white))
        if size >= WHITE_MM and self._places is not None:
            size *= self._of_places(self._places)
        self._white_on = size >= (CALMS * WHITE_MM if self._white_on else WHITE_MM)
        self._sum()

    def _of_places(self, places: Places) -> float:
        """The noise of places by that of groups which err by themselves."""
        if self._seen >= self._asks and len(self._kept) > ORDER + 1:
            self._asks = self._seen + AGAIN
            kept = np.array(self._kept)
            rough = np.diff(kept, n=ORDER, axis=0) ** 2 @ self.member
            alone = float(self._square @ np.median(rough, axis=0))
            there = (np.diff(places(kept), n=ORDER, axis=0) ** 2).sum(-1)
            self._share = math.sqrt(float(np.median(there, axis=0).mean()) / alone)
        return self._share

    def _sum(self) -> None:
        if not self.trembles:
            self.mm = 0.0
            return
        variance = self._share**2 * self.white + self.tone
        self.mm = 1e3 * math.sqrt(float(self._square @ variance))

    def _lately(self) -> tuple[np.ndarray, np.ndarray]:
        """The last steps `(T, C)`, and a window on them."""
        many = min(self._count, LONG)
        steps = np.concatenate(
            (self._steps[self._count % LONG + 1 :], self._steps[: self._count % LONG + 1])
        )
        return steps[-many:], np.hanning(many + 2)[1:-1, None]

    def _suspected(self) -> float | None:
        """Hz of what may be a tremble, by mixtures of all channels."""
        steps, window = self._lately()
        size = np.sqrt(np.einsum("tc,tc->c", steps, steps))
        mixed = steps @ (self._mixing / np.where(size > 1e-5 * size.max(), size, np.inf)[:, None])
        hz, power = _spectrum(mixed * window, 1.0 / self._usual)
        at = _clearest(hz, power, 1.0 / self._usual, len(steps))
        return None if at is None else _peak(hz, power, at)

    def _judge(self, found: float | None) -> None:
        """Looks whether most channels have a tremble at `found` Hz, and how large it is."""
        if found is not None:
            steps, window = self._lately()
            rate, many = 1.0 / self._usual, len(steps)
            size = np.abs(steps).max(0)
            hz, power = _spectrum(steps[:, size > 1e-5 * size.max()] * window, rate)
            if _clear(hz, power, int(np.abs(hz - found).argmin()), many) >= 1.0:
                at = found + 2.6 * rate / many * np.array([-1.0, 0.0, 1.0])
                wave = np.exp(-2j * np.pi * at[:, None] * np.arange(many) / rate) * window[:, 0]
                tone = 2.0 * np.abs(wave @ steps) ** 2 / window.sum() ** 2
                tone /= (2.0 * np.sin(np.pi * at / rate)[:, None]) ** 2
                tone = np.maximum(tone[1] - 0.5 * (tone[0] + tone[2]), 0.0) @ self.member
                if 1e6 * float(self._square @ tone) >= LEAST_MM**2:
                    self._vain, self.hz, self.tone = 0, found, tone
                    self._sum()
                    return
        self._vain += 1
        if self._vain >= PATIENCE:
            self.hz, self.tone = None, np.zeros_like(self.tone)
            self._sum()


def _spectrum(steps: np.ndarray, rate: float) -> tuple[np.ndarray, np.ndarray]:
    """Hz `(F)`, and the power `(F, N)` of what makes such `steps (T, N)`."""
    hz = np.fft.rfftfreq(2 * LONG, 1.0 / rate)[1:]
    power = np.abs(np.fft.rfft(steps, 2 * LONG, axis=0)[1:]) ** 2
    return hz, power / (2.0 * np.sin(np.pi * hz[:, None] / rate)) ** 2


def _octaves(hz: np.ndarray, k: int, many: int) -> tuple[slice, slice] | None:
    """The bins of the octave below the peak at `hz[k]` and of that above, None where there are none."""
    gap = max(2.0 * hz[0] * 2 * LONG / many, 0.12 * hz[k])
    # Bins are hz[0] apart, from hz[0] on.
    edges = np.array([hz[k] / 2.2, hz[k] - gap, hz[k] + gap, 2.3 * hz[k]]) / hz[0] - 1.0
    a, b, c, d = np.ceil(edges).astype(int)
    return None if b <= a or c >= min(d, len(hz)) else (slice(a, b), slice(c, d))


def _clear(hz: np.ndarray, power: np.ndarray, k: int, many: int) -> float:
    """How far the peak at `hz[k]` stands out in the quietest channels, 1 for what is a tremble."""
    octaves = _octaves(hz, k, many)
    if octaves is None:
        return 0.0
    peak = np.quantile(power[k - 1 : k + 2].max(0), QUIETEST)
    over, under = (
        peak / (np.quantile(power[span], QUIETEST, axis=1).max(1) + 1e-300) for span in octaves
    )
    starts, limits = np.array(TREMBLES).T
    limit = limits[np.searchsorted(starts, hz[k] + 1e-9) - 1]
    return float((np.minimum(over, under / ABOVE) / limit).max())


def _clearest(hz: np.ndarray, power: np.ndarray, rate: float, many: int) -> int | None:
    """Index of the peak of mixtures `power (F, N)` that stands out most; None where none may be a
    tremble."""
    whole = power.sum(1)
    top = (hz >= SLOWEST_HZ) & (hz <= min(HIGHEST_HZ, 0.42 * rate))
    peaks = np.flatnonzero(top[1:-1]) + 1
    peaks = peaks[(whole[peaks] > whole[peaks - 1]) & (whole[peaks] > whole[peaks + 1])]
    peaks = peaks[np.argsort(-whole[peaks] * hz[peaks] ** 2)[:FEW]]
    best: tuple[float, int | None] = (1.0, None)
    for k in peaks:
        octaves = _octaves(hz, int(k), many)
        if octaves is None:
            continue
        peak = power[k - 1 : k + 2].max(0)
        clear = min(
            float(np.quantile(peak / (power[span].max(0) + 1e-300), MOST)) / may
            for span, may in zip(octaves, MAY, strict=True)
        )
        best = max(best, (clear, int(k)), key=lambda found: found[0])
    return best[1]


def _peak(hz: np.ndarray, power: np.ndarray, k: int) -> float:
    """Hz of the peak at `hz[k]`, between the bins."""
    left, here, right = np.log(power[k - 1 : k + 2]).mean(1)
    bend = left - 2 * here + right
    return float(hz[k] + (0.5 * (left - right) / bend if bend < 0 else 0.0) * (hz[1] - hz[0]))


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
    """Smooths channels `(C)` sample by sample, from their past alone.

        fading = FadingFilter(groups, weights)
        x = fading(z, dt)            # the newest sample as it is now known
        earlier = fading.before()    # the samples before it, by all that has come since

    A channel is z = x + n + e: motion x, a tremble n of one frequency, white noise e of variance R. x
    moves on by its velocity, driven by white noise of power R dt (2 pi c)^4. Kalman filters of several c
    (Hz) run side by side; a group takes their mean, each weighted by how likely it made the group's last
    samples (Magill 1965, with a memory that fades):

        log w <- e^(-dt / tau) log w - |z - H x'|^2 / (2 R S) - d / 2 log S.

    The samples before the newest are those of a Rauch-Tung-Striebel smoother.

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
