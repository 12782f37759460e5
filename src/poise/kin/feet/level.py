"""Feet that stand flat on the soles of a body that was made from other clips.

The roll of a foot is what motion capture knows least: soles of one performer stand 5 to 20 degrees apart
from one recording to the next, and retargeting adds its own. A rigid sole then stands on its edge.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from poise.body import BodyTable
from poise.kin.feet.contact import lowest_and_slow, sole_boxes
from poise.kin.fk import carried
from poise.motion import Clip
from poise.spatial import quat_between, quat_conj, quat_mul, quat_rotate, shortest_arc

#: Frames of standing of which the mean is to be trusted.
ENOUGH_FRAMES = 5
#: Degrees: less is no fault, and more is no foot that stands.
LEAST_DEG, MOST_DEG = 1.0, 35.0


@dataclass(frozen=True, eq=False)
class Levelled:
    """Turns of feet, constant over a clip: joint index to quaternion wxyz in the foot's own frame."""

    turns: Mapping[int, Tensor]

    def onto(self, clip: Clip) -> Clip:
        """The clip with its feet turned; what hangs on them stays as it is in the world."""
        return self._turned(clip, self.turns)

    def off(self, clip: Clip) -> Clip:
        """What `onto` did, undone."""
        return self._turned(clip, {j: quat_conj(q) for j, q in self.turns.items()})

    @staticmethod
    def _turned(clip: Clip, turns: Mapping[int, Tensor]) -> Clip:
        if not turns:
            return clip
        rot = torch.tensor(clip.rot)
        for joint, turn in turns.items():
            rot[:, joint] = quat_mul(rot[:, joint], turn)
            for child in clip.skeleton.children(joint):
                rot[:, child] = quat_between(turn, rot[:, child])
        return clip.replaced(rot=rot.numpy())


def level_feet(clip: Clip, table: BodyTable) -> Levelled:
    """The turns with which the table's soles are level on average while the feet of a clip stand.

    A foot stands while it is among the lowest and slow (`lowest_and_slow`). The turn is the shortest
    from the sole's normal to the mean of the vertical, both in the foot's frame.
    """
    pos, quat = (torch.tensor(x) for x in clip.world())
    up = torch.tensor([0.0, 0.0, 1.0], dtype=pos.dtype)
    turns: dict[int, Tensor] = {}
    for _, row, box in sole_boxes(table):
        normal = quat_rotate(torch.tensor(box.quat, dtype=pos.dtype), up)
        place = carried(pos[:, row.joint], quat[:, row.joint], box.pos)
        stands = lowest_and_slow(place, clip.fps)
        if int(stands.sum()) < ENOUGH_FRAMES:
            continue
        here = quat[stands, row.joint]
        mean = quat_rotate(quat_conj(here), up.expand(len(here), 3)).mean(0)
        mean = mean / mean.norm()
        angle = float(torch.rad2deg(torch.acos((normal @ mean).clamp(-1.0, 1.0))))
        if LEAST_DEG < angle < MOST_DEG:
            turns[row.joint] = shortest_arc(normal, mean)
    return Levelled(turns)
