"""How physical a clip looks, whether it was captured, simulated or mended: one measure for all."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from poise.metrics import Shapes, foot_points, foot_slide, lowest_points, penetration
from poise.motion import Clip


def clip_figures(
    clip: Clip, joints: Sequence[int], shapes: Shapes, feet: Sequence[int], ground: float = 0.0
) -> dict[str, float]:
    """`foot_slide_mm_per_s` and `penetration_mm` of a clip with a character's shapes (docs/metrics.md).

    Args:
        joints: the clip's joint that each body of `shapes` is fixed to. feet: the bodies that are feet.
        ground: height (m) of the floor under the soles, for the slide; penetration is below z = 0.
    """
    pos, quat = (torch.tensor(x)[:, list(joints)] for x in clip.world())
    slide = foot_slide(foot_points(pos, quat, shapes, feet), clip.fps, ground=ground)
    return {
        "foot_slide_mm_per_s": float(slide),
        "penetration_mm": float(penetration(lowest_points(pos, quat, shapes)).mean_mm),
    }
