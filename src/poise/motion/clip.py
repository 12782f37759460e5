"""A motion: one skeleton, one root path, one local rotation per joint and frame."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

from poise.errors import PoiseError
from poise.motion.limits import check_rate
from poise.motion.skeleton import Skeleton
from poise.spatial import forward_kinematics


def _frozen(array: np.ndarray) -> np.ndarray:
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
    """

    skeleton: Skeleton
    root_pos: np.ndarray
    rot: np.ndarray
    fps: float
    name: str = "clip"
    cyclic: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "root_pos", _frozen(self.root_pos))
        object.__setattr__(self, "rot", _frozen(self.rot))
        frames, joints = len(self.root_pos), len(self.skeleton)
        if self.root_pos.shape != (frames, 3) or self.rot.shape != (frames, joints, 4):
            raise PoiseError(
                f"root_pos must be (T, 3) and rot (T, {joints}, 4), got "
                f"{self.root_pos.shape} and {self.rot.shape}",
                self.name,
            )
        if frames < 2:
            raise PoiseError(
                f"the clip has {frames} frame{'' if frames == 1 else 's'}; motion needs at least 2",
                self.name,
            )
        check_rate(self.fps, self.name)
        if not np.isfinite(self.root_pos).all():
            frame = int(np.argwhere(~np.isfinite(self.root_pos))[0][0])
            raise PoiseError(f"the root position is not finite at frame {frame}", self.name)
        norms = np.linalg.norm(self.rot, axis=-1)
        if not np.isfinite(norms).all() or np.abs(norms - 1).max() > 1e-4:
            bad = np.argwhere(~(np.abs(norms - 1) <= 1e-4))[0]
            raise PoiseError(
                f"the rotation of joint '{self.skeleton.names[bad[1]]}' at frame {bad[0]} is not a "
                f"unit quaternion (norm {norms[tuple(bad)]:.4g})",
                self.name,
            )

    @property
    def frames(self) -> int:
        """The number of frames T."""
        return len(self.root_pos)

    @property
    def seconds(self) -> float:
        """Time from the first frame to the last, (T - 1) / fps."""
        return (self.frames - 1) / self.fps

    def tensors(self, dtype: torch.dtype = torch.float64) -> tuple[torch.Tensor, torch.Tensor]:
        """Copies of `root_pos (T, 3)` and `rot (T, J, 4)` as tensors."""
        return torch.tensor(self.root_pos, dtype=dtype), torch.tensor(self.rot, dtype=dtype)

    def world(self) -> tuple[np.ndarray, np.ndarray]:
        """World joint positions `(T, J, 3)` m and rotations `(T, J, 4)` wxyz."""
        pos, quat = forward_kinematics(
            self.skeleton.parents, torch.tensor(self.skeleton.offsets), *self.tensors()
        )
        return pos.numpy(), quat.numpy()

    def positions(self) -> np.ndarray:
        """World joint positions `(T, J, 3)` m."""
        return self.world()[0]

    def replaced(self, **changes: object) -> Clip:
        """A copy with fields replaced."""
        return replace(self, **changes)  # type: ignore[arg-type]
