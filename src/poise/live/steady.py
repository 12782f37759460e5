"""Poses of a skeleton as they come, smoothed as much as they tremble."""

from __future__ import annotations

import numpy as np

from poise.kin.fading import FadingFilter, Tremble
from poise.live import quats as q
from poise.live.passage import doublings, world_of
from poise.motion import Skeleton

#: A root `(3)` m and local rotations `(J, 4)`.
Pose = tuple[np.ndarray, np.ndarray]


class Steady:
    """The poses of one person. A pose that does not tremble is given back as it came."""

    def __init__(self, skeleton: Skeleton):
        self._skeleton, self._fading = skeleton, None
        self._fading: FadingFilter | None
        self._last = np.zeros((len(skeleton), 4))

    @property
    def tremble(self) -> Tremble:
        """What the person does now."""
        return Tremble() if self._fading is None else self._fading.tremble

    def __call__(self, root: np.ndarray, rot: np.ndarray, dt: float) -> Pose:
        """The newest pose, `dt` s after the one before."""
        if self._fading is None:
            self._fading = self._begun(rot)
        z = self._channels(root, rot)
        x = self._fading(z, dt)
        return (root, rot) if x is z else self._pose(x)

    def before(self) -> list[Pose]:
        """The poses before it, from the latest on, by all that came since; none where nothing trembles."""
        return [] if self._fading is None else [self._pose(x) for x in self._fading.before()]

    def restart(self, root: np.ndarray, rot: np.ndarray) -> None:
        """The person is elsewhere."""
        if self._fading is not None:
            self._fading.restart(self._channels(root, rot))

    def _channels(self, root: np.ndarray, rot: np.ndarray) -> np.ndarray:
        """`(C)`: rotations, each of the sign of the one before, and the root."""
        flip = (rot * self._last).sum(-1, keepdims=True) < 0
        self._last = np.where(flip, -rot, rot)
        return np.concatenate((self._last.ravel(), root))

    def _pose(self, x: np.ndarray) -> Pose:
        return x[-3:], q.normalized(x[:-3].reshape(-1, 4))

    def _begun(self, rot: np.ndarray) -> FadingFilter:
        count = len(self._skeleton)
        groups = np.append(np.repeat(np.arange(count), 4), [count] * 3)
        at = self._places(np.append(rot.ravel(), np.zeros(3))[None])[0]
        far = np.zeros((count, count))
        for j in range(count):
            above = j
            while above >= 0:
                far[above, j] = np.linalg.norm(at[j] - at[above])
                above = self._skeleton.parents[above]
        # A turn whose components err by a variance v together moves what is d m away by sqrt(8 v / 3) d.
        weights = np.append(np.sqrt(8.0 / 3.0 * (far**2).mean(1)), 1.0)
        return FadingFilter(groups, weights, self._places)

    def _places(self, channels: np.ndarray) -> np.ndarray:
        """`(T, J, 3)` m of channels `(T, C)`."""
        skeleton = self._skeleton
        rot = channels[:, :-3].reshape(len(channels), -1, 4).swapaxes(0, 1)
        world = world_of(skeleton, rot)
        above = np.maximum(skeleton.parents, 0)
        out = q.rotate(world[above], np.asarray(skeleton.offsets)[:, None])
        out[0] = channels[:, -3:]
        for joints, parents in doublings(tuple(skeleton.parents)):
            out[joints] = out[parents] + out[joints]
        return out.swapaxes(0, 1)
