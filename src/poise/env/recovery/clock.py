"""Falls and far starts as parts of episodes, and which worlds recover, from what, and since when.

A task with a `Recovery` has these kinds of episodes (PHC Secs. 3.2 and 3.3), a task without one has only
the first:

| kind        | begins                                      | the reference         |
|-------------|---------------------------------------------|-----------------------|
| tracked     | on the reference                            | goes on               |
| fallen      | lying on the floor under it                 | waits `grace` steps   |
| far         | on it, but metres beside it                 | goes on               |
| fallen, far | both                                        | waits                 |
| continued   | where a failure would have ended an episode | waits                 |

A character that recovers cannot fail. Its episode does not end with the clip, whose last frame then
stands still, before the root has come as near as `switch` and stayed for `settle` steps, with no wait
left.

**Point goal** (Eq. 3): while the root is farther than `switch` from its reference, the goal tells only
where the reference's root is and how it is turned, see `toward`. The point goal and the rewards that
count (`RewardTerm.when`) depend on that distance alone, also in tracked episodes and in evaluations, so
that a policy sees the same in all of them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, Literal

import torch
from torch import Tensor

from poise.body import Humanoid
from poise.control import PDTargets
from poise.env import frame as observables
from poise.env.events import EpisodeStart, Event, StepOutcome
from poise.env.frame import Frame, LazyPose, Observable, PointGoal, Pose, PoseLayout
from poise.env.recovery.falls import Drop, fall_states, rest_angles
from poise.errors import PoiseError
from poise.settings import Range, Share, validate
from poise.sim import Backend

#: Bits of an episode's kind; CONTINUED is set when it goes on after a failure.
TRACKED, FALLEN, FAR, CONTINUED = 0, 1, 2, 4


@dataclass(frozen=True)
class Recovery:
    """How often episodes are about recovery, and what it is; the module lists the kinds.

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

    fallen: Share = 0.3
    far: Share = 0.3
    continues: Share = 0.5
    grace: Annotated[int, Range(0)] = 90
    distance: Annotated[tuple[float, float], Range(0, rising=True, unit="m")] = (2.0, 5.0)
    by_area: bool = False
    switch: Annotated[float, Range(0, above=True, infinite=True)] = 0.5
    reach: Annotated[float, Range(0, above=True, infinite=True)] = 5.0
    settle: Annotated[int, Range(0)] = 30
    drop: Drop = field(default_factory=Drop)

    def __post_init__(self) -> None:
        validate(self)
        if self.reach <= self.switch < math.inf:
            raise PoiseError(
                f"switch must lie above 0 and below reach, got {self.switch:g} and {self.reach:g} m",
                "Recovery",
                code="not-rising",
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


class RecoveryClock(Event):
    """The recoveries of an environment's worlds.

    Attributes:
        table: `(N, 4)` float32; its columns are the next four.
        grace: control steps for which the goal still waits.
        spare: above 0 as long as the episode cannot fail.
        before: m, between the roots one step ago.
        kind: bits of the episode's kind.

    Args:
        config: the settings.
        backend: the worlds, in which characters fall when fallen ones are first needed.
        humanoid, pd: their body and its servos.
        layout: of the packed goals.
        seed: of the falls.
    """

    def __init__(
        self,
        config: Recovery,
        backend: Backend,
        humanoid: Humanoid,
        pd: PDTargets,
        layout: PoseLayout,
        seed: int = 0,
    ):
        self.config, self.seed, self._layout = config, seed, layout
        self._rest = rest_angles(humanoid).float().to(backend.device)
        self._made_with = backend, humanoid, pd
        self.table = torch.zeros(backend.num_envs, 4, device=backend.device)
        self.grace, self.spare, self.before, self._kind = self.table.unbind(1)
        self._falls: Tensor | None = None

    @property
    def falls(self) -> Tensor:
        """`(K, nq)` of fallen characters."""
        if self._falls is None:
            self._falls = fall_states(*self._made_with, self.config.drop, self.seed)
        return self._falls

    def drop_anew(self, seed: int) -> None:
        """The next fallen characters are those of another seed."""
        self.seed, self._falls = seed, None

    @property
    def kind(self) -> Tensor:
        """`(N,)` bits of each episode's kind."""
        return self._kind.long()

    # --- what terms see -----------------------------------------------------------------------

    def tells(self) -> Mapping[str, Tensor | Observable]:
        """Where the reference's root is, a goal that is a point where that is far, and episodes that
        cannot end."""

        def point(frame: Frame) -> PointGoal:
            before = frame.source("recovery")[:, 2]
            return point_goal(frame.sim, frame.ref, before, self.config.switch)

        def ahead(frame: Frame) -> Pose | None:
            goal = observables.ahead(frame)
            assert goal is not None and frame.point is not None
            return toward(frame.sim, goal, frame.point.far, self.config.reach)

        def spared(frame: Frame) -> Tensor:
            return frame.source("recovery")[:, 1] != 0

        return {"point": point, "ahead": ahead, "spared": spared, "recovery": self.table}

    # --- starts -------------------------------------------------------------------------------

    def kinds(self, count: int, rng: torch.Generator) -> Tensor:
        """`(count,)` kinds of new episodes, drawn."""
        u, c = torch.rand(count, 2, dtype=torch.float64, generator=rng), self.config
        return FALLEN * (u[:, 0] < c.fallen) + FAR * (u[:, 1] < c.far)

    def begin(self, episodes: EpisodeStart) -> None:
        """Begins episodes fallen, far, or on the reference, by their kinds."""
        (qpos, qvel), rng, rows = episodes.start, episodes.rng, episodes.rows
        kind = self.kinds(len(qpos), rng) if episodes.drawn else episodes.kind
        kind = torch.zeros(len(qpos), dtype=torch.long) if kind is None else kind.cpu()
        # As many draws whatever the kinds, so that one episode's kind does not move the others.
        c, u = self.config, torch.rand(len(kind), 3, dtype=torch.float64, generator=rng)
        angle, length = 2 * math.pi * u[:, 0], c.radius(u[:, 1])
        offset = torch.stack((angle.cos(), angle.sin()), -1) * length.unsqueeze(-1)
        offset = offset * (kind & FAR).bool().unsqueeze(-1)
        fallen, place = (kind & FALLEN).bool(), qpos.clone()
        if bool(fallen.any()):
            pick, down = (u[:, 2] * len(self.falls)).long()[fallen], fallen.to(qpos.device)
            lying = self.falls[pick].to(qpos)
            lying[:, :2] = qpos[down, :2]
            place[down] = lying
            qvel = torch.where(down.unsqueeze(-1), 0.0, qvel)
        place[:, :2] += offset.to(place)
        self.table[rows, 0] = (c.grace * fallen).to(self.table)
        self.table[rows, 1] = ((c.settle + 1) * (kind > 0)).to(self.table)
        self.table[rows, 2] = (place[:, :3] - qpos[:, :3]).norm(dim=-1).to(self.table)
        self.table[rows, 3] = kind.to(self.table)
        episodes.start = place, qvel

    # --- stepping -----------------------------------------------------------------------------

    def held(self) -> Tensor:
        """`(N,)` bool. The goal of an episode that failed first reaches the frame it made for."""
        return (self.grace > 0) & (self.grace <= self.config.grace)

    def targets(self, hinges: Tensor) -> Tensor:
        """The goal's hinges, or the body at rest where the goal is a point, which tells no angles."""
        far = self.before > self.config.switch
        return torch.where(far.unsqueeze(-1), self._rest.to(hinges), hinges)

    def after_step(self) -> None:
        self.grace.sub_(1.0).clamp_min_(0.0)

    def judged(self, outcome: StepOutcome) -> None:
        ref = self._layout.unpacked(outcome.ref).pos
        self.reached(root_distance(ref, self._made_with[0].state.xpos[:, 1:]))
        if outcome.rng is not None:
            failed, terminated, truncated = outcome.ends.unbind(0)
            ids = self.survive(failed, outcome.rng)
            failed[ids] = terminated[ids] = False
            truncated[ids] = outcome.late[ids]
        # Episodes that recover, or have recovered, have not been where their age says.
        outcome.counted = self.kind == 0
        far = self.before > self.config.switch
        outcome.log |= {"recovery/far": far.float(), "recovery/waiting": self.held().float()}

    def reached(self, distance: Tensor) -> None:
        """The step led to these distances between the roots, m `(N,)`: near ones settle."""
        near = (self.grace == 0) & (distance <= self.config.switch)
        left = torch.where(near, self.spare - 1.0, self.config.settle + 1.0)
        self.spare.copy_(torch.where(self.spare > 0, left, 0.0))
        self.before.copy_(distance)

    def survive(self, failed: Tensor, rng: torch.Generator) -> Tensor:
        """`(n,)` of the worlds that go on of those that `failed (N,)`."""
        ids = failed.nonzero().squeeze(-1)
        u = torch.rand(len(ids), dtype=torch.float64, generator=rng)
        ids = ids[(u < self.config.continues).to(ids.device)]
        # One step longer than others', since the goal first reaches the frame it makes for.
        self.grace[ids], self.spare[ids] = self.config.grace + 1.0, self.config.settle + 1.0
        self._kind[ids] = (self.kind[ids] | CONTINUED).to(self.table)
        return ids

    def past(self, rows: Tensor) -> Tensor:
        """`(n,)` bool of worlds `rows (n,)` that have no past in their clips: fallen characters have not
        come to lie with them."""
        return (self.kind[rows] & FALLEN).bool()

    # --- persistence --------------------------------------------------------------------------

    def state(self) -> dict[str, Tensor]:
        """The falls are those of a seed, and made again from it."""
        return {"recovery": self.table.clone(), "falls": torch.tensor([self.seed])}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Goes on from `state()`; from one of a task without recovery as if all were tracked."""
        if "recovery" not in state:
            self.table.zero_()
            return
        self.table.copy_(state["recovery"])
        if int(state["falls"]) != self.seed:
            self.drop_anew(int(state["falls"]))

    def rows(self) -> dict[str, Tensor]:
        return {"recovery": self.table}
