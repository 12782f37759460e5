"""Speed of an NVIDIA GPU: stepping beside mujoco_warp's own captured step, the tracker's training,
labels.

Each part takes less than 9 minutes: what the clock stops goes on with the next command. In a smoke test
everything runs on the CPU, Warp's steps only where it is installed. The null is MuJoCo on the cores.
"""

from __future__ import annotations

import importlib.util
import math
import time
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor

from benchmarks.common.clips import WALK, Places
from benchmarks.common.machine import cores, median
from benchmarks.common.rows import Figure, of
from benchmarks.common.runner import Part, Raws
from benchmarks.suites.engine import Progress, bench_engine, exploring
from poise.env import ImitationEnv
from poise.formats import read_clip
from poise.jobs.runs import evaluate
from poise.learn import Trainer, VecEnv, load_checkpoint
from poise.motion import ClipLibrary
from poise.recipes.imitation import Imitation
from poise.recipes.perpetual import build as build_tracking
from poise.recipes.residual_force import build
from poise.recipes.residual_force_settings import ResidualForce
from poise.sim import WarpBackend
from poise.sim.warp_setup import load_warp
from training.tracker import config as tracker_config

_COPIED = ("time", "qpos", "qvel", "qacc_warmstart", "ctrl", "qfrc_applied", "xfrc_applied")


class RawWarp:
    """`mujoco_warp.step` alone, captured as its manual recommends, on copies of a backend's worlds."""

    def __init__(self, backend: WarpBackend, substeps: int):
        self._wp, self._mjw = load_warp()
        self._device, self._substeps, room = str(backend.device), substeps, backend.capacity
        with self._wp.ScopedDevice(self._device):
            self._m = self._mjw.put_model(backend.model)
            self._m.opt.warn_overflow = 0
            self._d = self._mjw.make_data(
                backend.model, backend.num_envs, room.contacts, njmax=room.rows, nccdmax=room.convex
            )
            self._steps()  # Compiles.
            with self._wp.ScopedCapture(self._device) as capture:
                self._steps()
        self._graph = capture.graph

    def _steps(self) -> None:
        for _ in range(self._substeps):
            self._mjw.step(self._m, self._d)

    def load(self, backend: WarpBackend) -> None:
        """Takes over a backend's worlds as they are now, with what drives them."""
        for name in _COPIED:
            own = self._wp.to_torch(getattr(self._d, name))
            own.copy_(backend.raw(name))
        synchronize(backend.device)

    def seconds(self, count: int) -> float:
        """Time of `count` control steps on end."""
        start = time.perf_counter()
        with self._wp.ScopedDevice(self._device):
            for _ in range(count):
                self._wp.capture_launch(self._graph)
            self._wp.synchronize_device(self._device)
        return time.perf_counter() - start


def synchronize(device: torch.device) -> None:
    """Waits until the device has done what it was given."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def bench_gpu(
    imitation: Imitation,
    num_envs: int,
    device: str = "cuda",
    repeats: int = 5,
    steps: int = 16,
    tell: Progress | None = None,
    until: float = math.inf,
) -> dict[str, Any]:
    """Stepping and training on a GPU against `mujoco_warp.step` alone, interleaved in one process.

    Every repeat measures, one right after the other: `steps` control steps of the environment with
    observations, rewards and resets; as many raw control steps from where the environment began; one
    training iteration. Ratios are taken within a repeat, and medians over them. After `until`
    (`time.monotonic()`) no further repeat begins.
    """
    sim = imitation.config.sim

    def make() -> tuple[ImitationEnv, WarpBackend]:
        backend = WarpBackend(imitation.model, num_envs, device)
        return imitation.env(seed=0, guard=False, backend=backend), backend

    env, backend = make()
    learner, _ = make()
    ppo, seed = imitation.ppo(), imitation.config.seed
    trainer = Trainer(cast(VecEnv, learner), ppo, seed, imitation.humanoid.identity)
    raw, rows = RawWarp(backend, sim.substeps), []
    env.reset()
    _walk(env, exploring(imitation, env, 2))
    trainer.iterate()
    for k in range(repeats):
        if rows and time.monotonic() > until:
            break
        if tell is not None:
            tell(f"gpu, {k + 1} of {repeats}")
        raw.load(backend)
        stepping = _walk(env, exploring(imitation, env, steps, seed=k))
        limit = raw.seconds(steps)
        stats = trainer.iterate()
        share = num_envs * steps
        training = stats.batch / (stats.collect_seconds + stats.update_seconds)
        rows.append(
            {
                "raw_per_s": share / limit,
                "stepping_per_s": share / stepping,
                "training_per_s": training,
                "stepping_of_raw": limit / stepping,
                "training_of_raw": training * limit / share,
            }
        )
    result = {name: median([row[name] for row in rows]) for name in rows[0]}
    env.close()
    learner.close()
    return {
        "device": _name(backend.device),
        "envs": num_envs,
        "repeats": len(rows),
        "rate_hz": sim.rate_hz,
        "control_hz": sim.control_hz,
        "integrator": sim.integrator,
        "contacts_per_world": backend.capacity.contacts,
        "constraints_per_world": backend.capacity.rows,
        **result,
    }


def _walk(env: ImitationEnv, actions: list[Tensor]) -> float:
    """Seconds of these control steps."""
    actions = [action.to(env.device) for action in actions]
    synchronize(env.device)
    start = time.perf_counter()
    for action in actions:
        env.step(action)
    synchronize(env.device)
    return time.perf_counter() - start


def _name(device: torch.device) -> str:
    return torch.cuda.get_device_name(device) if device.type == "cuda" else "Warp's CPU device"


# --- learning ---------------------------------------------------------------------------------------


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


def make_trainer(imitation: Imitation, physics: str, networks: str, **metadata: Any) -> Trainer:
    """PPO with physics on "cpu" or with MuJoCo Warp on "cuda", and networks on either; physics on a GPU
    has its networks there."""
    env: Any = imitation.env(device=physics)
    if torch.device(networks).type != env.device.type:
        env = OnDevice(env, networks)
    threads = cores() if torch.device(networks).type == "cpu" else 1
    ppo, seed, body = imitation.ppo(), imitation.config.seed, imitation.humanoid.identity
    return Trainer(cast(VecEnv, env), ppo, seed, body, metadata=metadata, update_threads=threads)


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


# --- parts ----------------------------------------------------------------------------------------

#: Seconds after which a part begins nothing new.
LIMIT_S = 480.0
WORLDS = 4096


def device_of(places: Places) -> str:
    """The machine that is measured."""
    return "cpu" if places.smoke else "cuda"


def warp_is_there() -> bool:
    """Whether MuJoCo Warp can be asked."""
    return importlib.util.find_spec("mujoco_warp") is not None


@cache
def imitated(places: Places) -> Imitation:
    """The task by which the engine is measured."""
    config = ResidualForce(help_limit=100.0, help_start=None, num_envs=8 if places.smoke else WORLDS)
    if places.smoke:
        config = replace(config, ppo=replace(config.ppo, horizon=4, minibatch=16, norm_warmup=2))
    return build(read_clip(WALK), config)


@cache
def trained(places: Places) -> Imitation:
    """The task by which the tracker is trained, with its network, on the walk."""
    config = tracker_config(0)
    ppo = replace(config.ppo, policy_hidden=config.single_hidden)
    if places.smoke:
        ppo = replace(ppo, horizon=4, minibatch=16, policy_hidden=(16,), value_hidden=(16,))
    config = replace(config, num_envs=8 if places.smoke else WORLDS, ppo=ppo)
    return build_tracking(ClipLibrary.of(read_clip(WALK)), config)


def stepping(places: Places, unit: str) -> Any:
    """The environment beside raw stepping."""
    repeats, steps = (1, 2) if places.smoke else (5, 16)
    until = time.monotonic() + LIMIT_S
    if unit == CORES:
        return bench_engine(imitated(places), 0, repeats, steps, until=until)
    worlds = 8 if places.smoke else WORLDS
    return bench_gpu(imitated(places), worlds, device_of(places), repeats, steps, until=until)


CORES, WARP = "stepping, MuJoCo on the cores", "stepping, MuJoCo Warp"
RATES = ("raw_per_s", "stepping_per_s", "training_per_s", "stepping_of_raw")


def stepping_rows(places: Places, raws: Raws) -> Iterator[Figure]:
    """Rates of both."""
    for unit, r in raws.items():
        yield from of(unit, {k: r[k] for k in RATES}, r["envs"])


def sides(places: Places) -> list[str]:
    """The device of physics and networks."""
    here = device_of(places)
    pairs = [("cpu", here), ("cpu", "cpu")] + ([(here, here)] if warp_is_there() else [])
    return [
        f"physics on {a}, networks on {b}"
        for a, b in dict.fromkeys(pairs)
        if not (places.smoke and a != b)
    ]


def training(places: Places, unit: str) -> Any:
    """Samples a second."""
    physics, networks = (side.rpartition(" ")[2] for side in unit.split(", "))
    return bench_training(
        trained(places), physics, networks, 1 if places.smoke else 5, time.monotonic() + LIMIT_S
    )


def training_rows(places: Places, raws: Raws) -> Iterator[Figure]:
    """Rates."""
    for unit, r in raws.items():
        values = {k: r[k] for k in ("samples_per_s", "collect_s", "update_s")}
        yield from of(f"training, {unit}", values, r["repeats"])


def figure(places: Places, unit: str) -> Any:
    """Training until 90 % of the start frames are tracked; goes on from its checkpoint."""
    physics, networks = (side.rpartition(" ")[2] for side in unit.split(", "))
    checkpoint = places.work / "figure.safetensors"
    checkpoint.parent.mkdir(parents=True, exist_ok=True)
    given = (trained(places), physics, networks, checkpoint, {"unit": unit}, time.monotonic() + LIMIT_S)
    return bench_figure(*given, 0.0, 2) if places.smoke else bench_figure(*given)


def figure_rows(places: Places, raws: Raws) -> Iterator[Figure]:
    """Seconds and samples, where it was reached."""
    for unit, r in raws.items():
        values = {"training_s": r["training_s"], "samples": r["samples"], "reached": float(r["reached"])}
        yield from of(f"figure, {unit}", values, r["starts"])


PARTS = {
    "stepping": Part(
        "the environment beside raw stepping",
        lambda _: [WARP, CORES] if warp_is_there() else [CORES],
        stepping,
        stepping_rows,
        alone=True,
        hours=0.1,
        needs=("gpu",),
    ),
    "training": Part(
        "samples/s of the tracker's training",
        sides,
        training,
        training_rows,
        alone=True,
        hours=0.1,
        needs=("gpu",),
    ),
    "figure": Part(
        "seconds of training to a figure",
        lambda p: sides(p)[-1:],
        figure,
        figure_rows,
        alone=True,
        hours=0.15,
        needs=("gpu",),
    ),
}
