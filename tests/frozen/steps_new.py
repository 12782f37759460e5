"""The frozen twin's new side: Poise as it is. Names and settings follow the source; see `cases`."""

from __future__ import annotations

import dataclasses
import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import cases
import numpy as np
from torch import Tensor

import poise
from poise.cli.main import main as command
from poise.control import SuccessHelp
from poise.env import ImitationEnv
from poise.env.recovery.clock import RecoveryClock
from poise.env.starts import AdaptiveSampling
from poise.eval import read_score
from poise.jobs.deliver import deliver
from poise.jobs.open import open_run
from poise.jobs.perpetual import run as perpetual_run
from poise.jobs.perpetual.demonstrations import odds, practised
from poise.jobs.perpetual.stage_initialisation import staged
from poise.jobs.perpetual.stage_order import Stage
from poise.jobs.run_file import learning_curve
from poise.jobs.runs import begin, evaluate, train, trained_policy
from poise.jobs.track import TrackConfig, Tracked, imitation_of, track, write
from poise.jobs.track.noise import noise_of
from poise.jobs.track.placement import place
from poise.learn import (
    AmpConfig,
    CloneConfig,
    ConvergenceConfig,
    PPOConfig,
    Until,
    load_checkpoint,
)
from poise.motion import Clip, ClipLibrary, Skeleton, read_clip, trim, write_clip
from poise.plan import SamplingConfig
from poise.recipes import ResidualForce
from poise.recipes import build as build_imitation
from poise.recipes.imitation import Imitation
from poise.recipes.perpetual import Perpetual, RecoveryPlan
from poise.recipes.perpetual import build as build_perpetual
from poise.recipes.perpetual.shapes import BodyShapes

WHERE = Path(poise.__file__).parent
WALK = WHERE / "data/walk.bvh"
SMALL = {"policy_hidden": (16,), "value_hidden": (16,), "norm_warmup": 2}
TINY_PPO = PPOConfig(horizon=4, epochs=1, minibatch=64, std=0.02, **SMALL)
STYLE = AmpConfig(frames=3, hidden=(8,), minibatch=16, steps=1, kept=16, replay=32)


# --- settings and clips ---------------------------------------------------------------------------


def walk(start: int = 0, stop: int | None = None, name: str = "walk") -> Clip:
    return trim(read_clip(WALK), start, stop).replaced(name=name)


def toy(*names: str) -> ClipLibrary:
    m = cases.motions()
    names_, parents = tuple(map(str, m["names"])), tuple(map(int, m["parents"]))
    ends = ((names_.index("Head"), tuple(map(float, m["head_end"]))),)
    skeleton = Skeleton(names_, parents, m["offsets"], ends)
    return ClipLibrary.of([Clip(skeleton, m[f"{n}/pos"], m[f"{n}/rot"], 30.0, n, False) for n in names])


def three() -> ClipLibrary:
    return toy("calm", "walk", "turn")


def lively() -> ClipLibrary:
    return toy("calm", "walk", "turn", "stroll", "rises")


def imitating(**changes: Any) -> ResidualForce:
    # What was the default then: 100 N for ever.
    then = {"help_limit": 100.0, "help_start": None}
    return ResidualForce(**(then | {"num_envs": cases.WORLDS, "seed": cases.SEED} | changes))


def tiny(**changes: Any) -> Perpetual:
    plain: dict[str, Any] = {
        "num_envs": cases.WORLDS,
        "single_hidden": (24, 16),
        "composer_hidden": (8,),
        "evaluate_every": 2,
        "seed": 1,
        "clone": CloneConfig(steps=4, rounds=1, critic_steps=4),
        "recovery": False,
        "recovering": RecoveryPlan(
            share=0.3, falls=4, trials=2, final_trials=2, seconds=(0.1, 0.2), demonstrations=4
        ),
        "convergence": ConvergenceConfig(patience=1),
        "style": None,
        "ppo": TINY_PPO,
    }
    return Perpetual(**(plain | changes))


# --- environments ---------------------------------------------------------------------------------


def environment(name: str) -> ImitationEnv:
    clip = walk()
    if name == "imitate":
        return _env(build_imitation(clip, imitating()))
    if name == "imitate_schedule":
        how = {"help_start": 100.0, "help_limit": 0.0, "horizon": 20}
        return _env(_eager(build_imitation(clip, imitating(**how))))
    if name == "imitate_linear":
        how = {"help_start": 100.0, "help_limit": 20.0, "help_schedule": "linear"}
        return _env(build_imitation(clip, imitating(**how, help_steps=(50, 250))))
    if name == "explicit":
        return _env(build_imitation(clip, imitating(method="rfc-explicit")))
    if name == "local_phase_absolute":
        how = {"reward": "local", "observation": "phase", "action": "absolute"}
        return _env(build_imitation(clip, imitating(**how, faithful="code", done="height")))
    if name == "deepmimic":
        return _env(build_imitation(clip, imitating(method="deepmimic")))
    if name == "perpetual":
        return _env(_eager(build_perpetual(three(), tiny())))
    if name == "perpetual_recovery_primitive":
        return _staged(build_perpetual(three(), tiny(recovery=True)), Stage("recovery", 2))
    if name == "perpetual_recovery_composer":
        return _staged(build_perpetual(three(), tiny(recovery=True)), Stage("composer", 3, mixed=True))
    if name == "perpetual_ways":
        made = build_perpetual(lively(), tiny(recovery=True, help_start=0.0))
        return _staged(made, Stage("composer", 3, mixed=True))
    if name == "perpetual_shapes":
        return _env(build_perpetual(three(), tiny(shape=True, shapes=BodyShapes(count=3, seed=2))))
    if name == "perpetual_keypoints":
        return _env(
            _eager(build_perpetual(three(), tiny(goal="keypoints", help_by="clip", faithful="paper")))
        )
    if name == "perpetual_additive":
        changes = {"num_envs": cases.WORLDS, "seed": 1, "recovery": False}
        return _env(build_perpetual(three(), Perpetual.additive(**changes)))
    if name == "perpetual_style":
        return _env(build_perpetual(three(), tiny(style=STYLE, termination="code", energy=0.0005)))
    if name == "shipped":
        tracker = open_run().tracker
        made = imitation_of(tracker, [place(walk(), tracker)])
        return _env(made, cases.WORLDS)
    raise ValueError(name)


def _eager(made: Imitation) -> Imitation:
    """Help that is taken away by episodes of random actions."""
    return replace(made, task=replace(made.task, help=SuccessHelp(0.3, 0.1, 0.9, every=2)))


def _env(made: Imitation, worlds: int | None = None) -> ImitationEnv:
    return made.env(worlds, threads=1)


def _staged(made: Imitation, stage: Stage) -> ImitationEnv:
    env = staged(practised(made, stage), stage).env(threads=1)
    seconds = (made.reference.length.cpu() - 1).double()
    env.weights = odds(made, stage, seconds, env.reference.length)
    return env


def worlds(env: ImitationEnv) -> int:
    return env.num_envs


def actions(env: ImitationEnv) -> int:
    return env.num_actions


def clips(env: ImitationEnv) -> int:
    return len(env.reference.length)


def reset(env: ImitationEnv) -> Tensor:
    return env.reset()


def reset_to(env: ImitationEnv, clip: Tensor, frame: Tensor) -> Tensor:
    return env.reset_to(clip, frame)


def step(env: ImitationEnv, action: Tensor) -> dict[str, Any]:
    s = env.step(action)
    state = env.backend.state
    out = {
        "obs": s.obs, "reward": s.reward, "terminated": s.terminated, "truncated": s.truncated,
        "final_obs": s.final_obs, "failed": s.failed, "qpos": state.qpos, "qvel": state.qvel,
        "xpos": state.xpos, "clip": env.clip, "frame": env.frame, "age": env.age,
        "imitation": env.imitation, "features": env.features(), "pose": env.pose().pos,
        "ctrl": env.backend.drive.ctrl, "applied": env.backend.drive.qfrc_applied,
    }  # fmt: skip
    if env.wrench is not None:
        out |= {"force": env.wrench.force, "torque": env.wrench.torque}
    return out | {f"log/{k}": v for k, v in s.log.items()}


def state(env: ImitationEnv) -> dict[str, Any]:
    out: dict[str, Any] = {"help": env.help.now, "weights": env.weights}
    if (sampling := env.plugin(AdaptiveSampling)) is not None:
        out["hardness"] = sampling.state()["hardness"]
    if (clock := env.plugin(RecoveryClock)) is not None:
        out["kind"] = clock.kind
    return out


def close(env: ImitationEnv) -> None:
    env.close()


# --- jobs -----------------------------------------------------------------------------------------


def _card(card: Any) -> dict[str, np.ndarray]:
    # What the clock says is no figure.
    said = {k: v for k, v in dataclasses.asdict(card).items() if k not in ("seconds",)}
    return {f"card/{k}": v for k, v in cases.numbers(said).items()}


def _score(path: Path) -> dict[str, np.ndarray]:
    said = json.loads(path.read_text())
    said.pop("seconds", None)
    return {f"score/{k}": v for k, v in cases.numbers(said).items()}


def _tracked(t: Tracked, folder: Path) -> dict[str, np.ndarray]:
    out = _card(t.evaluation.card)
    for k, recording in enumerate(t.evaluation.recordings):
        out[f"qpos/{k}"] = cases.array(recording.qpos)
    out["failures"] = np.array(t.failures, dtype=float).reshape(-1, 2)
    out["placed"] = cases.array(t.placed.qpos)
    out["notes"] = np.array("\n".join(t.notes))
    if t.found is not None:
        out["found/actions"] = cases.array(t.found.actions)
        out["found/reached"] = np.array([t.found.reached, t.found.tries])
    if t.losses is not None:
        out["losses"] = np.array([*t.losses.lost, -1.0, *t.losses.back])
    done = write(t, folder / "written")
    for name, path in done.paths.items():
        if path.suffix in (".bvh", ".glb", ".npz"):
            out[f"file/{name}"] = cases.file_bytes(path)
    return out | _score(done.paths["score"])


def aside(metres: float) -> Clip:
    """The walk pushed to the side within 8 frames."""
    clip = walk()
    pos = clip.root_pos.copy()
    pos[:, 1] += metres * np.clip((np.arange(len(pos)) - 40) / 8, 0, 1)
    return clip.replaced(root_pos=pos)


def job_track(folder: Path) -> dict[str, np.ndarray]:
    return _tracked(track(walk(), open_run().tracker, controller="policy"), folder)


def job_track_search(folder: Path) -> dict[str, np.ndarray]:
    search = SamplingConfig(characters=64, retries=2, rounds=2)
    done = track(
        aside(0.6), open_run().tracker, TrackConfig(controller="search", search=search, threads=1)
    )
    assert done.found is not None and done.found.whole
    return _tracked(done, folder)


def job_track_recover(folder: Path) -> dict[str, np.ndarray]:
    done = track(aside(2.0), open_run().tracker, TrackConfig(controller="policy", recover=True))
    assert done.losses is not None
    return _tracked(done, folder)


def job_track_noise_crowd(folder: Path) -> dict[str, np.ndarray]:
    config = TrackConfig(
        controller="policy", noise=noise_of(("jitter:0.5",)), count=2, reset_on_fail=True
    )
    done = track(trim(walk(), 0, 50), open_run().tracker, config)
    return _tracked(done, folder)


def _learned(folder: Path) -> dict[str, np.ndarray]:
    tensors, _ = load_checkpoint(folder / "checkpoint.safetensors")
    # The clock is the one number that differs between two runs.
    return {f"learned/{k}": cases.array(v) for k, v in tensors.items() if "counters" not in k}


def _imitated(folder: Path, config: ResidualForce) -> dict[str, np.ndarray]:
    run = folder / "run"
    task = begin(run, ClipLibrary.of(walk(0, 50)), config)
    train(task, run, Until(iterations=3), threads=1, tensorboard=False)
    out = _learned(run)
    result = evaluate(task, *trained_policy(run, task), most=8)
    out |= _card(result.card)
    out["recording"] = cases.array(result.recordings[0].qpos)
    done = deliver(task, result, folder / "out", learning_curve(run))
    out["file"] = cases.file_bytes(done.paths["simulated"])
    assert read_score(done.paths["score"]).succ == result.card.succ
    return out | _score(done.paths["score"])


def job_imitation_run(folder: Path) -> dict[str, np.ndarray]:
    ppo = PPOConfig(std=0.055, horizon=8, epochs=2, minibatch=64, **SMALL)
    return _imitated(folder, imitating(expert=False, help_limit=50.0, ppo=ppo))


def job_expert_run(folder: Path) -> dict[str, np.ndarray]:
    ppo = PPOConfig(std=0.055, horizon=8, epochs=2, minibatch=64, **SMALL)
    config = imitating(method="rfc-explicit", help_start=100.0, help_limit=0.0, ppo=ppo, num_envs=8)
    return _imitated(folder, config)


def _perpetual(folder: Path, library: ClipLibrary, config: Perpetual, count: int) -> dict[str, Any]:
    run = folder / "run"
    made = perpetual_run.begin(run, library, config)
    perpetual_run.train(made, run, Until(iterations=count), threads=1, tensorboard=False)
    out: dict[str, Any] = _learned(run)
    for path in sorted(run.glob("*.safetensors")):
        if path.name not in ("checkpoint.safetensors", "run.safetensors"):
            tensors, _ = load_checkpoint(path)
            out |= {f"{path.stem}/{k}": cases.array(v) for k, v in tensors.items()}
    said = json.loads((run / "result.json").read_text())
    said.pop("seconds", None)
    out |= {f"result/{k}": v for k, v in cases.numbers(said).items()}
    out["success"] = np.array((run / "success.csv").read_text())
    return out


def job_perpetual_run(folder: Path) -> dict[str, np.ndarray]:
    return _perpetual(folder, three(), tiny(style=STYLE, num_envs=8), 8)


def job_perpetual_ways_run(folder: Path) -> dict[str, np.ndarray]:
    how = {"help_start": 0.0, "expert": False, "action": "additive", "recovery": True, "num_envs": 8}
    out = _perpetual(folder, lively(), tiny(**how), 10)
    return out | _tracked(
        track(walk(0, 40), open_run(folder / "run").tracker, controller="policy"), folder
    )


def job_verbs(folder: Path) -> dict[str, np.ndarray]:
    """Verbs without physics, from file to file."""
    clip, out = str(WALK), {}
    ill, n = folder / "ill.bvh", np.arange(86)[:, None]
    lifts, jumps = 0.06 * (n > 40), 0.3 * ((n > 60) & (n < 64))
    jitter = 0.004 * np.random.default_rng(0).standard_normal((86, 3))
    ill_clip = walk()
    write_clip(
        ill_clip.replaced(root_pos=ill_clip.root_pos + jitter + [0, 0, 1] * lifts + [0, 1, 0] * jumps),
        ill,
    )
    lines = {
        "mended.bvh": ["doctor", str(ill), "--fix", "-o", "OUT"],
        "convert.glb": ["convert", clip, "OUT"],
        "doctor.bvh": ["doctor", clip, "--fix", "-o", "OUT"],
        "inbetween.bvh": ["inbetween", clip, "--keyframes", "0,30,60", "-o", "OUT"],
        "retarget.bvh": ["retarget", clip, "--onto", str(folder / "rig.glb"), "-o", "OUT"],
    }
    assert command(["convert", clip, str(folder / "rig.glb")]) == 0
    for name, line in lines.items():
        path = folder / name
        assert command([str(path) if x == "OUT" else x for x in line]) == 0, name
        out[name] = cases.file_bytes(path)
    return out


JOBS = {name: globals()[f"job_{name}"] for name in cases.JOBS}

if __name__ == "__main__":
    cases.run(sys.modules[__name__])
