"""What a motion that follows no clip is worth, piece by piece: slide, sinking, jerk, standing still."""

from __future__ import annotations

import numpy as np
import torch

from poise.body import Humanoid
from poise.kin.fk import Kinematics
from poise.kin.solids import shapes_of
from poise.metrics import foot_points, foot_slide, jerk, lowest_points, penetration

#: Mean speed (m/s) of the bodies over a second below which a character stands still.
STILL = 0.1


class Figures:
    """Sums over pieces of coordinates, by the character's own soles and shapes."""

    def __init__(self, humanoid: Humanoid, fps: float):
        self.humanoid, self.fps = humanoid, fps
        self._kinematics, self._shapes = Kinematics(humanoid.table), shapes_of(humanoid.table)
        self._sums, self._frames = np.zeros(4), np.zeros(4)
        self._still, self._longest = 0.0, 0.0
        self._quiet = 0

    def add(self, qpos: np.ndarray) -> None:
        """A piece `(T, 7 + n)` of at least 4 frames; shorter ones are left out."""
        if len(qpos) < 4:
            return
        state = self._kinematics(torch.tensor(qpos))
        soles = foot_points(state.pos, state.quat, self._shapes, self.humanoid.feet)
        deep = penetration(lowest_points(state.pos, state.quat, self._shapes)).mean_mm
        speed = torch.diff(state.pos, dim=0).norm(dim=-1).mean(-1) * self.fps
        values = (
            float(foot_slide(soles, self.fps)), float(deep), float(jerk(state.pos, self.fps).mean()),
            float(speed.mean()),
        )  # fmt: skip
        for k, value in enumerate(values):
            if np.isfinite(value):
                self._sums[k] += value * len(qpos)
                self._frames[k] += len(qpos)
        second = max(1, round(self.fps))
        for part in speed.split(second):
            seconds = len(part) / self.fps
            still = float(part.mean()) < STILL
            self._quiet += len(part) if still else -self._quiet
            self._still += seconds * still
            self._longest = max(self._longest, self._quiet / self.fps)

    def to_dict(self) -> dict[str, float | None]:
        """Means over all frames; None where nothing was to be measured."""
        names = ("foot_slide_mm_per_s", "penetration_mm", "jerk_m_per_s3", "speed_m_per_s")
        means = {
            name: round(float(s / f), 3) if f else None
            for name, s, f in zip(names, self._sums, self._frames, strict=True)
        }
        return {**means, "still_s": round(self._still, 1), "longest_still_s": round(self._longest, 1)}
