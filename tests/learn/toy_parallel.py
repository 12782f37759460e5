"""Trains points in one process of a group; started by `torch.multiprocessing` or as a program."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest
import torch
from torch import Tensor
from toy_point_env import PointEnv

import poise.learn.rollout
from poise.errors import PoiseError
from poise.learn import PPOConfig, StepResult, Trainer, Until, run
from poise.learn.networks import GaussianPolicy
from poise.learn.parallel import ALONE, Comm, joined, rank_seed

torch.set_num_threads(1)
TOY = PPOConfig(
    products="float32",
    std=0.3,
    horizon=8,
    epochs=2,
    policy_hidden=(16,),
    value_hidden=(16,),
    # One minibatch: which samples share one differs between one and more processes.
    minibatch=8 * 32,
    kl_target=0.01,
    learn_std=True,
    norm_warmup=3,
)
ENVS = 32


class TwinEnv(PointEnv):
    """What two processes have together: their environments, one after the other."""

    def __init__(self, num_envs: int, seed: int = 0):
        super().__init__(num_envs, seed)
        self.parts = [PointEnv(num_envs // 2, rank_seed(seed, r)) for r in range(2)]

    def reset(self) -> Tensor:
        return torch.cat([part.reset() for part in self.parts])

    def step(self, actions: Tensor) -> StepResult:
        a, b = (part.step(x) for part, x in zip(self.parts, actions.chunk(2), strict=True))
        log = {k: (a.log[k] + b.log[k]) / 2 for k in a.log}
        return StepResult(*(torch.cat([x, y]) for x, y in zip(a[:5], b[:5], strict=True)), log)


def twin_draws(
    policy: GaussianPolicy, patch: pytest.MonkeyPatch, noises: tuple[torch.Generator, torch.Generator]
) -> None:
    """Makes a trainer draw its noise for each half of the rows as a process of its own would."""
    act = policy.act

    def halves(obs: Tensor, generator: torch.Generator | None = None) -> Tensor:
        if generator is None:
            return act(obs)
        return torch.cat([act(x, n) for x, n in zip(obs.chunk(2), noises, strict=True)])

    def normal(out: Tensor, _: torch.Generator) -> None:
        for half, n in zip(out.chunk(2, 1), noises, strict=True):
            half.copy_(torch.randn(half.shape, generator=n))

    patch.setattr(policy, "act", halves)
    patch.setattr(poise.learn.rollout, "standard_normal", normal)


def trainer(comm: Comm = ALONE, config: PPOConfig = TOY, seed: int = 3, bad_rank: int = -1) -> Trainer:
    env = PointEnv(ENVS // comm.size, rank_seed(seed, comm.rank))
    if comm.rank == bad_rank:
        env.step = lambda actions: StepResult(  # type: ignore[method-assign]
            *PointEnv.step(env, actions * torch.nan)
        )
    return Trainer(env, config, seed, character="point", comm=comm)


def train(folder: Path, iterations: int, bad_rank: int = -1) -> None:
    """One process's whole run; its last weights go to `weights<rank>.txt` for comparison."""
    with joined() as comm:
        one = trainer(comm, bad_rank=bad_rank)
        try:
            run(one, Until(iterations=iterations), folder, tensorboard=False)
        except PoiseError as problem:
            (folder / f"error{comm.rank}.txt").write_text(str(problem))
            return
        state = one.ppo.state()
        weights = torch.cat([v.double().flatten() for k, v in state.items() if "noise" not in k])
        (folder / f"weights{comm.rank}.txt").write_text(" ".join(map(float.hex, weights.tolist())))


def spawned(rank: int, size: int, runs: list[tuple[int, str, int, int]]) -> None:
    os.environ |= {"RANK": str(rank), "WORLD_SIZE": str(size), "LOCAL_WORLD_SIZE": str(size)}
    for port, folder, iterations, bad_rank in runs:
        os.environ |= {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)}
        train(Path(folder), iterations, bad_rank)
        threads = [t.read_text().strip() for t in Path("/proc/self/task").glob("*/comm")]
        (Path(folder) / f"threads{rank}.txt").write_text("\n".join(threads))


if __name__ == "__main__":
    train(Path(sys.argv[1]), int(sys.argv[2]))
    print("finished", flush=True)
