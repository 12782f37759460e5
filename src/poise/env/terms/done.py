"""Failures that end an episode early. Time-outs are not failures and do not stand here."""

from __future__ import annotations

from torch import Tensor

from poise.env.frame import Frame


def root_too_low(frame: Frame, margin: float = 0.1) -> Tensor:
    """The root is more than `margin` m below the clip's lowest reference height (the paper's rule)."""
    return frame.sim.pos[:, 0, 2] < frame.min_height - margin


def bodies_too_far(frame: Frame, limit: float = 0.5) -> Tensor:
    """The bodies are on average more than `limit` m away from the reference (UHC, PHC)."""
    return (frame.sim.pos - frame.ref.pos).norm(dim=-1).mean(-1) > limit


def any_body_too_far(frame: Frame, limit: float = 0.25) -> Tensor:
    """Some body is more than `limit` m away from the reference (PHC's code in training)."""
    return (frame.sim.pos - frame.ref.pos).norm(dim=-1).amax(-1) > limit
