"""Lookahead: before it acts, a controller simulates what a policy and small changes of it would do."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Annotated, NamedTuple

import torch
from torch import Tensor

from poise.errors import PoiseError
from poise.kinematics.forward import shapes_of
from poise.machine import one_thread
from poise.metrics import has_lost
from poise.metrics.plausibility import foot_contacts, jerk
from poise.metrics.shape_points import Shapes, foot_points
from poise.plan.sampling import draw_offsets
from poise.settings import Count, Length, NotNegative, Range, Share, validate

if TYPE_CHECKING:
    from poise.env.env import ImitationEnv, Snapshot
    from poise.env.task import Acts

#: m/s^3, the mean jerk below which a reference counts as calm.
CALM = 50.0


@dataclass(frozen=True, eq=False)
class Roughness:
    """How roughly K motions of T frames go, by the score card's own measures.

    Attributes:
        jerk: `(K, T')` m/s^3, mean over the bodies, from frame to frame.
        slide: `(K, T - 1)` m/s with which points of the soles that touch the ground move along it,
            summed over the points and divided by half their number.
    """

    jerk: Tensor
    slide: Tensor

    @classmethod
    def of(
        cls, pos: Tensor, quat: Tensor, past: Tensor, shapes: Shapes, feet: Sequence[int], rate_hz: float
    ) -> Roughness:
        """Measures predictions.

        Args:
            pos: `(K, T, B, 3)` m, world positions of the bodies, the first where they are now.
            quat: `(K, T, B, 4)` wxyz.
            past: `(K, k, B, 3)` m, up to three frames before them; `(1, k, B, 3)` where all share them.
            shapes: the solids of the bodies.
            feet: indices of the feet among the bodies.
            rate_hz: frames a second.
        """
        whole = torch.cat((past.expand(len(pos), -1, -1, -1), pos), 1)
        speed, contact = foot_contacts(foot_points(pos, quat, shapes, feet), rate_hz)
        slide = (speed * contact).sum(-1) / 1000.0 / (speed.shape[-1] / 2)
        few = whole.shape[1] < 4
        return cls(slide[:, :0] if few else jerk(whole, rate_hz), slide)

    def price(self, reference: Roughness, jerk_price: float, slide_price: float) -> Tensor:
        """`(K,)`, what these motions cost beside references `(G, ...)`, each that of K / G of them,

            jerk_price sum_t j_t / max(mean j_ref, CALM) + slide_price sum_t max(0, s_t - mean s_ref),

        with the jerk j and the slide s, so that a leap may be as jerky as a leap is, and standing feet
        stand.
        """
        if not self.slide.shape[1]:
            return torch.zeros(len(self.slide))
        each = len(self.slide) // len(reference.slide)
        slid = reference.slide.mean(1, keepdim=True).repeat_interleave(each, 0)
        price = slide_price * (self.slide - slid).clamp_min(0.0).sum(1)
        if self.jerk.shape[1]:
            source = torch.full((len(price),), CALM)
            if reference.jerk.shape[1]:
                source = reference.jerk.mean(1).clamp_min(CALM).repeat_interleave(each)
            price = price + jerk_price / source * self.jerk.sum(1)
        return price


#: What each control step costs in which a copy is lost.
LOSS = 100.0


class Changes(NamedTuple):
    """What N copies change of a policy's action pi: a_h = lerp(much pi(o_h) + offset_h, a_(h-1), keep).

    Attributes:
        offsets: `(N, H, A)` rad.
        keep: `(N, 1)`, share of the last action that actions keep, in place of the environment's own
            (`TaskConfig.filter`).
        much: `(N, 1)`, share of the policy's own action.
    """

    offsets: Tensor
    keep: Tensor
    much: Tensor


class CandidateScores(NamedTuple):
    """What N copies of G worlds came to.

    Attributes:
        cost: `(N,)`, c = - sum_h gamma^h r_h - gamma^H V(o_H), and `LOSS` for each step that is lost.
        lost: `(N,)` bool, whether one was.
        ended: `(G,)` bool, whether a world's goal ended before the horizon.
        rough: how rough the copies were.
        source: how rough their goals were, `(G, ...)`.
        off: `(N, T, B)` m, how far each body was from its goal, from the first step on.
    """

    cost: Tensor
    lost: Tensor
    ended: Tensor
    rough: Roughness
    source: Roughness
    off: Tensor


class Candidates:
    """Simulates what is tried; N copies are of G worlds, N / G of each one after another.

    Args:
        copies: an environment of N worlds without ends and automatic restarts, with rewards
            (`Imitation.bare`).
        policy: acts on its observations.
        value: the return `(N,)` that the policy is still to earn, of observations `(N, O)`.
        discount: gamma.
    """

    def __init__(
        self,
        copies: ImitationEnv,
        policy: Acts,
        value: Callable[[Tensor], Tensor],
        discount: float,
    ):
        self.copies, self.policy, self.value, self.discount = copies, policy, value, discount
        humanoid = copies.goal.humanoid
        self._shapes, self._feet = shapes_of(humanoid.table), humanoid.feet
        self.steps = 0

    def tried(
        self, snapshot: Snapshot, changes: Changes, past: Tensor, groups: int = 1
    ) -> CandidateScores:
        """What the copies come to from a snapshot of one world or of N.

        Args:
            past: `(1 or N, k, B, 3)` m, the bodies in the frames before; with none nothing is kept of
                an action before the first.
            groups: G.
        """
        env, n = self.copies, self.copies.num_envs
        own = slice(None, None, n // groups)
        obs, start = env.restore(snapshot), env.pose()
        pos, quat = [start.pos.clone()], [start.quat.clone()]
        aim = env.goal_pose()
        ref_pos, ref_quat = [aim.pos[own].clone()], [aim.quat[own].clone()]
        cost, lost = torch.zeros(n), torch.zeros(n, dtype=torch.bool)
        ended = torch.zeros(groups, dtype=torch.bool)
        # Nothing came before the first action of an episode.
        keep = changes.keep * (env.age > 0).unsqueeze(1) if past.shape[1] else 0.0 * changes.keep
        factor = 1.0
        for offset in changes.offsets.unbind(1):
            # The last frame of a clip is a goal that is reached.
            ended |= env.goal.layout.place(env.goal.now()).end[own] > 0
            if bool(ended.all()):
                break
            action = torch.lerp(changes.much * self.policy.act(obs) + offset, env.action, keep)
            keep = changes.keep
            obs = env.step(env.unfiltered(action)).final_obs
            pose = env.pose()
            pos.append(pose.pos.clone())
            quat.append(pose.quat.clone())
            aim = env.goal_pose()
            ref_pos.append(aim.pos[own].clone())
            ref_quat.append(aim.quat[own].clone())
            lost |= has_lost(pose.pos, aim.pos)
            cost, factor = cost - factor * env.imitation + LOSS * lost, factor * self.discount
        cost = cost - factor * self.value(obs)
        self.steps += n * (len(pos) - 1)
        rough, source = (
            Roughness.of(
                torch.stack(p, 1), torch.stack(q, 1), was, self._shapes, self._feet, env.goal.rate_hz
            )
            for p, q, was in ((pos, quat, past), (ref_pos, ref_quat, past[:1, :0]))
        )
        each = n // groups
        aims = torch.stack(ref_pos[1:] or ref_pos, 1).repeat_interleave(each, 0)
        off = (torch.stack(pos[1:] or pos, 1) - aims).norm(dim=-1)
        return CandidateScores(cost, lost, ended, rough, source, off)


#: Copies below which there is nothing to choose from.
FEWEST = 4
#: Budget from which on the horizon is longer, and the longer one in control steps.
FAR = (400.0, 16)
#: Share of the slack that is always left.
LEAST = 0.05
#: Frames before a prediction that its jerk needs.
PAST = 3


@dataclass(frozen=True)
class LookaheadConfig:
    """How a controller looks ahead.

    Attributes:
        candidates: copies of the character that try at once.
        horizon: control steps that each is simulated.
        hold_steps: control steps from one decision to the next, for which an offset is held; it fades
            over the rest of the horizon.
        noise_range: (low, high) rad, between which the deviation of a copy's offsets is drawn, evenly in
            its logarithm.
        warm: share of the copies with offsets about those that the last decision had planned to go on
            with; the others have theirs about none.
        smoothing: shares of the last action that actions keep; the copies take them in turns. They
            replace the share of an environment that filters (`TaskConfig.filter`), which only the first
            copy keeps, since it does what the policy does.
        corrections: shares of the policy's own action that the copies add their offsets to; they take
            them in turns, too. Less of it is less jerk, where the policy corrects more than it must.
        jerk_price: cost of a control step as jerky as the goal, see `Roughness.price`.
        slide_price: cost of 1 m/s with which soles slide more than the goal's, in a control step.
        slack: how much more than the best one a copy may cost in tracking alone, and still be chosen,
            where the character is on its goal.
        strict_m: mean distance (m) from the goal at which there is next to no slack left, so that
            tracking alone decides; between them it falls evenly.
        discount: gamma.
        seed: seed of all draws.
    """

    candidates: int = 64
    horizon: int = 12
    hold_steps: Count = 4
    noise_range: Annotated[tuple[float, float], Range(0, above=True, rising=True)] = (0.03, 0.3)
    warm: Share = 0.5
    smoothing: Annotated[tuple[float, ...], Range(0, 1, below=True), Length(1)] = (
        0.0,
        0.5,
        0.7,
        0.9,
        0.97,
    )
    corrections: Annotated[tuple[float, ...], Range(0, 1)] = (1.0, 0.7, 0.4, 0.1)
    jerk_price: NotNegative = 0.5
    slide_price: NotNegative = 12.0
    slack: NotNegative = 1.5
    strict_m: Annotated[float, Range(0, above=True, infinite=True)] = 0.25
    discount: Annotated[float, Range(0, 1, above=True)] = 0.97
    seed: int = 0

    def __post_init__(self) -> None:
        validate(self)
        if self.candidates < max(FEWEST, 2 * len(self.smoothing)):
            least = max(FEWEST, 2 * len(self.smoothing))
            what = f"lookahead needs at least {least} candidates, got {self.candidates}"
            steps = least * self.horizon / self.hold_steps
            raise PoiseError(
                what, hint=f"Give a budget of {steps:g} simulated steps or more", code="budget-too-small"
            )
        if self.hold_steps > self.horizon:
            what = f"hold_steps must lie in 1 to the horizon {self.horizon}, got {self.hold_steps}"
            raise PoiseError(what, "LookaheadConfig", code="out-of-range")
        if self.corrections[:1] != (1.0,):
            what = f"corrections must begin with 1, got {self.corrections}"
            raise PoiseError(what, "LookaheadConfig", code="out-of-range")

    @property
    def budget(self) -> float:
        """Simulated control steps for each that is made."""
        return self.candidates * self.horizon / self.hold_steps

    def with_budget(self, steps: float) -> LookaheadConfig:
        """The same with as many candidates as so many simulated control steps for each that is made
        allow; from `FAR` on they look farther ahead, which is worth more then than further candidates.

        Raises:
            PoiseError: too few.
        """
        horizon = max(self.horizon, FAR[1]) if steps >= FAR[0] else self.horizon
        return replace(self, candidates=int(steps * self.hold_steps / horizon), horizon=horizon)


class Choice(NamedTuple):
    """What a decision came to.

    Attributes:
        offsets: `(H, A)` rad, by control step from now on.
        smoothing: share of the last action that actions keep.
        correction: share of the policy's own action.
    """

    offsets: Tensor
    smoothing: float
    correction: float


@dataclass(eq=False)
class _World:
    """What a controller remembers of a world.

    Attributes:
        choice: what it does now; None before the first decision.
        step: control steps since the decision.
        past: `(k, B, 3)` m, the bodies in the last frames, up to `PAST`.
    """

    choice: Choice | None = None
    step: int = 0
    past: list[Tensor] = field(default_factory=list)


class Lookahead:
    """Acts as a policy does, after it has looked ahead; `watch` tells it which environment it acts in.

        control = Lookahead(copies, policy, value)
        control.watch(env)
        simulate(env, control, obs, steps)

    Every few control steps the worlds of `copies` become copies of the character as it stands. Each copy
    acts as the policy plus an offset of its own (`Changes`), is simulated some steps ahead, and costs

        c = - sum_h gamma^h r_h - gamma^H V(o_H) + prices,

    with the imitation reward r, the critic's V, and prices of jerk and sliding feet (`Roughness.price`).
    Each control step in which the motion is lost costs `LOSS`, more than all of that. The character then
    does what the best copy began with. A copy sees no more of the goal than the goal tells: a clip its
    frames, a stream or a generator what it knows.

    Args:
        copies: an environment of the same body and kind of goal in which it tries, of as many worlds as
            there are candidates: without ends and automatic restarts, with rewards (`Imitation.bare`).
        policy: acts on observations of both environments.
        value: the return `(N,)` that the policy is still to earn, of observations `(N, O)`.
        config: see `LookaheadConfig`.
        prices: `(F, B)`, what a metre costs by which each body is off its goal, beside the reward, in
            each of the reference's frames; None for nothing.

    Attributes:
        keep: `(K, 1)`, the share of the last action that each candidate keeps; the first one, which is
            the policy's own, keeps that of the task's filter.
        seconds: of each decision.
    """

    def __init__(
        self,
        copies: ImitationEnv,
        policy: Acts,
        value: Callable[[Tensor], Tensor],
        config: LookaheadConfig | None = None,
        prices: Tensor | None = None,
    ):
        self.prices = prices
        self.copies, self.policy = copies, policy
        self.config = c = config or LookaheadConfig(candidates=copies.num_envs)
        if copies.num_envs != c.candidates:
            what = f"{c.candidates} candidates need as many copies, got {copies.num_envs}"
            raise PoiseError(what, "Lookahead", code="count-differs")
        self._candidates = Candidates(copies, policy, value, c.discount)
        shares = torch.tensor(c.smoothing)
        turn = torch.arange(c.candidates)
        self.keep = shares[turn % len(shares)].unsqueeze(1)
        if copies.task.filter:
            self.keep[0] = copies.task.filter
        much = torch.tensor(c.corrections)
        self._much = much[turn // len(shares) % len(much)].unsqueeze(1)
        # Held, then fading to nothing at the horizon.
        left = torch.arange(1, c.horizon + 1) - c.hold_steps
        self._shape = 1.0 - left.clamp_min(0) / max(1, c.horizon - c.hold_steps)
        self._rng = torch.Generator().manual_seed(c.seed)
        self._env: ImitationEnv | None = None
        self._only: frozenset[int] | None = None
        self._worlds: list[_World] = []
        self.seconds: list[float] = []

    def watch(self, env: ImitationEnv, worlds: Collection[int] | None = None) -> None:
        """Acts in the worlds of `env` from now on, and looks ahead in some of them, all for None."""
        self._env, self._only = env, None if worlds is None else frozenset(worlds)
        self._worlds = [_World() for _ in range(env.num_envs)]
        self._rng.manual_seed(self.config.seed)

    def remember(self, world: int, past: Tensor) -> None:
        """Tells what a world's bodies `(k, B, 3)` m did before it acts: jerk is counted from there."""
        self._worlds[world].past = list(past[-PAST:].float())

    @property
    def steps(self) -> int:
        """Control steps that were simulated for the decisions."""
        return self._candidates.steps

    @property
    def num_obs(self) -> int:
        """Width of the observations that the policy takes."""
        return getattr(self.policy, "num_obs", self.copies.num_obs)

    @property
    def num_actions(self) -> int:
        """Width of the actions that the policy gives."""
        return getattr(self.policy, "num_actions", self.copies.num_actions)

    @one_thread()
    def act(self, obs: Tensor) -> Tensor:
        """Actions `(N, A)` for observations `(N, O)` of the worlds as they stand.

        Raises:
            PoiseError: it watches no environment.
        """
        env = self._env
        if env is None:
            raise PoiseError(
                "a lookahead acts in an environment",
                hint="Call watch(env) first",
                code="environment-missing",
            )
        pos, fresh = env.pose().pos, (env.age == 0).tolist()
        offsets = torch.zeros(len(obs), env.num_actions)
        keep, much = torch.zeros(len(obs), 1), torch.ones(len(obs), 1)
        for i, world in enumerate(self._worlds):
            if self._only is not None and i not in self._only:
                continue
            if fresh[i]:
                world.choice, world.past = None, []
            if world.choice is None or world.step == self.config.hold_steps:
                # Worlds decide in turns, so that no control step waits for all of them.
                world.step = i % self.config.hold_steps if world.choice is None else 0
                world.choice = self._decide(i, world)
            offsets[i] = world.choice.offsets[world.step]
            keep[i] = 0.0 if fresh[i] else world.choice.smoothing
            much[i] = world.choice.correction
            world.step += 1
            world.past = [*world.past, pos[i].clone()][-PAST:]
        return env.unfiltered(torch.lerp(much * self.policy.act(obs) + offsets, env.action, keep))

    def _decide(self, i: int, world: _World) -> Choice:
        """What world i does next."""
        env = self._env
        assert env is not None
        begun = time.perf_counter()
        bodies = torch.stack(world.past) if world.past else env.pose().pos[:0]
        off = float((env.pose().pos[i] - env.goal_pose().pos[i]).norm(dim=-1).mean())
        last = None if world.choice is None else world.choice.offsets[self.config.hold_steps :]
        prices = None
        if self.prices is not None:
            reference, clip = env.reference, int(env.clip[i])
            first = int(reference.start[clip])
            frame = torch.arange(1, self.config.horizon + 1) + int(env.frame[i])
            prices = self.prices[first + frame.clamp_max(int(reference.length[clip]) - 1)]
        out = self.decide(env.snapshot(torch.tensor([i])), bodies, off, last, prices=prices)
        self.seconds.append(time.perf_counter() - begun)
        return out

    def decide(
        self,
        snapshot: Snapshot,
        past: Tensor,
        off_m: float,
        last: Tensor | None = None,
        meanwhile: Tensor | None = None,
        prices: Tensor | None = None,
    ) -> Choice:
        """What a world does from a snapshot of it on.

        Args:
            past: `(k, B, 3)` m, its bodies in the frames before.
            off_m: mean distance of its bodies from the goal.
            last: `(h, A)` offsets that were planned for then.
            meanwhile: `(m, A)` offsets that it acts by before the decision counts; the choice begins
                with them.
            prices: `(T, B)` in each of the frames to come, see `Lookahead`.
        """
        c, drawn = self.config, self._drawn(last)
        if meanwhile is not None:
            drawn = torch.cat((meanwhile.expand(len(drawn), -1, -1), drawn), 1)
        changes = Changes(drawn, self.keep, self._much)
        cost, _, _, rough, source, apart = self._candidates.tried(snapshot, changes, past.unsqueeze(0))
        if prices is not None:
            cost = cost + (prices[: apart.shape[1]] * apart).sum((1, 2))
        price = rough.price(source, c.jerk_price, c.slide_price)
        left = 1.0 - off_m / c.strict_m
        cost = torch.where(cost.isfinite() & price.isfinite(), cost, torch.inf)
        allowed = cost.isfinite() & (cost <= cost.min() + c.slack * max(LEAST, left))
        # Where all went bad the policy acts alone.
        best = int(torch.where(allowed, cost + price, torch.inf).argmin()) if bool(allowed.any()) else 0
        return Choice(drawn[best], float(self.keep[best]), float(self._much[best]))

    def _drawn(self, rest: Tensor | None) -> Tensor:
        """`(K, H, A)` offsets: none, those `(h, A)` planned before, and random ones about either."""
        c, n = self.config, len(self.config.smoothing)
        noise = draw_offsets(c.candidates, self.copies, c.noise_range, self._rng)
        about = torch.rand(c.candidates, generator=self._rng) < c.warm
        noise[: 2 * n], about[:n], about[n : 2 * n] = 0.0, False, True
        out = noise[:, None] * self._shape[:, None]
        if rest is not None:
            out[about, : len(rest)] += rest
        return out
