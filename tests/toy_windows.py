"""Windows of toy motion for the in-betweening networks."""

from __future__ import annotations

import math

import torch

from poise.learn.between import BetweenConfig
from poise.learn.transition import Known, SkeletonLayout
from poise.learn.window_sampler import FrameData
from poise.papers.skeleton2humanoid.rtn import RTNConfig
from poise.synthesis.windows import FrameBank, pack_frames, step_contacts, train_statistics
from toy_human import swing

SMALL = BetweenConfig(width=32, layers=2, heads=2, feedforward=48, latent=3)
SMALL_RTN = RTNConfig(hidden=32, encoder=(32, 16), decoder=(32, 16))


def bank() -> FrameBank:
    clips = [swing(3.0, speed=0.5 * k, bend=0.3 * k, name=f"walk_{k}") for k in range(4)]
    return pack_frames(clips)


def layout(of: FrameBank) -> SkeletonLayout:
    return SkeletonLayout(of.parents, of.feet, of.facing)


def data(of: FrameBank) -> FrameData:
    feet = of.positions()[:, list(of.feet)]
    std = train_statistics(of)[1].clamp_min(0.01).float()
    return FrameData(
        layout(of), of.root.float(), of.rot.float(), step_contacts(feet).float(), of.offsets.float(),
        of.first, std,
    )  # fmt: skip


def known(of: FrameBank, past: int = 10, length: int = 12, dtype: torch.dtype = torch.float64) -> Known:
    """Two windows of the bank as a network sees them."""
    rows = torch.tensor([5, 100])[:, None] + torch.arange(past)
    goal = rows[:, -1] + length + 1
    parts = (of.root[rows], of.rot[rows], of.root[goal], of.rot[goal], of.offsets[:2])
    return Known(*(x.to(dtype) for x in parts))


def moved(k: Known, yaw: float, xy: tuple[float, float]) -> tuple[Known, torch.Tensor, torch.Tensor]:
    """The same elsewhere and turned; the turn and the way."""
    from poise.motion.rotations import quat_mul, quat_rotate

    turn = torch.tensor([math.cos(yaw / 2), 0, 0, math.sin(yaw / 2)], dtype=torch.float64)
    turn, way = turn.to(k.past_root), torch.tensor([*xy, 0.0]).to(k.past_root)

    def rooted(rot: torch.Tensor) -> torch.Tensor:
        first = quat_mul(turn.expand_as(rot[..., 0, :]), rot[..., 0, :])
        return torch.cat((first.unsqueeze(-2), rot[..., 1:, :]), -2)

    def placed(root: torch.Tensor) -> torch.Tensor:
        return quat_rotate(turn.expand(*root.shape[:-1], 4), root) + way

    other = Known(
        placed(k.past_root), rooted(k.past_rot), placed(k.target_root), rooted(k.target_rot), k.offsets
    )
    return other, turn, way
