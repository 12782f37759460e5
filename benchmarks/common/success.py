"""Whether an episode succeeds under each of the field's three rules, so that numbers compare.

- PHC (Luo et al. 2023): bodies are no more than 0.5 m off on average, in the world, in every frame.
- SONIC (Luo et al. 2025): the root is no more than 0.25 m higher or lower than the reference's, and
  turned by no more than 1 rad from it.
- BlinkMimic, with its base class of BeyondMimic: the pelvis no more than 0.25 m higher or lower, and the
  vertical, seen from the pelvis, no more than 0.8 off in its z component. It is the loosest: it sees
  neither where on the floor a character is nor how it faces.

Published rates are of robots, so that only the rule compares, not the body.
"""

from __future__ import annotations

import torch
from torch import Tensor

from poise.metrics import success_rule
from poise.motion.rotations import quat_distance, quat_rotate_inv
from poise.score.rollouts import RolloutSet, judge

RULES = ("phc", "sonic", "blinkmimic")
HEIGHT_M, TURN_RAD, TILT = 0.25, 1.0, 0.8


def under_rules(r: RolloutSet) -> dict[str, Tensor]:
    """`(E,)` bool by rule: the episode came to the end of its clip and broke the rule in no frame."""
    phc = judge(r, success_rule("phc"))
    root, want, quat, goal = (x[:, :, r.root].double() for x in (r.pos, r.ref_pos, r.quat, r.ref_quat))
    low = (root[..., 2] - want[..., 2]).abs() <= HEIGHT_M
    turned = quat_distance(quat, goal) <= TURN_RAD
    up = torch.zeros_like(root)
    up[..., 2] = 1.0
    tilt = (quat_rotate_inv(quat, up)[..., 2] - quat_rotate_inv(goal, up)[..., 2]).abs() <= TILT
    # A state that blew up fails; frames that were not simulated count in no rule.
    came = r.reached_end.bool() & phc.uncut.any(1) & (phc.uncut | ~r.valid).all(1)

    def won(kept: Tensor) -> Tensor:
        return came & (kept | ~r.valid).all(1)

    return {"phc": phc.won, "sonic": won(low & turned), "blinkmimic": won(low & tilt)}
