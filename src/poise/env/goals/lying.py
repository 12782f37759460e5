"""Where characters lie that have lost their motion: a goal that asks for nothing but to rest there."""

from __future__ import annotations

import torch
from torch import Tensor

from poise.body import Humanoid
from poise.env.frame import Layout
from poise.env.poser import Poser


class Lying:
    """The last poses of N characters, as goals that stand still.

    A goal that stays metres away from a character that has fallen makes it thrash until it rests.

    Attributes:
        qpos: `(N, 7 + n)`.
        packs: `(N, W)` packed poses; where in a motion they are is not told.
    """

    def __init__(self, humanoid: Humanoid, layout: Layout, qpos: Tensor):
        self._poser, self.layout = Poser(humanoid), layout
        self.qpos = qpos.double().clone()
        self.packs = torch.zeros(len(qpos), layout.width).to(qpos.device)

    def hold(self, worlds: Tensor, qpos: Tensor) -> None:
        """Worlds `(n,)` lie as in `qpos (N, 7 + n)` of all; those with no finite pose as before."""
        worlds = worlds[qpos[worlds].isfinite().all(-1)]
        if not len(worlds):
            return
        self.qpos[worlds] = qpos[worlds].to(self.qpos)
        still = torch.zeros(len(worlds), qpos.shape[1] - 1).double()
        pose = self._poser.live(self.qpos[worlds].cpu(), still)
        self.packs[worlds] = self.layout.pack(pose, torch.zeros(len(worlds), 4)).to(self.packs)

    def laid(self, packed: Tensor, worlds: Tensor, those: Tensor) -> None:
        """Puts poses of `worlds[those]` into rows `those` of `packed (n, W)`, which keep their place."""
        packed[those, :-4] = self.packs[worlds[those], :-4]
