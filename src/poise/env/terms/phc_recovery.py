"""The reward of recovery in Perpetual Humanoid Control (Luo et al. 2023), Eq. 4.

    r = 0.5 r_point + 0.5 r_amp + 0.1 r_energy,    r_point = d_(t-1) - d_t

with d_t m between the roots of the character and of its reference. A motion prior gives 0.5 r_amp and
halves the rest; the rewards of a task are made for both modes by `recovery_terms`:

| | near the reference | far from it |
|---|---|---|
| paper | Eq. 2 and the energy | r_point and a tenth of the energy |
| code | half of Eq. 2, r_point and the energy | r_point and the energy |

where the code's r_point is 9 min(d_(t-1) - d_t, 1/3): 0.3 for walking at 1 m/s at 30 Hz, where the
paper's is 0.033.
"""

from __future__ import annotations

from dataclasses import replace

from torch import Tensor

from poise.env.frame import Frame, RewardTerm
from poise.env.terms.phc_reward import Form

#: Of the energy penalty, what Eq. 4 counts.
TENTH = 0.1


def point_goal(frame: Frame, gain: float = 1.0, most: float = float("inf")) -> Tensor:
    """gain min(d_(t-1) - d_t, most), `(N,)`: m that the character came nearer to the reference's root
    in a step; below 0 where it went away.

    The reference moves, too; one that runs away at the character's speed leaves nothing to earn.
    """
    if frame.point is None:
        raise ValueError("a point goal needs a task with recovery")
    return gain * (frame.point.before - frame.point.distance).clamp_max(most)


def point_goal_term(form: Form = "paper") -> RewardTerm:
    """r_point as a term of a task: far from the reference ("paper"), or everywhere ("code")."""
    if form == "paper":
        return RewardTerm("point_goal", point_goal, 1.0, imitation=False, when="far")
    return RewardTerm("point_goal", point_goal, 1.0, {"gain": 9.0, "most": 1 / 3}, imitation=False)


def recovery_terms(rewards: tuple[RewardTerm, ...], form: Form = "paper") -> tuple[RewardTerm, ...]:
    """The rewards of a task without recovery, and the point goal, each where it counts; see the module.

    rewards: terms of imitation; costs, such as the energy; others count everywhere as before.
    """
    out = []
    for term in rewards:
        if term.imitation:
            share = 1.0 if form == "paper" else 0.5
            out.append(replace(term, weight=share * term.weight, when="near"))
        elif term.weight < 0 and form == "paper":
            away = replace(term, name=f"{term.name}_far", weight=TENTH * term.weight, when="far")
            out += replace(term, when="near"), away
        else:
            out.append(term)
    return (*out, point_goal_term(form))
