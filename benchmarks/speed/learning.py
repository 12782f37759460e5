"""Lookahead labels, samples of training, and seconds of training to a figure, with networks on a GPU."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor

from poise.env import ImitationEnv
from poise.errors import PoiseError
from poise.jobs.runs import evaluate
from poise.jobs.tracker import Tracker
from poise.learn import Trainer, Value, VecEnv, load_checkpoint
from poise.learn.protocols import Policy
from poise.plan import TeacherConfig
from poise.recipes.imitation import Imitation
from speed.gpu import synchronize
from speed.machine import Clock, cores, median

#: A policy has learned its clips when so many start frames of 64 are tracked to the end without help.
FIGURE, STARTS = 0.9, 64
#: Seconds of training between two evaluations.
EVERY_S = 10.0


class OnDevice:
    """Worlds for a learner on another device, a `VecEnv`: MuJoCo on the cores, networks on a GPU."""

    def __init__(self, env: ImitationEnv, device: str):
        self.env, self.device = env, torch.device(device)
        self.num_envs, self.num_obs, self.num_actions = env.num_envs, env.num_obs, env.num_actions
        self.state, self.load_state, self.close = env.state, env.load_state, env.close

    def reset(self) -> Tensor:
        """New episodes everywhere."""
        return self.env.reset().to(self.device)

    def step(self, actions: Tensor) -> Any:
        """One control step."""
        out = self.env.step(actions.to(self.env.device))
        moved: list[Any] = [x.to(self.device) if isinstance(x, Tensor) else x for x in out]
        return type(out)._make(moved)


class ActsOn:
    """A policy on another device than those whom it acts for."""

    def __init__(self, policy: Policy, device: str):
        self.policy, self.device = policy, device

    def act(self, obs: Tensor) -> Tensor:
        """Actions `(N, A)` where the observations are."""
        return self.policy.act(obs.to(self.device)).to(obs.device)


def make_trainer(imitation: Imitation, physics: str, networks: str, **metadata: Any) -> Trainer:
    """PPO with physics on "cpu" or with MuJoCo Warp on "cuda", and networks on either; physics on a GPU
    has its networks there."""
    env: Any = imitation.env(device=physics)
    if torch.device(networks).type != env.device.type:
        env = OnDevice(env, networks)
    threads = cores() if torch.device(networks).type == "cpu" else 1
    ppo, seed, body = imitation.ppo(), imitation.config.seed, imitation.humanoid.identity
    return Trainer(cast(VecEnv, env), ppo, seed, body, metadata=metadata, update_threads=threads)


def bench_labels(
    tracker: Tracker,
    imitation: Imitation,
    config: TeacherConfig,
    networks: str,
    repeats: int,
    until: float,
) -> dict[str, Any]:
    """What a teacher that looks ahead says in a second, with physics on the cores.

    The first of its lessons warms up. A repeat is one lesson, of `config.decisions` of each world.
    """
    if tracker.value is None:
        raise PoiseError(
            "the policy was saved without its critic, which lookahead needs", code="critic-missing"
        )
    policy = tracker.policy.copy().to(networks)
    value = Value(policy, tracker.value.state(), tracker.config.ppo.activation)
    value.critic.to(networks)
    value.scale.to(networks)
    acts, teacher, clock = ActsOn(policy, networks), imitation.teacher(config), Clock()

    def worth(obs: Tensor) -> Tensor:
        return value(obs.to(networks)).to(obs.device)

    teacher.teach(acts, worth)
    rows: list[dict[str, float]] = []
    with clock.on(teacher.copies, "step", "copies"), clock.on(acts, "act", "policy"):
        while len(rows) < repeats and (not rows or time.monotonic() < until):
            clock.read()
            start = time.perf_counter()
            labels = len(teacher.teach(acts, worth)[0])
            seconds, parts = time.perf_counter() - start, clock.read()
            rows.append(
                {
                    "labels_per_s": labels / seconds,
                    "copies_share": parts["copies"] / seconds,
                    "policy_share": parts["policy"] / seconds,
                }
            )
    teacher.close()
    return {"threads": cores(), "repeats": len(rows), **_medians(rows)}


def bench_training(
    imitation: Imitation, physics: str, networks: str, repeats: int, until: float
) -> dict[str, Any]:
    """Samples a second of PPO, collection and update together; the first iteration warms up."""
    trainer = make_trainer(imitation, physics, networks)
    trainer.iterate()
    rows: list[dict[str, float]] = []
    while len(rows) < repeats and (not rows or time.monotonic() < until):
        stats = trainer.iterate()
        synchronize(trainer.env.device)
        rows.append(
            {
                "samples_per_s": stats.samples_per_s,
                "collect_s": stats.collect_seconds,
                "update_s": stats.update_seconds,
            }
        )
    batch, ppo = trainer.rollout.samples, trainer.config
    trainer.close()
    sizes = {"observations": trainer.env.num_obs, "hidden": list(ppo.policy_hidden)}
    return {"threads": cores(), "batch": batch, **sizes, "repeats": len(rows), **_medians(rows)}


def bench_figure(
    imitation: Imitation,
    physics: str,
    networks: str,
    checkpoint: Path,
    about: dict[str, Any],
    until: float,
    every_s: float = EVERY_S,
    most: int | None = None,
) -> dict[str, Any]:
    """Seconds of training from nothing until `FIGURE` of the start frames are tracked, without help.

    Stopped by the clock, it leaves a checkpoint and goes on from it the next time. Evaluations are of
    the deterministic policy on the CPU, and their time does not count.

    Args:
        about: what a checkpoint must agree about; another one is replaced.
        until: `time.monotonic()` when it stops.
        most: iterations in all, for tests.
    """
    kept = checkpoint.exists() and load_checkpoint(checkpoint)[1]["metadata"]["about"] == about
    trainer = make_trainer(imitation, physics, networks, about=about, curve=[])
    if kept:
        trainer.metadata = trainer.load(checkpoint)["metadata"]
    else:
        _warm_up(trainer.env)
    curve: list[dict[str, float]] = trainer.metadata["curve"]
    done, last, longest = False, trainer.seconds, 0.0
    while not done and time.monotonic() + longest < until and (most is None or trainer.iteration < most):
        start = time.monotonic()
        trainer.iterate()
        if trainer.seconds - last >= every_s:
            last, policy = trainer.seconds, trainer.ppo.actor.copy().to("cpu")
            card = evaluate(imitation, policy, {"help_limit": 0.0}, most=STARTS).card
            row = {"succ": card.succ, "mpjpe_mm": round(card.mpjpe_mm, 1)}
            curve.append({"seconds": round(trainer.seconds, 1), "samples": trainer.samples, **row})
            done = card.succ >= FIGURE
        longest = max(longest, time.monotonic() - start)
    trainer.save(checkpoint)
    trainer.close()
    if done:
        checkpoint.unlink()
    told = {"figure": FIGURE, "starts": STARTS, "curve": curve}
    seconds = {"training_s": round(trainer.seconds, 1), "samples": trainer.samples}
    return {"reached": done, **seconds, **told, "finished": done or most is not None}


def _warm_up(env: VecEnv) -> None:
    """Compiles what the first steps compile, so that it is no part of the training's time."""
    env.reset()
    for _ in range(3):
        env.step(torch.zeros(env.num_envs, env.num_actions, device=env.device))


def _medians(rows: list[dict[str, float]]) -> dict[str, float]:
    return {name: median([row[name] for row in rows]) for name in rows[0]}
