"""A generator as a goal: a model makes the next frames from the past ones, without end."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import torch
from torch import Tensor

from poise.body import Humanoid
from poise.env.goals.buffer import BufferedGoal
from poise.errors import PoiseError


class MotionGenerator(Protocol):
    """A model of motion: the environment's view of a kinematic policy (RFC Sec. 5, Algorithm 1).

    past: frames that it sees. future: frames that it makes at once.
    """

    past: int
    future: int

    def begin(self, count: int, rng: torch.Generator) -> Tensor:
        """`(count, past, 7 + n)` frames from which motions begin."""
        ...

    def generate(self, past: Tensor, ids: Tensor, rng: torch.Generator) -> Tensor:
        """`(n, future, 7 + n)` frames that follow `past (n, past, 7 + n)` in worlds `ids (n,)`."""
        ...

    def rows(self) -> Mapping[str, Tensor]:
        """What it remembers of each world, `(N, ...)` by name, which snapshots copy in place."""
        ...


class GeneratorGoal(BufferedGoal):
    """Worlds follow motions that a generator makes as they go, from its own frames (line 11 of
    Algorithm 1). Where it makes what is no motion, the world's goal comes to rest, and `notes` says so.

    Args:
        generator: the model. num_envs: worlds. seed: of all that it draws.
        lead: frames that are always known ahead, as many as a controller looks ahead.
    """

    def __init__(
        self,
        generator: MotionGenerator,
        humanoid: Humanoid,
        rate_hz: float,
        num_envs: int = 1,
        device: torch.device | str = "cpu",
        seed: int = 0,
        lead: int = 0,
    ):
        if generator.past < 1 or generator.future < 1:
            raise PoiseError(
                f"a generator sees and makes at least 1 frame, got past {generator.past} and future "
                f"{generator.future}"
            )
        size = generator.past + 2 * generator.future + lead + 2
        super().__init__(humanoid, rate_hz, num_envs, size, torch.device(device), seed)
        self.generator, self.lead = generator, lead
        # Frames of what it makes that are done before it makes more.
        self.keeps = generator.future

    def begin(self, ids: Tensor) -> Tensor:
        """`(n, past, 7 + n)` frames from which motions of worlds `ids (n,)` begin."""
        return self.generator.begin(len(ids), self.rng)

    def make(self, past: Tensor, ids: Tensor) -> Tensor:
        """`(n, future, 7 + n)` frames that follow `past (n, past, 7 + n)` in worlds `ids (n,)`."""
        return self.generator.generate(past, ids, self.rng)

    def draw(self, ids: Tensor) -> None:
        """New motions in worlds `ids`."""
        frames = self.begin(ids)
        want = (len(ids), self.generator.past, self.humanoid.model.nq)
        if frames.shape != want or not bool(frames.isfinite().all()):
            raise PoiseError(
                f"the generator begins with {tuple(frames.shape)} coordinates, which must be finite and "
                f"{want}",
                type(self.generator).__name__,
            )
        self.clear(ids)
        self.extend(ids, frames.to(self.qpos))
        self.at[ids] = self.generator.past - 1

    def supply(self, ids: Tensor) -> None:
        g = self.generator
        begun = self.count[ids] > 0
        known = self.count[ids] - self.lead
        short = ids[begun & (self.at[ids] + 1 >= known) & (self.at[ids] < self.last[ids])]
        if not len(short):
            return
        index = self.count[short].unsqueeze(1) - g.past + torch.arange(g.past, device=self.device)
        past = self.qpos[short.unsqueeze(1), index.clamp_min(0) % self.size]
        made = self.make(past, short).to(past)
        if made.shape != (len(short), g.future, past.shape[-1]):
            raise PoiseError(
                f"the generator made {tuple(made.shape)} coordinates, and {len(short)} motions of "
                f"{g.future} frames have ({len(short)}, {g.future}, {past.shape[-1]})",
                type(g).__name__,
            )
        good = made.isfinite().all(-1).all(-1)
        for i in short[~good].tolist():
            self.last[i] = self.count[i] - 1
            self.notes.append(
                f"The generator made what is no motion in world {i} after frame {int(self.last[i])}; "
                "the character is to stand still there."
            )
        kept = short[good]
        if len(kept):
            self.extend(kept, made[good, : self.keeps])

    def rows(self) -> dict[str, Tensor]:
        own = {f"generator/{k}": v for k, v in self.generator.rows().items()}
        return {**super().rows(), **own}
