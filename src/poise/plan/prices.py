"""What predicted motion costs beside tracking: jerk of the bodies, sliding of the soles."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from poise.metrics.plausibility import foot_contacts, jerk
from poise.metrics.shapes import Shapes, foot_points


def motion_price(
    pos: Tensor,
    quat: Tensor,
    past: Tensor,
    shapes: Shapes,
    feet: Sequence[int],
    rate_hz: float,
    jerk_price: float,
    slide_price: float,
) -> Tensor:
    """`(K,)` price of predicted motion, with the score card's own measures.

        sum_t jerk_price |x'''_t| / 1000 + slide_price sum_p c_tp |v_tp| / (P / 2),

    |x'''| the mean jerk of all bodies in m/s^3, v the horizontal velocity (m/s) of P points on the soles
    and c whether they touch the ground.

    Args:
        pos: `(K, T, B, 3)` m, world positions of the bodies, the first where they are now.
        quat: `(K, T, B, 4)` wxyz.
        past: `(k, B, 3)` m, up to three frames before them, which all copies share.
        shapes: the solids of the bodies.
        feet: indices of the feet among the bodies.
        rate_hz: frames a second.
        jerk_price: of 1 km/s^3, for a frame.
        slide_price: of 1 m/s, for a frame.
    """
    price = torch.zeros(len(pos))
    if jerk_price and len(past) + pos.shape[1] > 3:
        whole = torch.cat((past.expand(len(pos), -1, -1, -1), pos), 1)
        price = price + jerk_price / 1000.0 * jerk(whole, rate_hz).sum(-1)
    if slide_price and pos.shape[1] > 1:
        speed, contact = foot_contacts(foot_points(pos, quat, shapes, feet), rate_hz)
        price = price + slide_price / 1000.0 * (speed * contact).sum((1, 2)) / (speed.shape[-1] / 2)
    return price
