"""A character that followed a motion without its noise, beside the motion as it came in."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from poise.jobs.track.placement import Placed, noise_read, place
from poise.jobs.track.points import fitted
from poise.jobs.tracker import Tracker
from poise.kin.doctor.faults import Fault
from poise.kin.fk import Kinematics
from poise.metrics import mpjpe_global, mpjpe_root
from poise.motion import Clip
from poise.motion.keypoints import Keypoints


@dataclass(frozen=True)
class BesideRaw:
    """mpjpe_mm, mpjpe_global_mm: the character's error beside what came in, up to where it failed; NaN
    where that is not known. noise: the largest that was taken off."""

    mpjpe_mm: float
    mpjpe_global_mm: float
    noise: Fault

    @property
    def figures(self) -> dict[str, float]:
        """The score card's `raw`."""
        return {
            "mpjpe_mm": self.mpjpe_mm,
            "mpjpe_global_mm": self.mpjpe_global_mm,
            "noise_mm": self.noise.size,
            "noise_hz": math.nan if self.noise.hz is None else self.noise.hz,
        }

    def sentence(self) -> str:
        """The motion that the score is against, in words."""
        beside = ""
        if math.isfinite(self.mpjpe_mm):
            beside = f"; the character is {self.mpjpe_mm:.0f} mm from the motion with it"
        return f"The score is that against the motion without its tremble{beside}."


def beside_raw(
    tracker: Tracker, motion: Clip | Keypoints, placed: Placed, sim: Tensor, judged: Tensor
) -> BesideRaw | None:
    """The character `sim (T, B, 3)` m in the frames `judged (T)`, None where no tremble was taken off.

    motion: what was placed, keypoints where it came as such.
    """
    of_clip = [f for f in placed.report.clips[0].clean.noise if f.kind == "tremble"]
    noise = [*noise_read(placed.source), *of_clip]
    if not noise:
        return None
    worst = max(noise, key=lambda f: f.size)
    if isinstance(motion, Keypoints):
        came = fitted(replace(motion, source=replace(motion.source, raw=True)))
    elif of_clip:
        came = motion.replaced(skeleton=motion.skeleton.with_source(raw=True))
    else:
        # The keypoints that a clip was made of are gone.
        return BesideRaw(math.nan, math.nan, worst)
    pos = Kinematics(tracker.humanoid.table)(torch.tensor(place(came, tracker).qpos)).pos.to(sim)
    # Samples that jump at an end of keypoints may have cut some frames off.
    frames = min(len(pos), len(sim))
    here, there, kept = sim[:frames], pos[:frames], judged[:frames]
    local, whole = (float(of(here, there)[kept].mean()) for of in (mpjpe_root, mpjpe_global))
    return BesideRaw(local, whole, worst)
