"""The pose at ease, of which the key poses of scenes' motions are made."""

# pyright: reportUnknownMemberType=false, reportUnknownArgumentType=false
# pyright: reportUnknownVariableType=false
from __future__ import annotations

import numpy as np
import torch

from poise.errors import PoiseError
from poise.jobs.tracker import Tracker
from poise.kin import qpos_to_clip
from poise.kin.directed import end_of
from poise.motion import Clip
from poise.spatial import quat_mul


def at_ease(tracker: Tracker, yaw: float = 0.0) -> np.ndarray:
    """`(7 + n,)` the policy's pose at ease, above the origin, facing +X turned by `yaw` rad.

    Raises:
        PoiseError: the policy has not learned to stand at ease, which policies with recovery have.
    """
    if tracker.recovery_clips is None:
        raise PoiseError(
            "the policy knows no pose at ease", hint="Give a policy that was trained with recovery"
        )
    qpos = tracker.recovery_clips.ease.double().numpy().copy()
    clip = qpos_to_clip(np.stack([qpos, qpos]), tracker.humanoid.table, tracker.humanoid.skeleton, 30.0)
    left, right = (clip.positions()[0, end_of(clip.skeleton, f"{s}_foot")] for s in ("left", "right"))
    hips = _hips(tracker, clip)
    side = hips if hips is not None else left - right
    turn = yaw + np.pi / 2 - np.arctan2(side[1], side[0])
    about = torch.tensor([np.cos(turn / 2), 0.0, 0.0, np.sin(turn / 2)], dtype=torch.float64)
    qpos[3:7] = quat_mul(about, torch.from_numpy(qpos[3:7])).numpy()
    qpos[:2] = 0.0
    return qpos


def _hips(tracker: Tracker, clip: Clip) -> np.ndarray | None:
    """From the right hip to the left one."""
    rows = tracker.humanoid.table.rows
    by = {rows[i].side: rows[i].joint for i in tracker.humanoid.rows_of("thigh")}
    if not {"left", "right"} <= by.keys():
        return None
    pos = clip.positions()[0]
    return pos[by["left"]] - pos[by["right"]]


def smooth_step(t: np.ndarray, start: float, stop: float) -> np.ndarray:
    """0 before `start`, 1 after `stop`, s, smooth between them."""
    x = np.clip((t - start) / (stop - start), 0.0, 1.0)
    return x * x * x * (10.0 + x * (6.0 * x - 15.0))
