"""Falls and getting up, being far and coming back, as parts of episodes (PHC Secs. 3.2 and 3.3).

A task with a `Recovery` has these kinds of episodes, and without one only the first:

| kind | begins | the reference |
|---|---|---|
| tracked | on the reference | goes on |
| fallen | lying on the floor under it | waits for `grace` steps |
| far | on it, but metres beside it | goes on |
| fallen, far | both | waits |
| continued | where a failure would have ended an episode | waits |

A character that recovers cannot fail, and its episode does not end with the clip, of which the last
frame then stands still: not before the root has come as near as `switch` and stayed for `settle` steps,
with no wait left.

**Point goal** (Eq. 3): as long as the root is farther than `switch` from its reference, of the goal
nothing is told but where the reference's root is and how it is turned: see `toward`. This and the
rewards that count (`RewardTerm.when`) depend on that distance alone, also in tracked episodes and while
evaluating, so that a policy sees the same in all of them. Additive actions there add to the body at
rest, since the reference's angles are not told either.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Literal

import torch
from torch import Tensor

from poise.env.frame import LazyPose, PointGoal, Pose
from poise.env.recovery.falls import Drop
from poise.errors import PoiseError

#: Bits of an episode's kind; CONTINUED is set when it goes on after a failure.
TRACKED, FALLEN, FAR, CONTINUED = 0, 1, 2, 4


@dataclass(frozen=True)
class Recovery:
    """How often episodes are about recovery, and what it is; see the module.

    Attributes:
        fallen, far: probabilities that an episode begins fallen and that it begins far, drawn apart.
        continues: probability that a failed episode goes on.
        grace: control steps for which the reference waits then and for those that begin fallen.
        distance: m, from and to which characters begin far.
        by_area: that distance is uniform over the ring on the floor, not over the length.
        switch: m between the roots, beyond which the goal is a point; inf: it never is.
        reach: m, no point is told to be farther.
        settle: control steps near the reference after which failures count again.
        drop: how the fallen fell.
    """

    fallen: float = 0.3
    far: float = 0.3
    continues: float = 0.5
    grace: int = 90
    distance: tuple[float, float] = (2.0, 5.0)
    by_area: bool = False
    switch: float = 0.5
    reach: float = 5.0
    settle: int = 30
    drop: Drop = field(default_factory=Drop)

    def __post_init__(self) -> None:
        for name in ("fallen", "far", "continues"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise PoiseError(f"{name} must lie in [0, 1], got {getattr(self, name)}", "Recovery")
        if self.grace < 0 or self.settle < 0:
            raise PoiseError(
                f"grace and settle must not be below 0, got {self.grace} and {self.settle}", "Recovery"
            )
        low, high = self.distance
        if not 0 <= low <= high < math.inf:
            raise PoiseError(f"distance must rise from 0 or more, got {low:g} to {high:g}", "Recovery")
        if not 0 < self.switch < self.reach and self.switch < math.inf:
            raise PoiseError(
                f"switch must lie above 0 and below reach, got {self.switch:g} and {self.reach:g} m",
                "Recovery",
            )

    @classmethod
    def phc(
        cls,
        faithful: Literal["paper", "code"] = "paper",
        stage: Literal["primitive", "composer"] = "composer",
    ) -> Recovery:
        """PHC's settings, of the recovery primitive or of the composer's interleaved training.

        | | paper | code |
        |---|---|---|
        | switch, reach | 0.5, 5 m | 0.25, 3 m |
        | far starts | 2 to 5 m | 5 m sqrt(U) |
        | falls | random torques, 150 steps | a random action of +-0.5, 150 steps |
        | composer: fallen, continues | not stated, as the code | 0.3, 0.5 |
        | primitive: fallen, continues | not stated, as the code | 1, 0 |
        | grace | not stated, as the code | 90 |
        | far | not stated: 0.3 and, for the primitive, 0.5 | the same |
        | settle | not stated: 30 | the same |
        """
        odds = cls(fallen=1.0, far=0.5, continues=0.0) if stage == "primitive" else cls()
        if faithful == "paper":
            return odds
        drop = Drop("action", 0.5)
        return replace(odds, distance=(0.0, 5.0), by_area=True, switch=0.25, reach=3.0, drop=drop)

    def radius(self, share: Tensor) -> Tensor:
        """Distances, m, of shares in [0, 1]."""
        low, high = self.distance
        if self.by_area:
            return (low**2 + share * (high**2 - low**2)).sqrt()
        return low + share * (high - low)


def point_goal(sim: Pose, ref: Pose, before: Tensor, switch: float) -> PointGoal:
    """Where the reference's root is from the character's, see `PointGoal`."""
    distance = root_distance(ref.pos, sim.pos)
    return PointGoal(distance > switch, distance, before)


def root_distance(a: Tensor, b: Tensor) -> Tensor:
    """Between the roots of body places `(N, B, 3)`, m `(N,)`."""
    return (a[:, 0] - b[:, 0]).norm(dim=-1)


def toward(sim: Pose, goal: Pose, far: Tensor, reach: float) -> Pose:
    """The goal where `far (N,)` is false; elsewhere nothing of it but the root's place and rotation.

    There all other bodies and hinges and all velocities are the character's own, so that they differ by
    nothing, and the root is moved toward the character to within `reach` m (Eq. 3, s^g-Fail).
    """

    def pick(own: Tensor, theirs: Tensor) -> Tensor:
        mask = far.view(-1, *(1 for _ in own.shape[1:]))
        return torch.where(mask, own, theirs)

    def root() -> Tensor:
        # 5 (p^ - p) / |p^ - p| beyond 5 m
        apart = goal.pos[:, 0] - sim.pos[:, 0]
        shrunk = (reach / apart.norm(dim=-1, keepdim=True).clamp_min(1e-9)).clamp_max(1.0)
        return sim.pos[:, 0] + apart * shrunk

    def with_root(place: Tensor, own: Tensor) -> Tensor:
        return torch.cat((place.unsqueeze(1), own[:, 1:]), 1)

    def qpos() -> Tensor:
        return torch.cat((root(), goal.qpos[:, 3:7], sim.qpos[:, 7:]), -1)

    return LazyPose(
        qpos=lambda: pick(qpos(), goal.qpos),
        qvel=lambda: pick(sim.qvel, goal.qvel),
        pos=lambda: pick(with_root(root(), sim.pos), goal.pos),
        quat=lambda: pick(with_root(goal.quat[:, 0], sim.quat), goal.quat),
        linvel=lambda: pick(sim.linvel, goal.linvel),
        angvel=lambda: pick(sim.angvel, goal.angvel),
        com=lambda: pick(sim.com, goal.com),
        local=lambda: pick(sim.local, goal.local),
        heading=lambda: goal.heading,
    )
