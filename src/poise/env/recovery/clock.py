"""Who of an environment's worlds recovers, from what, and since when."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from poise.body import Humanoid
from poise.control import PDTargets
from poise.env.recovery.config import CONTINUED, FALLEN, FAR, Recovery
from poise.env.recovery.falls import fall_states, rest_angles
from poise.sim import Backend


class RecoveryClock:
    """The recoveries of an environment's worlds.

    table: `(N, 4)` float32. grace: control steps for which the reference still waits. spare: above 0 as
    long as nobody can fail. before: m, between the roots one step ago. kind: bits of the episode's kind.

    Args:
        config: the settings. backend: the worlds, in which the fallen fall when they are first needed.
        humanoid, pd: their body and its servos. seed: of the falls.
    """

    def __init__(
        self, config: Recovery, backend: Backend, humanoid: Humanoid, pd: PDTargets, seed: int = 0
    ):
        self.config, self.seed = config, seed
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
        """Lets others fall when the fallen are next needed, those of `seed`."""
        self.seed, self._falls = seed, None

    @property
    def kind(self) -> Tensor:
        """`(N,)` bits of each episode's kind."""
        return self._kind.long()

    @property
    def held(self) -> Tensor:
        """`(N,)` bool: whose reference waits. One that failed first reaches the frame it made for."""
        return (self.grace > 0) & (self.grace <= self.config.grace)

    def targets(self, hinges: Tensor) -> Tensor:
        """What additive actions add to, rad `(N, n)`: the reference's `hinges (N, n)`, or the body at
        rest where the goal is a point, which tells nothing of the reference's."""
        far = self.before > self.config.switch
        return torch.where(far.unsqueeze(-1), self._rest.to(hinges), hinges)

    # --- starts -------------------------------------------------------------------------------

    def draw(self, count: int, rng: torch.Generator) -> Tensor:
        """`(count,)` kinds of new episodes."""
        u, c = torch.rand(count, 2, dtype=torch.float64, generator=rng), self.config
        return FALLEN * (u[:, 0] < c.fallen) + FAR * (u[:, 1] < c.far)

    def begin(
        self, ids: Tensor | slice, kind: Tensor, qpos: Tensor, qvel: Tensor, rng: torch.Generator
    ) -> tuple[Tensor, Tensor]:
        """Episodes of some kinds `(n,)` in worlds `ids`; the coordinates of their starts.

        qpos `(n, nq)`, qvel `(n, nv)`: of the reference, where it begins.
        """
        c, kind = self.config, kind.cpu()
        # As many draws whatever the kinds, so that one episode's kind does not move the others.
        u = torch.rand(len(kind), 3, dtype=torch.float64, generator=rng)
        angle, length = 2 * math.pi * u[:, 0], c.radius(u[:, 1])
        offset = torch.stack((angle.cos(), angle.sin()), -1) * length.unsqueeze(-1)
        offset = offset * (kind & FAR).bool().unsqueeze(-1)
        fallen, start = (kind & FALLEN).bool(), qpos.clone()
        if bool(fallen.any()):
            pick, down = (u[:, 2] * len(self.falls)).long()[fallen], fallen.to(qpos.device)
            lying = self.falls[pick].to(qpos)
            lying[:, :2] = qpos[down, :2]
            start[down] = lying
            qvel = torch.where(down.unsqueeze(-1), 0.0, qvel)
        start[:, :2] += offset.to(start)
        self.table[ids, 0] = (c.grace * fallen).to(self.table)
        self.table[ids, 1] = ((c.settle + 1) * (kind > 0)).to(self.table)
        self.table[ids, 2] = (start[:, :3] - qpos[:, :3]).norm(dim=-1).to(self.table)
        self.table[ids, 3] = kind.to(self.table)
        return start, qvel

    # --- stepping -----------------------------------------------------------------------------

    def tick(self, frame: Tensor) -> Tensor:
        """One control step has been made: takes it back in `frame (N,)` of references that waited.

        Returns:
            `(N,)` bool, whose reference waits in the next step.
        """
        frame.sub_(self.held.long())
        self.grace.sub_(1.0).clamp_min_(0.0)
        return self.held

    def judge(self, ends: Tensor, distance: Tensor, late: Tensor, rng: torch.Generator | None) -> None:
        """Notes who came how near, m `(N,)`, and takes back some failures in `ends (3, N)`.

        ends: failed, terminated, truncated. late: `(N,)` bool, whose time is over. rng: draws who goes
        on; None lets nobody.
        """
        self.reached(distance)
        if rng is not None:
            failed, terminated, truncated = ends.unbind(0)
            ids = self.survive(failed, rng)
            failed[ids] = terminated[ids] = False
            truncated[ids] = late[ids]

    def reached(self, distance: Tensor) -> None:
        """The step led to these distances between the roots, m `(N,)`: who is near settles."""
        near = (self.grace == 0) & (distance <= self.config.switch)
        left = torch.where(near, self.spare - 1.0, self.config.settle + 1.0)
        self.spare.copy_(torch.where(self.spare > 0, left, 0.0))
        self.before.copy_(distance)

    def survive(self, failed: Tensor, rng: torch.Generator) -> Tensor:
        """`(n,)` of the worlds that go on of those that `failed (N,)`."""
        ids = failed.nonzero().squeeze(-1)
        u = torch.rand(len(ids), dtype=torch.float64, generator=rng)
        ids = ids[(u < self.config.continues).to(ids.device)]
        # One step longer than others', since the reference first reaches the frame it makes for.
        self.grace[ids], self.spare[ids] = self.config.grace + 1.0, self.config.settle + 1.0
        self._kind[ids] = (self.kind[ids] | CONTINUED).to(self.table)
        return ids

    def shares(self) -> dict[str, Tensor]:
        """For the log: who is far and who waits, float32 `(N,)`."""
        far = self.before > self.config.switch
        return {"recovery/far": far.float(), "recovery/waiting": self.held.float()}

    # --- persistence --------------------------------------------------------------------------

    def state(self) -> dict[str, Tensor]:
        """What `load_state` takes. The falls are those of a seed, and made again from it."""
        return {"recovery": self.table.clone(), "falls": torch.tensor([self.seed])}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Goes on from `state()`; from one of a task without recovery as if all were tracked."""
        if "recovery" not in state:
            self.table.zero_()
            return
        self.table.copy_(state["recovery"])
        if int(state["falls"]) != self.seed:
            self.drop_anew(int(state["falls"]))
