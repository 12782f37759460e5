"""Actions that were found once, by a search or on recovery motions, are replayed."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from poise.env import Acts


@dataclass(eq=False)
class Replay:
    """Actions `(T, A)` one after another, for the one character that they were made for; after them
    acts the policy, if there is one."""

    actions: Tensor
    policy: Acts | None = None
    step: int = 0

    def act(self, obs: Tensor) -> Tensor:
        """The next one, `(1, A)`; `obs` is looked at by the policy alone."""
        at, self.step = self.step, self.step + 1
        if at >= len(self.actions) and self.policy is not None:
            return self.policy.act(obs)
        return self.actions[at : at + 1]
