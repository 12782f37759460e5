"""Faults planted into a clean clip, each at a known place."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from poise.motion import Clip, shifted
from poise.motion.rotations import quat_mul, rotvec_to_quat


def teleport(clip: Clip, frame: int, metres: float = 0.5) -> Clip:
    """The root is `metres` farther along +X from `frame` on."""
    path = np.array(clip.root_pos)
    path[frame:, 0] += metres
    return clip.replaced(root_pos=path)


def excursion(clip: Clip, first: int, last: int, metres: float = 0.5) -> Clip:
    """The root is `metres` beside its path in frames `first` to `last`."""
    path = np.array(clip.root_pos)
    path[first : last + 1, 1] += metres
    return clip.replaced(root_pos=path)


def turned(clip: Clip, joint: str, first: int, last: int, rotvec: tuple[float, float, float]) -> Clip:
    """A joint turned about an axis of its own in frames `first` to `last`."""
    rot, j = clip.rot.copy(), clip.skeleton.index(joint)
    turn = rotvec_to_quat(np.asarray(rotvec, dtype=float))
    rot[first : last + 1, j] = quat_mul(
        rot[first : last + 1, j], np.broadcast_to(turn, (last + 1 - first, 4))
    )
    return clip.replaced(rot=rot)


def drift(clip: Clip, speed: float) -> Clip:
    """The root drifts along +Y at `speed` m/s, so that all standing feet slide."""
    seconds = np.arange(clip.frames) / clip.fps
    return shifted(clip, seconds[:, None] * np.array([0.0, speed, 0.0]))


def lifted(clip: Clip, metres: float) -> Clip:
    """The whole clip higher."""
    return shifted(clip, (0.0, 0.0, metres))


def shaken(clip: Clip, joint: str, first: int, last: int, degrees: float, seed: int = 0) -> Clip:
    """White noise of `degrees` per axis on one joint's rotation in frames `first` to `last`."""
    rng = np.random.default_rng(seed)
    rot, j = clip.rot.copy(), clip.skeleton.index(joint)
    noise = rng.normal(0.0, np.radians(degrees), (last + 1 - first, 3))
    rot[first : last + 1, j] = quat_mul(rot[first : last + 1, j], rotvec_to_quat(noise))
    return clip.replaced(rot=rot)


def repeated(clip: Clip, frame: int, count: int) -> Clip:
    """Frame `frame` put in `count` times more."""
    pick = np.r_[0 : frame + 1, [frame] * count, frame + 1 : clip.frames]
    return clip.replaced(root_pos=clip.root_pos[pick], rot=clip.rot[pick])


def frozen(clip: Clip, frame: int, count: int) -> Clip:
    """The `count` frames after `frame` replaced by it."""
    pick = np.arange(clip.frames)
    pick[frame + 1 : frame + 1 + count] = frame
    return clip.replaced(root_pos=clip.root_pos[pick], rot=clip.rot[pick])


def cut(clip: Clip, frame: int, count: int) -> Clip:
    """`count` frames from `frame` on taken out."""
    pick = np.r_[0:frame, frame + count : clip.frames]
    return clip.replaced(root_pos=clip.root_pos[pick], rot=clip.rot[pick])


def exchanged(clip: Clip) -> Clip:
    """The names of left and right exchanged."""
    twin = {"Left": "Right", "Right": "Left", "l": "r", "r": "l"}

    def other(name: str) -> str:
        for word in ("Left", "Right"):
            if name.startswith(word):
                return twin[word] + name[len(word) :]
        swapped = twin.get(name[0], "") + name[1:]
        return swapped if swapped in clip.skeleton.names else name

    names = tuple(other(n) for n in clip.skeleton.names)
    return clip.replaced(skeleton=replace(clip.skeleton, names=names))
