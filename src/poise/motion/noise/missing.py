"""Noise that loses what is seen, or takes it for something else: dropouts, lost frames, sides, delay.

OpenPose on the four cameras of the Pose2Sim trial gives no confidence to 0.2, 3.2, 5.0 and 7.6 % of its
keypoints, in spells of 1.5 frames at the median and 0.19 s on average at 60 Hz; triangulation of four
cameras loses none. Neither that trial nor Rokoko's video loses a frame or shows exchanged sides: the
shares of those, and the latency, are assumptions. A point that is lost is NaN; a pose, which must be
whole, holds what was last seen.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from poise.motion.noise.kinds import Noise, Points, Pose, spell_mask


@dataclass(frozen=True, kw_only=True)
class Dropouts(Noise):
    """Points are missing for `share` of the time each, in spells of `mean_s` s on average."""

    share: float = 0.04
    mean_s: float = 0.19

    def points(self, track: Points, rng: np.random.Generator) -> Points:
        frames, count, _ = track.pos.shape
        lost = self._lost(rng, frames, count, track.fps)
        return track._replace(pos=np.where(lost[..., None], np.nan, track.pos))

    def pose(self, track: Pose, rng: np.random.Generator) -> Pose:
        frames, joints = track.rot.shape[:2]
        at = last_seen(self._lost(rng, frames, joints, track.fps))
        return track._replace(rot=np.take_along_axis(track.rot, at[..., None], 0))

    def _lost(self, rng: np.random.Generator, frames: int, count: int, fps: float) -> np.ndarray:
        return spell_mask(rng, frames, count, fps, min(self.share * self.strength, 1.0), self.mean_s)


@dataclass(frozen=True, kw_only=True)
class FrameLoss(Noise):
    """Whole frames are missing for `share` of the time, in spells of `mean_s` s on average."""

    share: float = 0.03
    mean_s: float = 0.1

    def points(self, track: Points, rng: np.random.Generator) -> Points:
        lost = self._lost(rng, len(track.pos), track.fps)
        return track._replace(pos=np.where(lost[:, None], np.nan, track.pos))

    def pose(self, track: Pose, rng: np.random.Generator) -> Pose:
        at = last_seen(self._lost(rng, len(track.rot), track.fps))[:, 0]
        return track._replace(root_pos=track.root_pos[at], rot=track.rot[at])

    def _lost(self, rng: np.random.Generator, frames: int, fps: float) -> np.ndarray:
        return spell_mask(rng, frames, 1, fps, min(self.share * self.strength, 1.0), self.mean_s)


@dataclass(frozen=True, kw_only=True)
class SwapSides(Noise):
    """Left is taken for right for `share` of the time, in spells of `mean_s` s, arms and legs apart."""

    share: float = 0.02
    mean_s: float = 0.15

    def points(self, track: Points, rng: np.random.Generator) -> Points:
        return track._replace(pos=self._swapped(track.pos, track, rng))

    def pose(self, track: Pose, rng: np.random.Generator) -> Pose:
        return track._replace(rot=self._swapped(track.rot, track, rng))

    def _swapped(self, values: np.ndarray, track: Points | Pose, rng: np.random.Generator) -> np.ndarray:
        share = min(self.share * self.strength, 1.0)
        wrong = spell_mask(rng, len(values), 2, track.fps, share, self.mean_s)
        out = values.copy()
        for left, right, limb in track.pairs:
            here = wrong[:, 0 if limb == "arm" else 1]
            out[here, left], out[here, right] = values[here, right], values[here, left]
        return out


@dataclass(frozen=True, kw_only=True)
class Latency(Noise):
    """Everything comes `seconds` s late, between frames by interpolation; before, the first frame."""

    seconds: float = 0.1

    def points(self, track: Points, rng: np.random.Generator) -> Points:
        del rng
        return track._replace(pos=self._late(track.pos, track.fps))

    def pose(self, track: Pose, rng: np.random.Generator) -> Pose:
        del rng
        rot = self._late(_hemisphere(track.rot), track.fps)
        rot /= np.linalg.norm(rot, axis=-1, keepdims=True)
        return track._replace(root_pos=self._late(track.root_pos, track.fps), rot=rot)

    def _late(self, values: np.ndarray, fps: float) -> np.ndarray:
        at = np.maximum(np.arange(len(values)) - self.seconds * self.strength * fps, 0.0)
        low = np.floor(at + 1e-9).astype(int)
        high = np.minimum(low + 1, len(values) - 1)
        t = np.clip(at - low, 0.0, 1.0).reshape(-1, *(1,) * (values.ndim - 1))
        # Where it comes on a whole frame the frame behind it must not matter, since it may be missing.
        return np.where(t > 1e-9, values[low] * (1 - t) + values[high] * t, values[low])


def last_seen(lost: np.ndarray) -> np.ndarray:
    """`(T, K)`, the frame that stands in for each: the last one not lost, at the start the first one.

    Where all frames of a column are lost it is frame 0.
    """
    frames = np.arange(len(lost))[:, None]
    at = np.maximum.accumulate(np.where(lost, -1, frames), axis=0)
    first = np.where(lost.all(0), 0, (~lost).argmax(0))
    return np.where(at < 0, first, at)


def _hemisphere(rot: np.ndarray) -> np.ndarray:
    """Rotations `(T, J, 4)` with signs such that neighbours lie on one side."""
    dot = np.sum(rot[1:] * rot[:-1], axis=-1)
    sign = np.cumprod(np.where(dot < 0, -1.0, 1.0), axis=0)
    return np.concatenate((rot[:1], rot[1:] * sign[..., None]))
