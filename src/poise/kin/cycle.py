"""Cyclic clips: the end made to meet the start, and what one cycle adds."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from poise.kin.coords import qpos_velocity
from poise.spatial import (
    heading_quat,
    quat_between,
    quat_conj,
    quat_mul,
    quat_rotate,
    quat_to_rotvec,
    rotvec_to_quat,
)

#: Angle (rad) between a hinge's first and last frame beyond which a clip is no cycle: a whole turn that
#: joint targets cannot carry on, or a gap so wide that closing it would be another motion.
OPEN = math.pi / 2


@dataclass(frozen=True)
class Cycle:
    """How the end of a cyclic clip met its start.

    gap_deg: the largest angle, of a hinge or of the root's tilt, by which it did not close.
    open_hinge: a hinge that ends more than `OPEN` from where it began; such a clip is played once.
    sunk_m: how far closing it would have pushed the body into the floor, where that was too much; such a
    clip is played once as well.
    """

    gap_deg: float
    open_hinge: str | None = None
    sunk_m: float = 0.0

    @property
    def closed(self) -> bool:
        """Whether the motion goes on from its end to its start."""
        return self.open_hinge is None and self.sunk_m == 0.0

    def sentence(self) -> str:
        """The cycle in words."""
        if self.open_hinge is not None:
            return (
                f"Not repeated, though its file calls it cyclic: {self.open_hinge} ends "
                f"{self.gap_deg:.0f} degrees from where it began."
            )
        if self.sunk_m:
            return (
                f"Not repeated, though its file calls it cyclic: closing a gap of {self.gap_deg:.0f} "
                f"degrees would push it {self.sunk_m * 100:.0f} cm into the floor."
            )
        return f"The cycle did not close by {self.gap_deg:.1f} degrees; the gap was spread over it."


def join_cycle(qpos: np.ndarray, hinges: Sequence[str]) -> tuple[np.ndarray, Cycle]:
    """`close_cycle` where every hinge comes back, else the motion as it is; and what was found.

    Args:
        qpos: `(T, 7 + n)`. hinges: n names.
    """
    apart = np.abs(qpos[-1, 7:] - qpos[0, 7:])
    if len(apart) and apart.max() > OPEN:
        worst = int(apart.argmax())
        return qpos, Cycle(math.degrees(float(apart[worst])), hinges[worst])
    closed, gap_deg = close_cycle(qpos)
    return closed, Cycle(gap_deg)


def close_cycle(qpos: np.ndarray) -> tuple[np.ndarray, float]:
    """A cycle `qpos (T, 7 + n)`, closed: its last frame is its first one cycle later; gap in degrees.

    Frame i takes the share s = i / (T - 1) of the gap: hinges modulo 2 pi, the root's height, and its
    tilt, the orientation without heading. What a cycle adds, heading and horizontal travel, stays. The
    gap is the largest of the hinges' and the tilt's.
    """
    out = np.array(qpos, dtype=np.float64)
    share = np.linspace(0.0, 1.0, len(out))[:, None]
    out[:, 2:3] -= share * (out[-1, 2] - out[0, 2])
    gap = out[-1, 7:] - out[0, 7:]
    gap -= 2 * math.pi * np.round(gap / (2 * math.pi))
    out[:, 7:] -= share * gap
    root = torch.tensor(out[:, 3:7])
    ends = root[[0, -1]]
    first, last = quat_between(heading_quat(ends), ends)
    # R_i' = R_i exp(s log(tilt_last^-1 tilt_first)) ends on heading_last tilt_first.
    lean = quat_to_rotvec(quat_between(last, first))
    out[:, 3:7] = quat_mul(root, rotvec_to_quat(torch.tensor(share) * lean)).numpy()
    widest = max(float(np.abs(gap).max(initial=0.0)), float(lean.norm()))
    return out, math.degrees(widest)


def cycle_step(qpos: np.ndarray) -> tuple[Tensor, Tensor]:
    """What one cycle adds: a turn about Z (wxyz), then a horizontal travel (m)."""
    first, last = torch.tensor(qpos[0]), torch.tensor(qpos[-1])
    turn = quat_mul(heading_quat(last[3:7]), quat_conj(heading_quat(first[3:7])))
    travel = last[:3] - quat_rotate(turn, first[:3])
    travel[2] = 0.0
    return turn, travel


def cycle_velocity(qpos: np.ndarray, fps: float) -> np.ndarray:
    """`qpos_velocity` of a closed cycle: the differences at its ends reach across the seam."""
    turn, travel = cycle_step(qpos)
    ahead, behind = torch.tensor(qpos[1]), torch.tensor(qpos[-2])
    ahead[:3] = quat_rotate(turn, ahead[:3]) + travel
    ahead[3:7] = quat_mul(turn, ahead[3:7])
    behind[:3] = quat_rotate(quat_conj(turn), behind[:3] - travel)
    behind[3:7] = quat_between(turn, behind[3:7])
    return qpos_velocity(np.vstack((behind.numpy(), qpos, ahead.numpy())), fps)[1:-1]
