"""The two baselines of the LAFAN1 benchmark: standing still, and interpolation.

Both have the networks' interface (`learn.transition`), so that one evaluation serves all rows.
"""

from __future__ import annotations

import torch
from torch import Tensor

from poise.learn.transition import FilledGap, Known, SkeletonLayout
from poise.motion.rotations import forward_kinematics

#: Under this distance of the dot product from 1 the published slerp is a plain weighted sum.
_LINEAR = 0.01


class Baseline:
    """`zero-velocity` repeats the last frame; `interpolation` draws lines and arcs to the target.

    Interpolation is Harvey et al.'s own: the root by LERP, LOCAL quaternions by SLERP in the start's
    hemisphere, weights in float32, and nearly equal quaternions by an unnormalised LERP.
    """

    def __init__(self, kind: str, layout: SkeletonLayout):
        if kind not in ("zero-velocity", "interpolation"):
            raise ValueError(f"there is no baseline '{kind}'")
        self.kind, self.layout = kind, layout

    def parameters(self) -> list[torch.nn.Parameter]:
        """None."""
        return []

    def fill(self, known: Known, length: int, noise: torch.Generator | None = None) -> FilledGap:
        """`length` frames after the last known one; see `learn.transition.TransitionNet`."""
        a, qa = known.past_root[:, -1:], known.past_rot[:, -1:]
        if self.kind == "zero-velocity":
            root = a.expand(-1, length, -1)
            rot = qa.expand(-1, length, -1, -1)
        else:
            t = torch.linspace(0, 1, length + 2, dtype=torch.float32)[1:-1].to(a.dtype)
            root = a + t[:, None] * (known.target_root.unsqueeze(1) - a)
            rot = protocol_slerp(qa, known.target_rot.unsqueeze(1), t[:, None])
        pos, _ = forward_kinematics(self.layout.parents, known.offsets[:, None], root, rot)
        contact = torch.zeros(*root.shape[:2], len(self.layout.feet), dtype=root.dtype)
        return FilledGap(root, rot, contact, pos)


def protocol_slerp(a: Tensor, b: Tensor, t: Tensor) -> Tensor:
    """Between `a` and `b (..., 4)` at `t (...)`, as the published benchmark does it."""
    dot = (a * b).sum(-1, keepdim=True)
    b = torch.where(dot < 0, -b, b)
    dot, t = dot.abs().clamp(max=1.0), t.unsqueeze(-1)
    near = 1 - dot < _LINEAR
    angle = torch.where(near, torch.ones_like(dot), torch.acos(dot))
    wa = torch.where(near, 1 - t, ((1 - t) * angle).sin() / angle.sin())
    wb = torch.where(near, t, (t * angle).sin() / angle.sin())
    return wa * a + wb * b
