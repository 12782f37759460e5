"""Trains our PPO and rsl_rl's on the same task with equal samples and network sizes.

    pip install 'poise-motion[rsl-rl]'
    python benchmarks/rsl_rl_twin.py CLIP [--samples 2000000] [--envs 512] [--seeds 1] [--out FILE]

Writes FILE.json (both learning curves, samples/s, settings, versions) and FILE.svg (the curves over
samples). What is compared is the deterministic policy from 64 start frames to the clip's end, since
rsl_rl learns how much noise it explores with and the reward of training depends on that. Each learner
runs alone, one after the other, in turns of `--seeds` seeds; the worlds, their seeds, the rewards,
horizon, minibatches, epochs, networks, first noise and discount are the same. What rsl_rl does in
another way stays its own: one learning rate for both networks, clipped value loss, no scaled returns,
learned noise. `--rsl-lr adaptive` lets it choose the rate by its KL rule.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import platform
import time
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from rsl_rl.runners import OnPolicyRunner
from tensordict import TensorDict

from poise.env.faces import GROUP, RslRlVecEnv
from poise.formats import read_clip
from poise.jobs.runs import evaluate
from poise.learn import Trainer, VecEnv
from poise.motion import ClipLibrary
from poise.recipes.imitation import Imitation
from poise.recipes.residual_force import ResidualForce, build
from poise.score.report.svg import line_plot

#: Samples, seconds of training; of the deterministic policy Succ, reward per step, joint error in mm;
#: and the reward of the last training step, noise included.
Curve = list[tuple[int, float, float, float, float, float]]


class _Acting:
    """Rsl_rl's network as a policy that can be evaluated."""

    def __init__(self, network: Callable[[TensorDict], torch.Tensor]):
        self.network = network

    def act(self, obs: torch.Tensor) -> torch.Tensor:
        return self.network(TensorDict({GROUP: obs}, [len(obs)]))


def _scored(task: Imitation, policy: Any) -> tuple[float, float, float]:
    card = evaluate(task, policy, {}, most=64).card
    return card.succ, card.reward["total"], card.mpjpe_mm


def ours(task: Imitation, seed: int, samples: int, every: int) -> Curve:
    """Our PPO; the clock counts collection and update, as rsl_rl's does."""
    env = task.env(seed=seed)
    trainer = Trainer(cast(VecEnv, env), task.ppo(), seed, task.humanoid.identity)
    trainer.state()  # The warm-up of the statistics is not counted.
    curve: Curve = []
    due = every
    while trainer.samples < samples:
        stats = trainer.iterate()
        if stats.samples >= due or stats.samples >= samples:
            score = _scored(task, trainer.policy())
            curve.append((stats.samples, stats.seconds, *score, stats.terms["imitation"]))
            due += every
    env.close()
    return curve


class _Watched(RslRlVecEnv):
    """Sums up the imitation reward of an iteration."""

    total, steps = 0.0, 0

    def step(self, actions: torch.Tensor) -> tuple[Any, torch.Tensor, torch.Tensor, dict[str, Any]]:
        out = super().step(actions)
        self.total += out[3]["log"]["/imitation"]
        self.steps += 1
        return out


def theirs(task: Imitation, seed: int, samples: int, every: int, rate: str) -> Curve:
    """Rsl_rl's PPO through the adapter, with the settings of `task` where it has them."""
    torch.manual_seed(seed)
    ppo, env = task.ppo(), _Watched(task.env(seed=seed))
    batch = ppo.horizon * env.num_envs
    std = ppo.std if isinstance(ppo.std, float) else float(np.mean(ppo.std))
    noise = {"class_name": "GaussianDistribution", "init_std": std, "std_type": "log"}

    def network(widths: tuple[int, ...]) -> dict[str, Any]:
        common = {"class_name": "MLPModel", "activation": ppo.activation, "obs_normalization": True}
        return {**common, "hidden_dims": list(widths)}

    config = {
        "num_steps_per_env": ppo.horizon,
        "save_interval": 10**9,
        "obs_groups": {"actor": [GROUP], "critic": [GROUP]},
        "algorithm": {
            "class_name": "PPO",
            "num_learning_epochs": ppo.epochs,
            "num_mini_batches": max(1, round(batch / ppo.minibatch)),
            "gamma": ppo.gamma,
            "lam": ppo.lam,
            "clip_param": ppo.clip,
            "entropy_coef": ppo.entropy_weight,
            "learning_rate": ppo.policy_lr,
            "schedule": rate,
            "desired_kl": 0.01 if rate == "adaptive" else None,
            "max_grad_norm": ppo.policy_grad_norm or 1e9,
        },
        "actor": {**network(ppo.policy_hidden), "distribution_cfg": noise},
        "critic": network(ppo.value_hidden),
    }
    # Its runner prints the networks and a table per iteration.
    with contextlib.redirect_stdout(io.StringIO()):
        runner = OnPolicyRunner(cast(Any, env), config)
        with torch.no_grad():
            # The same noise per action as ours: it differs between joints and residual force.
            deviations = torch.as_tensor(ppo.std, dtype=torch.float32).expand(env.num_actions)
            runner.alg.actor.distribution.log_std_param.copy_(deviations.log())
            # Both start near the reference: the policy's last layer is small, as ours is.
            last = [m for m in runner.alg.actor.mlp.modules() if isinstance(m, torch.nn.Linear)][-1]
            last.weight.mul_(0.1)
            last.bias.mul_(0.1)
        curve: Curve = []
        seconds, made, due = 0.0, 0, every
        while made < samples:
            env.total, env.steps = 0.0, 0
            begun = time.perf_counter()
            runner.learn(1)
            seconds += time.perf_counter() - begun
            made += batch
            if made >= due or made >= samples:
                score = _scored(task, _Acting(runner.get_inference_policy()))
                curve.append((made, seconds, *score, env.total / env.steps))
                runner.alg.train_mode()
                due += every
    env.close()
    return curve


def summary(curves: list[Curve]) -> dict[str, Any]:
    """Medians over the seeds of the rate and of the last figures, and every curve."""
    return {
        "samples_per_s": float(np.median([c[-1][0] / c[-1][1] for c in curves])),
        "succ": float(np.median([c[-1][2] for c in curves])),
        "reward": float(np.median([c[-1][3] for c in curves])),
        "mpjpe_mm": float(np.median([c[-1][4] for c in curves])),
        "curves": curves,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("clip", type=Path)
    parser.add_argument("--samples", type=int, default=2_000_000)
    parser.add_argument("--every", type=int, default=200_000, help="samples between evaluations")
    parser.add_argument("--envs", type=int, default=512)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--rsl-lr", choices=("fixed", "adaptive"), default="fixed")
    parser.add_argument("--threads", type=int, default=1, help="torch's, for both learners")
    parser.add_argument("--out", type=Path, default=Path("benchmarks/rsl_rl_twin"))
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    svg = args.out.with_suffix(".svg")
    config = ResidualForce(help_limit=100.0, help_start=None, num_envs=args.envs)
    task = build(ClipLibrary.of(read_clip(args.clip)), config)
    curves: dict[str, list[Curve]] = {"poise": [], "rsl_rl": []}
    for seed in range(args.seeds):
        curves["poise"].append(ours(task, seed, args.samples, args.every))
        curves["rsl_rl"].append(theirs(task, seed, args.samples, args.every, args.rsl_lr))
    result: dict[str, Any] = {name: summary(c) for name, c in curves.items()}
    versions = {name: metadata.version(name) for name in ("torch", "mujoco", "rsl-rl-lib")}
    result |= {"clip": args.clip.stem, "samples": args.samples, "envs": args.envs, "rsl_lr": args.rsl_lr}
    result |= {"versions": versions, "machine": platform.machine(), "torch_threads": args.threads}
    args.out.with_suffix(".json").write_text(json.dumps(result, indent=1) + "\n")
    # The first seed's curves; all are in the JSON.
    lines = [(name, [x[0] for x in c[0]], [x[3] for x in c[0]]) for name, c in curves.items()]
    title = f"{args.clip.stem}, equal samples, deterministic policies"
    line_plot(lines, title, "samples", "reward per step", svg)
    for name in curves:
        r = result[name]
        print(
            f"{name:<7} {r['samples_per_s']:>10,.0f} samples/s   at the end: succ {r['succ']:.3f}, "
            f"reward {r['reward']:.3f}, {r['mpjpe_mm']:.1f} mm"
        )


if __name__ == "__main__":
    main()
