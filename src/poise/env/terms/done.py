"""Failures that end an episode early. Time-outs are not failures and do not stand here."""

from __future__ import annotations

import torch
from torch import Tensor

from poise.body import Humanoid
from poise.env.frame import Frame


def root_too_low(frame: Frame, margin: float = 0.1) -> Tensor:
    """The root is more than `margin` m below the clip's lowest reference height (the paper's rule)."""
    return frame.sim.pos[:, 0, 2] < frame.min_height - margin


def root_below(frame: Frame, margin: float = 0.5) -> Tensor:
    """The root is more than `margin` m lower than the reference's now (Skeleton2Humanoid)."""
    return frame.sim.pos[:, 0, 2] < frame.ref.pos[:, 0, 2] - margin


def bodies_too_far(
    frame: Frame, limit: float = 0.5, bodies: Tensor | None = None, grace: int = 0
) -> Tensor:
    """The bodies are on average more than `limit` m away from the reference (UHC, PHC).

    Args:
        bodies: `(K,)` rows that count, all by default; `all_but_feet` is PHC's relaxed early
            termination.
        grace: control steps at the begin of an episode in which no character fails.
    """
    return _from(grace, frame, _distance(frame, bodies).mean(-1) > limit)


def any_body_too_far(
    frame: Frame, limit: float = 0.25, bodies: Tensor | None = None, grace: int = 0
) -> Tensor:
    """Some body is more than `limit` m away from the reference (PHC's code in training, grace 1).

    The rest as in `bodies_too_far`.
    """
    return _from(grace, frame, _distance(frame, bodies).amax(-1) > limit)


def all_but_feet(humanoid: Humanoid) -> Tensor:
    """`(K,)` rows without feet (ankles and toes), which may leave the reference to keep the balance."""
    return torch.tensor([i for i, r in enumerate(humanoid.table.rows) if r.kind != "foot"])


def _distance(frame: Frame, bodies: Tensor | None) -> Tensor:
    """Of each body from its reference, m `(N, K)`."""
    apart = frame.sim.pos - frame.ref.pos
    return (apart if bodies is None else apart.index_select(1, bodies)).norm(dim=-1)


def _from(grace: int, frame: Frame, failed: Tensor) -> Tensor:
    """`failed (N,)` of episodes that are older than `grace` control steps."""
    if not grace:
        return failed
    if frame.age is None:
        raise ValueError("a grace at the begin of an episode needs the age of the episodes")
    return failed & (frame.age > grace)
