"""What `endless_tables.py` compares: kinematic networks, and control policies that do their motion."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import torch
from endless_data import FUTURE, PAST
from next_frames import NextFrame, NextFrameConfig, NextFrameObjective, NextFrames
from torch import Tensor

from poise.body import Humanoid
from poise.env import Acts, EnvStep, ImitationEnv, Reference
from poise.env.generator import MotionGenerator
from poise.jobs.endless.endless_training import codes_of
from poise.jobs.endless.model import Motions
from poise.jobs.tracker import Tracker
from poise.kinematics import qpos_velocity
from poise.learn.cvae import CVAEConfig, CVAEObjective, CVAETraining, make_cvae
from poise.learn.inbetween_model import InbetweenTrainer
from poise.motion import ClipLibrary
from poise.recipes.imitation import Imitation
from poise.recipes.perpetual import task as universal_task
from poise.recipes.residual_force import ResidualForce, task
from poise.score import Nothing
from poise.synthesis.generator import ROOT, Kinematic

#: Width of all networks of motion, windows of a step of a network of the next frame and of ours.
WIDTH, BATCH, OUR_BATCH = 128, 32, 64
#: Frames that are made, so that what looks ahead sees beyond the last one that counts.
MADE = FUTURE + 10
#: n of Algorithm 1, and motions that a control policy learns.
SEGMENTS, MOTIONS = 5, 64
#: N and N m, the most help.
LIMIT = 100.0

#: The last one is not in the tables unless it is asked for.
NETS = {
    "ERD": replace(NextFrameConfig.erd(), encoder=(WIDTH, WIDTH), decoder=(WIDTH, 100), hidden=WIDTH),
    "acLSTM": replace(NextFrameConfig.aclstm(), hidden=WIDTH),
    "next frame": replace(NextFrameConfig.egopose(), hidden=WIDTH, decoder=(WIDTH,)),
}
#: Settings of control policies. EgoPose's sees no reference.
CONTROL: dict[str, dict[str, Any]] = {
    "RFC-Explicit": {"method": "rfc-explicit"},
    "RFC-Implicit": {"method": "rfc-implicit"},
    "no residual force": {"method": "deepmimic"},
    "no additive action": {"method": "rfc-implicit", "action": "absolute"},
    "EgoPose": {"method": "deepmimic", "action": "absolute"},
}


#: What learns on top of the policy that comes with Poise.
ON_TOP: dict[str, dict[str, Any]] = {
    "universal + RFC-Implicit": {"method": "rfc-implicit"},
    "universal + no residual force": {"method": "deepmimic"},
}
#: Deviation of the noise on joints there, rad.
ON_TOP_STD = 0.02


class Trained(NamedTuple):
    """A network as a generator, and what its training took."""

    made: MotionGenerator
    steps: int
    windows: int
    seconds: float


def network(motions: Motions, name: str, seed: int, steps: int) -> Trained:
    """A network of motion after so many steps."""
    features, rng = ROOT + len(motions.hinges), torch.Generator().manual_seed(seed)
    begun = time.process_time()
    if name == "ours":
        net = make_cvae(features, CVAEConfig(decoder="cosine", hidden=WIDTH, latent=64), rng)
        net.calibrate(motions.frames.frames)
        how = CVAETraining(batch=OUR_BATCH, lr=1e-3, held=0.3)
        objective: Any = CVAEObjective(net, how, steps, motions.weights)
    else:
        net = NextFrame(features, NETS[name], rng)
        net.calibrate(motions.frames.frames)
        objective = NextFrameObjective(net, BATCH)
    trainer = InbetweenTrainer(objective, motions.frames, seed, steps, block=10, ema=0.99)
    while not trainer.done:
        trainer.iterate()
    seconds, of, windows = time.process_time() - begun, trainer.averaged.eval(), steps * BATCH
    if name != "ours":
        made: Any = NextFrames(of, motions.seeds, motions.fps, motions.bounds)  # type: ignore[arg-type]
    else:
        windows = steps * OUR_BATCH
        codes = codes_of(of, motions, 1024)  # type: ignore[arg-type]
        made = Kinematic(of, motions.seeds, motions.fps, 1.0, motions.bounds, codes)  # type: ignore[arg-type]
    return Trained(made, steps, windows, round(seconds, 1))


def continued(made: MotionGenerator, pasts: Tensor, frames: int, seed: int) -> Tensor:
    """What follows pasts `(N, p, 7 + n)`, segment after segment `(N, frames, 7 + n)`."""
    rng, parts, have = torch.Generator().manual_seed(seed), [pasts], 0
    ids = torch.arange(len(pasts))
    while have < frames:
        parts.append(made.generate(torch.cat(parts, 1)[:, -PAST:], ids, rng))
        have += parts[-1].shape[1]
    return torch.cat(parts[1:], 1)[:, :frames]


def _reference(humanoid: Humanoid, motions: Tensor, rate: float) -> Reference:
    names = [f"motion {k}" for k in range(len(motions))]
    return Reference(humanoid, list(motions.double().numpy()), rate, names)


@dataclass(frozen=True, eq=False)
class Control:
    """A control policy with its task.

    Attributes:
        make: the task for motions.
        policy: acts deterministically.
        limit: N and N m of help.
        samples: control steps that it learned from. seconds: processor time of it.
    """

    make: Callable[[Reference], Imitation]
    policy: Acts
    limit: float
    samples: int = 0
    seconds: float = 0.0


def control(name: str, seed: int, tracker: Tracker, motions: list[Tensor], samples: int) -> Control:
    """A control policy that has learned motions, by RFC's local reward, from nothing or on top of the
    policy that comes with Poise.

    Episodes begin anywhere in them and end with the root 0.1 m below the lowest of the motion.
    """
    ppo = replace(ResidualForce().ppo, minibatch=512)
    ppo = replace(ppo, std=ON_TOP_STD) if name in ON_TOP else ppo
    config = ResidualForce(
        help_limit=LIMIT, help_start=None, reward="local", done="height", expert=False, seed=seed,
        completion_bonus=False, num_envs=128, sim=tracker.config.sim, ppo=ppo,
        **(CONTROL | ON_TOP)[name],
    )  # fmt: skip
    own = task(config, tracker.humanoid)
    if name in ON_TOP:
        under = universal_task(
            tracker.config, tracker.humanoid, guided=tracker.recovery_clips is not None
        )
        own = replace(own, obs=under.obs, pd=under.pd, left=under.left, window=under.window)
    if name == "EgoPose":
        own = replace(own, obs=tuple(t for t in own.obs if not t.name.startswith("target")))

    def make(reference: Reference) -> Imitation:
        return _imitation(tracker, reference, config, own)

    names = [f"motion {k}" for k in range(len(motions))]
    rate = tracker.config.sim.control_hz
    imitation = make(Reference(tracker.humanoid, [m.numpy() for m in motions], rate, names))
    begun = time.process_time()
    env: Any = imitation.env(seed=seed, threads=1, guard=False)
    env = OnTop(env, tracker.policy) if name in ON_TOP else env
    trainer = imitation.trainer(threads=1, env=env)
    while trainer.samples < samples:
        trainer.iterate()
    trainer.env.close()
    limit = 0.0 if config.method == "deepmimic" else LIMIT
    seconds = round(time.process_time() - begun, 1)
    policy: Acts = trainer.policy()
    policy = Both(tracker.policy, policy) if name in ON_TOP else policy
    return Control(make, policy, limit, trainer.samples, seconds)


class OnTop:
    """An environment in which a policy acts already; actions are added to its own, after which those
    of the residual force follow."""

    def __init__(self, env: ImitationEnv, under: Acts):
        self.env, self.under = env, under
        self._acts = torch.empty(0)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.env, name)

    def reset(self) -> Tensor:
        """See `learn.protocols.VecEnv`."""
        obs = self.env.reset()
        self._acts = self.under.act(obs)
        return obs

    def step(self, actions: Tensor) -> EnvStep:
        """See `learn.protocols.VecEnv`."""
        made = self.env.step(added(self._acts, actions))
        self._acts = self.under.act(made.obs)
        return made


@dataclass(frozen=True, eq=False)
class Both:
    """A policy and what was learned on top of it."""

    under: Acts
    over: Acts

    def act(self, obs: Tensor) -> Tensor:
        """Actions `(N, A)`."""
        return added(self.under.act(obs), self.over.act(obs))


def added(joints: Tensor, more: Tensor) -> Tensor:
    """Actions `more (N, A)`, of which the first are added to `joints (N, n)`."""
    n = joints.shape[1]
    return torch.cat((joints + more[:, :n], more[:, n:]), 1)


def universal(tracker: Tracker) -> Control:
    """The policy that comes with Poise, without help."""
    own = universal_task(tracker.config, tracker.humanoid, guided=tracker.recovery_clips is not None)

    def make(reference: Reference) -> Imitation:
        return _imitation(tracker, reference, tracker.config, replace(own, help_by="all"))

    return Control(make, tracker.policy, 0.0)


def servos(tracker: Tracker) -> Control:
    """No policy: servos that turn joints to the motion's angles, without help."""
    config = ResidualForce(method="deepmimic", sim=tracker.config.sim)
    own = task(config, tracker.humanoid)
    return Control(
        lambda r: _imitation(tracker, r, config, own), Nothing(len(tracker.humanoid.hinges)), 0.0
    )


def _imitation(tracker: Tracker, reference: Reference, config: Any, own: Any) -> Imitation:
    # Neither clips nor the report of a fit are asked for.
    library = ClipLibrary((tracker.example,), (1.0,))
    return Imitation(library, tracker.humanoid, reference, None, config, own)  # type: ignore[arg-type]


class Done(NamedTuple):
    """What characters did `(N, f, 7 + n)`, and the mean help, N and N m."""

    qpos: Tensor
    force: float
    torque: float


def simulated(tracker: Tracker, by: Control, pasts: Tensor, futures: Tensor) -> Done:
    """Futures `(N, MADE, 7 + n)` done from how pasts `(N, p, 7 + n)` end, moving as in their last two
    frames."""
    rate = tracker.config.sim.control_hz
    reference = _reference(tracker.humanoid, torch.cat((pasts[:, -1:], futures), 1), rate)
    env = by.make(reference).env(len(pasts), auto_reset=False, threads=1, guard=False)
    every = torch.arange(len(pasts))
    env.reset_to(every, torch.zeros_like(every))
    speed = torch.stack([torch.tensor(qpos_velocity(p[-2:].numpy(), rate)[-1]) for p in pasts])
    state = env.backend.state
    env.backend.write(None, pasts[:, -1].to(state.qpos), speed.to(state.qvel))
    obs, out, helped = env.observe(), list[Tensor](), list[Tensor]()
    for _ in range(FUTURE):
        obs = env.step(by.policy.act(obs)).final_obs
        out.append(env.backend.state.qpos.clone().double())
        wrench = env.wrench
        if wrench is not None:
            norms = [x.norm(dim=-1).sum(-1).mean() for x in (wrench.force, wrench.torque)]
            helped.append(torch.stack(norms))
    env.close()
    force, torque = torch.stack(helped).mean(0).tolist() if helped else (0.0, 0.0)
    return Done(torch.stack(out, 1), round(force, 1), round(torque, 1))


def imagined(made: MotionGenerator, motions: Motions, seed: int) -> list[Tensor]:
    """Motions of n segments after pasts of the library, which a control policy learns."""
    rng = torch.Generator().manual_seed(seed)
    picks = torch.randint(len(motions.seeds), (MOTIONS,), generator=rng)
    pasts = motions.seeds[picks].clone()
    after = continued(made, pasts, SEGMENTS * FUTURE, seed)
    return list(torch.cat((pasts[:, -1:], after), 1))
