"""Poses of a skeleton as they come, smoothed as much as they tremble."""

from __future__ import annotations

from collections import deque
from threading import Lock

import numpy as np

from poise.kin.fading import FadingFilter
from poise.live import quats as q
from poise.live.buffer import leapt
from poise.live.packet import Earlier, Tremble
from poise.live.passage import doublings, world_of
from poise.motion import Skeleton

#: s by which a clock goes back that began anew.
ANEW_S = 2.0


class Steady:
    """The poses of one person, in the order in which they come. One that does not tremble is given back
    as it came."""

    def __init__(self, skeleton: Skeleton):
        self.skeleton = skeleton
        self._fading: FadingFilter | None = None
        self._last = np.zeros((len(skeleton), 4))
        self._root = np.zeros(3)
        self._times = deque[float](maxlen=16)
        self._busy = Lock()

    @property
    def tremble(self) -> Tremble:
        """What the person does now."""
        fading = self._fading
        return Tremble() if fading is None else Tremble(fading.noise.mm, fading.noise.hz, fading.late_s)

    def __call__(
        self, time_s: float, root: np.ndarray, rot: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray] | None:
        """The pose of `time_s` as it is known, None where a newer one came before it."""
        with self._busy:
            times = self._times
            dt = time_s - times[0] if times else 0.0
            if -ANEW_S <= dt <= 0.0 and times:
                return None
            if self._fading is None:
                self._fading = self._begun(rot)
            z = self._channels(root, rot)
            leaps = bool(times) and leapt(self._root, root, dt)
            if leaps or dt < 0.0:
                times.clear()
            times.appendleft(time_s)
            self._root = root
            if leaps:
                self._fading.restart(z)
                return root, rot
            x = self._fading(z, dt)
            return (root, rot) if x is z else (x[-3:], self._rotations(x))

    def before(self) -> list[Earlier]:
        """The poses before it, from the latest on, by all that came since; none if nothing trembles."""
        if self._fading is None:
            return []
        known = zip(list(self._times)[1:], self._fading.before(), strict=False)
        return [Earlier(t, x[-3:], self._rotations(x)) for t, x in known]

    def _channels(self, root: np.ndarray, rot: np.ndarray) -> np.ndarray:
        """`(C)`: rotations, each of the sign of the one before, and the root."""
        flip = (rot * self._last).sum(-1, keepdims=True) < 0
        self._last = np.where(flip, -rot, rot)
        return np.concatenate((self._last.ravel(), root))

    def _rotations(self, x: np.ndarray) -> np.ndarray:
        return q.normalized(x[:-3].reshape(-1, 4))

    def _begun(self, rot: np.ndarray) -> FadingFilter:
        count = len(self.skeleton)
        groups = np.append(np.repeat(np.arange(count), 4), [count] * 3)
        at = self._places(np.append(rot.ravel(), np.zeros(3))[None])[0]
        far = np.zeros((count, count))
        for j in range(count):
            above = j
            while above >= 0:
                far[above, j] = np.linalg.norm(at[j] - at[above])
                above = self.skeleton.parents[above]
        # A turn that errs by a variance v, the sum over its components, moves what is d m away by
        # sqrt(8 v / 3) d.
        weights = np.append(np.sqrt(8.0 / 3.0 * (far**2).mean(1)), 1.0)
        return FadingFilter(groups, weights, self._places)

    def _places(self, channels: np.ndarray) -> np.ndarray:
        """`(T, J, 3)` m of channels `(T, C)`."""
        skeleton = self.skeleton
        rot = channels[:, :-3].reshape(len(channels), -1, 4).swapaxes(0, 1)
        world = world_of(skeleton, rot)
        above = np.maximum(skeleton.parents, 0)
        out = q.rotate(world[above], np.asarray(skeleton.offsets)[:, None])
        out[0] = channels[:, -3:]
        for joints, parents in doublings(tuple(skeleton.parents)):
            out[joints] = out[parents] + out[joints]
        return out.swapaxes(0, 1)
