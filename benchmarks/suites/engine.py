"""How fast the engine is against its limit, and whether its physics is true.

Stepping and training stand beside MuJoCo's own batch on the very states that the environment stepped, in
the same process and in turns. "nothing acts" is the null: characters whose servos hold the reference's
angles.
"""

from __future__ import annotations

import contextlib
import copy
import io
import math
import re
import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import mujoco
import numpy as np
import torch
from mujoco.batch import Batch
from torch import Tensor

from benchmarks.common.clips import WALK, Places
from benchmarks.common.machine import Clock, cores, median, memory_mb
from benchmarks.common.rows import Figure, between, of
from benchmarks.common.runner import Part, Raws
from benchmarks.common.starts import Nothing
from poise.control import stable_pd_torque
from poise.env import ImitationEnv
from poise.env.faces import GROUP, RslRlVecEnv
from poise.formats import read_clip
from poise.jobs.open import open_run
from poise.jobs.runs import begin, evaluate, help_left, train, trained_policy
from poise.jobs.track import imitation_of, side_by_side
from poise.jobs.track.placement import place
from poise.jobs.track.surroundings import crowd as in_one_world
from poise.jobs.warm_start import some_starts
from poise.learn import Policy, PolicyBundle, Trainer, Until, VecEnv
from poise.motion import ClipLibrary
from poise.recipes.imitation import Imitation
from poise.recipes.residual_force import build
from poise.recipes.residual_force_settings import ResidualForce
from poise.score import run_episodes, score_rollouts
from poise.sim import CpuBackend, SimConfig
from poise.sim.backend import STANDARD_FIELDS

_VEL, _NONE = int(mujoco.mjtStage.mjSTAGE_VEL), int(mujoco.mjtStage.mjSTAGE_NONE)


Progress = Callable[[str], None]


class Raw:
    """`mujoco.batch` alone, with the same fields copied out, replaying recorded states and drives."""

    def __init__(self, env: ImitationEnv, threads: int):
        self.batch = Batch(env.backend.model, env.num_envs, threads)
        self.substeps = env.substeps
        for name in STANDARD_FIELDS:
            self.batch.bind(name)

    def seconds(self, states: list[Tensor], stage: int = _VEL) -> float:
        """Time of one control step from each of the recorded states; only the stepping counts."""
        spent = 0.0
        for state in states:
            self.batch.state[:] = state.numpy()
            start = time.perf_counter()
            self.batch.step(None, self.substeps, stage)
            spent += time.perf_counter() - start
        return spent


def exploring(imitation: Imitation, env: ImitationEnv, count: int, seed: int = 0) -> list[Tensor]:
    """Actions as an untrained policy explores them: noise alone."""
    rng = torch.Generator().manual_seed(seed)
    std = torch.tensor(imitation.ppo().std)
    return [std * torch.randn(env.num_envs, env.num_actions, generator=rng) for _ in range(count)]


def record(env: ImitationEnv, actions: list[Tensor]) -> list[Tensor]:
    """The simulator's whole state before the physics of every step, drive included."""
    states: list[Tensor] = []
    plain = env.backend.step

    def keeping(nstep: int = 1) -> None:
        states.append(env.backend.snapshot(derived=False))
        plain(nstep)

    env.backend.step = keeping  # type: ignore[method-assign]
    try:
        for action in actions:
            env.step(action)
    finally:
        del env.backend.step
    return states


def bench_engine(
    imitation: Imitation,
    threads: int = 0,
    repeats: int = 5,
    steps: int = 16,
    tell: Progress | None = None,
    until: float = math.inf,
) -> dict[str, Any]:
    """Stepping and training against the raw limit, interleaved in one process.

    Every repeat measures, one right after the other: `steps` control steps of the environment with
    observations, rewards and resets; MuJoCo's batch alone on the same number of states, recorded from
    that environment; one training iteration. Ratios are taken within a repeat, and medians over them.
    After `until` (`time.monotonic()`) no further repeat begins.
    """
    threads = threads or cores()
    before = memory_mb()
    env, trainer = imitation.env(threads=threads), imitation.trainer(threads=threads)
    raw, clock, rows = Raw(env, threads), Clock(), []
    env.reset()
    for _ in range(2):
        for action in exploring(imitation, env, steps):
            env.step(action)
        trainer.iterate()
    with ExitStack() as stack:
        learner: Any = trainer.env
        for owner, method, name in (
            (env.backend, "step", "stepping physics"),
            (learner.backend, "step", "physics"),
            (learner, "step", "step"),
        ):
            stack.enter_context(clock.on(owner, method, name))
        for k in range(repeats):
            if rows and time.monotonic() > until:
                break
            if tell is not None:
                tell(f"engine, {k + 1} of {repeats}")
            actions = exploring(imitation, env, steps, seed=k)
            clock.read()
            start = time.perf_counter()
            for action in actions:
                env.step(action)
            stepping = time.perf_counter() - start
            own = clock.read()["stepping physics"]
            states = _recorded(env, actions)
            limit, bare = raw.seconds(states), raw.seconds(states, _NONE)
            stats = trainer.iterate()
            parts = clock.read()
            share = env.num_envs * steps
            training = stats.collect_seconds + stats.update_seconds
            row = {
                "raw": share / limit,
                "raw_without_derived": share / bare,
                "stepping": share / stepping,
                "training": stats.batch / training,
                "stepping_of_raw": limit / stepping,
                "stepping_physics_share": own / stepping,
                "training_of_raw": (stats.batch / training) / (share / limit),
                "physics": parts["physics"] / training,
                "terms": (parts["step"] - parts["physics"]) / training,
                "policy": (stats.collect_seconds - parts["step"]) / training,
                "update": stats.update_seconds / training,
            }
            rows.append(row)
    result = {name: median([r[name] for r in rows]) for name in rows[0]}
    for name in ("raw", "raw_without_derived", "stepping", "training"):
        result[f"{name}_per_s"] = round(result.pop(name))
    phases = {name: result.pop(name) for name in ("physics", "terms", "policy", "update")}
    sim = imitation.config.sim
    out = {
        "envs": env.num_envs,
        "threads": threads,
        "repeats": len(rows),
        "rate_hz": sim.rate_hz,
        "control_hz": sim.control_hz,
        "integrator": sim.integrator,
        "observations": env.num_obs,
        "actions": env.num_actions,
        **result,
        "training_phases": phases,
        "memory_mb": round(memory_mb() - before),
    }
    env.close()
    trainer.env.close()
    return out


def _recorded(env: ImitationEnv, actions: list[Tensor]) -> list[Tensor]:
    """`record` past a clock that may sit on the backend's step."""
    timed = env.backend.__dict__.pop("step", None)
    try:
        return record(env, actions)
    finally:
        if timed is not None:
            env.backend.step = timed  # type: ignore[method-assign]


# --- scaling, latency, fidelity --------------------------------------------------------------------


WORLDS = (32, 64, 128, 256, 512, 1024, 2048)


def thread_counts() -> list[int]:
    """1, 2, 4, ... and all cores."""
    most, counts = cores(), [1]
    while counts[-1] * 2 < most:
        counts.append(counts[-1] * 2)
    return counts if counts[-1] == most else [*counts, most]


def _row(imitation: Imitation, n: int, threads: int, steps: int, repeats: int) -> dict[str, Any]:
    env = imitation.env(n, threads=threads)
    env.record_at_once()
    raw, rates, limits = Raw(env, threads), [], []
    env.reset()
    actions = exploring(imitation, env, steps)
    for action in actions[:4]:
        env.step(action)
    for _ in range(repeats):
        start = time.perf_counter()
        for action in actions:
            env.step(action)
        rates.append(n * steps / (time.perf_counter() - start))
        limits.append(n * steps / raw.seconds(record(env, actions)))
    # The state that is stepped and the guard's copy, derived fields, both observations.
    held = [env.backend.snapshot(derived=k == 0) for k in range(2)] + [env.reset()] * 2
    memory = sum(x.nbytes for x in held) / 1e6
    env.close()
    return {
        "envs": n,
        "threads": threads,
        "stepping_per_s": round(median(rates)),
        "raw_per_s": round(median(limits)),
        "stepping_of_raw": median([a / b for a, b in zip(rates, limits, strict=True)]),
        "memory_mb": round(memory, 1),
    }


def bench_latency(
    imitation: Imitation, policy: Policy | None = None, steps: int = 600, helped: bool = False
) -> dict[str, Any]:
    """Policy, physics and observation of one deterministic character, in ms per control step.

    Rewards, failures and the guard against unstable states belong to training and are left out.

    policy: None takes an untrained one of the recipe's size, which costs the same. helped: with
    residual forces; without, as a character runs that was trained to need none.
    """
    task = imitation.bare(groups=True)
    env = task.env(1, 0, False, 1, help_scale=1.0 if helped else 0.0, guard=False)
    env.record_at_once()
    if policy is None:
        trainer = imitation.trainer(threads=1)
        policy = trainer.policy()
        trainer.env.close()
    zero, last = torch.zeros(1, dtype=torch.long), int(env.reference.length[0]) - 2
    clock, spent = Clock(), []
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with ExitStack() as stack:
            stack.enter_context(clock.on(env.backend, "step", "physics"))
            stack.enter_context(clock.on(policy, "act", "policy"))
            obs, parts = env.reset_to(zero, zero), []
            for k in range(steps + 50):
                if int(env.frame) >= last:
                    obs = env.reset_to(zero, zero)
                clock.read()
                start = time.perf_counter()
                obs = env.step(policy.act(obs)).obs
                # The first steps make buffers and recordings.
                if k >= 50:
                    spent.append(time.perf_counter() - start)
                    parts.append(clock.read())
    finally:
        torch.set_num_threads(threads)
        env.close()
    ms = sorted(1e3 * s for s in spent)
    split = {name: round(1e3 * statistics.median(p[name] for p in parts), 3) for name in parts[0]}
    median_ms = statistics.median(ms)
    rest = round(median_ms - sum(split.values()), 3)
    return {
        "ms": round(median_ms, 3),
        "ms_95": round(ms[int(0.95 * len(ms))], 3),
        "phases_ms": {**split, "observation": rest},
        "helped": helped,
        "steps": steps,
        "threads": 1,
        "rate_hz": imitation.config.sim.rate_hz,
    }


class StablePDBackend(CpuBackend):
    """Worlds with actuators that are replaced by `control.stable_pd_torque` (Tan et al. 2011).

    Gains, damping and torque limits are those of the model's position servos and joints; `drive.ctrl`
    still holds target angles. Thousands of linear solves a second make it a reference for short
    evaluations, not a place to train.
    """

    def __init__(self, model: mujoco.MjModel, num_envs: int, threads: int = 0) -> None:
        model = copy.copy(model)
        self._kp = torch.tensor(model.actuator_gainprm[:, 0].copy())
        limit = torch.tensor(model.actuator_forcerange[:, 1].copy())
        limited = torch.tensor(model.actuator_forcelimited.astype(bool))
        self._limit = torch.where(limited, limit, torch.inf)
        self._kd = torch.tensor(model.dof_damping[6:].copy())
        model.actuator_gainprm[:] = 0.0
        model.actuator_biasprm[:] = 0.0
        model.dof_damping[6:] = 0.0
        super().__init__(model, num_envs, threads)
        self.state.bind(["M", "qfrc_bias"])
        # MuJoCo keeps the lower triangle of the inertia row by row, without its zeros.
        rows = torch.arange(model.nv).repeat_interleave(torch.tensor(model.M_rownnz).long())
        self._places = rows, torch.tensor(model.M_colind).long()

    def inertia(self) -> Tensor:
        """`(N, nv, nv)` float64, the inertia of all degrees of freedom of the worlds as they stand."""
        nv = self.model.nv
        full = torch.zeros(self.num_envs, nv, nv, dtype=torch.float64)
        rows, columns = self._places
        full[:, rows, columns] = self.state["M"]
        full[:, columns, rows] = self.state["M"]
        return full

    def step(self, nstep: int = 1) -> None:
        held, dt = self.drive.qfrc_applied.clone(), self.model.opt.timestep
        for _ in range(nstep):
            torque = stable_pd_torque(
                self.inertia(),
                self.state["qfrc_bias"],
                self._kp,
                self._kd,
                self.state.qpos[:, 7:],
                self.state.qvel,
                self.drive.ctrl,
                dt,
                self._limit,
            )
            self.drive.qfrc_applied.copy_(held)
            self.drive.qfrc_applied[:, 6:].add_(torque)
            super().step(1)
        self.drive.qfrc_applied.copy_(held)


FINE = SimConfig(rate_hz=450.0, integrator="implicitfast")


PAPER = SimConfig(rate_hz=450.0, integrator="euler")


def bench_physics(
    folder: Path, stable_pd: bool = False, starts: int = 64, tell: Progress | None = None
) -> list[dict[str, Any]]:
    """The run's policy, deterministic, from the same start frames on each kind of physics.

    The first row is the physics it was trained on, the second 450 Hz `implicitfast` with MuJoCo's
    position servos, the third, with `stable_pd`, 450 Hz Euler with the paper's explicit stable PD
    (`control.stable_pd_torque`), which takes a linear solve per physics step.
    """
    own = open_run(folder).task
    policy, meta = trained_policy(folder, own)
    limit, scale = help_left(own, meta)
    clip, frame = some_starts(own, starts)
    kinds: list[tuple[str, SimConfig]] = [("trained", own.config.sim), ("fine", FINE)]
    if stable_pd:
        kinds.append(("stable PD", PAPER))
    rows = []
    for name, sim in kinds:
        sim = replace(sim, control_hz=own.config.sim.control_hz)
        if tell is not None:
            tell(f"physics, {name}: {sim.rate_hz:g} Hz {sim.integrator}")
        imitation = build(own.library, replace(own.config, sim=sim))
        make = (_stable if name == "stable PD" else _servos)(imitation, scale)
        rows.append(
            {"physics": name, "rate_hz": sim.rate_hz, "integrator": sim.integrator}
            | _score(imitation, policy, make, clip, frame, limit)
        )
    return rows


def _servos(imitation: Imitation, scale: float) -> Callable[[int], ImitationEnv]:
    return lambda n: imitation.env(n, auto_reset=False, help_scale=scale)


def _stable(imitation: Imitation, scale: float) -> Callable[[int], ImitationEnv]:
    def make(n: int) -> ImitationEnv:
        backend = StablePDBackend(imitation.model, n)
        return imitation.env(None, 0, False, help_scale=scale, guard=False, backend=backend)

    return make


def _score(
    imitation: Imitation,
    policy: PolicyBundle,
    make: Callable[[int], ImitationEnv],
    clip: Tensor,
    frame: Tensor,
    limit: float,
) -> dict[str, Any]:
    config = imitation.config
    rollouts, _ = run_episodes(make, policy, clip, frame, limit)
    card = score_rollouts(rollouts, method=config.method, seed=config.seed)
    return {
        "episodes": card.episodes,
        "succ": round(card.succ, 3),
        "mpjpe_mm": round(card.mpjpe_mm, 1),
        "reward": round(float(rollouts.reward["total"][rollouts.alive].mean()), 3),
    }


# --- one learner beside another -------------------------------------------------------------------


def _scored(task: Imitation, policy: Any) -> dict[str, float]:
    card = evaluate(task, policy, {}, most=64).card
    return {"done": card.succ, "reward": card.reward["total"], "mpjpe_mm": card.mpjpe_mm}


def ours(task: Imitation, seed: int, samples: int) -> dict[str, float]:
    """Our PPO; the clock counts collection and update, as rsl_rl's does."""
    env = task.env(seed=seed)
    trainer = Trainer(cast(VecEnv, env), task.ppo(), seed, task.humanoid.identity)
    trainer.state()  # The warm-up of the statistics is not counted.
    seconds = 0.0
    while trainer.samples < samples:
        stats = trainer.iterate()
        seconds = stats.seconds
    env.close()
    return {"training_samples_per_s": trainer.samples / seconds, **_scored(task, trainer.policy())}


def theirs(task: Imitation, seed: int, samples: int) -> dict[str, float]:
    """Rsl_rl's PPO through the adapter, with the settings of `task` where it has them. What it does in
    another way stays its own: one learning rate for both networks, clipped value loss, learned noise."""
    from rsl_rl.runners import OnPolicyRunner
    from tensordict import TensorDict

    torch.manual_seed(seed)
    ppo, env = task.ppo(), RslRlVecEnv(task.env(seed=seed))
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
            "schedule": "fixed",
            "desired_kl": None,
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
        seconds, made = 0.0, 0
        while made < samples:
            begun = time.perf_counter()
            runner.learn(1)
            seconds += time.perf_counter() - begun
            made += batch
        network_of = runner.get_inference_policy()

    class Acting:
        """Its network as a policy that can be evaluated."""

        def act(self, obs: torch.Tensor) -> torch.Tensor:
            return network_of(TensorDict({GROUP: obs}, [len(obs)]))

    score = _scored(task, Acting())
    env.close()
    return {"training_samples_per_s": made / seconds, **score}


def learned(places: Places, unit: str) -> Any:
    """One learner with one seed on DeepMimic's walk."""
    name, _, seed = unit.partition(", seed ")
    clip = read_clip(places.file("deepmimic_txt/humanoid3d_walk.txt"))
    many, samples = (16, 64) if places.smoke else (512, 2_000_000)
    ppo = ResidualForce().ppo
    ppo = replace(ppo, horizon=4, minibatch=16, norm_warmup=2) if places.smoke else ppo
    config = ResidualForce(help_limit=100.0, help_start=None, num_envs=many, ppo=ppo)
    task = build(ClipLibrary.of(clip), config)
    return {"poise": ours, "rsl_rl": theirs}[name](task, int(seed), samples)


def learned_rows(places: Places, raws: Raws) -> Iterator[Figure]:
    """Medians over the seeds of each learner."""
    for name in ("poise", "rsl_rl"):
        rows = [raw for unit, raw in raws.items() if unit.startswith(name)]
        for metric in ("training_samples_per_s", "done", "mpjpe_mm"):
            values = [r[metric] for r in rows]
            yield Figure(
                f"DeepMimic walk, learner of {name}",
                metric,
                median(values),
                len(rows),
                between(values),
                len(rows),
            )


# --- parts ----------------------------------------------------------------------------------------


def task_of(places: Places, worlds: int = 512) -> Imitation:
    """The walk that comes with Poise, with residual forces."""
    config = ResidualForce(help_limit=100.0, help_start=None, num_envs=16 if places.smoke else worlds)
    if places.smoke:
        config = replace(config, ppo=replace(config.ppo, horizon=4, minibatch=16, norm_warmup=2))
    return build(read_clip(WALK), config)


def stepping(places: Places, unit: str) -> Any:
    """The whole machine against its limit."""
    return bench_engine(task_of(places), 0, *((1, 2) if places.smoke else (5, 16)))


def stepping_rows(places: Places, raws: Raws) -> Iterator[Figure]:
    """Rates, and shares of the limit."""
    r = raws["stepping"]
    values = {
        "raw_steps_per_s": r["raw_per_s"],
        "env_steps_per_s": r["stepping_per_s"],
        "training_samples_per_s": r["training_per_s"],
        "env_share_of_raw": r["stepping_of_raw"],
        "training_share_of_raw": r["training_of_raw"],
        "memory_mb": r["memory_mb"],
    }
    yield from of(f"{r['envs']} characters, {_threads(r['threads'])}", values, r["repeats"])


def _threads(count: int) -> str:
    return {1: "one thread", 2: "two threads"}.get(count, f"{count} threads")


def worlds_of(places: Places) -> list[str]:
    """Numbers of characters and threads."""
    many = WORLDS[:1] if places.smoke else WORLDS
    return [
        f"{n} characters, {t} threads"
        for t in (thread_counts()[:1] if places.smoke else thread_counts())
        for n in many
    ]


def scaling(places: Places, unit: str) -> Any:
    """One number of characters and threads."""
    n, threads = (int(x) for x in re.findall(r"\d+", unit))
    return _row(
        task_of(places),
        n,
        threads,
        max(2, (64 if places.smoke else 4096) // n),
        1 if places.smoke else 3,
    )


def scaling_rows(places: Places, raws: Raws) -> Iterator[Figure]:
    """Rates beside the limit."""
    for unit, r in raws.items():
        values = {
            "env_steps_per_s": r["stepping_per_s"],
            "raw_steps_per_s": r["raw_per_s"],
            "env_share_of_raw": r["stepping_of_raw"],
            "memory_mb": r["memory_mb"],
        }
        yield from of(unit, values, 3)


def latency(places: Places, unit: str) -> Any:
    """One character: an untrained policy of the recipe's size, the tracker, and nothing that acts."""
    steps = 20 if places.smoke else 600
    if unit == "one character, one thread":
        return bench_latency(task_of(places), None, steps)
    tracker = open_run(None).tracker
    task = imitation_of(tracker, [place(read_clip(WALK), tracker)])
    acts = tracker.policy if "tracking" in unit else Nothing(tracker.policy.num_actions)
    return bench_latency(task, acts, steps)  # type: ignore[arg-type]


LATENCY = (
    "one character, one thread",
    "tracking, one character, one thread",
    "nothing acts, one character, one thread",
)


def latency_rows(places: Places, raws: Raws) -> Iterator[Figure]:
    """ms a control step, and what of it is whose."""
    for unit, r in raws.items():
        values = {"ms_a_step": r["ms"], "ms_a_step_95": r["ms_95"]}
        yield from of(unit, values | {f"ms_{k}": v for k, v in r["phases_ms"].items()}, r["steps"])


def crowd(places: Places, unit: str) -> Any:
    """Characters that share a world, policy and terms on some threads."""
    count, threads = (int(x) for x in re.findall(r"\d+", unit))
    tracker, steps = open_run(None).tracker, 5 if places.smoke else 600
    task = imitation_of(tracker, [place(read_clip(WALK), tracker)])
    task = side_by_side(task, count) if count > 1 else task
    backend = in_one_world(task.humanoid, task.config.sim, count)
    env = task.env(auto_reset=False, help_scale=0.0, guard=False, backend=backend)
    env.record_at_once()
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    clip, zero = torch.arange(count), torch.zeros(count, dtype=torch.long)
    last, spent = int(task.reference.length[0]) - 1, []
    try:
        obs = env.reset_to(clip, zero)
        for k in range(steps + 20):
            if int(env.frame[0]) >= last:
                obs = env.reset_to(clip, zero)
            start = time.perf_counter()
            obs = env.step(tracker.policy.act(obs)).obs
            # The first steps make buffers and recordings.
            if k >= 20:
                spent.append(time.perf_counter() - start)
    finally:
        torch.set_num_threads(before)
        env.close()
    return {
        "ms_a_step": 1e3 * statistics.median(spent),
        "steps_per_s": 1 / statistics.median(spent),
        "steps": steps,
    }


CROWDS = ((1, 1), (16, 1), (16, 2))


def crowd_rows(places: Places, raws: Raws) -> Iterator[Figure]:
    """Rates."""
    for unit, r in raws.items():
        yield from of(unit, {k: r[k] for k in ("steps_per_s", "ms_a_step")}, r["steps"])


def physics(places: Places, unit: str) -> Any:
    """A policy trained for a minute on coarse physics, on fine physics and with explicit stable PD."""
    folder = places.work / "physics"
    if not folder.exists():
        config = ResidualForce(help_limit=100.0, help_start=None, num_envs=16 if places.smoke else 512)
        if places.smoke:
            config = replace(
                config, ppo=replace(config.ppo, horizon=4, minibatch=16, norm_warmup=2), expert=False
            )
        made = begin(folder, ClipLibrary.of(read_clip(WALK)), config)
        until = Until(iterations=1) if places.smoke else Until(minutes=3.0)
        train(made, folder, until, threads=1, tensorboard=False)
    return bench_physics(folder, True, 2 if places.smoke else 64)


def physics_rows(places: Places, raws: Raws) -> Iterator[Figure]:
    """Its score on each kind of physics."""
    for r in raws["physics"]:
        subject = f"one policy, physics of {r['rate_hz']:g} Hz, {r['integrator']}"
        subject += ", stable PD" if r["physics"] == "stable PD" else ""
        yield from of(subject, {"done": r["succ"], "mpjpe_mm": r["mpjpe_mm"]}, r["episodes"], policy="")


PARTS = {
    "stepping": Part(
        "stepping and training beside MuJoCo's batch",
        lambda _: ["stepping"],
        stepping,
        stepping_rows,
        alone=True,
        hours=0.1,
        needs=(),
    ),
    "scaling": Part(
        "stepping over worlds and threads",
        worlds_of,
        scaling,
        scaling_rows,
        alone=True,
        hours=0.1,
        needs=(),
    ),
    "latency": Part(
        "ms a control step of one character",
        lambda _: list(LATENCY),
        latency,
        latency_rows,
        ("tracker",),
        alone=True,
        hours=0.01,
        needs=(),
    ),
    "crowd": Part(
        "characters in one world",
        lambda _: [f"tracking, {n} in one world, {t} threads" for n, t in CROWDS],
        crowd,
        crowd_rows,
        ("tracker",),
        alone=True,
        hours=0.01,
        needs=(),
    ),
    "physics": Part(
        "one policy on coarse and fine physics",
        lambda _: ["physics"],
        physics,
        physics_rows,
        hours=0.1,
        needs=(),
    ),
    "learners": Part(
        "PPO beside rsl_rl's, equal samples",
        lambda p: [f"{n}, seed {s}" for s in ((0,) if p.smoke else (0, 1)) for n in ("poise", "rsl_rl")],
        learned,
        learned_rows,
        alone=True,
        hours=0.5,
        needs=("data", "rsl_rl"),
    ),
}
