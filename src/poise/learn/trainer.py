"""The trainer: collect, learn, and a state from which training goes on bit for bit."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from poise.errors import PoiseError
from poise.learn.checkpoint import (
    State,
    TrainerMeta,
    check_fits,
    load_checkpoint,
    load_module,
    prefixed,
    save_checkpoint,
    take,
    under,
)
from poise.learn.clone import LessonConfig, Student
from poise.learn.parallel import (
    ALONE,
    Comm,
    gather_state,
    own_state,
    shared_statistics,
    sums,
    together,
)
from poise.learn.policy import PolicyBundle, WarmStart
from poise.learn.ppo import PPO, PPOConfig, UpdateStats
from poise.learn.protocols import Lessons, Style, VecEnv
from poise.learn.rollout import Episodes, Rollout, TrainingError, check_finite, collect
from poise.machine import one_thread
from poise.settings import check_data


@dataclass(frozen=True)
class IterationStats:
    """What one iteration did; all numbers but the times are the same for the same seed."""

    iteration: int
    """Iterations finished, this one included."""
    samples: int
    """Control steps learned from, over all iterations."""
    reward: float
    """Mean reward of the task per control step; that of a style is under "update/style_reward"."""
    episode_length: float
    """Mean control steps of the episodes that ended in this iteration; if none did, of the last
    iteration where one did (NaN before the first)."""
    episode_reward: float
    """Mean sum of rewards of the same episodes."""
    failure_rate: float
    """Share of the same episodes that ended by failure."""
    episodes: int
    """Episodes that ended in this iteration."""
    batch: int
    """Control steps of this iteration."""
    update: UpdateStats
    terms: Mapping[str, float]
    """Means of the environment's log over this iteration."""
    seconds: float
    """Training time since the first iteration, over all resumed runs."""
    collect_seconds: float
    update_seconds: float
    style: Mapping[str, float] = field(default_factory=dict)
    """Numbers of a learned style reward and of lessons, if there are any."""

    @property
    def samples_per_s(self) -> float:
        """Samples of this iteration over its time, collection and update together."""
        return self.batch / (self.collect_seconds + self.update_seconds)

    def row(self) -> dict[str, float]:
        """All numbers under flat names for a log; the times come last, under "time/"."""
        names = ("iteration", "samples", "reward", "episode_length", "episode_reward", "failure_rate")
        row: dict[str, float] = {name: getattr(self, name) for name in (*names, "episodes")}
        row |= {f"update/{k}": v for k, v in dataclasses.asdict(self.update).items()}
        row |= {f"update/{k}": v for k, v in self.style.items()}
        row |= {f"env/{k}": v for k, v in self.terms.items()}
        return row | {
            "time/seconds": self.seconds,
            "time/collect": self.collect_seconds,
            "time/update": self.update_seconds,
            "time/samples_per_s": self.samples_per_s,
        }


class Trainer:
    """PPO on one vectorised environment.

    Args:
        env: the environment; it is reset here.
        config: settings of PPO.
        seed: seeds the learner (the environment has a seed of its own).
        character: identity of the body that is trained, such as a hash; a checkpoint of another
            one is refused.
        metadata: JSON data that every checkpoint carries, such as the recipe and the clips.
        warm_start: a policy that gives the first weights and observation statistics, or a `WarmStart`
            that may bring a critic and counts what it cost; the action noise stays the config's. A
            column or a composer (`poise.learn.primitives`) is itself what learns, with its own noise.
        update_threads: with more than one, policy and critic are trained side by side, while the
            environment's own threads rest; the numbers are the same.
        comm: the processes that train together, each with a trainer and environments of its own but
            with the same seed, config and number of environments.
        lessons: a teacher, from which the policy learns after each update, see `learn.clone`, and how;
            it is closed with `close`.
    """

    def __init__(
        self,
        env: VecEnv,
        config: PPOConfig | None = None,
        seed: int = 0,
        character: str = "",
        metadata: Mapping[str, Any] | None = None,
        warm_start: PolicyBundle | WarmStart | None = None,
        update_threads: int = 1,
        comm: Comm = ALONE,
        style: Style | None = None,
        lessons: tuple[Lessons, LessonConfig] | None = None,
    ):
        self.env, self.config, self.seed = env, config or PPOConfig(), seed
        self.update_threads, self.comm, self.style = update_threads, comm, style
        self.character, self.metadata = character, dict(metadata or {})
        start = WarmStart(warm_start) if isinstance(warm_start, PolicyBundle) else warm_start
        actor = start.policy if start is not None and start.policy.learns_itself else None
        self.ppo = PPO(env.num_obs, env.num_actions, self.config, seed, env.device, comm, actor)
        if start is not None:
            _take_over(self.ppo, start)
        self.student = None if lessons is None else Student(self.ppo, *lessons, seed)
        drawn = self.ppo.actor.policy.num_drawn
        self.rollout = Rollout(
            self.config.horizon, env.num_envs, env.num_obs, drawn, torch.device(env.device)
        )
        self.episodes = Episodes(env.num_envs, torch.device(env.device))
        self.iteration = 0
        self.seconds: float
        self.samples, self.seconds = (start.samples, start.seconds) if start else (0, 0.0)
        # Length, reward and failure share of the last episodes that ended.
        self._ended = (math.nan, math.nan, math.nan)
        self._obs: Tensor | None = None

    def share_start(self) -> None:
        """Makes every process begin as the first one does, which alone had a warm start."""
        if self.comm.size == 1:
            return
        state = self.ppo.state()
        for name, value in state.items():
            if value.is_floating_point() and not name.startswith("generator/"):
                self.comm.sum_(value.zero_() if self.comm.rank else value)
        self.ppo.load_state(state)
        samples, self.seconds = sums(
            self.comm, (0.0, 0.0) if self.comm.rank else (self.samples, self.seconds)
        )
        self.samples = int(samples)

    @one_thread()
    def iterate(self) -> IterationStats:
        """Collects one batch and learns from it.

        A number that is not finite raises a `TrainingError`; the policy then is still that of
        the last good iteration, but the environment has moved on.
        """
        start = time.perf_counter()
        obs = self._begin() if self._obs is None else self._obs
        ppo, rollout = self.ppo, self.rollout
        with shared_statistics(self.comm, ppo.actor.norm), together(self.comm, TrainingError):
            self._obs = collect(
                self.env, ppo.actor.policy, ppo.actor.norm, rollout, obs, self.episodes, ppo.noise,
                self.style, ppo.distribution,
            )  # fmt: skip
            task = float(rollout.reward.mean())
            if self.style is not None:
                rollout.reward.copy_(self.style.reward(rollout.reward))
        collected = time.perf_counter()
        # The style first: if it fails, the policy is still that of the last good iteration.
        style = {} if self.style is None else self.style.update()
        train_policy = self.iteration >= self.config.critic_warmup
        if self.student is not None:
            train_policy &= self.student.config.reinforce
        update = ppo.update(rollout, train_policy, self.update_threads)
        if self.student is not None:
            style = style | self.student.learn()
        done = time.perf_counter()
        self.iteration += 1
        self.samples += rollout.samples * self.comm.size
        reward, seconds, terms = self._share(task, done - start, rollout.terms)
        self.seconds += seconds
        ended = self.episodes
        if ended.finished:
            totals = (ended.finished_length, ended.finished_total, ended.failures)
            a, b, c = (x / ended.finished for x in totals)
            self._ended = (a, b, c)
        return IterationStats(
            iteration=self.iteration,
            samples=self.samples,
            reward=reward,
            episode_length=self._ended[0],
            episode_reward=self._ended[1],
            failure_rate=self._ended[2],
            episodes=ended.finished,
            update=update,
            terms=terms,
            seconds=self.seconds,
            collect_seconds=collected - start,
            update_seconds=done - collected,
            batch=rollout.samples * self.comm.size,
            style=style,
        )

    def _share(
        self, reward: float, seconds: float, terms: dict[str, float]
    ) -> tuple[float, float, dict[str, float]]:
        """The numbers of this iteration over all processes: means, summed episodes, one clock."""
        comm, e = self.comm, self.episodes
        if comm.size == 1:
            return reward, seconds, terms
        names = sorted(terms)
        mine = [e.finished, e.finished_length, e.finished_total, e.failures]
        mine += [0.0 if comm.rank else seconds, reward, *(terms[k] for k in names)]
        count, e.finished_length, e.finished_total, e.failures, seconds, *means = sums(comm, mine)
        e.finished = round(count)
        reward, *values = (x / comm.size for x in means)
        return reward, seconds, dict(zip(names, values, strict=True))

    def _begin(self) -> Tensor:
        """The first observation, after some steps that only gather statistics."""
        obs, norm = self.env.reset(), self.ppo.actor.norm
        if float(norm.count) > 0:
            return obs
        with shared_statistics(self.comm, norm), together(self.comm, TrainingError), torch.no_grad():
            for _ in range(self.config.norm_warmup):
                check_finite("observation", obs)
                norm.observe(obs)
                obs = self.env.step(self.ppo.actor.policy.act(norm(obs), self.ppo.noise)).obs
        norm.freeze()
        return obs

    def policy(self) -> PolicyBundle:
        """A copy of the present policy, which later training does not change."""
        return self.ppo.actor.copy()

    def state(self) -> State:
        """Copies of everything that training goes on from; of all processes only on rank 0."""
        if self._obs is None:
            self._obs = self._begin()
        counters = (self.iteration, self.samples, self.seconds, *self._ended)
        own = {
            "trainer/obs": self._obs.clone(),
            "trainer/episode_length": self.episodes.length.clone(),
            "trainer/episode_reward": self.episodes.total.clone(),
            "trainer/counters": torch.tensor(counters, dtype=torch.float64),
        }
        style = {} if self.style is None else prefixed("style", self.style.state())
        env = prefixed("env", self.env.state())
        taught = {} if self.student is None else prefixed("student", self.student.state())
        return gather_state(self.comm, self.ppo.state() | env | style | taught | own)

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Goes on from what `state` returned, with the same environment and network sizes."""
        device, state = torch.device(self.env.device), own_state(self.comm, state)
        counters = take(state, "trainer/counters")
        if counters.shape != (6,) or not bool(counters[:3].isfinite().all() & (counters[:3] >= 0).all()):
            raise PoiseError(
                f"the saved counters make no sense: {counters.tolist()[:6]}", code="file-damaged"
            )
        obs = take(state, "trainer/obs")
        if obs.shape != (self.env.num_envs, self.env.num_obs):
            raise PoiseError(
                f"the saved state is of {obs.shape[0]} environments with {obs.shape[1]} observations, "
                f"this run has {self.env.num_envs} with {self.env.num_obs}",
                hint="Resume with the number of environments and the terms it was saved with",
                code="state-differs",
            )
        self.ppo.load_state(state)
        if self.style is not None:
            self.style.load_state(under("style", state))
        if self.student is not None:
            self.student.load_state(under("student", state))
        try:
            self.env.load_state(under("env", state))
        except (KeyError, IndexError, TypeError, ValueError, RuntimeError) as problem:
            why = f"'{problem.args[0]}' is missing" if isinstance(problem, KeyError) else str(problem)
            hint = "The checkpoint is damaged or was changed; go on from another one"
            raise PoiseError(
                f"the saved state of the worlds cannot be used ({why})", hint=hint, code="state-differs"
            ) from problem
        self._obs = obs.to(device, copy=True)
        self.episodes.length.copy_(take(state, "trainer/episode_length"))
        self.episodes.total.copy_(take(state, "trainer/episode_reward"))
        iteration, samples, self.seconds, a, b, c = counters.tolist()
        self.iteration, self.samples, self._ended = int(iteration), int(samples), (a, b, c)

    def save(self, path: str | Path, extra: Mapping[str, Tensor] | None = None) -> None:
        """Writes the whole state as a checkpoint, from which `load` or `load_policy` reads.

        extra: tensors that belong to the same moment, such as what decides when training ends.
        Of several processes all must call it, and rank 0 writes for all.
        """
        meta = {
            "kind": "trainer",
            **self.ppo.actor.identity(self.character),
            "num_envs": self.env.num_envs * self.comm.size,
            "processes": self.comm.size,
            "seed": self.seed,
            "config": dataclasses.asdict(self.config),
            "style": None if self.style is None else self.style.shape,
            "iteration": self.iteration,
            "samples": self.samples,
            "seconds": self.seconds,
            "metadata": self.metadata,
        }
        state = self.state()
        if self.comm.rank == 0:
            save_checkpoint(path, state | dict(extra or {}), meta)

    def load(self, path: str | Path) -> dict[str, Any]:
        """Goes on from a checkpoint and returns its metadata.

        Another character, observation, action or network size raises a `PoiseError`; other
        settings may differ, the present ones hold from here on.
        """
        tensors, meta = load_checkpoint(path)
        check_fits(meta, path, kind="trainer")
        check_data(TrainerMeta, meta, path)
        check_fits(
            meta,
            path,
            processes=self.comm.size if "processes" in meta else None,
            character=self.character,
            num_obs=self.env.num_obs,
            num_actions=self.env.num_actions,
            num_envs=self.env.num_envs * self.comm.size,
            policy=self.ppo.actor.shape,
            style=None if self.style is None else self.style.shape,
        )
        if self.style is None and meta.get("style") is not None:
            raise PoiseError(
                "the checkpoint was trained with a learned style reward, this run has none",
                path,
                "Use the settings it was made with, or start a new run in another folder",
                code="checkpoint-unfit",
            )
        try:
            self.load_state(tensors)
        except PoiseError as problem:
            raise PoiseError(
                problem.what, problem.where or path, problem.hint, code=problem.code
            ) from problem
        return meta

    def close(self) -> None:
        """Frees the worlds, a teacher's too."""
        self.env.close()
        if self.student is not None:
            self.student.lessons.close()


def _take_over(ppo: PPO, start: WarmStart) -> None:
    """Copies weights and statistics of a warm start into a fresh learner."""
    if not start.policy.learns_itself:
        norm, mean = start.policy.norm.state_dict(), start.policy.policy.mean.state_dict()
        load_module(ppo.actor.norm, prefixed("norm", norm), "norm")
        load_module(ppo.actor.policy.mean, prefixed("policy/mean", mean), "policy/mean")
    if start.critic is not None:
        load_module(ppo.critic, start.critic, "critic")
        load_module(ppo.return_norm, start.critic, "return_norm")
