"""Motions that are looked for by many characters at once, and played again by one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from torch import Tensor

from poise.env import Acts
from poise.jobs.tracker import Tracker
from poise.plan import SamplingConfig, SamplingControl, SamplingResult
from poise.recipes.imitation import Imitation


@dataclass(eq=False)
class Replay:
    """Actions `(T, A)` one after another, for the one character that they were made for; after them
    acts the policy, if there is one. by: the controller that made them."""

    actions: Tensor
    policy: Acts | None = None
    step: int = 0
    by: str = "policy"

    def act(self, obs: Tensor) -> Tensor:
        """The next one, `(1, A)`; `obs` is looked at by the policy alone."""
        at, self.step = self.step, self.step + 1
        if at >= len(self.actions) and self.policy is not None:
            return self.policy.act(obs)
        return self.actions[at : at + 1]


def look_for(
    tracker: Tracker,
    imitation: Imitation,
    config: SamplingConfig,
    clip: int = 0,
    threads: int = 0,
    show: Callable[[int, int], None] | None = None,
) -> SamplingResult:
    """Looks for one of a task's motions with the tracker's policy, without help.

    threads: of the physics; 0 is all cores. show: is told of the control steps done and of all of them.
    """
    # Worlds that lose the motion may go bad; they are left behind.
    env = imitation.bare(rewards=True).env(
        config.characters, auto_reset=False, threads=threads, help_scale=0.0, guard=False
    )
    try:
        return SamplingControl(env, tracker.policy, config, tracker.value, clip).run(show)
    finally:
        env.close()


def replay(found: SamplingResult, policy: Acts) -> Replay:
    """Does what was found, and from where it was lost what the policy does."""
    return Replay(found.actions[: found.reached].clone(), policy)
