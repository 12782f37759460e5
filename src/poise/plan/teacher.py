"""A teacher that looks ahead from where a learner itself has come to (DAgger, Ross et al. 2011).

Every few control steps each of W worlds is copied K times. The copies act as the learner plus an offset
of their own, which is held until the next decision; one has none. The best of them say what the learner
should have done:

    label(o_t) = pi(o_t) + mean of the best offsets,  t in the steps for which offsets are held,

with the costs and prices of `plan.lookahead`. The world goes on with the learner's own action or with
the best offset, half and half: the learner is taught where it goes wrong, and where it would be if it
did not.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import torch
from torch import Tensor

from poise.env.frame import Pose
from poise.env.task import Acts
from poise.errors import PoiseError
from poise.plan.lookahead import PAST, Candidates, Changes
from poise.plan.sampling import draw_offsets
from poise.settings import Count, NotNegative, Range, Share, validate

if TYPE_CHECKING:
    from poise.env.env import ImitationEnv


@dataclass(frozen=True)
class TeacherConfig:
    """How a teacher looks ahead.

    Attributes:
        worlds: W, in which the learner acts to be taught.
        candidates: K, copies of each.
        horizon: control steps that each is simulated.
        hold_steps: control steps from one decision to the next.
        best: of the copies, how many have their offsets averaged.
        decisions: of each world in an iteration of the training.
        noise_range: (low, high) rad, see `LookaheadConfig`.
        jerk_price, slide_price: see `LookaheadConfig`; here they are added to the cost of tracking.
        own: share of the decisions after which the learner's own action is done.
        discount: gamma.
    """

    worlds: Count = 16
    candidates: int = 32
    horizon: int = 8
    hold_steps: Count = 4
    best: Count = 6
    decisions: Count = 16
    noise_range: Annotated[tuple[float, float], Range(0, above=True, rising=True)] = (0.02, 0.2)
    jerk_price: NotNegative = 0.03
    slide_price: NotNegative = 2.0
    own: Share = 0.5
    discount: Annotated[float, Range(0, 1, above=True)] = 0.97

    def __post_init__(self) -> None:
        validate(self)
        if self.best >= self.candidates:
            what = f"best must be fewer than candidates, got {self.best} of {self.candidates}"
            raise PoiseError(what, "TeacherConfig", code="out-of-range")
        if self.hold_steps > self.horizon:
            what = f"hold_steps must lie in 1 to the horizon {self.horizon}, got {self.hold_steps}"
            raise PoiseError(what, "TeacherConfig", code="out-of-range")


class LookaheadTeacher:
    """Labels of a learner's own states; it satisfies `learn.protocols.Lessons`.

    Args:
        env: W worlds with automatic restarts, in which the learner acts.
        copies: W K worlds of the same task without ends and restarts, with rewards.
        config: see `TeacherConfig`.
        seed: of the draws.
    """

    def __init__(
        self, env: ImitationEnv, copies: ImitationEnv, config: TeacherConfig | None = None, seed: int = 0
    ):
        self.env, self.copies, self.config = env, copies, config or TeacherConfig()
        wanted = self.config.worlds, self.config.worlds * self.config.candidates
        if (env.num_envs, copies.num_envs) != wanted:
            got = f"{env.num_envs} worlds and {copies.num_envs} copies"
            what = f"got {got}, not {wanted[0]} and {wanted[1]}"
            raise PoiseError(what, "LookaheadTeacher", code="count-differs")
        self._rng = torch.Generator().manual_seed(seed)
        self._past: Tensor | None = None

    @torch.no_grad()
    def teach(
        self, policy: Acts, value: Callable[[Tensor], Tensor]
    ) -> tuple[Tensor, Tensor, dict[str, float]]:
        """What a learner should have done where it came to.

        Args:
            policy: the learner.
            value: the return `(N,)` that it is still to earn, of observations `(N, O)`.

        Returns:
            observations `(n, O)`, actions `(n, A)`, and numbers for the log: how much less the best
            copies cost, the share of the learner's own that are lost, and that of the best.
        """
        env = self.env
        if self._past is None:
            env.reset()
            self._past = _before(env.pose(), env.goal.rate_hz)
        tries = Candidates(self.copies, policy, value, self.config.discount)
        seen: list[Tensor] = []
        labels: list[Tensor] = []
        totals = torch.zeros(3)
        for _ in range(self.config.decisions):
            totals += self._decide(tries, policy, seen, labels)
        gain, lost, lost_best = (totals / self.config.decisions).tolist()
        log: dict[str, float] = {"gain": gain, "lost": lost, "lost_best": lost_best}
        return torch.cat(seen), torch.cat(labels), log

    def _decide(
        self, tries: Candidates, policy: Acts, seen: list[Tensor], labels: list[Tensor]
    ) -> Tensor:
        """One decision of every world and the steps until the next; its numbers for the log."""
        c, env, worlds = self.config, self.env, torch.arange(self.config.worlds)
        rows = worlds.repeat_interleave(c.candidates)
        drawn = draw_offsets(len(rows), self.copies, c.noise_range, self._rng)
        drawn[:: c.candidates] = 0.0
        held = (torch.arange(c.horizon) < c.hold_steps).float()
        # They act as the learner does: through the environment's own filter.
        kept, on = torch.full((len(rows), 1), env.task.filter), torch.ones(len(rows), 1)
        assert self._past is not None
        changes = Changes(drawn[:, None] * held[:, None], kept, on)
        told = tries.tried(env.snapshot(worlds).picked(rows), changes, self._past[rows], c.worlds)
        price = told.rough.price(told.source, c.jerk_price, c.slide_price)
        cost = (told.cost + price).nan_to_num(torch.inf).view(c.worlds, -1)
        lost, offsets = told.lost.view(c.worlds, -1), drawn.view(c.worlds, c.candidates, -1)
        best = cost.argsort(1)[:, : c.best]
        mean = offsets.gather(1, best[..., None].expand(-1, -1, offsets.shape[2])).mean(1)
        # Where even the best are lost, or the clip ends, there is nothing to learn.
        known = ~told.ended & cost[:, 0].isfinite() & ~lost.gather(1, best).all(1)
        own = torch.rand(c.worlds, generator=self._rng) < c.own
        done = torch.where(own[:, None], 0.0, offsets[worlds, best[:, 0]])
        obs = env.observe().clone()
        for _ in range(c.hold_steps):
            action = policy.act(obs)
            seen.append(obs[known])
            labels.append((action + mean)[known])
            pos = env.pose().pos.clone()
            step = env.step(action + done)
            obs, over = step.obs.clone(), step.terminated | step.truncated
            self._past = torch.cat((self._past[:, 1:], pos[:, None]), 1)
            if bool(over.any()):
                self._past[over] = _before(env.pose(), env.goal.rate_hz)[over]
                known, done = known & ~over, torch.where(over[:, None], 0.0, done)
        gain = (cost[:, 0] - cost.amin(1))[~lost[:, 0]].clamp(max=100.0)
        share = lost[:, 0].float().mean(), lost.gather(1, best[:, :1]).float().mean()
        return torch.stack((gain.mean().nan_to_num(), *share))

    def state(self) -> dict[str, Tensor]:
        """Everything that a bit-exact continuation needs."""
        past = {} if self._past is None else {"past": self._past.clone()}
        worlds = {f"env/{k}": v for k, v in self.env.state().items()}
        return {**worlds, **past, "rng": self._rng.get_state()}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Continues from `state()`."""
        self.env.load_state({k[4:]: v for k, v in state.items() if k.startswith("env/")})
        self._past = state["past"].clone() if "past" in state else None
        self._rng.set_state(state["rng"])

    def close(self) -> None:
        """Frees the worlds."""
        self.env.close()
        self.copies.close()


def _before(pose: Pose, rate_hz: float) -> Tensor:
    """`(N, PAST, B, 3)` m, where bodies that keep their velocity were in the frames before."""
    back = torch.arange(PAST, 0, -1).view(1, -1, 1, 1) / rate_hz
    return pose.pos[:, None] - back * pose.linvel[:, None]
