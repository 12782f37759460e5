"""Joint angles beyond the limits that a file states for them (ASF)."""

from __future__ import annotations

import numpy as np
import torch

from poise.body.generate import asf_axis_quat
from poise.kin.doctor.faults import Fault, spell_faults
from poise.kin.hinges import chain_angles
from poise.motion import Clip

#: Degrees beyond a limit that count, and for how long (s): the files' limits are rough.
BEYOND_DEG, LASTING_S = 45.0, 0.1


def limit_faults(clip: Clip) -> list[Fault]:
    """Spells in which a joint is more than `BEYOND_DEG` beyond the file's own limits.

    Angles are the file's own degrees of freedom, continuous in time; each may be a whole turn away.
    """
    out: list[Fault] = []
    source = clip.skeleton.source
    if source.format != "asf-amc" or not source.channels:
        return out
    gap = round(0.1 * clip.fps)
    for j, channel in enumerate(source.channels):
        letters = [c[1].upper() for c in channel.order if c[0] == "r"]
        if j == 0 or not letters or len(channel.limits) != len(letters):
            continue
        axis = channel.axis or (0.0, 0.0, 0.0)
        frame = torch.tensor(asf_axis_quat(axis, channel.axis_order, source.up_axis))
        # ASF lists the first-applied turn first, a chain its outermost hinge.
        low, high = np.array(channel.limits[::-1]).T
        middle = torch.tensor((low + high) / 2)
        order = "".join(reversed(letters))
        angles = chain_angles(torch.tensor(clip.rot[:, j]), order, frame, middle).numpy()
        over = np.degrees(np.maximum(np.maximum(low - angles, angles - high), 0.0)).max(-1)
        found = spell_faults("limit", clip.skeleton.names[j], over, over > BEYOND_DEG, gap)
        out += [f for f in found if f.stop - f.start >= round(LASTING_S * clip.fps)]
    return out
