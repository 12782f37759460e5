"""A motion: one skeleton, one root path, one local rotation per joint and frame; and its edits."""

# pyright: reportMissingTypeStubs=false, reportUnknownVariableType=false
from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, wraps
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from poise.errors import PoiseError
from poise.motion.rotations import slerp
from poise.motion.skeleton import Skeleton
from poise.motion.vectors import norm

if TYPE_CHECKING:
    from torch import Tensor

T = TypeVar("T")
MIN_FPS, MAX_FPS = 0.1, 2000.0
"""Frames per second that motion can have; others are damage, and ask for endless frames."""
MAX_POSES = 20_000_000
"""Frames times joints of the longest motion that is read (22 joints at 120 Hz: two hours)."""


def check_rate(fps: float, where: str | Path | None = None) -> None:
    """Refuses a frame rate that no motion has, NaN and 0 too."""
    if not MIN_FPS <= fps <= MAX_FPS:
        raise PoiseError(
            f"the frame rate must be from {MIN_FPS:g} to {MAX_FPS:g} per second, got {fps:.6g}",
            where,
            "State the right one with --fps F" if isinstance(where, Path) else None,
            code="rate-out-of-range",
        )


def check_frames(frames: int, where: str | Path | None = None) -> None:
    """Refuses a clip of less than two frames, which shows no motion."""
    if frames < 2:
        plural = "" if frames == 1 else "s"
        raise PoiseError(
            f"the clip has {frames} frame{plural}; motion needs at least 2", where, code="clip-too-short"
        )


def check_poses(frames: int, joints: int, where: str | Path | None = None) -> None:
    """Refuses motion that is too long to be held in memory several times over."""
    if frames * joints > MAX_POSES:
        raise PoiseError(
            f"it has {frames} frames of {joints} joints, more than the {MAX_POSES} poses that are read",
            where,
            "Cut it shorter, or state a lower rate with --fps F",
            code="clip-too-long",
        )


def _frozen(array: np.ndarray) -> np.ndarray:
    own = type(array) is np.ndarray and array.dtype == np.float64 and array.base is None
    if own and not array.flags.writeable:
        # It cannot be changed: clips share it, since an hour of motion is large.
        return array
    out = np.array(array, dtype=np.float64)
    out.flags.writeable = False
    return out


@dataclass(frozen=True, eq=False)
class Clip:
    """A frozen motion clip; metres, Z up, right-handed.

    root_pos: `(T, 3)` m, world position of the root joint.
    rot: `(T, J, 4)` wxyz, each joint's rotation in its parent's frame (the root's in the world).
    fps: frames per second.
    name: a short name, usually the file's stem. cyclic: the end joins the start (DeepMimic `wrap`).
    contacts: foot joints with `(T, 2)` bool, when heel and toe touch the floor, where a file says so; a
        clip with other frames has none.
    """

    skeleton: Skeleton
    root_pos: np.ndarray
    rot: np.ndarray
    fps: float
    name: str = "clip"
    cyclic: bool = False
    contacts: tuple[tuple[int, np.ndarray], ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "root_pos", _frozen(self.root_pos))
        object.__setattr__(self, "rot", _frozen(self.rot))
        frames, joints = len(self.root_pos), len(self.skeleton)
        if self.root_pos.shape != (frames, 3) or self.rot.shape != (frames, joints, 4):
            raise PoiseError(
                f"root_pos must be (T, 3) and rot (T, {joints}, 4), got "
                f"{self.root_pos.shape} and {self.rot.shape}",
                self.name,
                code="wrong-shape",
            )
        check_frames(frames, self.name)
        check_rate(self.fps, self.name)
        if any(touch.shape != (frames, 2) for _, touch in self.contacts):
            object.__setattr__(self, "contacts", ())
        if not np.isfinite(self.root_pos).all():
            frame = int(np.argwhere(~np.isfinite(self.root_pos))[0][0])
            raise PoiseError(
                f"the root position is not finite at frame {frame}", self.name, code="not-finite"
            )
        norms = norm(self.rot)
        if not np.isfinite(norms).all() or np.abs(norms - 1).max() > 1e-4:
            bad = np.argwhere(~(np.abs(norms - 1) <= 1e-4))[0]
            raise PoiseError(
                f"the rotation of joint '{self.skeleton.names[bad[1]]}' at frame {bad[0]} is not a "
                f"unit quaternion (norm {norms[tuple(bad)]:.4g})",
                self.name,
                code="not-a-rotation",
            )

    @property
    def frames(self) -> int:
        """The number of frames T."""
        return len(self.root_pos)

    @property
    def seconds(self) -> float:
        """Time from the first frame to the last, (T - 1) / fps."""
        return (self.frames - 1) / self.fps

    def arrays(self) -> tuple[np.ndarray, np.ndarray]:
        """Copies of `root_pos (T, 3)` and `rot (T, J, 4)`, which may be written on."""
        return self.root_pos.copy(), self.rot.copy()

    def tensors(self, dtype: Any = None) -> tuple[Tensor, Tensor]:
        """Copies of `root_pos (T, 3)` and `rot (T, J, 4)` as tensors, by default float64."""
        import torch

        root_pos, rot = torch.tensor(self.root_pos), torch.tensor(self.rot)
        return root_pos.to(dtype or root_pos.dtype), rot.to(dtype or rot.dtype)

    def world(self) -> tuple[np.ndarray, np.ndarray]:
        """World joint positions `(T, J, 3)` m and rotations `(T, J, 4)` wxyz, not to be written on."""
        return _world(self)

    def positions(self) -> np.ndarray:
        """World joint positions `(T, J, 3)` m."""
        return self.world()[0]

    def replaced(self, **changes: object) -> Clip:
        """A copy with fields replaced."""
        return replace(self, **changes)  # type: ignore[arg-type]


#: Numbers of a clip's rotations up to which what is told of it is kept: a minute or two.
_KEPT = 2**22


def remembered(told: Callable[[Clip], T]) -> Callable[[Clip], T]:
    """A function of a clip that keeps its last few answers: one motion is asked the same again and
    again. Long clips are not kept, since each would stay in memory with what is told of it."""
    few = lru_cache(maxsize=4)(told)

    @wraps(told)
    def ask(clip: Clip) -> T:
        return few(clip) if clip.rot.size <= _KEPT else told(clip)

    return ask


@remembered
def _world(clip: Clip) -> tuple[np.ndarray, np.ndarray]:
    pos, rot = clip.skeleton.forward(clip.root_pos, clip.rot)
    pos.flags.writeable = rot.flags.writeable = False
    return pos, rot


@dataclass(frozen=True)
class ClipLibrary:
    """Clips of one hierarchy, sampled by time.

    clips: at least one clip; all share joint names and parents (bone lengths may differ).
    weights: `(C,)` sampling weights; by default each clip counts by its duration.
    """

    clips: tuple[Clip, ...]
    weights: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if not self.clips:
            raise PoiseError("a library needs at least one clip", code="no-clips")
        first = self.clips[0].skeleton
        for clip in self.clips[1:]:
            if clip.skeleton.names != first.names or clip.skeleton.parents != first.parents:
                raise PoiseError(
                    f"its joints differ from those of '{self.clips[0].name}'",
                    clip.name,
                    "Give one library clips of one hierarchy",
                    code="skeleton-differs",
                )
        if not self.weights:
            object.__setattr__(self, "weights", tuple(c.seconds for c in self.clips))
        if len(self.weights) != len(self.clips) or min(self.weights) < 0 or sum(self.weights) <= 0:
            raise PoiseError(
                f"a library of {len(self.clips)} clips needs as many weights, none negative and not "
                f"all zero, got {self.weights}",
                code="bad-weights",
            )

    @classmethod
    def of(cls, clips: Clip | Sequence[Clip]) -> ClipLibrary:
        """A library from one clip or several."""
        return cls((clips,) if isinstance(clips, Clip) else tuple(clips))

    def __len__(self) -> int:
        return len(self.clips)

    def __iter__(self) -> Iterator[Clip]:
        return iter(self.clips)

    @property
    def names(self) -> tuple[str, ...]:
        """The clips' names in order."""
        return tuple(c.name for c in self.clips)

    @property
    def seconds(self) -> float:
        """Total duration in seconds."""
        return sum(c.seconds for c in self.clips)

    def sample(self, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """`count` draws of (clip index, time in s), clips by weight, times uniform in the clip."""
        p = np.asarray(self.weights) / sum(self.weights)
        which = rng.choice(len(self.clips), size=count, p=p)
        lengths = np.array([c.seconds for c in self.clips])
        return which, rng.uniform(0.0, 1.0, count) * lengths[which]


#: m/s of the root above which a motion leaps.
LEAPS = 12.0


def resample(clip: Clip, fps: float, smooth: bool = False) -> Clip:
    """The clip at another frame rate: positions linear, rotations by slerp, the duration kept.

    The last sample falls on or before the clip's last frame (within a hundredth of a frame, since
    files round their frame times).

    Args:
        smooth: to a higher rate by cubic splines through all frames, accelerations without steps, for
            motion that is known to be smooth. Straight lines have a corner at each frame, which is a
            jerk many times the motion's own. Where the root leaps lines stay straight; other leaps ring.
    """
    check_rate(fps, clip.name)
    count = int(np.floor(clip.seconds * fps + 1e-2)) + 1
    if count < 2:
        raise PoiseError(
            f"the clip lasts {clip.seconds:.3f} s, less than one frame at {fps:g} fps",
            clip.name,
            code="clip-too-short",
        )
    at = np.minimum(np.arange(count) / fps * clip.fps, clip.frames - 1)
    low = np.minimum(np.floor(at + 1e-9).astype(int), clip.frames - 2)
    t = np.clip(at - low, 0.0, 1.0)
    out = blended(clip, low, t)
    if smooth and fps > clip.fps:
        out = _splined(clip, at, out)
    return out.replaced(fps=float(fps))


def _splined(clip: Clip, at: np.ndarray, straight: Clip) -> Clip:
    """Frames `at (N)`, which lie between those of the clip, by cubic splines: q(t) / |q(t)| for
    rotations, each frame's quaternion on the side of the one before. Where the root leaps, as where a
    character was put back, one spline ends and the next begins; `straight` is what lies between them."""
    from scipy.interpolate import CubicSpline

    rot, root_pos, turned = clip.rot.copy(), straight.root_pos.copy(), straight.rot.copy()
    flips = (rot[1:] * rot[:-1]).sum(-1) < 0
    rot[1:][np.cumsum(flips, 0) % 2 == 1] *= -1.0
    speed = np.linalg.norm(np.diff(clip.root_pos, axis=0), axis=-1) * clip.fps
    ends = [0, *(np.flatnonzero(speed > LEAPS) + 1).tolist(), clip.frames]
    for first, end in pairwise(ends):
        here = (at >= first) & (at <= end - 1)
        if end - first < 4 or not here.any():
            continue
        every = np.arange(first, end)
        root_pos[here] = CubicSpline(every, clip.root_pos[first:end])(at[here])
        smooth = CubicSpline(every, rot[first:end])(at[here])
        turned[here] = smooth / np.linalg.norm(smooth, axis=-1, keepdims=True)
    return straight.replaced(root_pos=root_pos, rot=turned)


def blended(clip: Clip, low: np.ndarray, share: np.ndarray) -> Clip:
    """Frames `(N)`, each the share `(N)` of the way from frame `low (N)` to the next one."""
    root_pos = clip.root_pos[low] * (1 - share[:, None]) + clip.root_pos[low + 1] * share[:, None]
    rot = slerp(clip.rot[low], clip.rot[low + 1], share[:, None])
    return clip.replaced(root_pos=root_pos, rot=rot)


def trim(clip: Clip, start: int, stop: int | None = None) -> Clip:
    """Frames `start` up to but not including `stop`."""
    contacts = tuple((j, touch[start:stop]) for j, touch in clip.contacts)
    cut = {"root_pos": clip.root_pos[start:stop], "rot": clip.rot[start:stop], "contacts": contacts}
    return clip.replaced(**cut, cyclic=False)


def shifted(clip: Clip, offset: np.ndarray | tuple[float, float, float]) -> Clip:
    """The clip moved by `offset` m, one vector `(3,)` or one per frame `(T, 3)`."""
    return clip.replaced(root_pos=clip.root_pos + np.asarray(offset, dtype=float))


def ground_shift(clip: Clip, height: float) -> Clip:
    """The clip lifted by `height` m along +Z."""
    return shifted(clip, (0.0, 0.0, height))


def backwards(clip: Clip) -> Clip:
    """The clip from its last frame to its first.

    Accelerations, and with them the forces of muscles and floor, are the same at every pose, so that a
    motion that can be done can be done backwards; only what hits the floor hard cannot.
    """
    contacts = tuple((j, touch[::-1]) for j, touch in clip.contacts)
    return clip.replaced(root_pos=clip.root_pos[::-1], rot=clip.rot[::-1], contacts=contacts)
