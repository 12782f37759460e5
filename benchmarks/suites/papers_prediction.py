"""Tables 1 and 2 of Residual Force Control in spirit: 2 s of future after held-out pasts, by method.

Cross holds whole subjects out, Mix every fifth clip of a class; one model learns all classes, or each
class has one of its own. The kinematic policy (ours), ERD and acLSTM learn for the same processor time;
control policies make as many control steps, a third of them where they go on from the policy that comes
with Poise. MAE is the mean over 2 s of the Euclidean distance between hinge angles, rad, FAE that of the
last frame (the paper's words; of all hinges, without the root). Beside them stand how far the root is
off, how far futures of one past are apart, and how many have fallen. "zero velocity" and "servos" are
the nulls.
"""

from __future__ import annotations

import math
import re
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from benchmarks.common.clips import SIXTY, TWINS, Places, moment
from benchmarks.common.rows import Figure, of
from benchmarks.common.runner import Part, Raws
from benchmarks.suites.papers_next_frames import (
    NextFrame,
    NextFrameConfig,
    NextFrameObjective,
    NextFrames,
)
from poise.body import BodyConfig, Humanoid
from poise.body.humanoid import make_humanoid
from poise.env import Acts, EnvStep, ImitationEnv, Reference, TaskConfig
from poise.env.generator_goal import MotionGenerator
from poise.jobs.endless.endless_training import codes_of, reach_of
from poise.jobs.endless.model import Motions, spread
from poise.jobs.library.clips import LibraryConfig
from poise.jobs.library.files import subject_of
from poise.jobs.library.folder import library_of
from poise.jobs.open import open_run
from poise.jobs.track.placement import place
from poise.jobs.tracker import Tracker
from poise.kinematics import qpos_velocity
from poise.kinematics.fit import widen
from poise.kinematics.loops import repeated
from poise.learn.checkpoint import load_checkpoint, save_checkpoint
from poise.learn.cvae import CVAEConfig, CVAEObjective, CVAETraining, PackedFrames, make_cvae
from poise.learn.inbetween_model import InbetweenTrainer
from poise.motion import ClipLibrary
from poise.papers.residual_force.dual_policy import DualPolicy, build, dual_task
from poise.recipes.imitation import Imitation
from poise.recipes.perpetual import task as universal_task
from poise.recipes.residual_force import task
from poise.recipes.residual_force_settings import ResidualForce
from poise.score import Nothing
from poise.synthesis.generator import ROOT, Kinematic, features_of

#: Frames of a past and of its future, 1 s and 2 s.
PAST, FUTURE = 30, 60


#: The most windows of a class in a split.
WINDOWS = 8


#: Every so many clips of a class, the first one included, are for Mix, none of their frames is learned.
APART = 5


class Library(NamedTuple):
    """One of the data sets: its folders in DATA, whole subjects that Cross holds out, and what a clip's
    name says is done in it, the first that fits; "other" is what none fits."""

    folders: tuple[str, ...]
    cross: tuple[str, ...]
    classes: tuple[tuple[str, str], ...]


LIBRARIES = {
    "CMU": Library(
        ("cmu_amc", "cmu_bvh"),
        ("cmu 05", "cmu 08", "cmu 11", "cmu 14", "cmu 39"),
        (
            ("dance", r"05_|salsa|indian|dance"),
            ("martial arts", r"02_0[5-9]|135_|14_|martial|punch|kick|heian|11_"),
            ("walk and run", r"(06|07|08|35|38|39|43)_|02_0[1-3]|walk|run|jog"),
        ),
    ),
    "Bandai": Library(
        ("other/bandai_bvh",),
        (),
        (
            ("turning walk", r"_walk_(turn|left|right|back)"),
            ("walk", r"_walk_"),
            ("run", r"_(run|dash)_"),
        ),
    ),
}


class Clips(NamedTuple):
    """Clips on the body: coordinates `(F, 7 + n)` of each, names."""

    qpos: list[Tensor]
    names: list[str]


class Window(NamedTuple):
    """A past `(p, 7 + n)`, what followed `(f, 7 + n)`, the class, the clip, whether its subject is held
    out."""

    past: Tensor
    true: Tensor
    kind: str
    clip: str
    cross: bool


def kind_of(name: str, library: Library) -> str:
    """The class of a clip."""
    return next((k for k, pattern in library.classes if re.search(pattern, name)), "other")


def clips_of(name: str, data: Path, work: Path, tracker: Tracker) -> Clips:
    """All clips of a library on the tracker's body; kept in `work`."""
    file = work / f"clips-{name}.safetensors"
    if not file.exists():
        how = LibraryConfig(rates=SIXTY, leave_out=TWINS)
        folders = [data / f for f in LIBRARIES[name].folders]
        library, _ = library_of(folders, tracker.target, config=how, body=BodyConfig(), tell=print)
        tensors = {c.name: torch.tensor(place(c, tracker).qpos) for c in library}
        save_checkpoint(file, tensors, {"kind": "clips"})
    tensors, _ = load_checkpoint(file)
    names = sorted(tensors)
    return Clips([tensors[n].double() for n in names], names)


def windows_of(clips: Clips, library: Library) -> tuple[list[Window], list[int]]:
    """Windows of every class in both splits, evenly spread over all there are, and the clips that are
    left to learn from."""
    groups: dict[tuple[str, bool], list[int]] = {}
    for k, name in enumerate(clips.names):
        if len(clips.qpos[k]) >= PAST + FUTURE:
            cross = subject_of(name) in library.cross
            groups.setdefault((kind_of(name, library), cross), []).append(k)
    out, held = list[Window](), set[int]()
    for (kind, cross), rows in sorted(groups.items()):
        test = rows if cross else rows[::APART]
        held |= set(test)
        every = [(k, i) for k in test for i in range(0, len(clips.qpos[k]) - PAST - FUTURE + 1, PAST)]
        for pick in spread(len(every), WINDOWS).tolist():
            k, i = every[pick]
            q = clips.qpos[k]
            past, true = q[i : i + PAST], q[i + PAST : i + PAST + FUTURE]
            out.append(Window(past, true, kind, clips.names[k], cross))
    # Neither short clips of held-out subjects are learned, nor partners of dancers that are held out.
    partners = {p for k in held for p in partners_of(clips.names[k])}
    return out, [
        k
        for k, n in enumerate(clips.names)
        if k not in held and n not in partners and subject_of(n) not in library.cross
    ]


def partners_of(name: str) -> set[str]:
    """Names of the other dancer of a salsa, whose take has a number that is 15 more or less."""
    found = re.search(r"(.*acrnn_salsa-)(\d+)$", name)
    return {f"{found[1]}{int(found[2]) + k:02d}" for k in (-15, 15)} if found else set()


def motions_of(clips: Clips, rows: Sequence[int], tracker: Tracker) -> Motions:
    """Some of the clips as networks learn them."""
    rate, qpos = tracker.config.sim.control_hz, [clips.qpos[k] for k in rows]
    frames = torch.cat([features_of(q, rate).float() for q in qpos])
    first = torch.tensor(np.cumsum([0, *(len(q) for q in qpos)]))
    pasts = [q[i : i + PAST] for q in qpos for i in range(0, len(q) - PAST, PAST)]
    angles = torch.cat(qpos)[:, 7:]
    return Motions(
        PackedFrames(frames, first),
        torch.stack(pasts),
        torch.stack((angles.amin(0), angles.amax(0))),
        reach_of(frames, tracker.humanoid.table, rate),
        tuple(tracker.humanoid.hinges),
        rate,
        tuple(clips.names[k] for k in rows),
    )


# --- methods ---------------------------------------------------------------------------------------


#: Width of all networks of motion, windows of a step of a network of the next frame and of ours.
WIDTH, BATCH, OUR_BATCH = 128, 32, 64


#: Frames that are made, so that what looks ahead sees beyond the last one that counts.
MADE = FUTURE + 10


#: N and N m, the most help.
LIMIT = 100.0


#: The last one is not in the tables unless it is asked for.
NETS = {
    "ERD": replace(NextFrameConfig.erd(), encoder=(WIDTH, WIDTH), decoder=(WIDTH, 100), hidden=WIDTH),
    "acLSTM": replace(NextFrameConfig.aclstm(), hidden=WIDTH),
    "next frame": replace(NextFrameConfig.egopose(), hidden=WIDTH, decoder=(WIDTH,)),
}


#: Settings of control policies, all by Algorithm 1 but EgoPose's, which learns recorded motion and sees
#: no reference.
CONTROL: dict[str, dict[str, Any]] = {
    "RFC-Explicit": {"method": "rfc-explicit"},
    "RFC-Implicit": {"method": "rfc-implicit"},
    "RFC-Implicit, force that fades": {"method": "rfc-implicit", "help_limit": 0.0, "help_start": LIMIT},
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
    """Motion that follows pasts `(N, p, 7 + n)`, segment after segment `(N, frames, 7 + n)`."""
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
        make: the task for motions and their z `(N, Z)`.
        policy: acts deterministically.
        limit: N and N m of help.
        samples: control steps that it learned from. seconds: processor time of it.
    """

    make: Callable[[Reference, Tensor], Imitation]
    policy: Acts
    limit: float
    samples: int = 0
    seconds: float = 0.0


def control(
    name: str, seed: int, tracker: Tracker, learned: Kinematic | list[Tensor], samples: int
) -> Control:
    """A control policy that has learned a generator by Algorithm 1, from nothing or on top of the policy
    that comes with Poise; or recorded motions, in which episodes begin anywhere. They end with the root
    0.1 m below the lowest of the motion."""
    ppo = replace(ResidualForce().ppo, minibatch=512)
    ppo = replace(ppo, std=ON_TOP_STD) if name in ON_TOP else ppo
    stated: dict[str, Any] = {"help_limit": LIMIT} | (CONTROL | ON_TOP)[name]
    config = DualPolicy(seed=seed, num_envs=128, sim=tracker.config.sim, ppo=ppo, **stated)
    body, example, rate = tracker.humanoid, tracker.example, tracker.config.sim.control_hz

    def own(z: Tensor | None) -> TaskConfig:
        if name == "EgoPose":
            plain = task(config, body)
            return replace(plain, obs=tuple(t for t in plain.obs if not t.name.startswith("target")))
        made = dual_task(config, body, FUTURE, z)
        if name not in ON_TOP:
            return made
        under = universal_task(tracker.config, body, guided=tracker.recovery_clips is not None)
        seen = {"obs": under.obs, "pd": under.pd, "left": under.left, "window": under.window}
        return replace(made, events=(), **seen)

    def make(reference: Reference, z: Tensor) -> Imitation:
        return _imitation(tracker, reference, config, own(z[:, None]))

    if isinstance(learned, list):
        names = [f"motion {k}" for k in range(len(learned))]
        imitation = make(Reference(body, [m.numpy() for m in learned], rate, names), torch.empty(0))
    else:
        imitation = replace(build(learned, body, example, config), task=own(None))
    begun = time.process_time()
    env: Any = imitation.env(seed=seed, threads=1, guard=False)
    env = OnTop(env, tracker.policy) if name in ON_TOP else env
    trainer = imitation.trainer(threads=1, env=env)
    while trainer.samples < samples:
        trainer.iterate()
    trainer.env.close()
    left = float(env.help.now) if config.method != "deepmimic" else 0.0
    seconds = round(time.process_time() - begun, 1)
    policy: Acts = trainer.policy()
    policy = Both(tracker.policy, policy) if name in ON_TOP else policy
    return Control(make, policy, LIMIT * left, trainer.samples, seconds)


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

    def make(reference: Reference, z: Tensor) -> Imitation:
        return _imitation(tracker, reference, tracker.config, replace(own, help_by="all"))

    return Control(make, tracker.policy, 0.0)


def servos(tracker: Tracker) -> Control:
    """No policy: servos that turn joints to the motion's angles, without help."""
    config = ResidualForce(method="deepmimic", sim=tracker.config.sim)
    own = task(config, tracker.humanoid)
    return Control(
        lambda r, z: _imitation(tracker, r, config, own), Nothing(len(tracker.humanoid.hinges)), 0.0
    )


def _imitation(tracker: Tracker, reference: Reference, config: Any, own: Any) -> Imitation:
    # Neither clips nor the report of a fit are asked for.
    library = ClipLibrary((tracker.example,), (1.0,))
    return Imitation(library, tracker.humanoid, reference, None, config, own)  # type: ignore[arg-type]


class Done(NamedTuple):
    """Motion of characters `(N, f, 7 + n)`, and the mean help, N and N m."""

    qpos: Tensor
    force: float
    torque: float


def simulated(tracker: Tracker, by: Control, pasts: Tensor, futures: Tensor, z: Tensor) -> Done:
    """Futures `(N, MADE, 7 + n)` with their z `(N, Z)` done from how pasts `(N, p, 7 + n)` end, moving
    as in their last two frames."""
    rate = tracker.config.sim.control_hz
    reference = _reference(tracker.humanoid, torch.cat((pasts[:, -1:], futures), 1), rate)
    env = by.make(reference, z).env(len(pasts), None, False, 1, help_scale=by.limit / LIMIT, guard=False)
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


# --- rows ------------------------------------------------------------------------------------------


#: Of methods that draw; others make one future.
SAMPLES = 10


#: Steps of a network, which take about as long as each other on one core.
STEPS = {"ours": 1_680, "ERD": 480, "acLSTM": 180, "next frame": 1_020}
#: Control steps that a control policy learns from.
CONTROL_STEPS = 98_304


#: Methods that draw nothing.
FIXED = ("zero velocity", "acLSTM", "EgoPose", "next frame")


#: m below the recorded root in the last frame, from which on a character counts as fallen.
FALLEN = 0.3


#: The dual policy, against which the others are compared.
OURS = "RFC-Implicit"


ALL = (
    "zero velocity",
    "ours",
    OURS,
    "RFC-Implicit, force that fades",
    "RFC-Explicit",
    "EgoPose",
    "ERD",
    "acLSTM",
    "no residual force",
    "no additive action",
    "servos",
    "universal policy",
    *ON_TOP,
)


OF_A_CLASS = ("ours", "ERD", "acLSTM")


class Unit(NamedTuple):
    """Fields that the rows of one model of one seed share."""

    library: str
    model: str
    seed: int


def off(windows: list[Window], qpos: Tensor, samples: int) -> np.ndarray:
    """Distances of hinge angles, rad `(W, S, f)`."""
    true = torch.stack([w.true[:, 7:] for w in windows]).repeat_interleave(samples, 0)
    return (qpos[..., 7:] - true).norm(dim=-1).unflatten(0, (len(windows), samples)).numpy()


def groups_of(windows: list[Window]) -> dict[str, list[int]]:
    """Rows of each split, and of each class."""
    groups: dict[str, list[int]] = {"all": list(range(len(windows)))}
    for k, w in enumerate(windows):
        groups.setdefault("cross" if w.cross else "mix", []).append(k)
        groups.setdefault(w.kind, []).append(k)
    return groups


def figures(windows: list[Window], far: np.ndarray) -> dict[str, dict[str, Any]]:
    """MAE and FAE of each group, of the mean and of the best sample."""
    out: dict[str, dict[str, Any]] = {}
    for name, rows in groups_of(windows).items():
        mean, last = far[rows].mean(-1), far[rows][..., -1]
        out[name] = {
            "windows": len(rows),
            "clips": len({windows[k].clip for k in rows}),
            "mae": round(float(mean.mean()), 3),
            "fae": round(float(last.mean()), 3),
            "best_mae": round(float(mean.min(-1).mean()), 3),
            "best_fae": round(float(last.min(-1).mean()), 3),
        }
    return out


def root_off(windows: list[Window], qpos: Tensor, samples: int) -> float:
    """How far roots are from the recorded ones, the mean over all frames, m."""
    true = torch.stack([w.true[:, :3] for w in windows]).repeat_interleave(samples, 0)
    return round(float((qpos[..., :3] - true).norm(dim=-1).mean()), 3)


def diversity(windows: list[Window], qpos: Tensor, samples: int) -> float | None:
    """How far futures of one past are apart, the mean over frames and pairs, rad; None of one future."""
    if samples < 2:
        return None
    each = qpos[..., 7:].unflatten(0, (len(windows), samples)).transpose(1, 2).flatten(0, 1)
    return round(float(torch.cdist(each, each).sum((1, 2)).mean()) / (samples * (samples - 1)), 3)


def fallen(windows: list[Window], qpos: Tensor, samples: int) -> float:
    """Share of the characters that end far lower than what was recorded."""
    height = torch.stack([w.true[-1, 2] for w in windows]).repeat_interleave(samples)
    return round(float((qpos[:, -1, 2] < height - FALLEN).double().mean()), 3)


class Rows:
    """Makes the rows of one unit; networks are trained when a row first asks for them."""

    def __init__(self, unit: Unit, clips: Clips, tracker: Tracker, samples: int, steps: float):
        library = LIBRARIES[unit.library]
        windows, learned = windows_of(clips, library)
        if unit.model != "all":
            windows = [w for w in windows if w.kind == unit.model]
            learned = [k for k in learned if kind_of(clips.names[k], library) == unit.model]
        self.unit, self.windows, self.tracker, self.samples = unit, windows, tracker, samples
        self.motions = motions_of(clips, learned, tracker)
        self.recorded = [clips.qpos[k] for k in learned if len(clips.qpos[k]) >= FUTURE]
        self.network: Callable[[str], Trained] = cache(
            lambda name: network(self.motions, name, unit.seed, max(1, round(steps * STEPS[name])))
        )
        self.futures: Callable[[str], Tensor] = cache(self._futures)

    def _pasts(self, method: str) -> Tensor:
        count = 1 if method in FIXED else SAMPLES
        return torch.stack([w.past for w in self.windows]).repeat_interleave(count, 0)

    def _futures(self, method: str) -> Tensor:
        pasts = self._pasts(method)
        if method in ("zero velocity", "EgoPose"):
            # EgoPose's policy does not see it.
            return pasts[:, -1:].expand(-1, MADE, -1)
        return continued(self.network(method).made, pasts, MADE, self.unit.seed)

    def _latents(self, pasts: Tensor) -> Tensor:
        """z `(N, Z)` of the futures that `ours` makes of pasts."""
        made = self.network("ours").made
        assert isinstance(made, Kinematic)
        kept, rng = made.remembering(len(pasts)), torch.Generator().manual_seed(self.unit.seed)
        kept.generate(pasts, torch.arange(len(pasts)), rng)
        assert kept.latent is not None
        return kept.latent

    def row(self, method: str) -> tuple[dict[str, Any], np.ndarray]:
        """A row, and its distances `(W, S, f)`."""
        about: dict[str, Any] = {"method": method, **self.unit._asdict()}
        networks = method == "ours" or method in STEPS
        if networks or method == "zero velocity":
            qpos = self.futures(method)[:, :FUTURE]
            about |= {"body": False}
            if networks:
                made = self.network(method)
                about |= {"steps": made.steps, "windows": made.windows, "seconds": made.seconds}
        else:
            by = self._control(method)
            source = "EgoPose" if method == "EgoPose" else "ours"
            pasts = self._pasts(source)
            z = torch.empty(0) if source == "EgoPose" else self._latents(pasts)
            done = simulated(self.tracker, by, pasts, self.futures(source), z)
            qpos = done.qpos
            about |= {
                "body": True,
                "help_limit": by.limit,
                "help_n": done.force,
                "help_nm": done.torque,
                "control_steps": by.samples,
                "seconds": by.seconds,
            }
        count = len(qpos) // len(self.windows)
        about |= {"samples": count, "fallen": fallen(self.windows, qpos, count)}
        about["root_m"] = root_off(self.windows, qpos, count)
        about["diversity_rad"] = diversity(self.windows, qpos, count)
        far = off(self.windows, qpos, count)
        return about | {"groups": figures(self.windows, far)}, far

    def _control(self, method: str) -> Control:
        if method == "servos":
            return servos(self.tracker)
        if method == "universal policy":
            return universal(self.tracker)
        learned: Any = self.recorded if method == "EgoPose" else self.network("ours").made
        samples = self.samples // 3 if method in ON_TOP else self.samples
        return control(method, self.unit.seed, self.tracker, learned, samples)


@cache
def windows_and_clips(places: Places, library: str) -> tuple[Clips, Tracker]:
    """The clips of a library, and the tracker on a body whose hinges go as far as they do."""
    plain = open_run(None).tracker
    if places.smoke:
        long = torch.tensor(place(repeated(moment(seconds=2.0), 1, 3), plain).qpos).double()
        names = [
            "toy-01_walk",
            "toy-02_walk",
            "toy-05_walk",
            "toy-06_walk",
            "toy-07_walk",
            "toy-10_walk",
        ]
        clips = Clips([long] * len(names), names)
    else:
        clips = clips_of(library, places.data, places.work, plain)
    table, _ = widen(plain.humanoid.table, [q.numpy() for q in clips.qpos], 0.0)
    body = make_humanoid(plain.humanoid.skeleton, table)
    return clips, Tracker(**(vars(plain) | {"humanoid": body}))


def held_out_windows(places: Places, tracker: Tracker) -> list[Window]:
    """Pasts and futures of both libraries, for whoever predicts."""
    names = list(LIBRARIES)[: 1 if places.smoke else None]
    return [w for n in names for w in windows_of(windows_and_clips(places, n)[0], LIBRARIES[n])[0]]


@cache
def rows_of(places: Places, unit: Unit) -> Rows:
    """The rows of one model of one seed, which share networks in a process."""
    clips, tracker = windows_and_clips(places, unit.library)
    return Rows(unit, clips, tracker, *((128, 0.002) if places.smoke else (CONTROL_STEPS, 1.0)))


def units(places: Places) -> list[str]:
    """Libraries, models, seeds and methods."""
    if places.smoke:
        return [f"CMU/all/0/{m}" for m in ("zero velocity", "ERD", OURS)]
    out = []
    for library in LIBRARIES:
        for seed in (0, 1):
            out += [f"{library}/all/{seed}/{m}" for m in ALL]
            out += [
                f"{library}/{k}/{seed}/{m}" for k, _ in LIBRARIES[library].classes for m in OF_A_CLASS
            ]
    return out


def predicted(places: Places, unit: str) -> Any:
    """A row, with the mean distance of each clip."""
    library, model, seed, method = unit.split("/")
    rows = rows_of(places, Unit(library, model, int(seed)))
    row, far = rows.row(method)
    by_clip: dict[str, list[float]] = {}
    for w, distance in zip(rows.windows, far.mean((1, 2)), strict=True):
        by_clip.setdefault(w.clip, []).append(float(distance))
    return row | {"by_clip": {k: float(np.mean(v)) for k, v in by_clip.items()}}


def predicted_rows(places: Places, raws: Raws) -> Iterator[Figure]:
    """Every row, by split too, and how much farther off each method is than the dual policy, by means of
    clips over all seeds, with the standard error over clips."""
    table = "Residual Force Control, Tables 1 and 2"
    for unit, r in raws.items():
        policy = f"{r['method']} (trained for this table)"
        for split in ("all", "cross", "mix"):
            if own := r["groups"].get(split):
                values = {"mae_rad": own["mae"], "fae_rad": own["fae"], "best_mae_rad": own["best_mae"]}
                if split == "all":
                    told = ("fallen", "help_n", "root_m", "diversity_rad")
                    values |= {k: r.get(k) for k in told}
                    values["samples"] = r.get("control_steps") or None
                subject = f"{table}; {unit}" if split == "all" else f"{table}; {unit}, {split}"
                yield from of(subject, values, own["windows"], policy=policy)
    for library in dict.fromkeys(u.partition("/")[0] for u in raws):
        every = {u: r for u, r in raws.items() if u.startswith(f"{library}/all/")}
        for method in dict.fromkeys(r["method"] for r in every.values()):
            gaps: dict[str, list[float]] = {}
            for r in (r for r in every.values() if r["method"] == method != OURS):
                ours = every.get(f"{library}/all/{r['seed']}/{OURS}", {"by_clip": {}})["by_clip"]
                for clip, value in r["by_clip"].items():
                    if clip in ours:
                        gaps.setdefault(clip, []).append(value - ours[clip])
            means = np.array([np.mean(v) for v in gaps.values()])
            if len(means) > 1:
                error = float(means.std(ddof=1)) / math.sqrt(len(means))
                yield Figure(
                    f"{table}; {library}, {method} beside {OURS}",
                    "mae_more_rad",
                    float(means.mean()),
                    len(means),
                    f"+- {error:.3f}",
                    policy=f"{method} (trained for this table)",
                )


PARTS = {
    "prediction": Part(
        "Tables 1 and 2 of Residual Force Control", units, predicted, predicted_rows, hours=6.0
    )
}
