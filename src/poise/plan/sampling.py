"""Sampling-based control: many characters try a motion that a policy loses, and the best states go on.

SAMCON (Liu et al. 2010) with a trained policy in place of the open-loop trajectory: each character
acts as the policy plus an offset, held for some steps; then the best states are kept, and all
characters begin the next try from copies of them. The result is one simulation from the first frame
to the last, without help, and the actions that repeat it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated

import torch
from torch import Tensor

from poise.errors import PoiseError
from poise.machine import one_thread
from poise.metrics import has_lost, mpjpe_global
from poise.settings import Count, Range, validate

if TYPE_CHECKING:
    from poise.env.env import ImitationEnv
    from poise.env.task import Acts


@dataclass(frozen=True)
class SamplingConfig:
    """How sampling-based control tries a motion.

    Attributes:
        characters: number of characters that try at once.
        samples_per_state: number of tries from each kept state; the first of them is the policy's own.
        hold_steps: control steps for which an offset is held.
        noise_range: (low, high) rad, between which the deviation of a character's offsets is drawn,
            evenly in its logarithm.
        memory: factor from one choice to the next with which earlier costs count, 0 to 1.
        distance: cost of 1 m of mean distance beside the imitation reward, where no value function
            estimates what is to come.
        rounds: how often the whole motion is sampled, each time about the last result with half the
            deviation.
        retries: how often a place is tried again where no character comes through, each time from
            `hold_steps * back` steps farther back.
        back: choices of offsets by which each retry goes farther back.
        seed: seed of all draws.
    """

    characters: int = 512
    samples_per_state: Annotated[int, Range(2)] = 4
    hold_steps: Count = 4
    noise_range: Annotated[tuple[float, float], Range(0, above=True, rising=True)] = (0.03, 0.3)
    memory: float = 0.7
    distance: float = 2.0
    rounds: Count = 1
    retries: Annotated[int, Range(0)] = 8
    back: Count = 5
    seed: int = 0

    def __post_init__(self) -> None:
        validate(self)
        if self.characters < 2 * self.samples_per_state:
            what = f"got {self.characters} characters, {self.samples_per_state} from each state"
            raise PoiseError(
                what, "SamplingConfig", "Take 8 or more, 2 or more from each", code="out-of-range"
            )


@dataclass(frozen=True, eq=False)
class SamplingResult:
    """What sampling-based control came to.

    Attributes:
        actions: `(T, A)`, which repeat the motion from the first frame.
        reached: number of actions before the motion was lost; all where it was not.
        error_mm: mean distance of the bodies up to there, mm.
        tries: control steps that all characters made.
    """

    actions: Tensor
    reached: int
    error_mm: float
    tries: int

    @property
    def whole(self) -> bool:
        """Whether the motion was found to its end."""
        return self.reached == len(self.actions)


@dataclass(eq=False)
class _Kept:
    """The K states that were kept before a choice of offsets.

    Attributes:
        sim: `(K, S)` snapshots of the worlds.
        action: `(K, A)` their last actions.
        obs: `(K, O)` their observations.
        cost: `(K,)` discounted cost so far.
        error: `(K,)` m, sum over the steps of the mean distance of the bodies.
    """

    sim: Tensor
    action: Tensor
    obs: Tensor
    cost: Tensor
    error: Tensor


@dataclass(eq=False)
class _Choice:
    """What led from some kept states to the next.

    Attributes:
        actions: `(k, K, A)`.
        offsets: `(k, K, A)`, what the actions are more than the policy's.
        parent: `(K,)` the kept state that each began from.
    """

    actions: Tensor
    offsets: Tensor
    parent: Tensor


def draw_offsets(
    count: int, env: ImitationEnv, noise_range: tuple[float, float], rng: torch.Generator
) -> Tensor:
    """`(count, A)`, offsets of an environment's actions that move its joint targets at random; none of
    what is no joint.

    noise_range: (low, high) rad of the targets, between which the deviation of each row is drawn, evenly
        in its logarithm.
    """
    low, high = noise_range
    size = low * (high / low) ** torch.rand(count, 1, generator=rng)
    out = size * torch.randn(count, env.num_actions, generator=rng)
    out[:, : env.hinges] /= env.task.pd.scale
    out[:, env.hinges :] = 0.0
    return out


class SamplingControl:
    """Tries one clip of an environment's reference from its first frame to its last.

    Args:
        env: without automatic restarts and guard, with the rewards of the task; its `num_envs` worlds
            are the characters.
        policy: acts on its observations.
        config: see `SamplingConfig`.
        value: the return `(N,)` that the policy is still to earn, of observations `(N, O)`; None goes
            by rewards and distances so far.
        clip: index of the clip.
    """

    def __init__(
        self,
        env: ImitationEnv,
        policy: Acts,
        config: SamplingConfig | None = None,
        value: Callable[[Tensor], Tensor] | None = None,
        clip: int = 0,
    ):
        self.env, self.policy, self.value = env, policy, value
        self.config = config or SamplingConfig(characters=env.num_envs)
        self.rng = torch.Generator().manual_seed(self.config.seed)
        self.clip, self.last = clip, int(env.reference.length[clip]) - 1
        self.states = env.num_envs // self.config.samples_per_state
        self.tries, self.scale = 0, 1.0
        self.offsets = torch.zeros(self.last, env.num_actions)

    @one_thread()
    def run(self, show: Callable[[int, int], None] | None = None) -> SamplingResult:
        """Samples from the first frame to the last. show: is told of steps done and all steps."""
        rounds, best = self.config.rounds, None
        for k in range(rounds):
            told = show and (lambda done, steps, k=k: show(k * steps + done, rounds * steps))
            found = self._round(told)
            if best is None or (found.whole and found.error_mm < best.error_mm):
                best = found
            if not found.whole:
                break
            self.scale /= 2.0
        assert best is not None
        return replace(best, tries=self.tries)

    def _round(self, show: Callable[[int, int], None] | None) -> SamplingResult:
        c, clip = self.config, torch.full((self.env.num_envs,), self.clip)
        obs = self.env.reset_to(clip, torch.zeros_like(clip))
        now = self._first(obs)
        before: deque[_Kept] = deque(maxlen=c.retries * c.back + 1)
        path: list[_Choice] = []
        came: tuple[int, list[_Choice], _Kept] = (0, [], now)
        wall, failures = 0, 0
        while (done := sum(len(x.actions) for x in path)) < self.last:
            if show is not None:
                show(done, self.last)
            before.append(now)
            choice, after = self._extend(now, done)
            if after is not None:
                path.append(choice)
                now = after
                continue
            # No character came through: from farther back each time, unless it is another place.
            if done > wall + c.hold_steps * c.back:
                failures = 0
            wall, failures = max(wall, done), failures + 1
            came = max(came, (done, list(path), now), key=lambda x: x[0])
            if failures > c.retries:
                done, path, now = came
                return self._result(path, now, done)
            for _ in range(min(failures * c.back, len(before) - 1)):
                before.pop()
                path.pop()
            now = before.pop()
        return self._result(path, now, self.last)

    def _first(self, obs: Tensor) -> _Kept:
        nothing = torch.zeros(self.states)
        k, env = self.states, self.env
        return _Kept(
            env.backend.snapshot()[:k], env.action[:k].clone(), obs[:k].clone(), nothing, nothing
        )

    def _extend(self, now: _Kept, done: int) -> tuple[_Choice, _Kept | None]:
        """One choice of offsets, tried by all characters; None where all lose the motion."""
        c, env, n = self.config, self.env, self.env.num_envs
        parent = torch.arange(n) % self.states
        env.backend.restore(now.sim[parent])
        env.action.copy_(now.action[parent])
        env.age.fill_(done)
        if int(env.frame[0]) != done:
            env.seek(env.clip, torch.full_like(env.frame, done))
        obs, cost, error = now.obs[parent], c.memory * now.cost[parent], now.error[parent].clone()
        drawn, lost = self._drawn(n), torch.zeros(n, dtype=torch.bool)
        made: list[Tensor] = []
        given: list[Tensor] = []
        for step in range(done, min(done + c.hold_steps, self.last)):
            given.append(self.offsets[step] + drawn)
            made.append(self.policy.act(obs) + given[-1])
            obs = env.step(made[-1]).final_obs
            ref = env.goal_pose().pos
            off = mpjpe_global(env.pose().pos, ref) / 1000.0
            lost |= has_lost(env.pose().pos, ref)
            cost, error = cost - env.imitation, error + off
            if self.value is None:
                cost = cost + c.distance * off
        self.tries += n * len(made)
        ahead = cost if self.value is None else cost - self.value(obs)
        ahead = torch.where(lost | ~ahead.isfinite(), torch.inf, ahead)
        best = ahead.argsort(stable=True)[: self.states]
        alive = best[ahead[best].isfinite()]
        if not len(alive):
            return _Choice(torch.stack(made), torch.stack(given), parent), None
        # Where fewer came through than are kept, they have more tries.
        best = alive[torch.arange(self.states) % len(alive)]
        actions, offsets = (torch.stack([a[best] for a in x]) for x in (made, given))
        choice = _Choice(actions, offsets, parent[best])
        kept = _Kept(env.backend.snapshot()[best], env.action[best], obs[best], cost[best], error[best])
        return choice, kept

    def _drawn(self, count: int) -> Tensor:
        """`(N, A)` rad; none for the first try from each state."""
        out = self.scale * draw_offsets(count, self.env, self.config.noise_range, self.rng)
        out[: self.states] = 0.0
        return out

    def _result(self, path: list[_Choice], now: _Kept, reached: int) -> SamplingResult:
        """The actions that led to the best of those that came farthest; beyond, none is known."""
        at = int(now.error.argmin())
        error, actions, end = float(now.error[at]), torch.zeros_like(self.offsets), reached
        for choice in reversed(path):
            begin = end - len(choice.actions)
            actions[begin:end], self.offsets[begin:end] = choice.actions[:, at], choice.offsets[:, at]
            at, end = int(choice.parent[at]), begin
        return SamplingResult(actions, reached, 1000.0 * error / max(1, reached), self.tries)
